"""A trained agent on its own: what it decides is what the network in the environment decides."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import config as configs
from tdanet_jax.agent.agent import Agent
from tdanet_jax.agent.detection import Detection
from tdanet_jax.agent.navigator import Navigator, NavigatorConfig
from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import TEST_STEP_LIMITS, make_params
from tdanet_jax.env.reward import find_parents
from tdanet_jax.models import actor_critic
from tdanet_jax.models.classes import ClassVocabulary, make_vocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.scenes import dataset, tabulation
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.sensors import odometry
from tdanet_jax.sensors.triangulation import no_estimate
from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot
from tdanet_jax.vocabulary import TARGETS, Action
from tests.conftest import TINY, save_untrained
from tests.support import samples, step_counter, toy

CONFIG = TrainConfig(network=NetworkConfig(width=16, hidden=16, precision="float32"))


@pytest.fixture(scope="module")
def weights(glove):
    model = make_model(CONFIG, ClassVocabulary())
    return samples.parameters(model, glove.table(["Mug", "Bed"]))


@pytest.fixture
def agent(weights, glove):
    return Agent(CONFIG, weights, glove)


@pytest.fixture(scope="module")
def odometry_agent(glove):
    """An agent with odometry that matters to it; it mostly moves ahead."""
    return moving_by_odometry(glove, NetworkConfig(odometry=True))


@pytest.fixture(scope="module")
def triangulating_agent(glove):
    """One that triangulates, too."""
    return moving_by_odometry(glove, NetworkConfig(odometry=True, triangulation=True))


@pytest.fixture(scope="module")
def merging_agent(glove):
    """One with odometry, of a model that is shown one box for all objects of a class."""
    network = NetworkConfig(odometry=True, rows="class")
    return moving_by_odometry(glove, network)


@pytest.fixture(scope="module")
def counting_agent(glove):
    """One with odometry and a custom sensor."""
    return moving_by_odometry(glove, NetworkConfig(odometry=True, sensors=(step_counter.NAME,)))


def moving_by_odometry(glove, network):
    network = dataclasses.replace(network, width=16, hidden=16, precision="float32")
    config = dataclasses.replace(CONFIG, network=network)
    words = glove.table(["Mug", "Bed"])
    weights = samples.moving_by_odometry(make_model(config, ClassVocabulary()), words)
    if network.triangulation:  # nine of its inputs, and mostly zero
        layer = weights["way"]
        layer["kernel"] = layer["kernel"].at[-9:].multiply(5.0)
    return Agent(config, weights, glove)


def detections_of(tables, pose):
    rows = slice(tables.row_start[pose], tables.row_start[pose + 1])
    names = [tables.classes[c] for c in tables.row_class[rows]]
    boxes = tables.row_box[rows] / (tables.image * tables.subpixel)
    return [Detection(name, *map(float, box)) for name, box in zip(names, boxes, strict=True)]


observe = jax.jit(jax.vmap(dynamics.observe, (0, None)))
transition = jax.jit(jax.vmap(dynamics.transition, (0, 0, None)))
start = jax.jit(jax.vmap(dynamics.start, (0, 0, None)))
forward = jax.jit(actor_critic.forward, static_argnums=0)


def decide_alike(agent, some_rooms, glove, rotation=0, steps=3):
    """The agent and its network in the environment, side by side; how often it was stopped."""
    parents = find_parents(some_rooms, TARGETS)
    params = make_params(some_rooms, TARGETS, parents, TEST_STEP_LIMITS, agent.model.spec)
    model, weights = agent.model, agent.weights
    table = actor_critic.prepare(model, weights, jnp.asarray(glove.table(some_rooms.classes)))
    # It begins where it cannot move ahead.
    ahead = some_rooms.next_position[:, rotation // 45]
    position = int(np.flatnonzero(ahead == np.arange(len(ahead)))[9])
    goal = some_rooms.targets.index("Mug")
    one = jnp.array([position * 16 + rotation // 45 * 2]), jnp.array([goal])
    state = start(*one, params)
    carry, probs, is_first = model.initial_carry(1, weights), jnp.zeros((1, 6)), jnp.zeros(1, bool)
    own, blocked, stopped = agent.start(rotation), False, 0
    for key in jax.random.split(jax.random.key(3), steps):
        obs = observe(state, params)
        carry, out = forward(model, weights, table, carry, obs, probs, is_first)
        probs = jax.nn.softmax(out.logits)
        seen, pose = detections_of(some_rooms, int(state.pose[0])), int(state.pose[0])
        _, greedy = agent.act(own, seen, "Mug", blocked=blocked)
        assert greedy.action == Action(int(probs.argmax()))
        own, decision = agent.act(own, seen, "Mug", key, blocked)
        np.testing.assert_allclose(decision.probabilities, probs[0], rtol=1e-4)
        np.testing.assert_allclose(decision.value, out.value[0], rtol=1e-4, atol=1e-6)
        assert decision.action == int(jax.random.categorical(key, out.logits)[0])
        state = transition(state, jnp.array([decision.action]), params).state
        blocked = decision.action == Action.MOVE_AHEAD and int(state.pose[0]) == pose
        stopped += blocked
    return stopped


@pytest.mark.parametrize("rotation", [pytest.param(0, marks=pytest.mark.slow), 225])
@pytest.mark.parametrize(
    "who",
    [
        pytest.param("agent", marks=pytest.mark.slow),
        "triangulating_agent",
        pytest.param("merging_agent", marks=pytest.mark.slow),
        pytest.param("counting_agent", marks=pytest.mark.slow),
    ],
)
def test_it_decides_as_the_network_does_in_the_environment(
    some_rooms, glove, who, rotation, request
):
    chosen = request.getfixturevalue(who)
    assert chosen.model.spec.rows == ("class" if who == "merging_agent" else "object")
    steps = 25 if chosen.model.spec.sensors else 3
    stopped = decide_alike(chosen, some_rooms, glove, rotation, steps)
    assert 0 < stopped < steps - 10 or who == "agent"


def with_estimate(state, estimate):
    return state._replace(sensors={**state.sensors, "triangulation": estimate})


def test_the_estimate_of_the_target_matters(odometry_agent, triangulating_agent):
    """It remembers where the target was, and not where others were."""
    mug, sink = Detection("mug", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.1, 0.1, 0.3, 0.4)

    def sensors(agent, seen, target="mug"):
        state, _ = agent.act(agent.start(), [sink, seen], target)
        return state.sensors

    assert list(sensors(odometry_agent, mug)) == ["odometry"]
    known = sensors(triangulating_agent, mug)["triangulation"]
    assert float(known.normal[0, 0]) > 0
    assert not sensors(triangulating_agent, sink)["triangulation"].normal.any()
    state, _ = triangulating_agent.act(triangulating_agent.start(), [mug, sink], "mug")
    state = state._replace(action=jnp.int32(Action.MOVE_AHEAD))
    unseen = with_estimate(state, no_estimate())
    moved, blocked, forgot = (
        triangulating_agent.act(start, [sink], "mug", blocked=stopped)[1].probabilities
        for start, stopped in ((state, False), (state, True), (unseen, False))
    )
    assert np.abs(moved - forgot).max() > 1e-3
    assert np.abs(moved - blocked).max() > 1e-3


@pytest.mark.parametrize(
    ("target", "label"),
    [("television", "tv"), ("armchair", "Arm-Chairs_2"), ("mug", "Mug_1"), ("TV set", "tvmonitor"),
     ("remote controls", "remote"), ("zebra", "Zebras"), ("lampstand", "Lamp-Stand_3")],
)  # fmt: skip
def test_the_target_is_recognised_by_any_of_its_names(triangulating_agent, target, label):
    """What it decides and remembers is the same as if both had one name."""
    sink = Detection("sink", 0.6, 0.1, 0.8, 0.4)
    name = triangulating_agent.labels.resolve(target)

    def second(asked, detected):
        seen = [sink, Detection(detected, 0.1, 0.1, 0.3, 0.4)]
        state, _ = triangulating_agent.act(triangulating_agent.start(), seen, asked)
        return triangulating_agent.act(state, [sink], asked, blocked=False)

    (one, decided), (other, expected) = second(target, label), second(name, name)
    assert one.sensors["triangulation"].normal.any()
    chex.assert_trees_all_equal(one, other)
    np.testing.assert_array_equal(decided.probabilities, expected.probabilities)


def test_a_navigator_recognises_the_target_by_any_of_its_names(triangulating_agent):
    config = NavigatorConfig(forbid=("Done",), keep_frames=1)

    def looks_for(target, *labels):
        nav = Navigator(triangulating_agent, config=config).reset(target)
        for label in labels:
            nav.step([Detection(label, 0.1, 0.1, 0.3, 0.4)], blocked=True)
        assert len(nav.seen) == 1  # it is the same thing: the earlier box is not kept
        return nav.decision.probabilities

    one, other = looks_for("television", "tv", "TVs"), looks_for("tv", "Television", "television")
    np.testing.assert_array_equal(one, other)
    assert (one != looks_for("television", "mug", "mug")).any()


def test_a_class_without_a_word_vector_is_unknown_until_it_is_given_one(weights, glove):
    """As of a run in rooms with such objects, which it did not see."""
    agent = Agent(CONFIG, weights, glove, ClassVocabulary(("zzqx", "Mug"), (0, 1)))
    mug, odd = (Detection(name, 0.1, 0.1, 0.3, 0.4) for name in ("mug", "zzqx"))
    agent.act(agent.start(), [mug], "mug")
    with pytest.raises(KeyError, match="no word vector for zzqx"):
        agent.act(agent.start(), [odd], "mug")
    agent.add_words({"zzqx": glove.embed("mug", None)})
    _, one = agent.act(agent.start(), [odd], "zzqx")
    _, other = agent.act(agent.start(), [mug], "mug")
    np.testing.assert_allclose(one.probabilities, other.probabilities, rtol=1e-4)


@pytest.mark.parametrize(
    "names", [("Mug", "mug", "Bowl", "Bed"), ("\u732b", "\u72ac", "Bowl", "Bed")]
)
def test_classes_of_equal_words_leave_the_others_their_vectors(weights, glove, names):
    agent = Agent(CONFIG, weights, glove, ClassVocabulary(names, (0, 1, 2, 3)))
    plain = Agent(CONFIG, weights, glove)
    seen = [Detection(name, 0.1, 0.1, 0.3, 0.4) for name in ("bed", "bowl", "mug", "sink")]
    for target in ("bowl", "bed", "mug", "toaster"):
        one, other = (a.act(a.start(), seen, target)[1] for a in (agent, plain))
        np.testing.assert_allclose(one.probabilities, other.probabilities, rtol=1e-4)
        np.testing.assert_allclose(one.attention, other.attention, rtol=1e-4)


@pytest.mark.parametrize("at_once", [True, False])
def test_further_words_leave_the_classes_their_vectors(weights, glove, at_once):
    """Trained with the vector of "lamp stand", and with the mean of "coffee" and "machine"."""
    assert "lampstand" not in glove.index
    more = dict.fromkeys(("lampstand", "coffee machine", "zzqx"), -glove.embed("sink", None))
    classes = ClassVocabulary(("Lampstand", "CoffeeMachine", "zzqx"), (0, 1, 2))
    agent, plain = (
        Agent(CONFIG, weights, glove, classes, more_words=words)
        for words in (more if at_once else None, None)
    )
    if not at_once:
        assert agent.add_words(more) == 3
    seen = [Detection(name, 0.1, 0.1, 0.3, 0.4) for name in ("lampstand", "coffee machine", "mug")]
    for target in ("lampstand", "CoffeeMachine"):
        one, other = (a.act(a.start(), seen, target)[1] for a in (agent, plain))
        np.testing.assert_allclose(one.probabilities, other.probabilities, rtol=1e-5)
    assert agent.knows("zzqx")
    assert not plain.knows("zzqx")


def test_of_another_target_an_agent_has_never_seen_anything(triangulating_agent):
    mug, sink = Detection("mug", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.6, 0.1, 0.8, 0.4)
    state, _ = triangulating_agent.act(triangulating_agent.start(), [mug, sink], "mug")
    state = state._replace(action=jnp.int32(Action.MOVE_AHEAD))
    assert state.sensors["triangulation"].normal.any()
    never = with_estimate(state, no_estimate())

    def after(state, seen, target):
        return triangulating_agent.act(state, seen, target, blocked=False)

    for seen, target in (([], "sink"), ([mug, sink], "sink"), ([mug], "toaster")):
        (kept, one), (new, other) = (after(m, seen, target) for m in (state, never))
        np.testing.assert_array_equal(one.probabilities, other.probabilities)
        assert one.value == other.value
        chex.assert_trees_all_equal(kept.sensors, new.sensors)
        # It remembers its pose all the same, and nothing of the mug when it looks for that again.
        assert tuple(kept.sensors["odometry"].cell) == (0, 1)
        back, _ = after(kept._replace(action=jnp.int32(Action.LOOK_UP)), [], "mug")
        assert not back.sensors["triangulation"].normal.any()
    # A new label in between is no other target.
    same, _ = after(state, [Detection("vase", 0.6, 0.1, 0.8, 0.4)], "mug")
    assert same.sensors["triangulation"].normal.any()


@dataclasses.dataclass(frozen=True)
class Scored(Detection):
    """A detection with the detector's confidence, if there is one."""

    score: float | None = None


