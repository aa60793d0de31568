"""Names of one thing are one thing, and names of different things are not."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax import labels
from tdanet_jax.io import assets
from tdanet_jax.labels import LabelError, Labels
from tdanet_jax.vocabulary import class_words
from tdanet_jax.words import WordVectors

CLASSES = tuple(
    sorted(name.decode() for name in np.load(assets.path("ithor.npz"))["class_name"].tolist())
)
_COCO = (
    "person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, "
    "fire hydrant, stop sign, parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, "
    "bear, zebra, giraffe, backpack, umbrella, handbag, tie, suitcase, frisbee, skis, snowboard, "
    "sports ball, kite, baseball bat, baseball glove, skateboard, surfboard, tennis racket, "
    "bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple, sandwich, orange, broccoli, "
    "carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed, dining table, toilet, "
    "tv, laptop, mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink, "
    "refrigerator, book, clock, vase, scissors, teddy bear, hair drier, toothbrush"
)
COCO = _COCO.split(", ")
#: Those that are called otherwise in AI2-THOR.
COCO_CLASSES = {
    "couch": "Sofa", "potted plant": "HousePlant", "tv": "Television", "remote": "RemoteControl",
    "refrigerator": "Fridge",
}  # fmt: skip


@pytest.fixture(scope="module")
def of_agents(glove: WordVectors) -> Labels:
    """Labels as an agent of the bundled rooms takes them."""
    return Labels(CLASSES, glove.index)


def test_every_name_of_coco_is_accepted(of_agents: Labels, glove: WordVectors) -> None:
    assert len(set(COCO)) == 80
    assert sum(labels.ai2thor_class(label) is not None for label in COCO) == 26  # as the docs say
    own = {"".join(class_words(name)): name for name in CLASSES}
    for label in COCO:
        meaning = of_agents.resolve(label)
        assert glove.embed(meaning).shape == (50,)
        expected = COCO_CLASSES.get(label) or own.get("".join(class_words(label)))
        if expected is not None or meaning in CLASSES:
            assert meaning == expected
        elif label != "hair drier":
            assert meaning == label


def test_letters_lose_their_accents() -> None:
    for label, words in (("café table", ("cafe", "table")), ("Tür", ("tur",))):
        assert class_words(label) == words


def spellings(name: str) -> list[str]:
    words = class_words(name)
    plain = [
        name.upper(), name.lower(), " ".join(words), "_".join(words), "-".join(words).upper(),
        f"{name}_1", f"{name}2", f"{name} #12", f"{' '.join(words)} 3", f"{name}_3fd12c08",
        f"{name}|+00.12|+01.02|-01.50", f"{' '.join(words)} (household)",
    ]  # fmt: skip
    return plain if name.endswith("s") else [*plain, f"{name}s", f"{' '.join(words)}s_4"]


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_is_itself_however_it_is_written(of_agents: Labels, name: str) -> None:
    assert {labels.ai2thor_class(label) for label in spellings(name)} == {name}
    for labels_ in (of_agents, Labels()):
        assert {labels_.find(label) for label in (name, *spellings(name))} == {name}


@pytest.mark.parametrize(
    ("label", "meaning"),
    [
        ("Television set", "Television"), ("tvmonitor", "Television"), ("TV_sets", "Television"),
        ("Kitchen & dining room table", "DiningTable"), ("diningtable", "DiningTable"),
        ("cupboards", "Cabinet"), ("knives", "Knife"), ("Shelves", "Shelf"), ("boxes", "Box"),
        ("potatoes", "Potato"), ("Boot", "Boots"), ("window blind", "Blinds"),
        ("curtain", "Curtains"),
        ("Picture frame", "Painting"), ("tap", "Faucet"), ("Coffeemaker", "CoffeeMachine"),
        ("Waste container", "GarbageCan"), ("trash can/garbage can/wastebin", "GarbageCan"),
        ("pan_(for_cooking)", "Pan"), ("toilet tissue", "ToiletPaper"), ("soap", "SoapBar"),
        ("chest of drawers", "Dresser"), ("smart phone", "CellPhone"), ("cellphones", "CellPhone"),
        ("aerosol thing/couch", "Sofa"),
    ],
)  # fmt: skip
def test_names_of_the_same_thing(of_agents: Labels, label: str, meaning: str) -> None:
    assert of_agents.resolve(label) == Labels().find(label) == meaning
    assert of_agents.same(label, meaning)


@pytest.mark.parametrize(
    "label",
    ["clock", "cushion", "oven", "wine glass", "lamp", "table", "saucepan", "sports ball", "tape",
     "glasses", "glass", "plant", "mouse", "computer monitor", "phone", "control", "bath mat",
     "bookcase", "tube", "plane", "cape", "television camera", "toilet seat", "dog bowl"],
)  # fmt: skip
def test_names_of_other_things_are_no_class(of_agents: Labels, label: str) -> None:
    assert of_agents.resolve(label) not in CLASSES
    assert labels.ai2thor_class(label) is None


def test_the_bundled_table() -> None:
    table = labels.bundled()
    assert set(CLASSES) == {name for name in table if name[0].isupper()}
    names = [name for head, others in table.items() for name in (head, *others)]
    keys = ["".join(class_words(name)) for name in names]
    assert len(set(keys)) == len(keys)
    assert labels.names_in(assets.path(labels.ASSET)) == names


def test_the_bundled_names_that_others_mean_have_vectors(glove: WordVectors) -> None:
    assert not glove.missing(labels.bundled())


@pytest.mark.parametrize("label", ["ferret", "wooden spoon", "AK47 rifle", "cd player", "iphones"])
def test_other_labels_are_their_words(glove: WordVectors, label: str) -> None:
    found = Labels(CLASSES, glove.index)
    known = WordVectors(dict.fromkeys(class_words(label), 0) | glove.index, glove.vectors)
    assert Labels(CLASSES, known.index).resolve(label) == " ".join(class_words(label))
    assert found.find(label) is None


@pytest.mark.parametrize(
    ("label", "words"),
    [("lampstand", "lamp stand"), ("ToothbrushHolders_2", "toothbrush holders"),
     ("teddyears", None), ("birdcages", None), ("raincoat", "rain coat")],
)  # fmt: skip
def test_a_word_without_a_vector_is_split_into_two(
    of_agents: Labels, label: str, words: str | None
) -> None:
    if words is None:
        with pytest.raises(LabelError, match=f"label '{label}': no word vector for {label}"):
            of_agents.resolve(label)
    else:
        assert of_agents.resolve(label) == words


@pytest.mark.parametrize(
    ("label", "message"),
    [
        (
            "qwertzu",
            "label 'qwertzu': no word vector for qwertzu (agent.add_words adds words, synonyms add",
        ),
        (
            "televison",
            "label 'televison': no word vector for televison; did you mean Television?",
        ),
        (
            "big mikrowave",
            "label 'big mikrowave': no word vector for mikrowave; did you mean Micro",
        ),
        ("", "label '': has no words"),
        ("??\n", r"label '??\n': has no words"),
    ],
)
def test_what_means_nothing_is_an_error_in_one_line(
    of_agents: Labels, label: str, message: str
) -> None:
    with pytest.raises(KeyError, match=re.escape(message)) as caught:
        of_agents.resolve(label)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_classes_of_other_rooms_win_over_the_bundled_names() -> None:
    mine = Labels(["Couch", "TV", "TableTop", "tabletop", "Box2"])
    assert [mine.find(label) for label in ("sofa", "Sofas", "television", "couch_1", "TVs")] == [
        "Couch", "Couch", "TV", "Couch", "TV",
    ]  # fmt: skip
    assert [mine.find(label) for label in ("TableTop", "tabletop", "table-top")] == [
        "TableTop", "tabletop", "tabletop",
    ]  # fmt: skip
    assert [mine.find(label) for label in ("Box2", "box 2", "Box")] == ["Box2", "Box2", "Box"]
    both = Labels(["Couch", "Sofa"])
    assert (both.find("couch"), both.find("sofa"), both.find("settee")) == ("Couch", "Sofa", "Sofa")


def test_of_several_names_the_one_with_a_vector_stands_for_all() -> None:
    small = Labels((), {"tv": 0, "couch": 1})
    assert small.resolve("Television set") == small.resolve("TV") == "tv"
    with pytest.raises(LabelError, match="no word vector for fridge"):
        small.resolve("fridge")


def test_a_table_of_ones_own(tmp_path: Path, glove: WordVectors) -> None:
    path = tmp_path / "mine.json"
    table = {"tv": ["goggle box"], "Mug": ["Cup", "beaker"], "garden chair": ["Gartenstuhl"]}
    path.write_text(json.dumps(table))
    for given in (table, path, str(path)):
        mine = Labels(CLASSES, glove.index, given)
        assert mine.resolve("goggle_boxes") == "Television"
        assert [mine.resolve(x) for x in ("Cup", "cups", "Beaker_2", "Mug")] == ["Mug"] * 4
        assert mine.resolve("Gartenstuhl") == "garden chair"
        assert mine.same("Cup", "mug 7")
        assert mine.resolve("couch") == "Sofa"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ([], "not a JSON object"),
        ({"Mug": "beaker"}, "Mug: not a list of names"),
        ({"Mug": ["beaker", 3]}, "Mug: 3 is not a name"),
        ({"Mug": ["?!"]}, "Mug: '?!' is not a name"),
        ({"": ["beaker"]}, "'': not a name"),
        ({"Mug": ["beaker"], "Cup": ["Beaker"]}, "Cup: Beaker is listed under another name, too"),
        ({"qwertzu": ["beaker"]}, "label 'qwertzu': no word vector for qwertzu"),
        ('{"Mug": [], "Mug": []}', "Mug: is listed twice"),
        ("{", "not JSON"),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(
    tmp_path: Path, glove: WordVectors, table: Any, message: str
) -> None:
    path = tmp_path / "mine.json"
    path.write_text(table if isinstance(table, str) else json.dumps(table))
    with pytest.raises(ValueError, match=f"^{re.escape(f'{path}: {message}')}") as caught:
        Labels(CLASSES, glove.index, path)
    assert "\n" not in str(caught.value)
    if not isinstance(table, str):
        given = "must map each name" if table == [] else message
        with pytest.raises(ValueError, match=f"^synonyms: {re.escape(given)}"):
            Labels(CLASSES, glove.index, table)


def test_a_table_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.json: no such file"):
        Labels(synonyms=tmp_path / "none.json")
