"""Noise of the senses: against its definition one by one, its rates, and what it leaves alone."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tdanet_jax import sense_noise
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params, with_noise
from tdanet_jax.env.reward import no_parents
from tdanet_jax.env.types import EnvParams
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.sensors import noise
from tdanet_jax.sensors.noise import EXTRA, Detections, EpisodeNoise, NoiseLevels, NoiseParams
from tdanet_jax.sensors.odometry import Odometry, believed_angle
from tdanet_jax.sensors.sensor import Motion, Start
from tdanet_jax.vocabulary import Action
from tests.support import noise_oracle
from tests.support.noise_oracle import Seen, Walker
from tests.support.oracle import ROOMS

K, ROWS, CLASSES = 6, 40, 7
NAMES = NoiseLevels._fields
SPEC = ObservationSpec(sensors=("odometry", "triangulation"))


def everything(seed: int = 0) -> list[Seen]:
    """Detections of all sizes; class 3 occurs nowhere."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(ROWS):
        (x1, x2), (y1, y2) = np.sort(rng.integers(0, 4801, (2, 2)), axis=1) / 4800
        cls = int(rng.choice([0, 1, 2, 4, 5, 6]))
        # Centres of classes with several instances are not those of their extent.
        box = ((x1 + x2) / 2 + 0.01, (y1 + y2) / 2, (x2 - x1) * (y2 - y1))
        out.append(Seen(cls, box, (x1, y1, x2, y2)))
    return out


def params_of(rows: list[Seen]) -> NoiseParams:
    words = np.random.default_rng(1).normal(size=(CLASSES, 5))
    return noise.make_params(
        sense_noise.NONE,
        np.array([one.extent for one in rows]),
        np.array([one.cls for one in rows]),
        words,
        tuple("ABCDEFG"),
        K,
        one_per_class=False,
    )


TABLE = everything()
PARAMS = params_of(TABLE)
ROW_CLASS = jnp.array([one.cls for one in TABLE] + [0] * K, jnp.int32)


def frame_of(seen: list[Seen]) -> tuple[Detections, jax.Array]:
    classes, boxes = np.zeros(K, np.int32), np.zeros((K, 4), np.float32)
    corners, mask = np.ones((K, 4), np.float32), np.arange(K) < len(seen)
    for i, one in enumerate(seen):
        classes[i], boxes[i, :3], corners[i] = one
    boxes[:, 3] = mask
    return Detections(*map(jnp.asarray, (classes, boxes, mask))), jnp.asarray(corners)


def episode(levels: dict[str, float]) -> EpisodeNoise:
    values = jnp.array([levels[name] for name in NAMES], jnp.float32)
    return EpisodeNoise(jax.random.key_data(jax.random.key(0)), values)


@functools.partial(jax.jit, static_argnums=4)
def detect(
    seen: Detections, corners: jax.Array, bits: jax.Array, own: EpisodeNoise,
    one_per_class: bool = False,
) -> Detections:  # fmt: skip
    params = PARAMS.replace(one_per_class=one_per_class)
    return noise.detect(seen, corners, bits, own, params, ROW_CLASS)


def random_levels(rng: np.random.Generator) -> dict[str, float]:
    """Levels in sixteenths, half of them 0."""
    most = {"false_positives": 4, "duplicates": 0.5, "truncation": 0.45, "heading_drift": 8,
            "heading_error": 16}  # fmt: skip
    return {n: int(rng.integers(17)) / 16 * most.get(n, 1) * (rng.random() < 0.5) for n in NAMES}


@given(st.integers(0, 2**32 - 1), st.integers(0, K), st.booleans())
def test_frames_are_those_of_the_definition(seed: int, count: int, one_per_class: bool) -> None:
    rng = np.random.default_rng(seed)
    seen = [TABLE[i] for i in rng.choice(ROWS, count, replace=False)]
    levels = random_levels(rng)
    bits = rng.integers(0, 65536, (8, K + EXTRA + 1))
    drawn = jnp.asarray(bits, jnp.uint16)
    found = detect(*frame_of(seen), drawn, episode(levels), one_per_class)
    known = np.asarray(PARAMS.known)[: int(PARAMS.known_count)].tolist()
    expected = noise_oracle.detect(
        seen, K, TABLE, bits.tolist(), levels, known, np.asarray(PARAMS.similar).tolist(),
        one_per_class,
    )  # fmt: skip
    mask = np.asarray(found.mask)
    assert mask.tolist() == [row is not None for row in expected]
    for i, row in enumerate(expected):
        if row is None:
            assert not found.classes[i]
            assert not np.asarray(found.boxes[i]).any()
        else:
            assert int(found.classes[i]) == row.cls
            np.testing.assert_allclose(found.boxes[i], row[1:], atol=2e-6)