def test_an_agent_is_shown_scores_and_takes_a_missing_one_for_1(glove):
    config = TrainConfig(network=dataclasses.replace(CONFIG.network, scores=True))
    model = make_model(config, ClassVocabulary())
    agent = Agent(config, samples.parameters(model, glove.table(["Mug", "Bed"])), glove)
    corners = ("mug", 0.1, 0.1, 0.3, 0.4)

    def value(*seen):
        return agent.act(agent.start(), seen, "mug")[1].value

    assert value(Detection(*corners)) == value(Scored(*corners)) == value(Scored(*corners, 1.0))
    assert value(Scored(*corners, 0.5)) != value(Detection(*corners))


def test_a_custom_sensor_counts_and_matters(counting_agent):
    mug, sink = Detection("mug", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.6, 0.1, 0.8, 0.4)
    state = counting_agent.start(90)

    def counts(state):
        return {name: int(value) for name, value in state.sensors[step_counter.NAME].items()}

    assert counts(state) == {"actions": 0, "frames": 0, "path": 0, "rotation": 2}
    state, _ = counting_agent.act(state, [mug], "mug")
    assert counts(state) == {"actions": 0, "frames": 1, "path": 0, "rotation": 2}
    state, _ = counting_agent.act(
        state._replace(action=jnp.int32(Action.MOVE_AHEAD)), [mug, mug, sink], "mug", blocked=False
    )
    assert counts(state) == {"actions": 1, "frames": 2, "path": 1, "rotation": 2}
    turned = state._replace(action=jnp.int32(Action.ROTATE_LEFT))
    same, decision = counting_agent.act(turned, [sink], "mug")
    assert counts(same) == {"actions": 2, "frames": 2, "path": 2, "rotation": 2}
    other, _ = counting_agent.act(turned, [sink], "sink")
    assert counts(other)["frames"] == 1
    longer = {**turned.sensors[step_counter.NAME], "actions": jnp.int32(40)}
    late = turned._replace(sensors={**turned.sensors, step_counter.NAME: longer})
    changed = counting_agent.act(late, [sink], "mug")[1].probabilities
    assert np.abs(changed - decision.probabilities).max() > 1e-3


