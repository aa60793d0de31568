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
    assert rates["Random"]["seen"] == {
        "L>=1": {"SR": 9.5, "SPL": 3.3}, "L>=5": {"SR": 1.0, "SPL": 0.4}
    }  # fmt: skip
    assert rates["TDANet"]["unseen"]["L>=5"] == {"SR": 47.4, "SPL": 23.8}
    assert rates["TDANet without SA"] == {
        "seen": {"L>=1": {"SR": 63.3, "SPL": 20.0}}, "unseen": {"L>=1": {"SR": 14.2, "SPL": 2.1}}
    }  # fmt: skip
    assert paper.rates("14/8")["SSNet"]["seen"]["L>=1"] == {"SR": 59.3, "SPL": 24.5}
    assert paper.rates("22/0")["Li et al."] == {
        "seen": {"L>=1": {"SR": 71.0, "SPL": 19.6}, "L>=5": {"SR": 61.9, "SPL": 24.2}}
    }  # fmt: skip
    assert paper.rates("open") == {}
    assert [len(paper.rates(split)) for split in ("22/0", "18/4", "14/8")] == [13, 8, 5]


def test_only_modules_that_say_that_the_worlds_differ_show_the_rates():
    package = Path(paper.__file__).parents[1]
    for path in package.rglob("*.py"):
        text = path.read_text()
        if path.name != "paper.py" and "paper.rates(" in text:
            assert "paper.worlds(" in text, path