def test_at_levels_of_zero_everything_stays_to_the_last_bit() -> None:
    seen, corners = frame_of(TABLE[:K])
    bits = jax.random.bits(jax.random.key(1), (50, 8, K + EXTRA + 1), jnp.uint16)
    own = episode(dict.fromkeys(NAMES, 0.0))
    for found in (detect(seen, corners, b, own) for b in bits):
        chex.assert_trees_all_equal(found, seen)


def test_the_normal_numbers_have_mean_0_and_deviation_1() -> None:
    drawn = np.asarray(noise._normal(jnp.arange(65536, dtype=jnp.uint16)))
    assert drawn.mean() == pytest.approx(0, abs=1e-6)
    assert drawn.std() == pytest.approx(1, abs=1e-6)
    for z in (0.5, 1, 2):
        assert (np.abs(drawn) < z).mean() == pytest.approx(2 * stats.norm.cdf(z) - 1, abs=0.03)


def assert_rate(happened: np.ndarray, rate: float) -> None:
    """Whether as many happened as a rate lets expect, within five deviations."""
    count = happened.size
    assert abs(happened.sum() - rate * count) <= 5 * math.sqrt(rate * (1 - rate) * count) + 1


def many(levels: dict[str, float], seen: list[Seen], frames: int = 4000) -> Detections:
    """What is detected in many frames."""
    own = episode({**dict.fromkeys(NAMES, 0.0), **levels})
    drawn = jax.vmap(lambda step: noise.draw(own, step, K))(jnp.arange(frames))
    return jax.device_get(jax.vmap(detect, (None, None, 0, None))(*frame_of(seen), drawn, own))


def test_rates_are_those_asked_for() -> None:
    seen = [TABLE[i] for i in range(4)]
    assert_rate(~many({"misses": 0.3}, seen).mask[:, :4], 0.3)
    tiny = many({"small_misses": 0.8}, seen).mask
    for i, one in enumerate(seen):
        assert_rate(~tiny[:, i], 0.8 * math.exp(-math.sqrt(one.box[2]) / 0.1))
    assert_rate(many({"false_positives": 1.0}, seen).mask[:, 4:], 0.25)
    assert_rate(many({"duplicates": 0.25}, seen).mask[:, 4:], 0.25)
    assert_rate(many({"duplicates": 0.25, "false_positives": 2.0}, seen).mask[:, 4:], 0.625)
    was = np.array([one.cls for one in seen])
    swapped = many({"swaps": 0.2}, seen).classes[:, :4]
    assert_rate(swapped != was, 0.2)
    for i, cls in enumerate(was):
        for other in range(CLASSES):
            if other != cls:
                assert_rate(swapped[:, i] == other, 0.2 / 5 if other != 3 else 0)
    confused = many({"confusions": 0.5}, seen).classes[:, :4]
    assert_rate(confused != was, 0.5)
    for i, cls in enumerate(was):
        assert set(confused[:, i]) == {cls, *np.asarray(PARAMS.similar)[cls].tolist()}


def test_random_numbers_are_independent_of_one_another() -> None:
    own = episode(dict.fromkeys(NAMES, 0.0))
    frames = 2000
    bits = jax.vmap(lambda step: noise.draw(own, step, 1))(jnp.arange(frames))
    drawn = np.asarray(bits).reshape(frames, -1) / 2**16 - 0.5
    assert abs(drawn.mean()) < 0.005
    later = np.hstack([drawn[:-1], drawn[1:], (drawn[:-1] * 2**8) % 1 - 0.5])
    off = np.corrcoef(later.T) - np.eye(later.shape[1])
    assert np.abs(off).max() < 5.5 / math.sqrt(frames)


