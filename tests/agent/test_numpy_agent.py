"""An agent without JAX decides as the agent in JAX does, and needs nothing but NumPy."""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import Navigator, NavigatorConfig
from tdanet_jax.agent import detectors, numpy_agent
from tdanet_jax.agent.agent import Agent
from tdanet_jax.agent.detection import Detection
from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.evaluation import episodes
from tdanet_jax.labels import Labels
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.scenes import camera_view
from tdanet_jax.splits import make_split
from tdanet_jax.vocabulary import Action
from tdanet_jax.words import WordVectors
from tdanet_jax.workflows import export
from tests.support import samples
from tests.support.pages import ROOT, block

SMALL = TrainConfig(network=NetworkConfig(width=16, hidden=16, precision="float32"))
NETWORKS = {
    "default": {},
    "best": {"odometry": True, "triangulation": True},
    "robust": {
        "odometry": True,
        "triangulation": True,
        "robust_triangulation": True,
        "scores": True,
        "reach_threshold": 0.5,
        "temperature": 0.6,
        "done_bias": 1.5,
    },
    "rows": {"odometry": True, "rows": "class", "context": 6},
}


def small_agent(glove, **network):
    config = dataclasses.replace(SMALL, network=dataclasses.replace(SMALL.network, **network))
    classes = ClassVocabulary(("Mug", "Sink", "Bed"))
    weights = samples.parameters(make_model(config, classes), glove.table(["Mug", "Bed"]))
    weights["actor"]["bias"] = weights["actor"]["bias"].at[Action.DONE].add(-3.0)
    return Agent(config, weights, glove, classes)


def exported(agent, folder):
    folder.mkdir()
    export._write_agent(agent, None, folder)
    return folder


@pytest.fixture(scope="module")
def folder(glove, tmp_path_factory):
    """The folder of an untrained agent with triangulation."""
    return exported(small_agent(glove, **NETWORKS["best"]), tmp_path_factory.mktemp("a") / "out")


def draw_frame(rng):
    names = rng.choice(["mug", "Sink_2", "zebra", "tv", "coffee machine"], rng.integers(0, 5))
    corners = rng.uniform(0, 0.7, (len(names), 2))
    return [
        Detection(str(name), x, y, x + 0.2, y + 0.1, float(rng.random()))
        for name, (x, y) in zip(names, corners, strict=True)
    ]


@pytest.mark.parametrize(
    "preset",
    ["robust", "rows", *(pytest.param(n, marks=pytest.mark.slow) for n in ("default", "best"))],
)
def test_it_decides_as_in_jax(preset, glove, tmp_path):
    theirs = small_agent(glove, **NETWORKS[preset])
    ours = numpy_agent.load(exported(theirs, tmp_path / "out"))
    rng = np.random.default_rng(0)
    one, other = theirs.start(45), ours.start(45)
    never, reached = (Action.LOOK_UP,), set()
    for number in range(25):
        seen, target = draw_frame(rng), "mug" if number < 15 else "zebra"
        given = {"blocked": bool(rng.random() < 0.3), "forbidden": never if number % 2 else ()}
        one, expected = theirs.act(one, seen, target, **given)
        other, found = ours.act(other, seen, target, **given)
        assert found.action == expected.action
        loose = 1e-3 if ours.spec.sensors else 1e-5
        np.testing.assert_allclose(found.probabilities, expected.probabilities, atol=loose)
        np.testing.assert_allclose(found.value, expected.value, atol=10 * loose)
        np.testing.assert_allclose(found.attention, expected.attention, atol=1e-5)
        assert (found.reach is None) == (expected.reach is None)
        if preset == "robust":
            assert (found.reach is None) == (target not in {one.label for one in seen})
            may = found.reach is not None and found.reach >= 0.5
            assert (found.probabilities[Action.DONE] > 0) == may
            reached.add(found.reach and may)
        if found.reach is not None:
            np.testing.assert_allclose(found.reach, expected.reach, atol=loose)
    assert reached == ({True, False, None} if preset == "robust" else set())