def test_odometry_matters(odometry_agent):
    seen = [Detection("sink", 0.1, 0.1, 0.3, 0.4)]

    def second(rotation=0, blocked=False, action=Action.MOVE_AHEAD):
        state, _ = odometry_agent.act(odometry_agent.start(rotation), seen, "mug")
        state = state._replace(action=jnp.int32(action))
        return odometry_agent.act(state, seen, "mug", blocked=blocked)[1].probabilities

    plain = second()
    for other in (
        second(rotation=45),
        second(blocked=True),
        second(action=Action.ROTATE_LEFT),
    ):
        assert np.abs(other - plain).max() > 1e-3
    np.testing.assert_array_equal(second(rotation=-270), plain)
    np.testing.assert_array_equal(second(rotation=315), second(rotation=45))
    # Only a MoveAhead can be blocked.
    turned = second(action=Action.ROTATE_LEFT, blocked=True)
    np.testing.assert_array_equal(turned, second(action=Action.ROTATE_LEFT))


def test_an_agent_without_sensors_needs_not_be_told(agent):
    seen = [Detection("sink", 0.1, 0.1, 0.3, 0.4)]
    assert agent.start(45).sensors == {}
    state, plain = agent.act(agent.start(45), seen, "mug", blocked=True)
    np.testing.assert_array_equal(
        plain.probabilities, agent.act(agent.start(), seen, "mug")[1].probabilities
    )
    assert state.sensors == {}


