"""Do the tests notice? One fault at a time is put into a copy of the package, and they must fail.

Slow: `pytest -m slow tests/system/test_mutation.py`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]


class Fault(NamedTuple):
    """A change of one place of the source, and the tests that must notice."""

    name: str
    module: str  # path below tdanet_jax/
    right: str
    wrong: str
    tests: str  # paths below tests/


ENV, LEARNER, TDANET = "env/dynamics.py", "training/learner.py", "models/tdanet.py"
PARAMS, AGENT, SUITE = "env/params.py", "agent/agent.py", "sensors/suite.py"
ODOMETRY, TRIANGULATION = "sensors/odometry.py", "sensors/triangulation.py"
TEST_TDANET = "models/test_tdanet.py"
FAULTS = (
    Fault("rotation sign", ODOMETRY, "Action.ROTATE_RIGHT, 1, 0", "Action.ROTATE_RIGHT, -1, 0",
          "env/test_dynamics.py"),
    Fault("impossible look", ODOMETRY, "Action.LOOK_UP, higher, horizon",
          "Action.LOOK_UP, 1 - horizon, horizon", "env/test_dynamics.py"),
    Fault("L without Done", ENV, "astype(jnp.int32) + 1\n", "astype(jnp.int32)\n", "env/test_dynamics.py"),
    Fault("parent paid twice", ENV, "in_view & ((state.parents_seen & bits) == 0)", "in_view",
          "env/test_reward.py"),
    Fault("failed Done pays a parent", ENV, "jnp.where(~done & earns", "jnp.where(earns",
          "env/test_reward.py"),
    Fault("Done pays new parents only", ENV, "largest(new), largest(in_view)",
          "largest(new), largest(new)", "env/test_reward.py"),
    Fault("time-outs terminate", ENV, "terminated=done", "terminated=done | (steps >= limit)",
          "env/test_dynamics.py"),
    Fault("a step too many", ENV, "steps >= limit", "steps > limit", "env/test_dynamics.py"),
    Fault("first padding row is valid", ENV, "dtype=jnp.int32) < last - first",
          "dtype=jnp.int32) <= last - first", "env/test_dynamics.py"),
    Fault("always the same rotation", ENV, "(bits[0] & 7)", "(bits[0] & 1)", "env/test_dynamics.py"),
    Fault("starts that cannot reach", PARAMS, "valid = positions[reachable[positions, goal]]",
          "valid = positions", "env/test_dynamics.py"),
    Fault("centre of the extent", "sensors/detections.py", "first, _rows(centre, ",
          "first, centre_and_area(", "env/test_dynamics.py"),
    Fault("headings are not turned", ODOMETRY, "(turned | bits & BLOCKED)",
          "(stood | bits & BLOCKED)", "sensors/test_odometry.py"),
    Fault("what blocks is where one stands", ODOMETRY, "jnp.where(blocked, ahead, cell)", "cell",
          "sensors/test_odometry.py"),
    Fault("one visit is remembered", ODOMETRY, "state.cells[at] | bit", "bit",
          "sensors/test_odometry.py"),
    Fault("the map ends", ODOMETRY, "[heading]) & (MAP_SIZE - 1)", "[heading])",
          "sensors/test_odometry.py"),
    Fault("every start is along an axis", ODOMETRY, "modulo(start.rotation, math", "modulo(0 * start.rotation, math",
          "sensors/test_odometry.py"),
    Fault("the target moves along", TRIANGULATION, "moment - _dot(state.normal, moved)",
          "moment + _dot(state.normal, moved)", "sensors/test_triangulation.py"),
    Fault("the target's position is never shifted", ODOMETRY,
          "jnp.where(moved, jnp.asarray(grid.steps)[state.heading], 0)",
          "0 * jnp.asarray(grid.steps)[state.heading]", "sensors/test_triangulation.py"),
    Fault("a blocked agent has moved all the same", ODOMETRY,
          "(state.action == Action.MOVE_AHEAD) & ~state.blocked", "state.action == Action.MOVE_AHEAD",
          "sensors/test_triangulation.py"),
    Fault("rays of a level camera", TRIANGULATION, "down = odometry.tilt", "down = 0 * odometry.tilt",
          "sensors/test_triangulation.py"),
    Fault("no prior", TRIANGULATION, "PRIOR_WEIGHT = 1e-3", "PRIOR_WEIGHT = 0.0",
          "sensors/test_triangulation.py"),
    Fault("a prior as good as a ray", TRIANGULATION, "PRIOR_WEIGHT = 1e-3", "PRIOR_WEIGHT = 1.0",
          "sensors/test_triangulation.py"),
    Fault("any box is the one seen before", TRIANGULATION, "same = _any_ray(state) & agrees",
          "same = _any_ray(state)", "sensors/test_triangulation.py"),
    Fault("it tracks any of several", TRIANGULATION,
          "nearest = jnp.argmax(jnp.where(is_target, cosine, -2.0))",
          "nearest = jnp.argmax(jnp.where(is_target, boxes[:, 2], -1.0))", "sensors/test_triangulation.py"),
    Fault("boxes are compared with the old estimate", TRIANGULATION,
          "agrees = _dot(directions[nearest], _direction(_solve(more)[0])) > SAME_OBJECT_COSINE",
          "agrees = cosine[nearest] > SAME_OBJECT_COSINE", "sensors/test_triangulation.py"),
    Fault("a ray counts from where it was already seen", TRIANGULATION,
          "directions[nearest], state.moved)", "directions[nearest], True)",
          "sensors/test_triangulation.py"),
    Fault("who came back has not moved", TRIANGULATION,
          "moved=state.moved | jnp.any(cells != 0)", "moved=jnp.any(cells != 0)",
          "sensors/test_triangulation.py"),
    Fault("who has moved once always counts", TRIANGULATION,
          "normal=normal, moved=jnp.zeros((), bool)", "normal=normal", "sensors/test_triangulation.py"),
    Fault("distance in place of depth", TRIANGULATION,
          "jnp.linalg.norm(_solve(seen)[0]) / lengths[chosen]", "jnp.linalg.norm(_solve(seen)[0])",
          "sensors/test_triangulation.py"),
    Fault("a radius is not renewed at one point", TRIANGULATION, "seen.replace(radius=radius)",
          "seen.replace(radius=jnp.where(state.moved, radius, state.radius))",
          "sensors/test_triangulation.py"),
    Fault("the estimate is kept when the target changes", AGENT, "state.target != frame.target",
          "jnp.array(False)", "agent/test_agent.py"),
    Fault("nothing is ever remembered of the target", AGENT, "state.target != frame.target",
          "jnp.array(True)", "agent/test_agent.py"),
    Fault("another target does not clear the estimate", TRIANGULATION,
          "_choose(changed, no_estimate(), state)", "state", "sensors/test_triangulation.py"),
    Fault("it begins with the smallest", TRIANGULATION, "jnp.where(is_target, boxes[:, 2], -1.0)",
          "jnp.where(is_target, -boxes[:, 2], -2.0)", "sensors/test_triangulation.py"),
    Fault("a radius out of view is none", TRIANGULATION, "moment - _dot(state.normal, moved),",
          "moment - _dot(state.normal, moved), radius=jnp.zeros(()),", "sensors/test_triangulation.py"),
    Fault("certain of everything", TRIANGULATION, "within * certainty,", "within,",
          "sensors/test_triangulation.py"),
    Fault("padding is seen", TRIANGULATION, "frame.mask & (frame.classes == frame.target)",
          "frame.classes == frame.target", "sensors/test_triangulation.py"),
    Fault("an agent whose sensors see nothing", AGENT, "suite.observe(spec, sensors, frame)",
          "sensors", "agent/test_agent.py"),
    Fault("sensors see nothing at the start", ENV,
          "sensors=suite.observe(params.spec, begun, _frame(state, params))", "sensors=begun",
          "sensors/test_triangulation.py"),
    Fault("sensors see the frame before the action", ENV,
          "suite.observe(params.spec, moved, _frame(after, params))",
          "suite.observe(params.spec, moved, _frame(state, params))",
          "sensors/test_triangulation.py"),
    Fault("sensors see those before them as they were", SUITE,
          "sensor.update(states[name], motion, done)", "sensor.update(states[name], motion, states)",
          "sensors/test_suite.py"),
    Fault("features in the order of the readings", SUITE,
          "parts = [sensor.features(readings[name]) for name, sensor in make(spec).items()]",
          "parts = [make(spec)[name].features(readings[name]) for name in readings]",
          "sensors/test_suite.py"),
    Fault("a sensor comes before what it needs", SUITE, "if required not in out)",
          "if required not in spec.sensors)", "sensors/test_suite.py"),
    Fault("triangulation of a box for each class", "observation_spec.py",
          'self.rows != "object" or self.image is not None', "self.image is not None",
          "test_observation_spec.py"),
    Fault("a sensor that cannot be made is refused late", "models/factory.py",
          "    suite.make(spec)", "    pass", "sensors/test_suite.py"),
    Fault("everything looks larger", ENV, "jnp.where(is_target, state.area_factor, 1.0)",
          "state.area_factor", "env/test_size_noise.py"),
    Fault("a box larger than the image", ENV,
          "jnp.minimum(boxes[:, 2] * jnp.where(is_target, state.area_factor, 1.0), 1.0)",
          "boxes[:, 2] * jnp.where(is_target, state.area_factor, 1.0)", "env/test_size_noise.py"),
    Fault("sensors continue in the next episode", LEARNER,
          "dynamics.choose(terminal, begun, moved.state)",
          "dynamics.choose(terminal, begun, moved.state).replace(sensors=moved.state.sensors)",
          "training/test_learner.py"),
    Fault("an agent that nothing stops", AGENT, "Motion(state.action, blocked)",
          "Motion(state.action, jnp.zeros_like(blocked))", "agent/test_agent.py"),
    Fault("an agent along an axis", AGENT, "Start(jnp.int32(turn)",
          "Start(jnp.int32(0 * turn)", "agent/test_agent.py"),
    Fault("a trace without sensors", "analysis/trace.py",
          "dynamics.transition(state, action, params).state",
          "state.replace(pose=dynamics.move(state.pose, action, params))", "analysis/test_trace.py"),
    Fault("the attention of one step for all", "models/actor_critic.py",
          "self.encoder.attend(class_table, obs)",
          "self.encoder.attend(class_table, jax.tree.map(jnp.zeros_like, obs))",
          "models/test_actor_critic.py"),
    Fault("share of all rooms", "env/reward.py", "gaps = gaps[np.isfinite(gaps)]",
          "gaps = gaps[: support]", "env/test_reward.py"),
    Fault("parents from all rooms", "task.py", "find_parents(seen_rooms", "find_parents(tables",
          "env/test_zero_shot.py"),
    Fault("hidden detections leak", "task.py",
          "zero_shot.hide_classes(tables.subset(split.train_scenes), split.hidden)",
          "tables.subset(split.train_scenes)", "env/test_zero_shot.py"),
    Fault("hidden words leak", "task.py",
          "zero_shot.hide_words(words, tables.classes, split.hidden)", "words",
          "env/test_zero_shot.py"),
    Fault("hidden distances leak", "env/zero_shot.py", "target in hidden for target",
          "False for target", "env/test_zero_shot.py"),
    Fault("hidden visibility leaks", "env/zero_shot.py", "row_visible=tables.row_visible[keep_row]",
          "row_visible=tables.row_visible[: keep_row.sum()]", "env/test_zero_shot.py"),
    Fault("mask dropped", TDANET, "nn.softmax(logits, axis=-1, where=mask)",
          "nn.softmax(logits, axis=-1)", TEST_TDANET),
    Fault("empty frame has a word", TDANET, "jnp.where(obs.mask, weights, 0.0)", "weights",
          TEST_TDANET),
    Fault("difference without its absolute", TDANET, "jnp.abs(features - look_up",
          "(features - look_up", TEST_TDANET),
    Fault("boxes without attention", TDANET, "weights, obs.boxes)", "1.0 * obs.mask, obs.boxes)",
          TEST_TDANET),
    Fault("dropout without scale", TDANET, "features / (1 - self.dropout)", "features",
          TEST_TDANET),
    Fault("gates swapped", "models/lstm.py", "f * cell + i * g", "i * cell + f * g",
          "models/test_lstm.py"),
    Fault("no gradient through the cell", "models/lstm.py", "grad_cell * f), is_first_t",
          "0 * grad_cell), is_first_t", "models/test_activation_cache.py"),
    Fault("gradient across episodes", "models/lstm.py", "continues = ~is_first[..., None]",
          "continues = is_first[..., None] | True", "models/test_lstm.py"),
    Fault("time-outs not bootstrapped", LEARNER, "(truncated & ~valued_next)", "truncated",
          "training/test_learner.py"),
    Fault("bootstrap-only steps counted", LEARNER, "counted = ~steps.bootstrap_only",
          "counted = steps.bootstrap_only | True",
          "training/test_learner.py"),
    Fault("carry of the last episode", "models/actor_critic.py", "is_first=done",
          "is_first=jnp.zeros_like(done)", "training/test_learner.py"),
    Fault("no value after the rollout", LEARNER, "return after, steps, out.value",
          "return after, steps, 0 * out.value", "training/test_learner.py"),
    Fault("infinite updates applied", LEARNER, "jnp.where(finite, new, old)", "new",
          "training/test_learner.py"),
    Fault("the same episodes again", LEARNER, "fold_in(state.key, state.updates)",
          "fold_in(state.key, 0)", "training/test_learner.py"),
    Fault("entropy penalised", LEARNER, "- entropy_weight * entropy", "+ entropy_weight * entropy",
          "training/test_learner.py"),
    Fault("value over the episode's end", "training/gae.py", "gamma * (1.0 - terminal)",
          "gamma * (1.0 - bootstrap_only)", "training/test_gae.py"),
    Fault("advantage of a bootstrap-only step", "training/gae.py",
          "jnp.where(bootstrap_only_t, 0.0, delta_t", "jnp.where(False, 0.0, delta_t", "training/test_gae.py"),
    Fault("network forgets its actions", "models/actor_critic.py", "jax.nn.softmax(out.logits), jnp",
          "state.prev_action_probs, jnp", "evaluation/test_rollout.py"),
    Fault("network forgets", "models/actor_critic.py", "jnp.zeros_like(state.is_first))",
          "state.is_first)", "evaluation/test_rollout.py"),
    Fault("every episode like the first step", "evaluation/policies.py",
          "(class_table, recurrent), action", "memory, action", "evaluation/test_rollout.py"),
    Fault("success after the end", "evaluation/rollout.py", "success | (alive & out.success)",
          "success | out.success", "evaluation/test_rollout.py"),
    Fault("bootstrap of episodes", "evaluation/metrics.py",
          "_, member = np.unique(cluster, return_inverse=True)", "member = np.arange(len(cluster))",
          "evaluation/test_metrics.py"),
    Fault("L of five left out", "evaluation/metrics.py", "shortest >= least", "shortest > least",
          "evaluation/test_metrics.py"),
    Fault("differences of two samples", "evaluation/metrics.py", "mine - other, theirs", "mine, theirs",
          "evaluation/test_metrics.py"),
    Fault("compared with other episodes", "evaluation/comparison.py", '"x", "z", "rotation"', '"rotation"',
          "evaluation/test_comparison.py"),
    Fault("compared with other rooms", "evaluation/comparison.py", '("split", "data_version")', '("split",)',
          "evaluation/test_comparison.py"),
    Fault("a split's classes in the order they came", "splits.py",
          "name for name in ALL_TARGETS if name in named)", "named)", "test_splits.py"),
    Fault("validation holds out what is hidden", "splits.py",
          "for name in order if name not in missing", "for name in order", "test_splits.py"),
    Fault("own lists from other tables", "evaluation/episodes.py", "_committed(tables, split) or draw",
          "draw", "evaluation/test_episodes.py"),
    Fault("SPL without L", "evaluation/metrics.py", "success * shortest /", "success /", "evaluation/test_metrics.py"),
    Fault("raw means", "words.py", "else norm / max(float(np.linalg.norm(mean)), 1e-12)",
          "else norm", "test_words.py"),
    Fault("checksums not compared", "training/checkpoint.py", "if expected.get(n) != found.get(n)",
          "if False", "training/test_checkpoint.py"),
    Fault("damaged checkpoint taken for the end", "training/checkpoint.py", "faults.append(error)", "raise",
          "training/test_checkpoint.py"),
    Fault("a damaged one outlives the next", "training/checkpoint.py", "if step <= updates][:KEPT]",
          "][:KEPT]", "training/test_checkpoint.py"),
    Fault("newer checkpoints passed over", "training/checkpoint.py", "raise  # it is sound",
          "continue  # it is sound", "training/test_checkpoint.py"),
    Fault("written in place", "io/files.py", 'tempfile.mkdtemp(prefix=f"{PARTIAL}{os.getpid()}-", dir=parent)',
          "parent", "io/test_files.py"),
    Fault("what is being written is removed", "io/files.py", "or _is_running(int(match[1]))", "",
          "io/test_files.py"),
    Fault("half-written files stay", "io/files.py", "        temporary.unlink(missing_ok=True)\n",
          "        pass\n", "io/test_files.py"),
    Fault("cache built by all at once", "scenes/cache.py", "        _lock(stack)\n", "",
          "scenes/test_cache.py"),
    Fault("cache read unchecked", "scenes/cache.py", "== assets.sha256(path)", "!= ''",
          "scenes/test_cache.py"),
    Fault("asset read unchecked", "io/assets.py", "sha256(file) != expected", "False",
          "io/test_assets.py"),
    Fault("rows lost on a full disk", "training/journal.py", "self._waiting.clear()", "pass",
          "system/test_faults.py"),
    Fault("cut rows stay", "training/journal.py", "file.truncate(", "file.tell() or (",
          "system/test_faults.py"),
    Fault("seeds beyond 32 bits", "config.py", "0 <= seed < 2**32", "0 <= seed",
          "experiments/test_arguments.py"),
    Fault("starts drawn anywhere", "evaluation/episodes.py", "valid = positions[reachable[positions, goal]]",
          "valid = positions", "evaluation/test_episodes.py"),
    Fault("padding has a row", "models/shared/class_rows.py", "jnp.where(obs.mask, class_table.row[obs.classes], n)",
          "class_table.row[obs.classes]", "models/test_ssnet.py"),
    Fault("no gradient from what nodes share", "models/shared/graph_convolutions.py",
          'degree=jnp.einsum("nbh,bh->n", first, shared)', "degree=0 * weights.degree",
          "models/test_mjolnir.py"),
    Fault("inner steps uphill", "models/shared/adaptation.py", "-model.rate * product_grad",
          "model.rate * product_grad", "models/shared/test_adaptation.py"),
    Fault("largest of corrected moments", LEARNER, "bias_correction_nu=False",
          "bias_correction_nu=True", "training/test_learner.py"),
    Fault("every kernel is rounded", LEARNER, "x.ndim > 1 and x.size > SMALL", "x.ndim > 1",
          "training/test_learner.py"),
    Fault("the last call's product for all", "models/activation_cache.py",
          "(y, transposed) if once else ()", "(y, transposed)", "models/test_activation_cache.py"),
    Fault("the last step's kernel gradient", "models/matmul.py",
          "return total + over_rows(*step), None", "return over_rows(*step), None",
          "models/test_matmul.py"),
    Fault("another column on GPUs", "models/layers.py", "one_hot(column, table.shape[1])",
          "one_hot(column + 1, table.shape[1])", "models/test_layers.py"),
    Fault("GPUs add in any order", "models/layers.py",
          'if jax.default_backend() == "cpu":\n        return table[index]',
          "if True:\n        return table[index]", "training/test_devices.py"),
    Fault("devices exchange their rollouts", "models/matmul.py",
          "if a.ndim <= 2 or jax.default_backend()",
          "a, b = a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1])\n"
          "    if a.ndim <= 2 or jax.default_backend()", "training/test_devices.py"),
    Fault("all seeds become the first", "training/run.py", "lambda x, i=i: x[i]", "lambda x, i=i: x[0]",
          "training/test_run.py"),
    Fault("an old name is not known any more", "training/renames.py", 'r"^held$"', 'r"^helm$"',
          "training/test_old_runs.py"),
    Fault("an agent that was passed on is trained over", "training/checkpoint.py",
          "return (run / history.NETWORK).exists()", "return False", "evaluation/test_saved_networks.py"),
    Fault("a stranger's model is imported", "config.py", '{"model": (config.model,), ', "{",
          "test_config.py"),
    Fault("a stranger's sensor is imported", "config.py", ', "sensor": config.network.sensors}', "}",
          "test_observation_spec.py"),
    Fault("the last of several budgets", "config.py", "max(done[name]", "min(done[name]",
          "test_config.py"),
    Fault("evaluation begins anywhere", PARAMS, "(tables.room_type == room) & chosen",
          "tables.room_type == room", "env/test_zero_shot.py"),
    Fault("any pickled name", "io/untrusted/pickles.py", "if name not in _ALLOWED and",
          "if False and", "io/untrusted/test_pickles.py"),
    Fault("source packages are built", "tools/build_assets.py", '"--only-binary=:all:", ', "",
          "io/test_assets.py"),
    Fault("used tables are removed", "scenes/cache.py", "st_mtime >= oldest", "st_mtime < oldest",
          "scenes/test_cache.py"),
    Fault("validation looks at own test rooms", "scenes/dataset.py",
          "mine, rest = mine[:first], mine[first:]", "mine = mine[:first]",
          "scenes/test_dataset.py"),
    Fault("targets of own types from all rooms", "scenes/dataset.py",
          "tables.room_type[tables.object_scene] == room_type",
          "tables.room_type[tables.object_scene] >= 0", "scenes/test_dataset.py"),
    Fault("a step along the direction before", "poses.py", "self.turn * rotation + 45",
          "self.turn * rotation", "test_poses.py"),
    Fault("every map has cells of a quarter metre", ODOMETRY, "POSITION_SCALE / self.grid.grid_size",
          "POSITION_SCALE / 0.25", "sensors/test_odometry.py"),
)  # fmt: skip


def passes(root: Path, tests: str) -> bool:
    """Whether the tests pass in a copy of the repository."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [*command, *(f"tests/{name}" for name in tests.split())],
        cwd=root, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stdout + done.stderr  # neither passed nor failed
    return done.returncode == 0


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository; the tests in it see its own package."""
    root = tmp_path_factory.mktemp("copy")
    for name in ("tdanet_jax", "tests", "experiments", "assets", "agents"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_each_fault_is_noticed(copy: Path, fault: Fault) -> None:
    path = copy / "tdanet_jax" / fault.module
    source = path.read_text()
    assert source.count(fault.right) >= 1, "the source has changed: write the fault anew"
    path.write_text(source.replace(fault.right, fault.wrong))
    try:
        assert not passes(copy, fault.tests)
    finally:
        path.write_text(source)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_each_fault_still_has_its_place(fault: Fault) -> None:
    assert fault.right in (ROOT / "tdanet_jax" / fault.module).read_text()
