"""Zero-shot splits: which rooms and target classes are for training, and which for evaluation.

Sources: the splits of MJOLNIR (Qiu et al. 2020), SSNet (Zhao et al. 2023) and TDANet (Lian and
Zhang 2024).
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Any

from tdanet_jax.io import assets
from tdanet_jax.labels import Labels
from tdanet_jax.vocabulary import ALL_TARGETS, ROOM_TYPES, TARGETS, class_words

#: Scene numbers of each room type, in AI2-THOR's numbering; the first 20 train, the last 10 test.
SCENE_NUMBERS = {
    "kitchen": range(1, 31),
    "living_room": range(201, 231),
    "bedroom": range(301, 331),
    "bathroom": range(401, 431),
}
#: Room type of each iTHOR room.
ITHOR_ROOMS = {f"FloorPlan{n}": room for room, numbers in SCENE_NUMBERS.items() for n in numbers}
TRAIN_SCENES_PER_TYPE = 20
#: What the name of a split ends with in a run with `--validation`.
OF_VALIDATION = "-validation"
#: `--validation` trains on the first 16 training rooms of a type and evaluates on the last 4.
VALIDATION_TRAIN_SCENES_PER_TYPE = 16

#: The parts of a split that a room can belong to.
PARTS = ("train", "test")

#: Groups of test episodes: their target was a target in training, or was not.
GROUPS = ("seen", "unseen")
#: Classes that are never a target in training, by split (seen/unseen) and room type.
UNSEEN: dict[str, dict[str, tuple[str, ...]]] = {
    "22/0": dict.fromkeys(ROOM_TYPES, ()),
    "18/4": {
        "kitchen": ("Toaster",),
        "living_room": ("Laptop",),
        "bedroom": ("Pillow",),
        "bathroom": ("ToiletPaper",),
    },
    "14/8": {
        "kitchen": ("Apple", "Toaster"),
        "living_room": ("Television", "Laptop"),
        "bedroom": ("AlarmClock", "Pillow"),
        "bathroom": ("ToiletPaper", "Mirror"),
    },
}
#: The seen class of each room type that `--validation` holds out in place of the unseen ones; where
#: the split hides it already, the first class of the room type that is not hidden.
VALIDATION_UNSEEN = {
    "kitchen": ("Bread",),
    "living_room": ("RemoteControl",),
    "bedroom": ("DeskLamp",),
    "bathroom": ("SoapBar",),
}


#: The open-vocabulary benchmark: it has targets of its own.
OPEN, OPEN_ASSET = "open", "open.json"
#: The splits that have names.
NAMED = (*UNSEEN, OPEN)


@cache
def open_classes() -> dict[str, Any]:
    """The open benchmark's "targets" by room type, "unseen" classes, and those of "validation"."""
    content = json.loads(assets.path(OPEN_ASSET).read_text(encoding="utf-8"))
    targets = {room: tuple(names) for room, names in content["targets"].items()}
    return {**content, "targets": targets}