def test_an_agent_with_sensors_must_be_told_whether_its_move_was_blocked(odometry_agent):
    seen = [Detection("sink", 0.1, 0.1, 0.3, 0.4)]
    state, _ = odometry_agent.act(odometry_agent.start(), seen, "mug")
    moved = state._replace(action=jnp.int32(Action.MOVE_AHEAD))
    with pytest.raises(ValueError, match="whether its MoveAhead was `blocked`"):
        odometry_agent.act(moved, seen, "mug")
    turned = state._replace(action=jnp.int32(Action.ROTATE_LEFT))
    odometry_agent.act(turned, seen, "mug")


def test_odometry_knows_of_a_start_that_looks_down(odometry_agent):
    assert int(odometry_agent.start(horizon=30).sensors["odometry"].horizon) == 1
    assert int(odometry_agent.start(45.0001, 0.0).sensors["odometry"].heading) == 1
    with pytest.raises(ValueError, match="horizon 15: not among 0, 30 degrees"):
        odometry_agent.start(horizon=15)


@pytest.mark.parametrize("rotation", [30, -1, 44.5])
def test_a_rotation_off_the_eight_is_refused(agent, odometry_agent, rotation):
    for one in (agent, odometry_agent):
        with pytest.raises(ValueError, match=f"rotation {rotation}: not a multiple of 45"):
            one.start(rotation)


