"""Senses that err: detections and motion as an agent perceives them, from those of the world.

A frame is a pure function of the episode's key, the number of the step and the pose. Levels are
arrays, so that one compiled program serves them all. Random numbers are fields of 16 bits of one
draw per step: a column for each row of a frame, one for each extra detection, and a last one for
the motion that led to the step.

Axes: K rows of a frame, with or without noise, A known classes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax.sense_noise import SMALL_SIDE, SenseNoise, ends
from tdanet_jax.sensors.sensor import Slip

#: Rows after those in view that false positives and duplicates can fill.
EXTRA = 4
#: Classes that a class can be confused with.
SIMILAR = 4
#: Classes that look alike, or that detectors often take for each other; the nearest word vectors
#: give the others.
LOOKALIKES = (
    ("Mug", "Cup"), ("Bowl", "Pot"), ("Pan", "Plate"), ("Laptop", "Television"),
    ("ArmChair", "Sofa"), ("Chair", "Stool"), ("Book", "Box"), ("CoffeeMachine", "Toaster"),
    ("DeskLamp", "FloorLamp"), ("DiningTable", "Desk"), ("CoffeeTable", "SideTable"),
    ("Cabinet", "Drawer"), ("Dresser", "Drawer"), ("SoapBottle", "SprayBottle"),
    ("ToiletPaper", "PaperTowelRoll"), ("Towel", "HandTowel"), ("Painting", "Mirror"),
    ("CellPhone", "RemoteControl"), ("Fork", "Spoon"), ("Knife", "ButterKnife"),
    ("Potato", "Egg"), ("Apple", "Tomato"), ("Vase", "WineBottle"), ("Pillow", "TeddyBear"),
    ("Microwave", "Toaster"), ("GarbageCan", "LaundryHamper"),
)  # fmt: skip

#: Fields of a row's column of random bits.
_MISS, _CHANGE, _CLASS, _X, _Y, _WIDTH, _HEIGHT, _SCORE = range(8)
#: Fields of an extra detection's column; the last two are one number of 32 bits.
_FALSE, _AGAIN, _COPIED, _STRANGE, _STRANGE_LOW = range(5)
#: Fields of the motion's column.
_STEP, _TURN, _ERROR, _SHORT, _LENGTH, _FAIL = range(6)


class NoiseLevels(NamedTuple):
    """The fields of `SenseNoise`, each [] float32; biases and drift with the episode's sign."""

    misses: jax.Array
    small_misses: jax.Array
    false_positives: jax.Array
    duplicates: jax.Array
    swaps: jax.Array
    confusions: jax.Array
    jitter: jax.Array
    truncation: jax.Array
    scores: jax.Array
    distance_bias: jax.Array
    distance_noise: jax.Array
    turn_bias: jax.Array
    turn_noise: jax.Array
    heading_drift: jax.Array
    heading_error: jax.Array
    short_steps: jax.Array
    failed_turns: jax.Array


#: Levels to which an episode gives a sign.
_SIGNED = np.array(
    [name in ("distance_bias", "turn_bias", "heading_drift") for name in NoiseLevels._fields]
)


class NoiseParams(struct.PyTreeNode):
    """What the environment needs for senses that err; part of `EnvParams`."""

    low: jax.Array  # [17] float32, least levels of an episode, in the order of `NoiseLevels`
    high: jax.Array  # [17] float32, greatest levels
    corners: jax.Array  # [N + K, 4] float32, x1, y1, x2, y2 of each detection's extent
    known: jax.Array  # [C] int32, ascending: the A classes that are detected, the last repeated
    known_count: jax.Array  # [] int32, A
    similar: jax.Array  # [C, SIMILAR] int32, what a class is confused with
    rows: jax.Array  # [] int32, N, detections in the tables
    one_per_class: bool = struct.field(pytree_node=False)  # frames have one row per class


class EpisodeNoise(struct.PyTreeNode):
    """The noise of one episode; part of `EnvState`."""

    key: jax.Array  # [2] uint32, data of the episode's key
    levels: jax.Array  # [17] float32, in the order of `NoiseLevels`


class Detections(NamedTuple):
    """The rows of a frame."""

    classes: jax.Array  # [K] int32
    boxes: jax.Array  # [K, 3] float32, or [K, 4] with scores
    mask: jax.Array  # [K] bool


