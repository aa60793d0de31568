"""What a network attends to: attention in any state, and its means over pairs of classes.

Correspondence is the inner product of a detection's row and the target's, both through W_L (Eq. 1);
attention is its softmax over the detections in view (Eq. 2). The difference is the absolute
difference of the attended detection and the target in the Siamese comparison.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, Observation
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output, RecurrentState

#: Frames in one compiled call.
BATCH = 1024


class FrameAttention(NamedTuple):
    """Attention and difference in a batch of frames [B]; None where the model has none."""

    attention: jax.Array | None  # [B, K], weight of each detection, 0 in padding
    correspondence: jax.Array | None  # [B, K], attention before the softmax; undefined in padding
    difference: jax.Array | None  # [B, H], |attended detection - target|


def act(
    model: ActorCritic, weights: Any, class_table: Any, state: RecurrentState, obs: Observation
) -> tuple[RecurrentState, Output, FrameAttention]:
    """`actor_critic.act`, with the attention on its way."""
    state, out, kept = actor_critic.act(
        model, weights, class_table, state, obs, collections=("intermediates",)
    )
    inside = kept["intermediates"].get("encoder", {})
    values = (inside[name][0] if name in inside else None for name in FrameAttention._fields[1:])
    return state, out, FrameAttention(kept["intermediates"]["attention"][0], *values)


@functools.partial(jax.jit, static_argnums=0)
def attend(
    model: ActorCritic,
    weights: Any,
    words: jax.Array,
    pose: jax.Array,
    target: jax.Array,
    params: EnvParams,
) -> tuple[Observation, FrameAttention]:
    """Attention and difference in any states.

    Args:
      words: [C, D] word vectors of the tables' classes.
      pose: [B] int32. target: [B] int32, index among the tables' targets.

    Returns:
      The observations and their attention. Neither depends on earlier steps.
    """
    class_table = actor_critic.prepare(model, weights, words)
    begun = jax.vmap(dynamics.start, (0, 0, None))(pose, target, params)
    obs = jax.vmap(dynamics.observe, (0, None))(begun, params)
    state = actor_critic.initial_state(model, weights, pose.shape[0])
    return obs, act(model, weights, class_table, state, obs)[2]


@dataclasses.dataclass(frozen=True)
class ClassPairs:
    """Mean attention on each class while looking for each target.

    The target's own class counts in frames with the target in view, every other class in frames
    without it: there it shows what guides an agent before it sees the target.

    Attributes:
      targets: G names. classes: C names.
      frames: [G, C] int, frames with the class in view that count.
      attention: [G, C], mean over those frames of the class's attention (the sum over its
        detections); nan where there is no frame.
      even: [G, C], the same if every detection in view got the same weight.
    """

    targets: tuple[str, ...]
    classes: tuple[str, ...]
    frames: np.ndarray
    attention: np.ndarray
    even: np.ndarray

    def rows(self) -> list[dict[str, Any]]:
        """One row per pair that occurs, by target, then most attended first."""
        out = []
        for g, target in enumerate(self.targets):
            found = np.flatnonzero(self.frames[g])
            for c in found[np.argsort(-self.attention[g, found], kind="stable")]:
                out.append(
                    {
                        "target": target,
                        "class": self.classes[c],
                        "frames": int(self.frames[g, c]),
                        "attention": round(float(self.attention[g, c]), 4),
                        "even": round(float(self.even[g, c]), 4),
                    }
                )
        return out


def class_pairs(
    model: ActorCritic,
    weights: Any,
    words: jax.Array,
    pose: np.ndarray,
    target: np.ndarray,
    params: EnvParams,
    targets: Sequence[str],
    classes: Sequence[str],
) -> ClassPairs:
    """Mean attention by class pair over frames.

    Args:
      pose: [N] int, of each frame. Repeated frames are computed once and counted as often as they
        occur.
      target: [N] int, likewise.
      targets: names of the tables' targets.
      classes: names of the tables' classes.

    Raises:
      ValueError: the network has no attention.
    """
    frames, count = np.unique(np.stack([pose, target], axis=1), axis=0, return_counts=True)
    shape = (len(targets), len(classes))
    sums = np.zeros((3, *shape))
    for first in range(0, len(frames), BATCH):
        part = frames[first : first + BATCH]
        weight = np.zeros(BATCH, np.float32)  # 0 in the padding of the last batch
        weight[: len(part)] = count[first : first + BATCH]
        padded = np.resize(part, (BATCH, 2))
        more = _sum_pairs(model, shape, weights, words, *padded.T, params, weight)
        if more is None:
            raise ValueError("this network has no attention")
        sums += np.asarray(more, np.float64)
    with np.errstate(invalid="ignore"):
        attention, even = sums[1] / sums[0], sums[2] / sums[0]
    return ClassPairs(tuple(targets), tuple(classes), np.rint(sums[0]).astype(int), attention, even)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _sum_pairs(
    model: ActorCritic,
    shape: tuple[int, int],
    weights: Any,
    words: jax.Array,
    pose: jax.Array,
    target: jax.Array,
    params: EnvParams,
    count: jax.Array,
) -> jax.Array | None:
    """Sums over frames [3, G, C]: class in view, its attention, its share of the detections."""
    obs, seen = attend(model, weights, words, pose, target, params)
    if seen.attention is None:
        return None
    frame = jnp.arange(pose.shape[0])[:, None]

    def by_class(values: jax.Array) -> jax.Array:
        """Sum of each class's detections: [B, C]."""
        kept = jnp.where(obs.mask, values, 0.0)
        return jnp.zeros((pose.shape[0], shape[1])).at[frame, obs.classes].add(kept)

    ones = obs.mask.astype(jnp.float32)
    number = by_class(ones)
    even = number / jnp.maximum(ones.sum(-1, keepdims=True), 1)
    # Where the target is in view, other classes do not count.
    own = jnp.arange(shape[1]) == obs.target[:, None]
    found = jnp.any(own & (number > 0), axis=-1, keepdims=True)
    counts = (number > 0) & (own | ~found)
    values = jnp.where(
        counts, jnp.stack([jnp.ones_like(number), by_class(seen.attention), even]), 0.0
    )
    return jnp.zeros((3, *shape)).at[:, target].add(values * count[:, None])


