"""What `--targets` says: the classes that an agent is asked to find, as text.

Which of them can be found in which rooms is for `tdanet_jax.scenes.dataset.find_targets` to say.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator

from tdanet_jax import labels
from tdanet_jax.splits import in_order, is_plain, known_type, labels_of
from tdanet_jax.vocabulary import ALL_TARGETS

#: The 22 targets of the paper, or those that the rooms of `--data` name themselves.
PAPER = "paper"
#: Every class that can be found in a training room, by room type.
ALL = "all"


@contextlib.contextmanager
def naming(flag: str, instead_of: str = "--targets") -> Iterator[None]:
    """Errors inside that begin with another flag, by default --targets, begin with this one."""
    try:
        yield
    except ValueError as error:
        head, _, rest = str(error).partition(" ")
        if head != instead_of:
            raise
        raise ValueError(f"{flag} {rest}") from None


def parse(text: str) -> dict[str, tuple[str, ...]]:
    """Room type -> the labels of its targets; those of every room type have the key "".

    "Kettle, mugs" are targets in every room type; "kitchen: Kettle, Mug; bedroom: all" in these.

    Raises:
      ValueError: it is no list of classes; one line.
    """
    sections: dict[str, tuple[str, ...]] = {}
    for section in text.split(";"):
        room, colon, names = section.rpartition(":")
        room = known_type(room.strip())
        words = tuple(_class_name(word.strip()) for word in names.split(","))
        if (colon and not room) or not all(words):
            raise ValueError(
                f"--targets {text}: a name is missing; give {PAPER}, {ALL}, or classes such as "
                "Kettle,Mug or 'kitchen: Kettle, Mug; bedroom: Book'"
            )
        if room in sections:
            what = f"room type {room}" if room else "the list for every room type"
            raise ValueError(f"--targets {text}: {what} is given twice")
        for word in words:
            if not is_plain(word):
                raise ValueError(f"--targets {text}: {word!r} is not the name of a class")
            if words.count(word) > 1:
                raise ValueError(f"--targets {text}: {word} is given twice")
        sections[room] = words
    return sections


def canonical(text: str) -> str:
    """The same targets in one order and with AI2-THOR's names: "mug,kettle" is "Mug,Kettle"."""
    if text == PAPER:
        return text
    sections = parse(text)
    return "; ".join(
        (f"{room}: " if room else "") + ",".join(in_order(sections[room]))
        for room in sorted(sections)
    )


def known_classes(text: str, data: str | None) -> tuple[str, ...] | None:
    """The classes that can be unseen before the rooms are read; None: that the rooms will say.

    Args:
      text: the targets.
      data: the rooms' file; None: the bundled rooms, which hold classes of AI2-THOR alone.

    Raises:
      ValueError: the bundled rooms hold no such class; the message names the nearest ones.
    """
    if data is not None:
        parse(text)
        return None
    if text == PAPER:
        return ALL_TARGETS
    classes = tuple(name for name in labels.bundled() if name[0].isupper())
    found = {find(word, classes) for words in parse(text).values() for word in words}
    return in_order(classes if None in found else (name for name in found if name))


def find(label: str, classes: Collection[str]) -> str | None:
    """The class that a label of `--targets` means; None if it means all of them.

    Raises:
      ValueError: it means none; the message names the nearest ones.
    """
    if label == ALL:
        return None
    among = labels_of(tuple(classes))
    if (name := among.find(label)) in classes:
        return name
    near = [name for name in among.near(label) if name in classes]
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    raise ValueError(f"--targets {label}: no class of these rooms{hint}")


def _class_name(label: str) -> str:
    """AI2-THOR's name of what a label means, or else the label."""
    return label if label == ALL else labels.ai2thor_class(label) or label