def test_scores_tell_right_detections_from_wrong_ones_and_large_from_small() -> None:
    seen = [Seen(c, (0.5, 0.5, side**2), (0.1, 0.1, 0.9, 0.9)) for c, side in enumerate((1, 0.1))]
    found = many({"scores": 1.0, "swaps": 0.5}, seen)
    right, scores = found.classes[:, :2] == np.arange(2), found.boxes[:, :2, 3]
    small = 1 - math.exp(-1) / 2
    for i, size in enumerate((1.0, small)):
        assert scores[right[:, i], i].mean() == pytest.approx(size * 2 / 3, abs=0.01)
        assert scores[~right[:, i], i].mean() == pytest.approx(size / 3, abs=0.01)
    half = many({"scores": 0.5}, seen[:1]).boxes[:, 0, 3]
    assert half.mean() == pytest.approx(0.5 + 0.5 * 2 / 3, abs=0.01)


def test_without_noise_all_scores_are_1(some_rooms: SceneTables) -> None:
    shown = {}
    for scores in (False, True):
        spec = dataclasses.replace(SPEC, scores=scores)
        params = make_params(
            some_rooms, dict.fromkeys(ROOMS, some_rooms.targets), no_parents(some_rooms), (50,) * 4,
            spec,
        )  # fmt: skip
        shown[scores] = jax.jit(dynamics.reset)(jax.random.key(0), params)[0]
    np.testing.assert_array_equal(shown[True].boxes[:, 3], shown[True].mask)
    chex.assert_trees_all_equal(shown[True].replace(boxes=shown[True].boxes[:, :3]), shown[False])


def test_jitter_is_a_share_of_the_sides() -> None:
    one = Seen(0, (0.5, 0.5, 0.02), (0.4, 0.45, 0.6, 0.55))  # twice as wide as high
    boxes = many({"jitter": 0.1}, [one]).boxes[:, 0]
    assert boxes[:, 0].std() == pytest.approx(0.1 * 0.2, rel=0.05)
    assert boxes[:, 1].std() == pytest.approx(0.1 * 0.1, rel=0.05)
    assert np.log(boxes[:, 2] / 0.02).std() == pytest.approx(0.1 * math.sqrt(2), rel=0.05)


def test_the_mean_centre_of_a_class_stays_in_its_box() -> None:
    one = Seen(0, (0.9, 0.1, 0.2), (0.6, 0.0, 1.0, 0.5))  # most instances near one corner
    seen, corners = frame_of([one])
    own = episode({**dict.fromkeys(NAMES, 0.0), "jitter": 0.5})
    bits = jax.random.bits(jax.random.key(1), (300, 8, K + EXTRA + 1), jnp.uint16)
    found = jax.vmap(detect, (None, None, 0, None, None))(seen, corners, bits, own, True)
    middle = np.asarray(found.boxes[:, 0, :2])[np.asarray(found.mask[:, 0])]
    assert ((middle >= 0) & (middle <= 1)).all()
    assert (middle == [1, 0]).any(axis=0).all()


def test_what_lies_in_the_border_is_missed_and_what_reaches_into_it_is_cut() -> None:
    inside, across, outside = (
        Seen(c, ((x1 + x2) / 2, 0.5, (x2 - x1) * 0.2), (x1, 0.4, x2, 0.6))
        for c, (x1, x2) in enumerate([(0.3, 0.5), (0.0, 0.3), (0.02, 0.08)])
    )
    found = many({"truncation": 0.1}, [inside, across, outside], frames=2)
    assert found.mask[0, :3].tolist() == [True, True, False]
    np.testing.assert_allclose(found.boxes[0, 1], (0.2, 0.5, 0.04, 1), atol=1e-6)


def test_a_frame_of_one_row_per_class_keeps_one() -> None:
    per_class = PARAMS.replace(one_per_class=True)
    seen, corners = frame_of(TABLE[:K])
    bits = jax.random.bits(jax.random.key(1), (100, 8, K + EXTRA + 1), jnp.uint16)
    own = episode({**dict.fromkeys(NAMES, 0.0), "duplicates": 0.5, "swaps": 0.5, "misses": 0.5})
    one = lambda b: noise.detect(seen, corners, b, own, per_class, ROW_CLASS)  # noqa: E731
    found = jax.jit(jax.vmap(one))(bits)
    for classes, mask in zip(np.asarray(found.classes), np.asarray(found.mask), strict=True):
        assert len(set(classes[mask])) == mask.sum()


ODOMETRY = Odometry()
slip = jax.jit(noise.slip)