def make_params(
    noise: SenseNoise, corners: np.ndarray, classes: np.ndarray, words: np.ndarray,
    names: tuple[str, ...], padding: int, one_per_class: bool,
) -> NoiseParams:  # fmt: skip
    """The parameters for some tables of detections.

    Args:
      noise: the levels.
      corners: [N, 4], extent of each detection, as shares of the image.
      classes: [N], its class.
      words: [C, D], word vectors. Only classes that occur in `classes` enter anything.
      names: of the C classes.
      padding: rows to append, K.
      one_per_class: whether frames have one row per class instead of one per object.
    """
    known = np.unique(classes) if len(classes) else np.zeros(1, int)
    return NoiseParams(
        **levels_of(noise),
        corners=jnp.asarray(np.pad(corners.astype(np.float32), ((0, padding), (0, 0)))),
        known=jnp.asarray(np.pad(known, (0, len(names) - len(known)), mode="edge"), jnp.int32),
        known_count=jnp.int32(len(known)),
        similar=jnp.asarray(_similar_classes(words, names, known), jnp.int32),
        rows=jnp.int32(len(classes)),
        one_per_class=one_per_class,
    )


def levels_of(noise: SenseNoise) -> dict[str, jax.Array]:
    """The fields `low` and `high` of `NoiseParams`; replacing them compiles nothing."""
    ranges = np.array([ends(getattr(noise, name)) for name in NoiseLevels._fields], np.float32)
    return {"low": jnp.asarray(ranges[:, 0]), "high": jnp.asarray(ranges[:, 1])}


def _similar_classes(words: np.ndarray, names: tuple[str, ...], known: np.ndarray) -> np.ndarray:
    """What each class is confused with: look-alikes, then the classes with the nearest words."""
    unit = words / np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-9)
    out = np.repeat(np.arange(len(names))[:, None], SIMILAR, axis=1)
    index = {names[c]: c for c in known}
    for cls in known:
        pairs = (pair for pair in LOOKALIKES if names[cls] in pair)
        alike = [index[n] for pair in pairs for n in pair if n in index and n != names[cls]]
        nearest = known[np.argsort(-(unit[known] @ unit[cls]), kind="stable")]
        ordered = dict.fromkeys([*alike, *(c for c in nearest if c != cls)])
        if ordered:
            out[cls] = np.resize([*ordered][:SIMILAR], SIMILAR)
    return out


def begin(key: jax.Array, params: NoiseParams) -> EpisodeNoise:
    """The noise of an episode: levels from their ranges, and signs of what is the same in all of
    it."""
    own, draw = jax.random.split(key)
    bits = jax.random.bits(draw, (2, len(_SIGNED)), jnp.uint16)
    level = params.low + (params.high - params.low) * _uniform(bits[0])
    sign = jnp.where(_SIGNED & (bits[1] >> 15 == 1), -1.0, 1.0)
    return EpisodeNoise(key=jax.random.key_data(own), levels=sign * level)


def draw(noise: EpisodeNoise, step: jax.Array, rows: int) -> jax.Array:
    """The random bits of a step, [8, rows + EXTRA + 1] uint16.

    JAX's own numbers of the step's key are mixed with a counter: 300 of them for each frame would
    take more time than all else in a frame.
    """
    key = jax.random.fold_in(jax.random.wrap_key_data(noise.key), step)
    first, second = jax.random.key_data(key)
    counter = jnp.arange(4 * (rows + EXTRA + 1), dtype=jnp.uint32).reshape(4, -1)
    words = _mixed(_mixed(counter + first) ^ second)
    return jnp.concatenate([words, words >> 16]).astype(jnp.uint16)


def _mixed(words: jax.Array) -> jax.Array:
    """Words of 32 bits whose every bit depends on all bits of the given ones: MurmurHash3's end."""
    words = (words ^ words >> 16) * jnp.uint32(0x85EBCA6B)
    words = (words ^ words >> 13) * jnp.uint32(0xC2B2AE35)
    return words ^ words >> 16