@pytest.mark.parametrize("sampled", [True, False])
def test_if_all_else_is_forbidden_it_is_done_out_of_reach(glove, tmp_path, sampled):
    theirs = small_agent(glove, **NETWORKS["robust"])
    others = [action for action in Action if action != Action.DONE]
    for agent in (theirs, numpy_agent.load(exported(theirs, tmp_path / "out"))):
        key = agent.key(0, 0) if sampled else None
        _, decision = agent.act(agent.start(), [], "mug", key, forbidden=others)
        assert decision.action == Action.DONE
        np.testing.assert_array_equal(decision.probabilities, [0, 0, 0, 0, 0, 1])


def test_it_can_decide_otherwise_than_its_run(glove, folder, tmp_path):
    theirs = small_agent(glove, **NETWORKS["robust"])
    own = exported(theirs, tmp_path / "out")
    seen = [Detection("mug", 0.4, 0.4, 0.6, 0.6)]
    allowed = []
    for threshold in (None, 0.0, 0.999):
        agent = numpy_agent.load(own, decisions=Decisions(reach_threshold=threshold))
        allowed.append(agent.act(agent.start(), seen, "mug")[1].probabilities[Action.DONE] > 0)
    reach = agent.act(agent.start(), seen, "mug")[1].reach
    assert allowed == [reach >= 0.5, True, False]
    other = Decisions(temperature=2.0, done_bias=-1.0)
    agent = numpy_agent.load(own, decisions=other)
    assert (agent.meta.temperature, agent.meta.done_bias) == (2.0, -1.0)
    with pytest.raises(ValueError, match=r"--reach-threshold 1\.0: must be at least 0 and below 1"):
        numpy_agent.load(own, decisions=Decisions(reach_threshold=1.0))
    with pytest.raises(ValueError, match=r"--reach-threshold: .* was trained without it"):
        numpy_agent.load(folder, decisions=Decisions(reach_threshold=0.5))


def test_a_folder_of_an_older_version_decides_as_it_did(folder, tmp_path):
    older = shutil.copytree(folder, tmp_path / "older")
    meta = json.loads((older / "meta.json").read_text())
    assert (meta.pop("reach_threshold"), meta.pop("reach_units")) == (0.0, 0)
    assert (meta.pop("temperature"), meta.pop("done_bias")) == (1.0, 0.0)
    (older / "meta.json").write_text(json.dumps(meta))
    agent = numpy_agent.load(older)
    assert agent.meta == numpy_agent.load(folder).meta
    seen = [Detection("mug", 0.1, 0.1, 0.3, 0.4)]
    assert agent.act(agent.start(), seen, "mug")[1].reach is None
    (older / "meta.json").write_text(json.dumps(meta | {"temperature": 0.0}))
    with pytest.raises(ValueError, match=r"meta\.json: --temperature .*: must be"):
        numpy_agent.load(older)