@jax.jit
def moved(state: Any, motion: Motion) -> tuple[Any, Any, jax.Array]:
    """State, reading and believed angle after an action."""
    after = ODOMETRY.update(state, motion, {})
    return after, ODOMETRY.read(after, {}), believed_angle(ODOMETRY.grid, after)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_the_believed_pose_is_that_of_a_walk_in_degrees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    levels, turns = random_levels(rng), int(rng.integers(2))
    levels |= {name: levels[name] * rng.choice([-1, 1]) for name in ("distance_bias", "turn_bias")}
    own, slow = episode(levels), Walker(45.0 * turns)
    bits = rng.integers(0, 65536, (13, 8, 1))
    slips = [slip(jnp.asarray(b, jnp.uint16), own) for b in bits]
    state = ODOMETRY.init(Start(jnp.int32(turns), jnp.int32(0), slips[0]))
    for b, misjudged in zip(bits[1:], slips[1:], strict=True):
        action, blocked = int(rng.choice(4, p=[0.5, 0.2, 0.2, 0.1])), bool(rng.random() < 0.2)
        state, reading, angle = moved(
            state, Motion(jnp.int32(action), jnp.array(blocked), misjudged)
        )
        slow.act(action, blocked, b[:, 0].tolist(), levels)
        place = np.asarray(state.cell + state.deviation.place)
        np.testing.assert_allclose(place, [slow.x, slow.z], atol=1e-4)
        turned = math.degrees(float(angle)) - slow.heading - slow.error
        assert (turned + 180) % 360 == pytest.approx(180, abs=1e-2)
        angle = math.radians(slow.heading + slow.error)
        right = slow.x * math.cos(angle) - slow.z * math.sin(angle)
        assert float(reading.motion[0]) == pytest.approx(right * 0.25 / 4, abs=1e-4)


# In the environment.


def rooms_of(tables: SceneTables, text: str) -> EnvParams:
    targets = dict.fromkeys(ROOMS, tables.targets)
    params = make_params(tables, targets, no_parents(tables), (50,) * 4, SPEC)
    words = np.random.default_rng(0).normal(size=(len(tables.classes), 5))
    return with_noise(params, tables, sense_noise.parse(text), words)


@functools.partial(jax.jit, static_argnums=1)
def walk(params: EnvParams, batch: int = 16, key: Any = 0) -> tuple[Any, ...]:
    """What a batch of episodes shows on a random walk of 25 steps, and in the end."""
    keys = jax.random.split(jax.random.key(key), batch)
    _, state = jax.vmap(dynamics.reset, (0, None))(keys, params)

    def body(state: Any, key: jax.Array) -> tuple:
        action = jax.random.randint(key, (batch,), 0, 5)
        before = jax.vmap(dynamics.observe, (0, None))(state, params)
        out = jax.vmap(dynamics.transition, (0, 0, None))(state, action, params)
        return out.state, (before, state.pose, out.reward, out.success, out.state)

    return jax.lax.scan(body, state, jax.random.split(jax.random.key(9), 25))[1]


@pytest.fixture(scope="module")
def walks(some_rooms: SceneTables) -> dict[str, tuple]:
    noisy = rooms_of(some_rooms, "mix")
    still = noisy.replace(noise=noisy.noise.replace(**noise.levels_of(sense_noise.NONE)))
    plain = rooms_of(some_rooms, "none")
    assert plain.noise is None
    return {name: walk(p) for name, p in (("plain", plain), ("still", still), ("mix", noisy))}


@pytest.mark.slow
def test_levels_of_zero_show_and_sense_what_no_noise_does(walks: dict[str, tuple]) -> None:
    (plain, *rest), (still, *others) = walks["plain"], walks["still"]
    chex.assert_trees_all_equal(still.replace(sensors={}), plain.replace(sensors={}))
    chex.assert_trees_all_equal(still.sensors["odometry"], plain.sensors["odometry"])
    np.testing.assert_allclose(
        still.sensors["triangulation"], plain.sensors["triangulation"], rtol=1e-3, atol=2e-4
    )
    chex.assert_trees_all_equal(rest[:3], others[:3])


