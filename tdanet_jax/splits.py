"""Zero-shot splits: which rooms and target classes are for training, and which for evaluation.

Sources: the splits of MJOLNIR (Qiu et al. 2020), SSNet (Zhao et al. 2023) and TDANet (Lian and
Zhang 2024).
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection

from tdanet_jax.labels import ai2thor_class
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


@dataclasses.dataclass(frozen=True)
class Split:
    """Rooms and target classes for training, and for evaluation as seen and as unseen.

    Attributes:
      name: "18/4", "Mug,Vase", or "18/4-validation".
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

    def within(self, scenes: Collection[str], classes: Collection[str]) -> Split:
        """The split restricted to these scenes and classes.

        Raises:
          ValueError: no room for training, or none for evaluation, is left.
        """
        train = tuple(name for name in self.train_scenes if name in scenes)
        evaluated = tuple(name for name in self.eval_scenes if name in scenes)
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


def make_split(text: str, validation: bool = False) -> Split:
    """The split with a name, or the custom one that leaves these classes out (see `split_name`).

    With `validation`, neither test rooms nor unseen classes are used: the last 4 training rooms of
    each type are for evaluation, and one of the seen classes of each type is held out as well.

    Raises:
      ValueError: `text` is not a split, or leaves no class for training in some room type.
    """
    name = split_name(text)
    missing = unseen_classes(name)
    first = VALIDATION_TRAIN_SCENES_PER_TYPE if validation else TRAIN_SCENES_PER_TYPE
    last = TRAIN_SCENES_PER_TYPE if validation else None
    train, evaluated = [], []
    for room in ROOM_TYPES:
        names = [f"FloorPlan{n}" for n in SCENE_NUMBERS[room]]
        train += names[:first]
        evaluated += names[first:last]
    unseen = {r: _held_out(r, missing[r]) for r in ROOM_TYPES} if validation else missing
    hidden = {c for room in ROOM_TYPES for c in (*missing[room], *unseen[room])}
    seen = {room: tuple(c for c in TARGETS[room] if c not in hidden) for room in ROOM_TYPES}
    if empty := [room for room in ROOM_TYPES if not seen[room]]:
        besides = " besides the one that --validation holds out" if validation else ""
        raise ValueError(
            f"--split {text}: leaves no class to train on in {', '.join(empty)}{besides}"
        )
    return Split(
        name=f"{name}-validation" if validation else name,
        train_scenes=tuple(train),
        eval_scenes=tuple(evaluated),
        hidden=frozenset(hidden),
        seen=seen,
        unseen=dict(unseen),
    )


def split_name(text: str) -> str:
    """The canonical name of the split that `text` describes.

    Args:
      text: "22/0", "18/4" or "14/8"; or the unseen classes in any order, separated by commas:
        "vase,Mug" is "Mug,Vase", and the four classes of 18/4 are "18/4".

    Raises:
      ValueError: it describes none; the message says why.
    """
    if text in UNSEEN:
        return text
    named = [_target_class(word, text) for word in text.split(",")]
    if twice := [name for name in ALL_TARGETS if named.count(name) > 1]:
        raise ValueError(f"--split {text}: {twice[0]} is given twice")
    for name, classes in UNSEEN.items():
        if set(named) == {c for room in ROOM_TYPES for c in classes[room]}:
            return name
    return ",".join(name for name in ALL_TARGETS if name in named)


def unseen_classes(name: str) -> dict[str, tuple[str, ...]]:
    """Room type -> classes that the split with this canonical name leaves out of training."""
    if name in UNSEEN:
        return UNSEEN[name]
    named = name.split(",")
    return {room: tuple(c for c in TARGETS[room] if c in named) for room in ROOM_TYPES}


def file_name(split: str) -> str:
    """A split's name for use in a file name: 18-4, Mug-Vase-validation."""
    return split.replace("/", "-").replace(",", "-")


def _target_class(word: str, text: str) -> str:
    """The target class that `word` means."""
    name = ai2thor_class(word)
    if name in ALL_TARGETS:
        return name
    keys = {"".join(class_words(name)): name for name in ALL_TARGETS}
    key = "".join(class_words(word))
    if not key and "," in text:
        raise ValueError(f"--split {text}: a comma without a class on both sides")
    if near := difflib.get_close_matches(key, keys, n=1):
        raise ValueError(
            f"--split {text}: no target is called {word}; did you mean {keys[near[0]]}?"
        )
    problem = "" if word == text else f"no target is called {word}; "
    raise ValueError(
        f"--split {text}: {problem}choose one of {', '.join(UNSEEN)}, or name the unseen classes, "
        f"separated by commas, among {', '.join(ALL_TARGETS)}"
    )


def _held_out(room: str, missing: Collection[str]) -> tuple[str, ...]:
    """The class of a room type that validation holds out, if the split leaves any."""
    order = (*VALIDATION_UNSEEN[room], *TARGETS[room])
    return tuple(name for name in order if name not in missing)[:1]