@pytest.mark.slow
def test_a_network_of_ithors_rooms_goes_to_rooms_on_another_grid(some_rooms, glove, tmp_path):
    """In turns of 30 degrees and three horizons; evaluated there, and as an agent on its own."""
    grid = PoseGrid(0.25, 12, (-30, 0, 30))
    network = dataclasses.replace(TINY.network, odometry=True, triangulation=True)
    run, data = tmp_path / "run", tmp_path / "rooms.npz"
    save_untrained(dataclasses.replace(TINY, network=network), run, some_rooms, glove)
    apple = toy.thing("Apple", (0.0, toy.CAMERA, 1.8))  # near enough for there to be no void
    hall = dataclasses.replace(toy.room(toy.line(5), apple), room_type="hall", grid=grid)
    scenes = [dataclasses.replace(hall, name=name) for name in "AB"]
    rooms = Rooms(tabulation.build(scenes), Extras(parts={"A": "train", "B": "test"}))
    dataset.save_rooms(rooms, data)
    results = tdanet_jax.evaluate(run, data=str(data), policy="greedy", out=tmp_path / "out")
    assert list(results["by_room"]) == ["hall"]
    rows = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    assert {json.loads(row)["rotation"] for row in rows} == set(range(0, 360, 30))
    agent = tdanet_jax.load(run, grid=grid)
    state = agent.start(150, -30)
    assert int(state.sensors["odometry"].heading) == 2  # 60 degrees from an axis of the grid
    assert int(state.sensors["odometry"].horizon) == 0
    state, decision = agent.act(state, [Detection("apple", 0.4, 0.4, 0.6, 0.6)], "apple")
    state, _ = agent.act(state, [], "apple", blocked=decision.action == Action.MOVE_AHEAD)
    with pytest.raises(ValueError, match="rotation 45: not a multiple of 30 degrees"):
        agent.start(45)
    with pytest.raises(ValueError, match="horizon 15: not among -30, 0, 30 degrees"):
        agent.start(0, 15)


@pytest.fixture(scope="module")
def row_agent(some_rooms, glove):
    """An agent with a row per known class, and parameters that make every row matter."""
    classes = make_vocabulary(some_rooms.classes, {"Toaster", "Laptop", "Bread"})
    config = dataclasses.replace(CONFIG, model="ssnet")
    model = make_model(config, classes)
    words = jnp.asarray(glove.table(some_rooms.classes))
    weights = samples.parameters(model, words)
    return Agent(config, weights, glove, classes)


def test_a_model_with_a_row_per_class_is_shown_what_it_was_in_training(
    row_agent, some_rooms, glove
):
    assert row_agent.model.spec.rows == "class"
    decide_alike(row_agent, some_rooms, glove)


def test_a_model_with_a_row_per_class_sees_known_classes_alone_and_any_target(row_agent):
    sink, mug = Detection("sink", 0.1, 0.1, 0.3, 0.4), Detection("mug", 0.5, 0.5, 0.6, 0.7)
    others = [Detection(name, 0.0, 0.0, 1.0, 1.0) for name in ("toaster", "dog", "bread")]

    def probabilities(seen, target):
        return row_agent.act(row_agent.start(), seen, target)[1].probabilities

    plain = probabilities([sink, mug], "toaster")
    np.testing.assert_allclose(probabilities([mug, *others, sink], "toaster"), plain, rtol=1e-5)
    assert np.abs(probabilities([sink], "toaster") - plain).max() > 1e-4
    assert np.abs(probabilities([sink, mug], "dog") - plain).max() > 1e-4
    assert row_agent.act(row_agent.start(), [sink], "mug")[1].attention is None


def test_a_model_that_sees_an_image_can_be_looked_into_but_not_asked(some_rooms, glove):
    classes = make_vocabulary(some_rooms.classes, {"Toaster"})
    network = dataclasses.replace(CONFIG.network, image="raster")
    config = dataclasses.replace(CONFIG, model="baseline", network=network)
    words = glove.table(some_rooms.classes)
    agent = Agent(config, samples.parameters(make_model(config, classes), words), glove, classes)
    assert agent.weights["actor"]["kernel"].shape == (16, 6)
    with pytest.raises(ValueError, match="baseline needs an image; an agent is shown det"):
        agent.act(agent.start(), [Detection("sink", 0.1, 0.1, 0.3, 0.4)], "mug")
    with pytest.raises(ValueError, match="baseline needs an image"):
        Navigator(agent)


def test_attention_sums_to_one_over_the_detections_and_none_is_fine(agent):
    seen = [Detection("coffee machine", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.5, 0.5, 1, 1)]
    state, decision = agent.act(agent.start(), seen, "toaster")
    assert decision.attention.shape == (2,)
    assert decision.attention.sum() == pytest.approx(1, abs=1e-5)
    _, blank = agent.act(state, [], "toaster")
    assert blank.attention.shape == (0,)
    assert np.isfinite(blank.probabilities).all()


def test_order_and_new_labels_change_nothing(agent):
    seen = [Detection(name, 0.1, 0.1, 0.3, 0.4) for name in ("sink", "mug", "plate")]
    _, first = agent.act(agent.start(), seen, "mug")
    agent.act(agent.start(), [Detection("dog", 0, 0, 1, 1)], "horse")
    _, second = agent.act(agent.start(), seen[::-1], "mug")
    np.testing.assert_allclose(first.probabilities, second.probabilities, rtol=1e-5)
    np.testing.assert_allclose(first.attention, second.attention[::-1], rtol=1e-5)


