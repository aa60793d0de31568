"""What `--targets` may say, and that it is said in one way."""

from __future__ import annotations

import re

import pytest

from tdanet_jax import config as configs
from tdanet_jax import targets
from tdanet_jax.config import TrainConfig
from tdanet_jax.vocabulary import ALL_TARGETS


@pytest.mark.parametrize(
    ("text", "parsed", "canonical"),
    [
        ("all", {"": ("all",)}, "all"),
        ("kettle, mugs,Book", {"": ("Kettle", "Mug", "Book")}, "Mug,Book,Kettle"),
        (
            "LivingRoom: tv; kitchen:Kettle,  Mug",
            {"living_room": ("Television",), "kitchen": ("Kettle", "Mug")},
            "kitchen: Mug,Kettle; living_room: Television",
        ),
        ("Mug; workshop: all", {"": ("Mug",), "workshop": ("all",)}, "Mug; workshop: all"),
        ("Lathe of mine", {"": ("Lathe of mine",)}, "Lathe of mine"),
    ],
)
def test_targets_in_words(text: str, parsed: dict[str, tuple[str, ...]], canonical: str) -> None:
    assert targets.parse(text) == parsed
    assert targets.canonical(text) == targets.canonical(canonical) == canonical
    config = TrainConfig(targets=text, extra_targets=text, data="rooms.npz").normalised()
    assert config.targets == config.extra_targets == canonical
    assert configs.from_json(configs.to_json(config)) == config


def test_a_run_of_before_there_were_targets_looks_for_the_papers() -> None:
    values = configs.to_json(TrainConfig())
    del values["targets"], values["extra_targets"]
    assert configs.from_json(values) == TrainConfig()
    assert targets.known_classes("paper", None) == ALL_TARGETS


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"targets": ""}, "--targets : a name is missing; give paper, all, or classes such as"),
        ({"targets": "Mug,,Book"}, "--targets Mug,,Book: a name is missing"),
        ({"targets": "kitchen:"}, "--targets kitchen:: a name is missing"),
        ({"targets": ":Mug"}, "--targets :Mug: a name is missing"),
        ({"targets": "mug,Mugs"}, "--targets mug,Mugs: Mug is given twice"),
        ({"targets": "kitchen:Mug;kitchen:Book"}, "room type kitchen is given twice"),
        ({"targets": "Mug;Book"}, "the list for every room type is given twice"),
        ({"targets": "my\\mug"}, "--targets my\\mug: 'my\\\\mug' is not the name of a class"),
        ({"targets": "Ketle"}, "--targets Ketle: no class of these rooms; did you mean Kettle?"),
        ({"extra_targets": "Ketle"}, "--extra-targets Ketle: no class of these rooms; did you"),
        ({"extra_targets": "Mug,,"}, "--extra-targets Mug,,: a name is missing"),
        ({"targets": "Kettle,Mug", "split": "Vase"}, "--split Vase: choose one of 22/0,"),
        ({"targets": "all", "split": "Ketle"}, "--split Ketle: no target is called Ketle; did you "
                                               "mean Kettle?"),
    ],
)  # fmt: skip
def test_what_names_no_targets_is_refused_in_one_line(flags: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        TrainConfig(**flags).check()  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("flags", "split"),
    [
        ({"targets": "kettle,mug,Book", "split": "kettles"}, "Kettle"),
        ({"targets": "all", "split": "Kettle, tv"}, "Television,Kettle"),
        ({"data": "rooms.npz", "split": "lathe"}, "lathe"),  # the rooms will say what it is
    ],
)
def test_any_target_can_be_unseen(flags: dict[str, str], split: str) -> None:
    config = TrainConfig(**flags)  # type: ignore[arg-type]
    config.check()
    assert config.normalised().split == split