@dataclasses.dataclass(frozen=True)
class Split:
    """Rooms and target classes for training, and for evaluation as seen and as unseen.

    Attributes:
      name: "18/4", "Mug,Vase", "open", or "18/4-validation".
      train_scenes, eval_scenes: scene names such as "FloorPlan1".
      hidden: classes that training must know nothing of.
      seen: room type -> target classes of training.
      unseen: room type -> target classes evaluated as unseen; a subset of `hidden`.
    """

    name: str
    train_scenes: tuple[str, ...]
    eval_scenes: tuple[str, ...]
    hidden: frozenset[str]
    seen: dict[str, tuple[str, ...]]
    unseen: dict[str, tuple[str, ...]]

    @property
    def is_open(self) -> bool:
        """Whether it is the open-vocabulary benchmark, or its validation."""
        return is_open(self.name)

    def within(self, scenes: Collection[str], classes: Collection[str]) -> Split:
        """The split restricted to these scenes and classes.

        Raises:
          ValueError: no room for training, or none for evaluation, is left.
        """
        train = tuple(name for name in self.train_scenes if name in scenes)
        evaluated = tuple(name for name in self.eval_scenes if name in scenes)
        if evaluated and not train and self.name.endswith(OF_VALIDATION):
            raise ValueError(
                "--validation: needs two training rooms of a type, to evaluate in one of them"
            )
        for title, left in (("training", train), ("evaluation", evaluated)):
            if not left:
                raise ValueError(
                    f"none of the {title} rooms of split {self.name} (by iTHOR's names, or by "
                    f'"split" in a scene file) is among the {len(scenes)} rooms'
                )

        def present(targets: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
            return {
                room: tuple(c for c in names if c in classes) for room, names in targets.items()
            }

        return dataclasses.replace(
            self,
            train_scenes=train,
            eval_scenes=evaluated,
            hidden=frozenset(self.hidden & set(classes)),
            seen=present(self.seen),
            unseen=present(self.unseen),
        )


def make_split(
    text: str, validation: bool = False, targets: Mapping[str, tuple[str, ...]] | None = None
) -> Split:
    """The split with a name, or the custom one that leaves these classes out (see `split_name`).

    With `validation`, neither test rooms nor unseen classes are used: the last 4 training rooms of
    each type are for evaluation, and one of the seen classes of each type is held out as well.

    Args:
      targets: room type -> target classes; `dataset.find_targets` makes them of `--targets`. None:
        those of the paper, or of the open benchmark.

    Raises:
      ValueError: `text` is not a split, or leaves no class for training in some room type.
    """
    if targets is None:
        targets = open_classes()["targets"] if text == OPEN else TARGETS
    every = in_order(c for names in targets.values() for c in names)
    name = split_name(text, every)
    missing = unseen_classes(name)
    first = VALIDATION_TRAIN_SCENES_PER_TYPE if validation else TRAIN_SCENES_PER_TYPE
    last = TRAIN_SCENES_PER_TYPE if validation else None
    train, evaluated = [], []
    for room in ROOM_TYPES:
        names = [f"FloorPlan{n}" for n in SCENE_NUMBERS[room]]
        train += names[:first]
        evaluated += names[first:last]
    unseen = missing
    if validation:
        own = name == OPEN
        unseen = tuple(open_classes()["validation"]) if own else _held_out(targets, missing)
    hidden = {*missing, *unseen}
    seen = {room: tuple(c for c in names if c not in hidden) for room, names in targets.items()}
    if empty := [room for room in ROOM_TYPES if targets.get(room) and not seen[room]]:
        besides = " besides the one that --validation holds out" if validation else ""
        raise ValueError(
            f"--split {text}: leaves no class to train on in {', '.join(empty)}{besides}"
        )
    return Split(
        name=f"{name}{OF_VALIDATION}" if validation else name,
        train_scenes=tuple(train),
        eval_scenes=tuple(evaluated),
        hidden=frozenset(hidden),
        seen=seen,
        unseen={room: tuple(c for c in unseen if c in names) for room, names in targets.items()},
    )


def split_name(text: str, targets: Collection[str] | None = ALL_TARGETS) -> str:
    """The canonical name of the split that `text` describes.

    Args:
      text: "22/0", "18/4", "14/8" or "open"; or the unseen classes in any order, separated by
        commas: "vase,Mug" is "Mug,Vase", and the four classes of 18/4 are "18/4".
      targets: the classes that may be unseen; None: any, as long as the rooms are not known.

    Raises:
      ValueError: it describes none; the message says why.
    """
    if text in NAMED:
        return text
    named = [_target_class(word, text, targets) for word in text.split(",")]
    if twice := [name for name in named if named.count(name) > 1]:
        raise ValueError(f"--split {text}: {twice[0]} is given twice")
    for name in UNSEEN:
        if set(named) == {*unseen_classes(name)}:
            return name
    return ",".join(in_order(named))


def unseen_classes(name: str) -> tuple[str, ...]:
    """The classes that the split with this canonical name leaves out of training."""
    if name in UNSEEN:
        return tuple(c for room in ROOM_TYPES for c in UNSEEN[name][room])
    if name == OPEN:
        return tuple(open_classes()["unseen"])
    return tuple(name.split(","))


def is_open(name: str) -> bool:
    """Whether a split with this name is the open-vocabulary benchmark, or its validation."""
    return name.removesuffix(OF_VALIDATION) == OPEN


def in_order(classes: Iterable[str]) -> tuple[str, ...]:
    """The different classes among these: the paper's targets in its order, then the others."""
    names = set(classes)
    return (*(c for c in ALL_TARGETS if c in names), *sorted(names - {*ALL_TARGETS}))


def known_type(name: str) -> str:
    """iTHOR's room type that a name has the words of, as LivingRoom has; otherwise the name."""
    same = (known for known in ROOM_TYPES if class_words(known) == class_words(name))
    return next(same, name)


def file_name(split: str) -> str:
    """A split's name for use in a file name: 18-4, Mug-Vase-validation."""
    return split.replace("/", "-").replace(",", "-")


def _target_class(word: str, text: str, targets: Collection[str] | None) -> str:
    """The target class that `word` means."""
    word = word.strip()
    name = labels_of(tuple(targets or ())).find(word)
    if targets is None:
        if name is not None and name[0].isupper():
            return name
        if word and is_plain(word):
            return word
        targets = ALL_TARGETS
    elif name is not None and name in targets:
        return name
    keys = {"".join(class_words(name)): name for name in targets}
    key = "".join(class_words(word))
    if not key and "," in text:
        raise ValueError(f"--split {text}: a comma without a class on both sides")
    if near := difflib.get_close_matches(key, keys, n=1):
        raise ValueError(
            f"--split {text}: no target is called {word}; did you mean {keys[near[0]]}?"
        )
    problem = "" if word == text else f"no target is called {word}; "
    raise ValueError(
        f"--split {text}: {problem}choose one of {', '.join(NAMED)}, or name the unseen classes, "
        f"separated by commas, among {', '.join(targets)}"
    )


@cache
def labels_of(classes: tuple[str, ...]) -> Labels:
    """What labels mean among these classes."""
    return Labels(classes)


def is_plain(name: str) -> bool:
    """Whether a class can be a target: targets are given in lists, and become names of files."""
    return name.isprintable() and name == name.strip() and not set(name) & set(",;:/\\")


def _held_out(targets: Mapping[str, tuple[str, ...]], missing: Collection[str]) -> tuple[str, ...]:
    """The classes that validation holds out: one of each of iTHOR's room types.

    In rooms of other types alone, one of each of those. It is a class without which every room type
    still has one to train on. If there is none, nothing is held out in a room type that has all of
    its targets; in another, its last one is, and `make_split` refuses the split.
    """
    held: list[str] = []
    rooms = [room for room in ROOM_TYPES if targets.get(room)] or [*targets]
    for room in rooms:
        order = (*VALIDATION_UNSEEN.get(room, ()), *targets[room])
        left = [c for c in order if c in targets[room] and c not in {*missing, *held}]
        without = ({*missing, *held, c} for c in left)
        spared = [
            c
            for c, hidden in zip(left, without, strict=True)
            if all(set(targets[other]) - hidden for other in rooms if targets[other])
        ]
        held += (spared or (left if {*missing} & {*targets[room]} else []))[:1]
    return tuple(held)
