"""What a label means: one name for each thing, however a detector or a user writes it.

"armchair", "Arm-Chairs" and "ArmChair_2" are ArmChair; "tv" and "television set" are Television.
Which names mean the same is listed in `assets/labels.json`, and in a table of the user's own.
"""

from __future__ import annotations

import difflib
import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path

from tdanet_jax.io import assets
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.vocabulary import class_words

ASSET = "labels.json"
#: Name -> other names of the same thing.
Synonyms = Mapping[str, Iterable[str]]

#: A word without a vector is not split into two if it is as similar as this to a known label.
_TYPO = 0.85
#: Its parts are among this many most frequent words, or in the names in the tables: others are
#: often no words, but endings.
_COMMON = 10_000
#: Known labels at least as similar as this to an unknown one are suggested in the error.
_SIMILAR = 0.7


class LabelError(KeyError):
    """A label means nothing that is known; the message is one line."""

    def __str__(self) -> str:
        """The message, which KeyError would put in quotation marks."""
        return str(self.args[0])


class Labels:
    """What labels mean to an agent or in some rooms.

    A label is looked up in the user's synonyms, the class names and the bundled table, in this
    order; capitals, accents, spaces, hyphens, underscores, plurals, an instance's number and what
    is in brackets do not matter. Of alternatives ("trash can/bin"), the first that is known counts.

    Args:
      classes: class names. Each of them means itself, unless the user's synonyms say otherwise.
      words: the words with a vector, most frequent first (`WordVectors.index`); None: any word is
        good enough.
      synonyms: the user's own table, or the path of a JSON file of it: name -> other names of it.

    Raises:
      ValueError: the user's table is not one, or one of its names means nothing; the message names
        the file and the entry.
    """

    def __init__(
        self,
        classes: Iterable[str] = (),
        words: Mapping[str, int] | None = None,
        synonyms: Synonyms | Path | str | None = None,
    ) -> None:
        classes = tuple(classes)
        self._words = words
        self._split: dict[str, tuple[str, ...] | None] = {}
        self._names = {name: name for name in classes}
        for name in classes:
            self._names.setdefault(_key(name), name)
        for name, others in bundled().items():
            self._add((name, *others))
        self._add_singulars()
        self._parts = {word for name in self._names.values() for word in class_words(name)}
        if synonyms is not None:
            given = self._meanings(synonyms)
            self._names |= given
            self._names |= {name: given[_key(name)] for name in classes if _key(name) in given}
            self._add_singulars()

    def find(self, label: str) -> str | None:
        """The class or the name in the tables that a label means; None if it means neither."""
        for text in _readings(label):
            key = _key(text)
            for candidate in (text, key, *_singulars(key)):
                if candidate in self._names:
                    return self._names[candidate]
        return None

    def resolve(self, label: str) -> str:
        """The name of what a label means: as `find` gives it, or else the label's words.

        A word without a vector becomes its singular, or the two words that it consists of:
        "lampstand" is "lamp stand".

        Raises:
          LabelError: it means nothing that is known, and a word has no vector; the message names
            the most similar labels that are known, and how to add a word or a name.
        """
        if (name := self.find(label)) is not None:
            return name
        first, *rest = _readings(label)
        for text in (*rest, first):
            if words := self._known_words(text):
                return " ".join(words)
        lacking = ", ".join(word for word in class_words(first) if self._vector_words(word) is None)
        near = self.near(first)
        problem = f"no word vector for {lacking}" if lacking else "has no words"
        question = f"; did you mean {' or '.join(near)}?" if near else ""
        way_out = " (agent.add_words adds words, synonyms add names)" if lacking else ""
        raise LabelError(f"label {label!r}: {problem}{question}{way_out}")

    def near(self, label: str) -> list[str]:
        """The most similar names that are known, the most similar first."""
        return [*dict.fromkeys(self._names[key] for key in self._near(_key(label), _SIMILAR))]

    def same(self, label: str, other: str) -> bool:
        """Whether two labels mean the same, whether or not their words have vectors."""
        one, two = (_key(self.find(x) or [*_readings(x)][-1]) for x in (label, other))
        return one == two

    def _add(self, group: tuple[str, ...]) -> None:
        """Adds names of one thing: they mean the one that is a class, or else has vectors."""
        known = [self._names[key] for key in map(_key, group) if key in self._names]
        named = known or [name for name in group if self._has_vector(name)]
        for name in group if named else ():
            self._names.setdefault(_key(name), named[0])

    def _add_singulars(self) -> None:
        for key, name in tuple(self._names.items()):
            for singular in _singulars(key):
                self._names.setdefault(singular, name)

    def _meanings(self, synonyms: Synonyms | Path | str) -> dict[str, str]:
        """Key -> name, from the user's table."""
        if isinstance(synonyms, str | Path):
            source, table = str(synonyms), read(Path(synonyms))
        else:
            source, table = "synonyms", check("synonyms", synonyms)
        meanings: dict[str, str] = {}
        for name, others in table.items():
            try:
                meaning = self.resolve(name)
            except LabelError as error:
                raise FileError(source, error) from None
            for other in others:
                if meanings.setdefault(_key(other), meaning) != meaning:
                    raise FileError(source, f"{name}: {other} is listed under another name, too")
        return meanings

    def _has_vector(self, text: str) -> bool:
        known, words = self._words, class_words(text)
        return known is None or " ".join(words) in known or all(word in known for word in words)

    def _known_words(self, text: str) -> tuple[str, ...]:
        """The words of a text, each with a vector; none if a word has none."""
        words = class_words(text)
        if self._has_vector(text):
            return words
        found = [self._vector_words(word) for word in words]
        return tuple(word for part in found for word in part or ()) if None not in found else ()

    def _vector_words(self, word: str) -> tuple[str, ...] | None:
        """A word with a vector, or the words with vectors that it consists of."""
        if self._words is None or word in self._words:
            return (word,)
        if word not in self._split:
            singular = [(one,) for one in _singulars(word) if one in self._words]
            self._split[word] = singular[0] if singular else self._compound(word)
        return self._split[word]

    def _compound(self, word: str) -> tuple[str, str] | None:
        """The two common words that a word consists of, the rarer one as frequent as possible."""
        pairs = [(word[:at], word[at:]) for at in range(3, len(word) - 2)]
        pairs = [pair for pair in pairs if max(map(self._rank, pair)) < _COMMON]
        if not pairs or self._near(word, _TYPO):
            return None
        return min(pairs, key=lambda pair: max(map(self._rank, pair)))

    def _rank(self, word: str) -> int:
        """How many words are more frequent; none, if a name in the tables has the word."""
        assert self._words is not None
        return 0 if word in self._parts and word in self._words else self._words.get(word, _COMMON)

    def _near(self, key: str, similarity: float) -> list[str]:
        return difflib.get_close_matches(key, self._names, cutoff=similarity)