def detect(
    seen: Detections, corners: jax.Array, bits: jax.Array, noise: EpisodeNoise,
    params: NoiseParams, row_class: jax.Array,
) -> Detections:  # fmt: skip
    """What a detector makes of the detections in view: K rows, the padding zero.

    Args:
      seen: the detections in view, the first of K rows.
      corners: [K, 4], their extents.
      bits: of the step (`draw`).
      noise: of the episode.
      params: tables of classes and boxes.
      row_class: [N + K] int32, classes of all detections, for false positives.
    """
    levels = NoiseLevels(*noise.levels)
    count = seen.mask.shape[0]
    number = jnp.sum(seen.mask, dtype=jnp.int32)
    own, extra = bits[:, :count], bits[:, count : count + EXTRA]
    side = jnp.sqrt(seen.boxes[:, 2])
    shown = (1 - levels.misses) * (1 - levels.small_misses * jnp.exp(-side / SMALL_SIDE))
    there = seen.mask & (_uniform(own[_MISS]) >= 1 - shown)

    # The rows after those in view: false positives are those of any view, duplicates copy rows that
    # are there.
    false = _uniform(extra[_FALSE]) < levels.false_positives / EXTRA
    copied = jnp.minimum(_index(extra[_COPIED], number), count - 1)
    again = (_uniform(extra[_AGAIN]) < levels.duplicates * number / EXTRA) & there[copied]
    strange = _wide_index(extra[_STRANGE], extra[_STRANGE_LOW], params.rows)
    x1, y1, x2, y2 = params.corners[strange].T
    strange_box = jnp.stack([(x1 + x2) / 2, (y1 + y2) / 2, (x2 - x1) * (y2 - y1)], axis=-1)
    after = jnp.arange(count, dtype=jnp.int32) - number

    def place(rows: jax.Array, copies: jax.Array, others: jax.Array) -> jax.Array:
        """The rows with the extra ones after those in view, as far as there is room."""
        for i in range(EXTRA):
            one = jnp.where(false[i], others[i], copies[i])
            rows = jnp.where((after == i).reshape(-1, *[1] * one.ndim), one, rows)
        return rows

    classes = place(seen.classes, seen.classes[copied], row_class[strange])
    boxes = place(seen.boxes[:, :3], seen.boxes[copied, :3], strange_box)
    corners = place(corners, corners[copied], params.corners[strange])
    mask = place(there, again, jnp.ones_like(false))
    is_false = place(jnp.zeros_like(there), jnp.zeros_like(false), jnp.ones_like(false))
    labels = _labels(classes, own, levels, params, is_false)
    scores = _scores(~is_false & (labels == classes), boxes, own, levels)
    boxes, visible = _boxes(boxes, corners, own, levels, params.one_per_class)
    mask &= visible
    if seen.boxes.shape[1] > 3:
        boxes = jnp.concatenate([boxes, scores], axis=1)
    if params.one_per_class:
        earlier = jnp.tril(jnp.ones((count, count), bool), -1)
        mask &= ~jnp.any(earlier & mask & (labels == labels[:, None]), axis=1)
    return Detections(jnp.where(mask, labels, 0), jnp.where(mask[:, None], boxes, 0.0), mask)


def _labels(
    classes: jax.Array, bits: jax.Array, levels: NoiseLevels, params: NoiseParams,
    is_false: jax.Array,
) -> jax.Array:  # fmt: skip
    """Labels: swapped for any other known class, else confused with a similar one."""
    chance = _uniform(bits[_CHANGE])
    swap = (chance < levels.swaps) & ~is_false
    confuse = ~swap & (chance < levels.swaps + (1 - levels.swaps) * levels.confusions) & ~is_false
    pick = _index(bits[_CLASS], jnp.maximum(params.known_count - 1, 1))
    # The known classes are ascending: skipping the own one leaves `others` of them.
    at = pick + (params.known[pick] >= classes)
    other = params.known[jnp.minimum(at, params.known_count - 1)]
    alike = params.similar[classes, (bits[_CLASS] >> 14).astype(jnp.int32)]
    return jnp.where(swap, other, jnp.where(confuse, alike, classes))