def test_a_navigator_runs_it(folder):
    ours = numpy_agent.load(folder, synonyms={"Mug": ["Humpen"]})
    seen = [Detection("Humpen", 0.1, 0.1, 0.3, 0.4), Detection("sink", 0.5, 0.1, 0.8, 0.4)]

    def actions(seed):
        nav = Navigator(ours, config=NavigatorConfig(seed=seed, max_steps=20)).reset("mug")
        return [nav.step(seen, pose=(0.2 * i, 0.0, 0.1 * i)) for i in range(5) if not nav.finished]

    assert actions(1) == actions(1)
    assert len({tuple(actions(seed)) for seed in range(5)}) > 1
    assert not ours.knows("zwiebacky")
    assert ours.add_words({"zwiebacky": np.ones(50)}) == 1
    state, _ = ours.act(ours.start(), seen, "zwiebacky")
    more = {"zwiebacky": np.ones(50)}
    named = numpy_agent.load(folder, synonyms={"zwiebacky": ["zz"]}, more_words=more)
    assert named.knows("zz")
    with pytest.raises(ValueError, match="say whether its MoveAhead was `blocked`"):
        ours.act(state._replace(action=0), seen, "mug")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("meta.json", lambda text: text[:40], r"meta\.json: not JSON"),
        ("meta.json", lambda text: "[]", r"meta\.json: not an agent in the format"),
        ("meta.json", lambda text: text.replace('"hidden": 16', '"hidden": "x"'), "hidden is miss"),
        ("meta.json", lambda text: text.replace('"hidden": 16', '"hidden": 8'), "actor/kernel is"),
        ("meta.json", lambda text: text.replace('"odometry"', '"os.path"'), "no sensor is called"),
        (
            "meta.json",
            lambda text: text.replace('"reach_units": 0', '"reach_units": 8').replace(
                "triangulation", "odometry"
            ),
            "reach_units: needs triangulation",
        ),
        *(
            ("meta.json", lambda text, field=field: json.dumps(json.loads(text) | field), message)
            for field, message in [
                ({"rows": "objects"}, r"meta\.json: rows objects: must be object or class"),
                ({"rows": "class"}, r"meta\.json: --triangulation: needs a box of every object"),
                ({"sensors": ["triangulation"]}, r"meta\.json: --triangulation: needs --odometry"),
                ({"sensors": ["odometry"] * 2}, r"meta\.json: sensors: one is listed twice"),
                ({"target_box": [0.5, 0.5]}, r"meta\.json: target_box is not 3 numbers"),
                ({"target_box": [0.5, 0.5, "x"]}, r"meta\.json: .*target_box, is not a number"),
                ({"word_norm": 0.0}, r"meta\.json: word_norm is not positive"),
                ({"word_norm": 1e300}, r"meta\.json: word_norm, .* is not finite or above"),
                ({"temperature": float("nan")}, r"meta\.json: not JSON \(NaN is not a number"),
            ]
        ),
        ("meta.json", lambda text: "[" * 100_000, r"meta\.json: lists and objects \d+ deep"),
        ("model.npz", None, r"model\.npz: no such file"),
        ("words.npz", None, r"words\.npz: no such file"),
        ("meta.json", None, r"meta\.json: no such file"),
    ],
)
def test_a_broken_folder_is_refused_in_one_line(folder, tmp_path, name, change, message):
    broken = shutil.copytree(folder, tmp_path / "broken")
    text = None if change is None else change((broken / name).read_text())
    (broken / name).unlink()
    if text is not None:
        (broken / name).write_text(text)
    with pytest.raises(ValueError, match=message) as refused:
        numpy_agent.load(broken)
    assert "\n" not in str(refused.value)


def test_words_of_a_runs_own_file_are_those_that_the_agent_has(glove, tmp_path):
    """They are not read again."""
    (tmp_path / "out").mkdir()
    agent = small_agent(WordVectors(glove.index, glove.vectors * 1.1))
    export._write_agent(agent, "no longer there.txt", tmp_path / "out")
    kept = numpy_agent.load(tmp_path / "out")
    for row in range(3):
        np.testing.assert_array_equal(kept._vector(row, 3.0), agent._vector(row, 3.0))


def test_parameters_must_be_finite(folder, tmp_path):
    broken = shutil.copytree(folder, tmp_path / "broken")
    arrays = dict(np.load(broken / "model.npz"))
    arrays["critic/bias"][:] = np.inf
    np.savez(broken / "model.npz", **arrays)
    with pytest.raises(ValueError, match=r"model\.npz: critic/bias is not finite$"):
        numpy_agent.load(broken)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"Mug": ["a"], "Mug": ["b"]}', r"mine\.json: Mug: is listed twice"),
        ('{"Mug": "Humpen"}', r"mine\.json: Mug: not a list of names"),
        ('{"qwertzu": ["a"]}', r"mine\.json: label 'qwertzu': no word vector"),
        ("[" * 100_000, r"mine\.json: lists and objects \d+ deep"),
    ],
)
def test_a_table_of_synonyms_is_read_as_in_jax(folder, glove, tmp_path, text, message):
    (tmp_path / "mine.json").write_text(text)
    for read in (
        lambda path: numpy_agent.load(folder, synonyms=path),
        lambda path: Labels((), glove.index, path),
    ):
        with pytest.raises(ValueError, match=message) as refused:
            read(tmp_path / "mine.json")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (dataclasses.replace(SMALL, model="tdanet-no-ta"), "--model tdanet-no-ta: only tdanet is"),
        (
            dataclasses.replace(
                SMALL,
                network=NetworkConfig(odometry=True, sensors=("tests.support.step_counter",)),
            ),
            r"--sensors tests\.support\.step_counter: only odometry,",
        ),
    ],
)
def test_what_is_only_there_in_jax_is_refused(config, message, glove):
    with pytest.raises(ValueError, match=message):
        export.check(Agent(config, {}, glove))