@cache
def bundled() -> dict[str, tuple[str, ...]]:
    """The bundled table, name -> other names of the same thing.

    The names are AI2-THOR's classes, which begin with a capital letter, and then those of everyday
    things that AI2-THOR lacks, which do not.
    """
    table = json.loads(assets.path(ASSET).read_text(encoding="utf-8"))
    return {name: tuple(others) for name, others in table.items()}


def ai2thor_class(label: str) -> str | None:
    """The class of AI2-THOR that a label means, according to the bundled table."""
    name = _bundled_labels().find(label)
    return name if name is not None and name[0].isupper() else None


@cache
def _bundled_labels() -> Labels:
    return Labels()


def build_asset(out_dir: Path | str) -> Path:
    """Copies the bundled table, which is written by hand: its checksum is not verified."""
    return Path(shutil.copy(assets.folder() / ASSET, Path(out_dir) / ASSET))


def names_in(path: Path | str) -> list[str]:
    """All names in a table, which `words.build_asset` keeps the vectors of."""
    return [name for head, others in read(path).items() for name in (head, *others)]


def read(path: Path | str) -> Synonyms:
    """The table in a JSON file.

    Raises:
      FileError: the file is missing, or holds no table; the message names the entry.
    """
    table: dict[str, Iterable[str]] = {}
    for name, others in jsons.members(Path(path)):
        if name in table:
            raise FileError(path, f"{name}: is listed twice")
        table[name] = others
    return check(str(path), table)


def check(source: str, table: Synonyms) -> Synonyms:
    """The table itself, if it is one.

    Raises:
      FileError: an entry is not a name with a list of names; the message names it.
    """
    if not isinstance(table, Mapping):
        raise FileError(source, "must map each name to a list of other names")
    for name, others in table.items():
        if not isinstance(name, str) or not _key(name):
            raise FileError(source, f"{name!r}: not a name")
        if not isinstance(others, list | tuple):
            raise FileError(source, f"{name}: not a list of names")
        for other in others:
            if not isinstance(other, str) or not _key(other):
                raise FileError(source, f"{name}: {other!r} is not a name")
    return table


def _key(label: str) -> str:
    """What is left of a label without capitals and separators."""
    return "".join(class_words(label))


def _readings(label: str) -> Iterator[str]:
    """What a label may say: all of it; then each alternative without brackets and instance.

    AI2-THOR calls instances "Mug|+00.12|+01.02|-01.50" and "Mug_3fd12c08", others "mug 2".
    """
    yield label
    for part in re.sub(r"\([^()]*\)", " ", label.split("|")[0]).split("/"):
        text = re.sub(r"_[0-9a-f]{8}$", "", part.strip()).rstrip("0123456789 _#-")
        if text not in ("", label):
            yield text


def _singulars(word: str) -> Iterator[str]:
    """What a word may be the plural of."""
    if len(word) < 3 or not word.endswith("s") or word.endswith("ss"):
        return
    yield word[:-1]
    if word.endswith(("ses", "xes", "zes", "ches", "shes", "oes")):
        yield word[:-2]
    if word.endswith("ves"):
        yield from (word[:-3] + "f", word[:-3] + "fe")
    if word.endswith("ies"):
        yield word[:-3] + "y"