def test_a_key_samples_and_the_same_key_samples_the_same(agent):
    seen = [Detection("mug", 0.1, 0.1, 0.3, 0.4)]
    keys = jax.random.split(jax.random.key(0), 20)
    actions = [agent.act(agent.start(), seen, "mug", key)[1].action for key in keys]
    again = [agent.act(agent.start(), seen, "mug", key)[1].action for key in keys]
    assert actions == again
    assert len(set(actions)) > 1


def test_what_is_forbidden_is_never_done(agent):
    seen = [Detection("mug", 0.1, 0.1, 0.3, 0.4)]
    _, free = agent.act(agent.start(), seen, "mug")
    tilts = (Action.LOOK_UP, Action.LOOK_DOWN)
    state, decision = agent.act(agent.start(), seen, "mug", forbidden=tilts)
    kept = [action for action in Action if action not in tilts]
    assert not decision.probabilities[[*tilts]].any()
    share = free.probabilities[kept] / free.probabilities[kept].sum()
    np.testing.assert_allclose(decision.probabilities[kept], share, rtol=1e-5)
    # The network remembers what it would have done, as in training.
    np.testing.assert_allclose(state.recurrent.prev_action_probs[0], free.probabilities, rtol=1e-6)
    others = [action for action in Action if action != free.action]
    assert agent.act(agent.start(), seen, "mug", forbidden=others)[1].action == free.action
    best = agent.act(agent.start(), seen, "mug", forbidden=[free.action])[1]
    assert best.action != free.action
    sampled = {
        agent.act(agent.start(), seen, "mug", key, forbidden=others[1:])[1].action
        for key in jax.random.split(jax.random.key(0), 20)
    }
    assert sampled == {free.action, others[0]}
    with pytest.raises(ValueError, match="every action is forbidden"):
        agent.act(agent.start(), seen, "mug", forbidden=Action)


@pytest.mark.parametrize("forbidden", [["LookUp"], [7], [-1], [[0]], [True]])
def test_what_is_no_action_cannot_be_forbidden(agent, forbidden):
    with pytest.raises(ValueError, match=r"^forbidden .*: must be an Action, 0 to 5$"):
        agent.act(agent.start(), [], "mug", forbidden=forbidden)


@pytest.mark.parametrize("pose", [5.0, (0, 0, 0)])
def test_a_pose_must_be_measured(odometry_agent, pose):
    with pytest.raises(ValueError, match=r"^pose: must be what `measured_pose` gives$"):
        odometry_agent.act(odometry_agent.start(measured=True), [], "mug", pose=pose)


def several(agent, steps, together):
    """What three robots decide in some steps, by `act_many` or one after the other."""
    boxes = [Detection(name, 0.1, 0.1, 0.3, 0.4) for name in ("sink", "mug", "plate")]
    targets = ["mug", "sink", "toaster"]
    states = [agent.start(rotation) for rotation in (0, 45, 90)]
    shown = []
    for step in range(steps):
        frames = [boxes[: (step + i) % 4] * (1 + 8 * i * step) for i in range(3)]
        keys = [*jax.random.split(jax.random.key(step), 2), None]
        told = [False, step % 2 == 1, False]
        if together:
            done = agent.act_many(states, frames, targets, keys, told, forbidden=[5])
        else:
            every = zip(states, frames, targets, keys, told, strict=True)
            done = [agent.act(*one, forbidden=[Action.DONE]) for one in every]
        states = [state for state, _ in done]
        shown += [decision for _, decision in done]
    return states, shown