def write_csv(pairs: ClassPairs, path: Path | str) -> None:
    """Every pair that occurs, one a line: target, class, frames, attention, even."""
    path = Path(path)
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, ["target", "class", "frames", "attention", "even"])
        table.writeheader()
        table.writerows(pairs.rows())


def markdown(pairs: ClassPairs, title: str, unseen: Iterable[str], per_target: int = 6) -> str:
    """The classes that each target attends to most, as a table.

    Args:
      unseen: targets that are marked as never trained on.
      per_target: columns. Pairs with fewer than `MIN_FRAMES` frames are left out.
    """
    unseen = set(unseen)
    lines = [
        f"# {in_markdown(title)}",
        "",
        "Mean attention (percent) while looking for a target: on the target where it is in view, "
        "on other classes in frames without the target; in brackets what even weights would give. "
        f"Most attended first, pairs with at least {MIN_FRAMES} frames. * never a target in "
        "training.",
        "",
        f"| Target | Target itself |{' Other class |' * per_target}",
        f"|{'---|' * (per_target + 2)}",
    ]
    rows = pairs.rows()
    for target in dict.fromkeys(row["target"] for row in rows):
        found = [r for r in rows if r["target"] == target and r["frames"] >= MIN_FRAMES]
        own = [_percent(r) for r in found if r["class"] == target] or ["-"]
        rest = (row for row in found if row["class"] != target)
        others = [f"{in_markdown(row['class'])} {_percent(row)}" for row in rest]
        cells = (others + [""] * per_target)[:per_target]
        lines.append(f"| {in_markdown(target)}{'*' if target in unseen else ''} | {own[0]} | ")
        lines[-1] += " | ".join(cells) + " |"
    return "\n".join(lines) + "\n"


#: A mean over fewer frames than this says little; such pairs are in the CSV alone.
MIN_FRAMES = 20


def _percent(row: dict[str, Any]) -> str:
    return f"{100 * row['attention']:.0f} ({100 * row['even']:.0f})"