@pytest.mark.slow
def test_the_world_stays_as_it_is(walks: dict[str, tuple]) -> None:
    (plain, *rest), (noisy, *others) = walks["plain"], walks["mix"]
    chex.assert_trees_all_equal(rest[:3], others[:3])  # poses, rewards, successes
    assert noisy.mask.sum() < 0.9 * plain.mask.sum()
    off = np.abs(noisy.sensors["odometry"].motion - plain.sensors["odometry"].motion)[-1]
    assert np.median(off[:, :2].max(axis=1)) > 1e-3


def test_sensors_see_the_frame_that_the_agent_sees(some_rooms: SceneTables) -> None:
    params = rooms_of(some_rooms, "misses=1")
    obs, *_ = walk(params)
    assert obs.empty.all()
    assert not np.asarray(obs.sensors["triangulation"]).any()
    shown = walk(rooms_of(some_rooms, "misses=0.5"))[0]
    found = (shown.mask & (shown.classes == shown.target[..., None])).any(axis=-1)
    known = np.asarray(shown.sensors["triangulation"]).any(axis=-1)
    np.testing.assert_array_equal(known, np.logical_or.accumulate(found, axis=0))
    assert found.sum() > 20


def test_runs_repeat_and_episodes_differ(some_rooms: SceneTables) -> None:
    params = rooms_of(some_rooms, "misses=0.1:0.9,turn_bias=0.2")
    again = [walk(params)[4].noise for _ in range(2)]
    chex.assert_trees_all_equal(*again)
    levels = np.asarray(again[0].levels)[0]
    misses, bias = (levels[:, NAMES.index(name)] for name in ("misses", "turn_bias"))
    assert len(set(misses.tolist())) == len(misses)
    assert 0.1 <= misses.min() < 0.35
    assert 0.65 < misses.max() <= 0.9
    assert set(np.round(bias, 6).tolist()) == {np.float32(0.2).round(6), np.float32(-0.2).round(6)}
    assert len(np.unique(np.asarray(again[0].key)[0], axis=0)) == len(misses)


def test_a_failed_turn_turns_what_the_agent_believes_alone(some_rooms: SceneTables) -> None:
    params = rooms_of(some_rooms, "failed_turns=1")
    state = jax.jit(dynamics.start)(jnp.int32(0), jnp.int32(0), params)
    out = jax.jit(dynamics.transition)(state, jnp.int32(2), params)
    assert int(out.state.pose) == 0
    assert int(out.state.sensors["odometry"].heading) == 1
    free = np.flatnonzero(some_rooms.next_position[:, 0] != np.arange(len(some_rooms.position)))[0]
    pose = some_rooms.grid.join(free, 0, some_rooms.grid.level)
    state = jax.jit(dynamics.start)(jnp.int32(pose), jnp.int32(0), params)
    out = jax.jit(dynamics.transition)(state, jnp.int32(Action.MOVE_AHEAD), params)
    assert int(out.state.pose) != pose


@pytest.mark.slow
def test_jit_is_eager_and_vmap_a_loop() -> None:
    seen, corners = frame_of(TABLE[:K])
    bits = jax.random.bits(jax.random.key(1), (3, 8, K + EXTRA + 1), jnp.uint16)
    own = episode({**dict.fromkeys(NAMES, 0.1), "false_positives": 2.0})
    together = jax.vmap(detect, (None, None, 0, None))(seen, corners, bits, own)
    slips = jax.jit(jax.vmap(noise.slip, (0, None)))(bits, own)
    for i in range(3):
        alone = noise.detect(seen, corners, bits[i], own, PARAMS, ROW_CLASS)
        one, slipped = jax.tree.map(lambda x, i=i: x[i], (together, slips))
        chex.assert_trees_all_close(alone, one, atol=1e-6)
        chex.assert_trees_all_close(noise.slip(bits[i], own), slipped, atol=1e-6)


@chex.assert_max_traces(1)
def traced(params: EnvParams) -> Any:
    return dynamics.reset(jax.random.key(0), params)


def test_all_levels_are_one_program(some_rooms: SceneTables) -> None:
    params = rooms_of(some_rooms, "mix")
    show = jax.jit(traced)
    for levels in sense_noise.SWEEPS["misses"].values():
        show(params.replace(noise=params.noise.replace(**noise.levels_of(levels))))


def test_levels_have_the_fields_of_the_configuration() -> None:
    assert tuple(field.name for field in dataclasses.fields(SenseNoise)) == NAMES