def _scores(right: jax.Array, boxes: jax.Array, bits: jax.Array, levels: NoiseLevels) -> jax.Array:
    """The detector's confidence in each row, [K, 1]."""
    one, other = bits[_SCORE] >> 8, bits[_SCORE] & 255
    drawn = jnp.where(right, jnp.maximum(one, other), jnp.minimum(one, other))
    of_size = 1 - jnp.exp(-jnp.sqrt(boxes[:, 2]) / SMALL_SIDE) / 2
    sure = drawn.astype(jnp.float32) * jnp.float32(2.0**-8) * of_size
    return (1 - levels.scores * (1 - sure))[:, None]


def _boxes(
    boxes: jax.Array, corners: jax.Array, bits: jax.Array, levels: NoiseLevels, one_per_class: bool
) -> tuple[jax.Array, jax.Array]:
    """Boxes x, y, S after jitter and truncation, and whether anything of them is left.

    Without either, every value stays the same to the last bit.
    """
    lower, upper = corners[:, :2], corners[:, 2:]
    side = upper - lower
    moved = levels.jitter * _normal(bits[_X : _Y + 1].T) * side
    grown = (jnp.exp(levels.jitter * _normal(bits[_WIDTH : _HEIGHT + 1].T)) - 1) * side / 2
    least, most = levels.truncation, 1 - levels.truncation
    low = jnp.clip(lower + (moved - grown), least, most)
    high = jnp.clip(upper + (moved + grown), least, most)
    middle = boxes[:, :2] + ((low - lower) + (high - upper)) / 2
    if one_per_class:  # the mean of the instances' centres may lie near the end that is cut off
        middle = jnp.clip(middle, low, high)
    whole = jnp.prod(side, axis=1)
    ratio = jnp.where(whole > 0, jnp.prod(high - low, axis=1) / jnp.maximum(whole, 1e-12), 1.0)
    area = jnp.minimum(boxes[:, 2] * ratio, 1.0)
    left = jnp.all((high > low) | (side <= 0), axis=1)
    return jnp.concatenate([middle, area[:, None]], axis=1), left


def slip(bits: jax.Array, noise: EpisodeNoise) -> Slip:
    """How the motion that leads to a step is misjudged, from the step's bits."""
    levels, own = NoiseLevels(*noise.levels), bits[:, -1]
    short = _uniform(own[_SHORT]) < levels.short_steps
    factor = 1 + levels.distance_bias + levels.distance_noise * _normal(own[_STEP])
    return Slip(
        distance=factor * jnp.where(short, 1 + _uniform(own[_LENGTH]), 1.0),
        turn=1 + levels.turn_bias + levels.turn_noise * _normal(own[_TURN]),
        drift=jnp.radians(levels.heading_drift),
        error=jnp.radians(levels.heading_error) * _normal(own[_ERROR]),
    )


def turn_fails(bits: jax.Array, noise: EpisodeNoise) -> jax.Array:
    """Whether a turn that leads to a step fails, from the step's bits."""
    return _uniform(bits[_FAIL, -1]) < NoiseLevels(*noise.levels).failed_turns


def _uniform(bits: jax.Array) -> jax.Array:
    """From 16 bits, a multiple of 2^-16 in [0, 1)."""
    return bits.astype(jnp.float32) * jnp.float32(2.0**-16)


def _index(bits: jax.Array, count: jax.Array) -> jax.Array:
    """From 16 bits, a whole number from 0 below `count`, which is at most 2^15."""
    return (bits.astype(jnp.int32) * count) >> 16


def _wide_index(high: jax.Array, low: jax.Array, count: jax.Array) -> jax.Array:
    """From 32 bits, a whole number from 0 below `count`, all but equally likely."""
    share = high.astype(jnp.float32) * 2.0**-16 + low.astype(jnp.float32) * 2.0**-32
    return jnp.clip((share * count).astype(jnp.int32), 0, jnp.maximum(count - 1, 0))


def _normal(bits: jax.Array) -> jax.Array:
    """From 16 bits, a number with mean 0 and deviation 1: the sum of four uniform ones of 4 bits.

    Close to normal, in steps of 0.11, and never beyond 3.3.
    """
    whole = bits.astype(jnp.int32)
    total = (whole & 15) + (whole >> 4 & 15) + (whole >> 8 & 15) + (whole >> 12)
    return (total - 30).astype(jnp.float32) * jnp.float32(85.0**-0.5)
