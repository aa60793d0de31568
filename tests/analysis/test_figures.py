"""Charts of attention; those of learning curves are drawn where their numbers are tested."""

from __future__ import annotations

import numpy as np
from matplotlib.image import imread

from tdanet_jax.analysis import figures
from tdanet_jax.analysis.attention import ClassPairs


def test_class_pairs_are_drawn_even_if_there_are_none(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 60, (3, 50))
    classes = tuple(f"Class{i}" for i in range(50))
    pairs = ClassPairs(classes[:3], classes, frames, rng.random((3, 50)), rng.random((3, 50)))
    figures.class_pairs(pairs, {"Class1"}, "Pairs", tmp_path / "pairs.png")
    empty = ClassPairs(classes[:3], classes, 0 * frames, np.nan * frames, np.nan * frames)
    figures.class_pairs(empty, set(), "Nothing", tmp_path / "none.png")
    for name in ("pairs.png", "none.png"):
        assert imread(tmp_path / name).std() > 0.01