def outside_type_checking(tree):
    """The imported modules, but for those under `if TYPE_CHECKING`, at the top level."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


def test_the_modules_that_are_copied_need_numpy_alone():
    copied = {f"tdanet_jax.{name}".replace("/", ".").removesuffix(".__init__")
              for name in export.MODULES}  # fmt: skip
    for name in (*export.MODULES, "robot"):
        text = (ROOT / "tdanet_jax" / f"{name}.py").read_text()
        for module in outside_type_checking(ast.parse(text, feature_version=(3, 10))):
            first = module.split(".")[0]
            assert module in {"tdanet_jax", *copied} or first in {"numpy", *sys.stdlib_module_names}


#: A robot on which nothing but NumPy is installed.
ROBOT = """
import json, sys
sys.modules.update(dict.fromkeys(("jax", "flax", "chex", "scipy", "filelock", "tyro", "rich")))
from tdanet_jax import Detection
class Robot:
    blocked, done = False, []
    def detect(self):
        return [Detection("sofa", 0.1, 0.3, 0.5, 0.8), Detection("laptop", 0.4, 0.4, 0.5, 0.5)]
    def do(self, action):
        self.done.append(action)
robot = Robot()
"""


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    """The exported bundled agent."""
    return tdanet_jax.export("18-4-best", tmp_path_factory.mktemp("robot") / "exported")


@pytest.mark.slow
@pytest.mark.parametrize("python", [sys.executable, "python3.10"])
def test_the_loop_of_the_page_runs_with_numpy_alone(python, bundled):
    if shutil.which(python) is None:
        pytest.skip(f"no {python}")
    numpy = subprocess.run([python, "-c", "import numpy"], capture_output=True, check=False)
    if numpy.returncode:
        pytest.skip(f"{python} has no NumPy")
    program = ROBOT + block("robots.md", "without JAX") + "print(json.dumps(robot.done))"
    done = subprocess.run(
        [python, "-c", program], cwd=bundled.parent, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(bundled)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    nav = Navigator(tdanet_jax.load("18-4-best"), tdanet_jax.Camera(69, 55)).reset("laptop")
    seen = [Detection("sofa", 0.1, 0.3, 0.5, 0.8), Detection("laptop", 0.4, 0.4, 0.5, 0.5)]
    expected = []
    while not nav.finished:
        expected.append(nav.step(seen, blocked=False))
    assert json.loads(done.stdout) == expected


@pytest.mark.slow
def test_whole_episodes_are_the_same(ithor, bundled):
    """60 of the fixed test episodes, evenly spaced."""
    theirs, ours, grid = tdanet_jax.load("18-4-best"), numpy_agent.load(bundled), ithor.grid
    played, found, errors = 0, 0, []
    for listed in episodes.load(ithor, make_split("18/4")).values():
        for k in np.linspace(0, len(listed) - 1, 30).astype(int):
            place, rotation, horizon = (int(part) for part in grid.split(int(listed.pose[k])))
            target = ithor.targets[goal := int(listed.target[k])]
            one, other = (a.start(45 * rotation, grid.horizons[horizon]) for a in (theirs, ours))
            blocked = False
            for _ in range(200):
                state = int(grid.join(place, rotation, horizon))
                view = camera_view.of_pose(ithor, state)
                rows = zip(view.classes, view.boxes, strict=True)
                seen = detectors.in_image((*row, None) for row in rows)
                one, expected = theirs.act(one, seen, target, blocked=blocked)
                other, decision = ours.act(other, seen, target, blocked=blocked)
                action = decision.action
                assert action == expected.action
                errors.append(np.abs(decision.probabilities - expected.probabilities).max())
                if action == Action.DONE:
                    break
                ahead = int(ithor.next_position[place, rotation])
                blocked = action == Action.MOVE_AHEAD and ahead == place
                place = ahead if action == Action.MOVE_AHEAD else place
                turn = (action == Action.ROTATE_RIGHT) - (action == Action.ROTATE_LEFT)
                rotation = (rotation + turn) % grid.rotations
                down = (action == Action.LOOK_DOWN) - (action == Action.LOOK_UP)
                horizon = min(max(horizon + down, 0), 1)
            played += 1
            found += action == Action.DONE and ithor.distance[state, goal] == 0
    assert (played, found) == (60, 60)
    assert np.median(errors) < 1e-5
    assert max(errors) < 2e-3
