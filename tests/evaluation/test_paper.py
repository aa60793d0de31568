"""The paper's figures: their shape, and that nothing shows them without saying what they are."""

from pathlib import Path

from tdanet_jax.evaluation import paper
from tdanet_jax.evaluation.metrics import BUCKETS
from tdanet_jax.splits import UNSEEN


def test_rates_are_percentages_of_known_splits_groups_and_buckets():
    for rate in paper.RATES:
        assert rate.split in UNSEEN
        assert rate.group in ("seen", "unseen")
        assert rate.bucket in BUCKETS
        assert 0 <= rate.spl <= rate.sr <= 100
    assert len({rate[:4] for rate in paper.RATES}) == len(paper.RATES)


def test_the_rates_of_a_split_come_by_agent_group_and_bucket():
    rates = paper.rates("18/4")
    assert rates["Random"] == {"seen": {"L>=1": {"SR": 11.2, "SPL": 5.1}}}
    assert rates["TDANet"]["unseen"] == {"L>=1": {"SR": 62.5, "SPL": 25.3}}
    assert paper.rates("22/0") == {}


def test_only_modules_that_say_that_the_worlds_differ_show_the_rates():
    package = Path(paper.__file__).parents[1]
    for path in package.rglob("*.py"):
        text = path.read_text()
        if path.name != "paper.py" and "paper.rates(" in text:
            assert "paper.worlds(" in text, path