@pytest.mark.parametrize(
    "who", [pytest.param("agent", marks=pytest.mark.slow), "triangulating_agent"]
)
def test_robots_together_decide_as_each_on_its_own(who, request):
    chosen = request.getfixturevalue(who)
    (one, alone), (other, together) = several(chosen, 3, False), several(chosen, 3, True)
    chex.assert_trees_all_close(
        [s.recurrent for s in one], [s.recurrent for s in other], rtol=1e-4, atol=1e-5
    )
    for a, b in zip(alone, together, strict=True):
        assert a.action == b.action
        np.testing.assert_allclose(a.probabilities, b.probabilities, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(a.attention, b.attention, rtol=1e-4, atol=1e-6)
    assert chosen._decide_many._cache_size() <= 3  # one for each number of rows


def test_robots_together_are_told_equally_much(odometry_agent):
    states = [odometry_agent.start(), odometry_agent.start(measured=True)]
    assert odometry_agent.act_many([], [], []) == []
    with pytest.raises(ValueError, match="2 states: give as many frames, targets, keys, blocked"):
        odometry_agent.act_many(states, [[]], ["mug", "mug"])
    pose = odometry.measured_pose(ITHOR, 0, 0, 0, 0)
    with pytest.raises(ValueError, match="poses: give one for each robot, or none"):
        odometry_agent.act_many(states, [[], []], ["mug", "mug"], poses=[None, pose])


def test_what_robots_together_are_told_may_be_an_array(odometry_agent):
    """Of one robot, too: array([False]) is not nothing."""
    for count in (1, 2):
        states, frames, targets = [odometry_agent.start()] * count, [[]] * count, ["mug"] * count
        keys, told = jax.random.split(jax.random.key(0), count), [True, False][-count:]
        states = [s for s, _ in odometry_agent.act_many(states, frames, targets, blocked=told)]
        as_lists = odometry_agent.act_many(states, frames, targets, [*keys], told)
        as_arrays = odometry_agent.act_many(states, frames, targets, keys, np.array(told))
        assert [d.action for _, d in as_lists] == [d.action for _, d in as_arrays]


def test_measured_poses_are_believed(triangulating_agent):
    """Where motion goes as planned they change nothing; else the map and estimate follow them."""
    mug, sink = Detection("mug", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.6, 0.1, 0.8, 0.4)

    def second(ahead, turned, blocked=False):
        state, _ = triangulating_agent.act(
            triangulating_agent.start(measured=True), [mug, sink], "mug", pose=pose(0, 0)
        )
        state = state._replace(action=jnp.int32(Action.MOVE_AHEAD))
        return triangulating_agent.act(
            state, [sink], "mug", blocked=blocked, pose=pose(ahead, turned)
        )

    def pose(ahead, turned):
        return odometry.measured_pose(ITHOR, 0, ahead, 0.0, turned)

    state, _ = triangulating_agent.act(triangulating_agent.start(), [mug, sink], "mug")
    state = state._replace(action=jnp.int32(Action.MOVE_AHEAD))
    _, plain = triangulating_agent.act(state, [sink], "mug", blocked=False)
    after, decision = second(0.25, 0)
    np.testing.assert_allclose(decision.probabilities, plain.probabilities, rtol=1e-4)
    for ahead, turned in ((0.1, 0), (0.25, 10)):
        other = second(ahead, turned)[1].probabilities
        assert np.abs(other - plain.probabilities).max() > 1e-4
    (both,) = triangulating_agent.act_many(
        [after], [[sink]], ["mug"], blocked=[False], poses=[pose(0.4, 0)]
    )
    alone = triangulating_agent.act(after, [sink], "mug", blocked=False, pose=pose(0.4, 0))
    np.testing.assert_allclose(both[1].probabilities, alone[1].probabilities, rtol=1e-4)
    for begun, given in ((after, None), (state, pose(0, 0))):
        with pytest.raises(ValueError, match="a pose is measured in every step of an episode"):
            triangulating_agent.act(begun, [], "mug", blocked=False, pose=given)


def test_an_agent_is_given_more_words(weights, glove, tmp_path):
    agent = Agent(CONFIG, weights, glove, synonyms={"Mug": ["Humpen"]})
    mug = Detection("mug", 0.1, 0.1, 0.3, 0.4)
    _, before = agent.act(agent.start(), [mug], "mug")
    with pytest.raises(KeyError, match=r"no word vector for qwertzu.*agent\.add_words adds words"):
        agent.act(agent.start(), [], "qwertzu")
    sink = glove.embed("sink", None)
    assert agent.add_words({"Qwertzu": 2 * sink, "mug": -sink}) == 1
    _, after = agent.act(agent.start(), [mug], "humpen")
    np.testing.assert_array_equal(before.probabilities, after.probabilities)
    _, one = agent.act(agent.start(), [mug, Detection("qwertzus", 0.5, 0.5, 0.9, 0.9)], "qwertzu")
    _, other = agent.act(agent.start(), [mug, Detection("sink", 0.5, 0.5, 0.9, 0.9)], "sink")
    np.testing.assert_allclose(one.probabilities, other.probabilities, rtol=1e-4)
    path = tmp_path / "more.txt"
    path.write_text("zwiebacky 1 2 3\n")
    with pytest.raises(
        ValueError, match=r"more\.txt: vectors of 3 numbers, where the others have 50"
    ):
        agent.add_words(path)
    assert not agent.knows("zwiebacky")
    path.write_text(f"zwiebacky {' '.join(map(str, sink))}\n")
    assert agent.add_words(path) == 1
    assert agent.knows("zwiebacky")


def test_what_an_agent_knows(weights, glove):
    agent = Agent(CONFIG, weights, glove, synonyms={"Mug": ["Humpen"]})
    assert all(map(agent.knows, ("ArmChair", "armchair_2", "backpack", "wooden spoon", "Humpen")))
    assert not any(map(agent.knows, ("qwertzu", "", "televison")))
    seen = [Detection("Humpen", 0.1, 0.1, 0.3, 0.4)]
    named = [Detection("mug", 0.1, 0.1, 0.3, 0.4)]
    _, one = agent.act(agent.start(), seen, "Mug")
    _, other = agent.act(agent.start(), named, "Mug")
    np.testing.assert_array_equal(one.probabilities, other.probabilities)


def test_a_table_of_synonyms_is_loaded_with_the_agent(weights, glove, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(configs.to_json(CONFIG)))
    path = history.write(tmp_path, Snapshot(weights, 40, 3, 1.0, 1, "any"))
    table = tmp_path / "mine.json"
    table.write_text('{"Mug": ["Humpen"]}')
    assert tdanet_jax.load(path, synonyms=table).labels.resolve("humpen") == "Mug"
    table.write_text('{"Mug": "Humpen"}')
    with pytest.raises(ValueError, match=r"mine\.json: Mug: not a list of names"):
        tdanet_jax.load(path, synonyms=table)


def test_bad_input_is_refused(agent, tmp_path):
    rows = len(agent._rows)
    for seen, target in (([], "qwertzu"), ([Detection("qwertzu", 0, 0, 1, 1)], "mug")):
        with pytest.raises(KeyError, match="label 'qwertzu': no word vector for qwertzu"):
            agent.act(agent.start(), seen, target)
    assert len(agent._rows) == rows
    with pytest.raises(ValueError, match="is this the folder of a run"):
        tdanet_jax.load(tmp_path)


#: A run of the first version of the software, width 4, and its second decision about two objects.
OLD_RUN = Path(__file__).parents[1] / "data" / "run_format_1"


def test_a_run_of_the_first_version_still_decides_as_it_did(tmp_path):
    run = shutil.copytree(OLD_RUN, tmp_path / "run")
    old = tdanet_jax.load(run)
    seen = [Detection("sink", 0.1, 0.2, 0.4, 0.5), Detection("coffee machine", 0.5, 0.5, 0.75, 1.0)]
    state = old.start()
    for _ in range(2):
        state, decision = old.act(state, seen, "toaster")
    expected = json.loads((run / "second_decision.json").read_text())
    np.testing.assert_allclose(decision.probabilities, expected["probabilities"], atol=1e-6)
    np.testing.assert_allclose(decision.value, expected["value"], atol=1e-6)
    np.testing.assert_allclose(decision.attention, expected["attention"], atol=1e-5)


def test_a_checkpoint_of_a_newer_version_is_refused_in_one_line(tmp_path):
    run = shutil.copytree(OLD_RUN, tmp_path / "run")
    meta = run / "checkpoints" / "2" / "meta" / "metadata"
    meta.write_text(meta.read_text().replace('"format": 1', '"format": 4'))
    with pytest.raises(ValueError, match="checkpoint of format 4, this version reads up to 3"):
        tdanet_jax.load(run)


def test_it_can_decide_otherwise_than_its_run(some_rooms, glove, opinionated_run, tmp_path):
    network = dataclasses.replace(
        TINY.network, odometry=True, triangulation=True, reach_threshold=0.5
    )
    run = tmp_path / "run"
    save_untrained(dataclasses.replace(TINY, network=network), run, some_rooms, glove)
    seen, told = [Detection("mug", 0.4, 0.4, 0.6, 0.6)], []
    for threshold in (None, 0.0, 0.999):
        agent = tdanet_jax.load(run, decisions=Decisions(reach_threshold=threshold))
        decision = agent.act(agent.start(), seen, "mug")[1]
        told.append(decision.probabilities[Action.DONE] > 0)
    assert told == [decision.reach >= 0.5, True, False]
    assert agent.act(agent.start(), seen, "sink")[1].reach is None
    with pytest.raises(ValueError, match=r"--reach-threshold: .* was trained without it"):
        tdanet_jax.load(opinionated_run, decisions=Decisions(reach_threshold=0.5))
    agent = tdanet_jax.load(run, decisions=Decisions(reach_threshold=0.0))
    plain = agent.act(agent.start(), seen, "mug")[1].probabilities
    given = Decisions(reach_threshold=0.0, temperature=0.5, done_bias=1.0)
    other = tdanet_jax.load(run, decisions=given)
    squared = (plain * np.exp(np.eye(6)[Action.DONE])) ** 2
    found = other.act(other.start(), seen, "mug")[1].probabilities
    np.testing.assert_allclose(found, squared / squared.sum(), rtol=1e-4)


def test_a_point_of_the_history_is_loaded_by_its_file(weights, glove, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(configs.to_json(CONFIG)))
    path = history.write(tmp_path, Snapshot(weights, 40, 3, 1.0, 1, "any"))
    loaded = tdanet_jax.load(path)
    for ours, theirs in zip(jax.tree.leaves(loaded.weights), jax.tree.leaves(weights), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_synonyms_may_be_of_further_words():
    """In one call, as `tdanet serve --words --synonyms` has them."""
    words, names = {"zwieback": [0.1] * 50}, {"zwieback": ["rusk"]}
    loaded = tdanet_jax.load(OLD_RUN, synonyms=names, more_words=words)
    assert loaded.labels.resolve("rusk") == "zwieback"
    with pytest.raises(ValueError, match="zwieback"):
        tdanet_jax.load(OLD_RUN, synonyms=names)
