"""No flag does nothing: two values of each, of every command, have two results.

The heavy functions behind a command are replaced by recorders. A flag's row in `ROWS` is what to
type; what the functions are then asked to do must differ from what they are asked without it. What
these functions make of their arguments is tested with them. Settings of a training run end up in
its configuration: `SHOWN` names the test in which each has its effect, and two tests here show that
of the others. A flag without a row fails.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import json
import shutil
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax.commands import scenes as scenes_command
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.task import load_task, make_task
from tdanet_jax.training import learner
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.workflows import train as workflow
from tests.env import test_hidden_inputs as hidden
from tests.support import handmade, samples

TESTS = Path(__file__).resolve().parents[1]


class Ended(BaseException):
    """Raised by the last function of a command that is recorded."""


class Recorder:
    """What functions were asked to do."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[str] = []
        self._patch = monkeypatch

    def record(self, *names: str, gives: Any = None) -> None:
        """Replaces functions; each call is noted, and gives this value, or ends the command."""
        for name in names:

            def called(*given: Any, name: str = name, **named: Any) -> Any:
                shown = [*map(as_text, given), *(f"{k}={as_text(v)}" for k, v in named.items())]
                self.calls.append(f"{name}({', '.join(shown)})")
                if gives is Ended:
                    raise Ended
                return gives() if callable(gives) else gives

            self._patch.setattr(name, called)


def as_text(value: Any) -> str:
    """A value as text that tells two apart, and is the same in every process."""
    if isinstance(value, np.ndarray | jax.Array):
        return str(value.shape)
    text = str(value)
    return type(value).__name__ if " at 0x" in text else text


class Tables:
    """Some rooms, which say which."""

    classes = ("Mug",)
    state_scene = 0

    def __init__(self, *scenes: str) -> None:
        self.scenes = scenes

    def __str__(self) -> str:
        return " ".join(self.scenes)

    def subset(self, names: tuple[str, ...]) -> Tables:
        return Tables(*names)

    def nearest_state(self, *pose: float) -> tuple[float, ...]:
        return pose

    def as_scene(self) -> str:
        return "a scene"


EPISODE = "tdanet_jax.analysis.episode_lookup"
TRACE = SimpleNamespace(scene="FloorPlan1", target="Mug", outcome="success", player="one")


def agents(recorder: Recorder, last: str) -> None:
    """The commands that show an episode."""
    tables = Tables("FloorPlan1")
    task = SimpleNamespace(tables=tables)
    player = SimpleNamespace(name="one", attends=True, task=task)
    recorder.record("tdanet_jax.scenes.dataset.load_rooms", gives=Rooms(tables, None))
    recorder.record("tdanet_jax.scenes.target_distances.with_targets", gives=tables)
    recorder.record("tdanet_jax.analysis.trace.load_player", gives=player)
    recorder.record(f"{EPISODE}.find", gives="an episode")
    record = SimpleNamespace(episode="a recorded episode", actions="its actions")
    recorder.record(f"{EPISODE}.read_record", gives=record)
    recorder.record("tdanet_jax.analysis.trace.play", gives=TRACE)
    recorder.record("tdanet_jax.analysis.trace.retrace", gives=TRACE)
    recorder.record("tdanet_jax.analysis.trace.Player", gives="the shortest path")
    recorder.record("tdanet_jax.scenes.floor_plan.of_room", "tdanet_jax.analysis.replay.page")
    recorder.record("tdanet_jax.commands.attention.play_lists", gives=dict)
    recorder.record("tdanet_jax.commands.attention.write_pairs", gives=None)
    recorder.record("tdanet_jax.commands.attention.example", gives=TRACE)
    recorder.record(last, gives=Ended)


BENCHMARKS = tuple(
    f"tdanet_jax.tools.benchmarking.{part}_row"
    for part in ("environment", "rollout", "update", "evaluation", "decision", "agent")
)
MODEL_TASK = SimpleNamespace(model=SimpleNamespace(dtype="float32"), classes="classes")


def row() -> dict[str, Any]:
    return {"part": "x", "size": "x", "value": 1, "steps_per_second": 1.0, "float32_gflops": 1.0}


def prepare_benchmark(recorder: Recorder) -> None:
    recorder.record("tdanet_jax.task.load_task", gives=MODEL_TASK)
    recorder.record("tdanet_jax.models.factory.unused_flags", gives=list)
    recorder.record("tdanet_jax.training.devices.connect", gives=None)
    recorder.record("tdanet_jax.training.devices.check_divides", gives=None)
    recorder.record("tdanet_jax.evaluation.saved_networks.find", gives=None)
    recorder.record("tdanet_jax.tools.benchmarking.operations_per_step", gives=int)
    recorder.record("tdanet_jax.tools.benchmarking.share_of_peak", gives=dict)
    recorder.record("tdanet_jax.tools.benchmarking.machine_row", *BENCHMARKS, gives=row)
    recorder.record("tdanet_jax.tools.profiling.profile_row", gives=row)
    recorder.record("tdanet_jax.tools.quality.quality_row", gives=row)
    for part in ("tables", "import", "startup"):
        recorder.record(f"tdanet_jax.commands.benchmark.{part}_row", gives=row)


def prepare_scaling(recorder: Recorder) -> None:
    params = SimpleNamespace(max_detections=74)
    task = SimpleNamespace(train_words=np.zeros((117, 2)), train_params=params, model="a model")
    recorder.record("tdanet_jax.task.make_task", gives=task)
    recorder.record("tdanet_jax.scenes.load_tables", "tdanet_jax.words.load_bundled")
    recorder.record(
        "tdanet_jax.commands.scaling.with_rooms", "tdanet_jax.commands.scaling.with_detections"
    )
    recorder.record("tdanet_jax.tools.benchmarking.update_cost", gives=row)
    recorder.record("tdanet_jax.analysis.figures.scaling", gives=Ended)


def prepare_scenes(recorder: Recorder) -> None:
    tables = Tables("FloorPlan1", "FloorPlan2", "FloorPlan20")
    scene = SimpleNamespace(name="FloorPlan1", points=np.zeros((9, 3)))
    recorder.record("tdanet_jax.tools.build_assets.build", gives=())
    for part in ("grid.summary", "agreement.table", "survey.uses"):
        recorder.record(f"tdanet_jax.scenes.checks.{part}", gives=())
    recorder.record("tdanet_jax.scenes.checks.survey.summary", gives=lambda: iter(["some rooms"]))
    recorder.record("tdanet_jax.scenes.checks.dense_rays.summary", gives="")
    recorder.record("tdanet_jax.scenes.ithor.load_scenes", gives=lambda: [scene] * 9)
    recorder.record("tdanet_jax.scenes.ithor.published_points", gives=None)
    recorder.record("tdanet_jax.scenes.load_tables", gives=tables)
    recorder.record("tdanet_jax.scenes.metadata.read_scenes", gives=lambda: [scene])
    recorder.record("tdanet_jax.scenes.tabulation.build", gives=tables)
    recorder.record("tdanet_jax.analysis.pictures.most_telling_state", gives=0)
    recorder.record("tdanet_jax.analysis.pictures.room", gives=Ended)
    rooms = SimpleNamespace(
        tables=tables, extras=None, records=None, scenes=lambda names: [scene] * len(names)
    )
    parts = SimpleNamespace(train_scenes=("FloorPlan1",), eval_scenes=("FloorPlan2",))
    recorder.record("tdanet_jax.scenes.dataset.assign_rooms", gives=parts)
    recorder.record("tdanet_jax.scenes.placement.statistics", gives="statistics")
    recorder.record("tdanet_jax.scenes.vary.vary", gives="a variant")
    recorder.record("tdanet_jax.analysis.pictures.plans", gives=Ended)
    recorder.record("tdanet_jax.scenes.variants.make", gives=rooms)
    recorder.record("tdanet_jax.scenes.generated.make", gives=rooms)
    recorder.record("tdanet_jax.scenes.checks.survey.making", gives=())
    recorder.record("tdanet_jax.evaluation.room_statistics.table", gives=Ended)
    recorder.record("tdanet_jax.scenes.dataset.load_rooms", gives=rooms)
    recorder.record("tdanet_jax.scenes.dataset.build_rooms", gives=rooms)
    recorder.record("tdanet_jax.scenes.dataset.save_rooms", gives=Ended)
    recorder.record("tdanet_jax.scenes.room_names.read_table", gives=dict)
    recorder.record("tdanet_jax.scenes.offline.importer.read_folder", gives=rooms)
    recorder.record("tdanet_jax.scenes.offline.features.find_features", gives="maps")
    recorder.record("tdanet_jax.scenes.offline.features.save_with_maps", gives=Ended)
    recorder.record("tdanet_jax.env.reward.named_parents", gives=dict)
    recorder.record("tdanet_jax.scenes.offline.exporter.check_layout", gives=None)
    recorder.record("tdanet_jax.commands.scenes.export.test_starts", gives=())
    vectors = SimpleNamespace(table=lambda *names: "vectors")
    recorder.record("tdanet_jax.words.load_word_vectors", gives=vectors)
    recorder.record("tdanet_jax.scenes.offline.exporter.write_folder", gives=Ended)
    recorder.record("tdanet_jax.scenes.collect.collect", gives="found")
    recorder.record("tdanet_jax.scenes.collect.write_scenes", gives=None)
    controller = SimpleNamespace(stop=lambda: None)
    recorder.record("tdanet_jax.commands.scenes.collect._start_ai2thor", gives=controller)


def prepare_sweep(recorder: Recorder) -> None:
    finished = SimpleNamespace(
        folder=Path("elsewhere"), results={"split": "18/4", "data_version": "d"}
    )
    recorder.record("tdanet_jax.workflows.sweep.finished", gives=finished)
    recorder.record("tdanet_jax.training.devices.connect")
    recorder.record("tdanet_jax.training.devices.check_divides")
    recorder.record("tdanet_jax.workflows.train.train", "tdanet_jax.workflows.train.train_together")
    recorder.record("tdanet_jax.commands.sweep.write_report", gives=())


def prepare_serve(recorder: Recorder) -> None:
    agent = SimpleNamespace(add_words=lambda path: recorder.calls.append(f"add_words({path})"))
    recorder.record("tdanet_jax.agent.agent.load", gives=agent)
    recorder.record("tdanet_jax.training.devices.keep_compiled", gives=None)
    navigator = SimpleNamespace(camera=SimpleNamespace(limits=tuple))
    recorder.record("tdanet_jax.commands.serve.Navigator", gives=navigator)
    recorder.record("tdanet_jax.commands.serve.read_lines", gives=Ended)


def prepare_failures(recorder: Recorder) -> None:
    split = SimpleNamespace(name="18/4")
    task = SimpleNamespace(tables=Tables("FloorPlan1"), split=split, eval_params="params")
    player = SimpleNamespace(name="one", task=task)
    recorder.record("tdanet_jax.scenes.dataset.load_rooms", gives=Rooms(task.tables, None))
    recorder.record("tdanet_jax.scenes.target_distances.with_targets", gives=task.tables)
    recorder.record("tdanet_jax.analysis.trace.load_task", gives=task)
    recorder.record("tdanet_jax.analysis.trace.load_player", gives=player)
    recorder.record(f"{EPISODE}.read_records", gives=list)
    recorder.record("tdanet_jax.analysis.failures.summarise", gives="a summary")
    recorder.record("tdanet_jax.analysis.failures.examples", gives=list)
    recorder.record("tdanet_jax.analysis.figures.failures", gives=Ended)


def prepare_noise(recorder: Recorder) -> None:
    recorder.record("tdanet_jax.agent.measured_noise.read_coco", gives=((), ()))
    recorder.record("tdanet_jax.agent.measured_noise.measure", gives=Ended)


#: Command -> how its functions are recorded.
PREPARE: dict[str, Callable[[Recorder], None]] = {
    "train_zero_shot": lambda r: r.record("tdanet_jax.workflows.train.train"),
    "evaluate": lambda r: r.record("tdanet_jax.workflows.evaluate.evaluate", gives=Ended),
    "share": lambda r: r.record("tdanet_jax.evaluation.saved_networks.share", gives=Ended),
    "export": lambda r: r.record("tdanet_jax.workflows.export.export", gives=Ended),
    "noise": prepare_noise,
    "demo": lambda r: r.record("tdanet_jax.commands.demo.show", "webbrowser.open", gives=None),
    "serve": prepare_serve,
    "replay": lambda r: agents(r, "tdanet_jax.io.files.write_text"),
    "trajectories": lambda r: agents(r, "tdanet_jax.analysis.pictures.trajectories"),
    "attention": lambda r: agents(r, "tdanet_jax.analysis.pictures.attention_episode"),
    "failures": prepare_failures,
    "sweep": prepare_sweep,
    "benchmark": prepare_benchmark,
    "scaling": prepare_scaling,
    "scenes": prepare_scenes,
}

ONE_EPISODE = {
    "--checkpoint": ("--checkpoint run --episode 3", "--checkpoint other --episode 3"),
    "--scene": "--scene FloorPlan2",
    "--target": "--target Vase",
    "--start": "--start 1 2 90",
    "--episode": ("--checkpoint run --episode 3", "--checkpoint run --episode 4"),
    "--seed": "--seed 5",
    "--data": "--data rooms.npz",
    "--word-vectors": "--word-vectors words.txt",
    "--policy": "--policy greedy",
    "--reach-threshold": "--reach-threshold 0.5",
    "--temperature": "--temperature 0.5",
    "--done-bias": "--done-bias 1",
    "--out": "--out other/a.png",
}
SHOW = "--checkpoint run --scene FloorPlan1 --target Mug"
#: Command -> what is typed, and flag -> what is added to it; or a pair to compare.
ROWS: dict[str, tuple[str, dict[str, str | tuple[str, str]]]] = {
    "train_zero_shot": (
        "--out new",
        {
            "--preset": "--preset best",
            "--out": ("--out new", "--out newer"),
            "--resume": ("--resume run --steps 9", "--resume other --steps 9"),
            "--tensorboard": "--tensorboard",
            "--log": ("--log csv", "--log csv tensorboard"),
            "--devices": "--devices 2",
        },
    ),
    "evaluate": (
        "--checkpoint run",
        {
            "--checkpoint": ("--checkpoint run --out new", "--checkpoint other --out new"),
            "--history": "--history",
            "--policy": "--policy greedy",
            "--split": ("--policy random --split 18/4", "--policy random --split 14/8"),
            "--validation": ("--policy random", "--policy random --validation"),
            "--data": "--data rooms.npz",
            "--word-vectors": "--word-vectors words.txt",
            "--step-limit": "--step-limit 9",
            "--episodes": "--episodes 9",
            "--scenes": "--scenes FloorPlan21",
            "--targets": "--targets Mug",
            "--training-rooms": "--training-rooms",
            "--noise": "--noise mix",
            "--reach-threshold": "--reach-threshold 0.5",
            "--temperature": "--temperature 0.5",
            "--done-bias": "--done-bias 1",
            "--test-targets": "--test-targets Mug",
            "--seed": "--seed 5",
            "--out": "--out new",
        },
    ),
    "share": (
        "--out new",
        {
            "--checkpoint": ("--out new --checkpoint run", "--out new --checkpoint other"),
            "--out": ("--checkpoint run --out new", "--checkpoint run --out more"),
            "--word-vectors": (
                "--checkpoint run --out new",
                "--checkpoint run --out new --word-vectors words.txt",
            ),
        },
    ),
    "export": (
        "--out new",
        {
            "--checkpoint": ("--out new --checkpoint run", "--out new --checkpoint other"),
            "--out": ("--checkpoint run --out new", "--checkpoint run --out more"),
            "--word-vectors": (
                "--checkpoint run --out new",
                "--checkpoint run --out new --word-vectors words.txt",
            ),
        },
    ),
    "noise": (
        "--truth a.json --found b.json",
        {
            "--truth": ("--found b.json --truth a.json", "--found b.json --truth c.json"),
            "--found": ("--truth a.json --found b.json", "--truth a.json --found c.json"),
            "--min-score": "--min-score 0.5",
            "--iou": "--iou 0.7",
        },
    ),
    "demo": (
        "",
        {
            "--checkpoint": ("--checkpoint run", "--checkpoint other"),
            "--scene": "--scene FloorPlan1",
            "--target": "--target Vase",
            "--seed": "--seed 5",
            "--out": "--out new.html",
            "--show": "--no-show",
        },
    ),
    "serve": (
        "--checkpoint run",
        {
            "--checkpoint": ("--checkpoint run", "--checkpoint other"),
            "--forbid": "--forbid LookUp LookDown",
            "--min-score": "--min-score 0.5",
            "--keep-frames": "--keep-frames 2",
            "--max-steps": "--max-steps 9",
            "--seed": "--seed 5",
            "--hfov": (
                "--checkpoint run --hfov 60 --vfov 50",
                "--checkpoint run --hfov 70 --vfov 50",
            ),
            "--vfov": (
                "--checkpoint run --hfov 60 --vfov 50",
                "--checkpoint run --hfov 60 --vfov 60",
            ),
            "--aspect": (
                "--checkpoint run --hfov 60 --vfov 50",
                "--checkpoint run --hfov 60 --aspect 2",
            ),
            "--horizon": "--horizon 10",
            "--grid-size": "--grid-size 0.5",
            "--turn": "--turn 90",
            "--horizons": "--horizons 0",
            "--word-vectors": "--word-vectors words.txt",
            "--words": "--words words.txt",
            "--synonyms": "--synonyms mine.json",
            "--reach-threshold": "--reach-threshold 0.5",
            "--temperature": (
                "--checkpoint run --seed 5",
                "--checkpoint run --seed 5 --temperature 0.5",
            ),
            "--done-bias": "--done-bias 1",
        },
    ),
    "replay": (
        SHOW,
        {**ONE_EPISODE, "--out": "--out other/a.html", "--shortest": "--shortest"},
    ),
    "trajectories": (SHOW, {**ONE_EPISODE, "--shortest": "--shortest"}),
    "attention": (SHOW, ONE_EPISODE | {"--checkpoint": ("--checkpoint run", "--checkpoint other")}),
    # Without an episode, it plays the test episodes.
    "attention ": (
        "--checkpoint run",
        {
            flag: ONE_EPISODE[flag]
            for flag in (
                "--seed",
                "--data",
                "--word-vectors",
                "--policy",
                "--reach-threshold",
                "--temperature",
                "--done-bias",
                "--out",
            )
        },
    ),
    "failures": (
        "--checkpoint run",
        {
            "--checkpoint": ("--checkpoint run", "--checkpoint other"),
            "--replays": "--replays 3",
            "--data": "--data rooms.npz",
            "--word-vectors": "--word-vectors words.txt",
            "--out": "--out new",
        },
    ),
    "sweep": (
        "--out new --seeds 0 --steps 1",
        {
            "--out": ("--out new --steps 1", "--out other/new --steps 1"),
            "--splits": "--splits 14/8",
            "--models": "--models ssnet",
            "--seeds": ("--out new --steps 1 --seeds 0", "--out new --steps 1 --seeds 1"),
            "--per-model": "--per-model tdanet:--num-envs=8",
            "--vmap-seeds": "--vmap-seeds",
            "--shard": (
                "--out new --steps 1 --seeds 0 1",
                "--out new --steps 1 --seeds 0 1 --shard 1/2",
            ),
            "--report-only": ("--out new --steps 1", "--out new --report-only"),
            "--include": "--include elsewhere",
        },
    ),
    "benchmark": (
        "",
        {
            "--parts": "--parts decision",
            "--environments": "--environments 8",
            "--batches": "--batches 8",
            "--precisions": "--precisions bfloat16",
            "--networks": "--networks 8",
            "--checkpoint": "--checkpoint run",
            "--models": "--models ssnet",
            "--odometry": "--odometry",
            "--triangulation": ("--odometry", "--odometry --triangulation"),
            "--data": "--data rooms.npz",
            "--devices": "--devices 2",
            "--preset": "--preset best",
            "--context": "--context 8",
            "--seeds": ("--parts quality", "--parts quality --seeds 8"),
            "--most-steps": ("--parts quality", "--parts quality --most-steps 8"),
            "--num-envs": ("--parts quality", "--parts quality --num-envs 8"),
            "--units": "--units 8",
            "--repeats": "--repeats 8",
            "--out": ("--parts decision", "--parts decision --out new.jsonl"),
        },
    ),
    "scaling": (
        "",
        {
            "--environments": "--environments 8",
            "--rooms": "--rooms 8",
            "--classes": "--classes 128",
            "--detections": "--detections 80",
            "--repeats": "--repeats 8",
            "--out": "--out new",
        },
    ),
    "scenes build": ("", {"--out": "--out new", "--wheels": "--wheels wheels"}),
    "scenes verify": (
        "",
        {"--rooms": "--rooms 3", "--views": "--views 3", "--worst": "--worst 3"},
    ),
    "scenes inspect": (
        "FloorPlan1",
        {
            "--position": "--position 1 2",
            "--rotation": ("FloorPlan1 --position 1 2", "FloorPlan1 --position 1 2 --rotation 90"),
            "--horizon": ("FloorPlan1 --position 1 2", "FloorPlan1 --position 1 2 --horizon 30"),
            "--scenes": "--scenes rooms.json",
            "--data": "--data rooms.npz",
            "--variants": ("FloorPlan1 --variants 2", "FloorPlan1 --variants 3"),
            "--out": "--out new.png",
        },
    ),
    "scenes vary": (
        "--out new.npz",
        {
            "--out": ("--out new.npz", "--out newer.npz"),
            "--copies": "--copies 2",
            "--seed": "--seed 2",
            "--part": "--part all",
            "--data": "--data rooms.npz",
        },
    ),
    "scenes generate": (
        "--out new.npz",
        {
            "--out": ("--out new.npz", "--out newer.npz"),
            "--rooms": "--rooms 2",
            "--seed": "--seed 2",
            "--validation": "--validation",
        },
    ),
    "scenes compare": ("rooms.npz", {"--data": "--data others.npz"}),
    "scenes import": (
        "--from folder",
        {
            "--from": ("--from folder", "--from other"),
            "--room-type": "--room-type office",
            "--part": "--part test",
            "--rooms": "--rooms rooms.csv",
            "--out": "--out new.npz",
            "--features": "--features",
            "--frame-size": "--frame-size 640x480",
        },
    ),
    "scenes export": (
        "--out new",
        {
            "--out": ("--out new", "--out other/new"),
            "--scenes": "--scenes FloorPlan1",
            "--data": "--data rooms.npz",
            "--features": "--features",
            "--vectors": "--vectors",
            "--word-vectors": ("--out new --vectors", "--out new --vectors --word-vectors w.txt"),
        },
    ),
    "scenes collect": (
        "FloorPlan1=kitchen",
        {"--grid-size": "--grid-size 0.5", "--out": "--out new.json"},
    ),
}
CASES = [(name, flag) for name, (_, flags) in ROWS.items() for flag in flags]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def asked(command: str, words: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the functions behind a command are asked to do, and the files that it writes itself."""
    name, _, sub = command.partition(" ")
    main = importlib.import_module(f"tdanet_jax.commands.{name}").main
    for path in Path().iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for run in ("run", "other"):
        Path(run).mkdir()
        written = json.dumps(configs.to_json(TrainConfig(steps=5)))
        (Path(run) / "config.json").write_text(written)
    with monkeypatch.context() as patch, contextlib.suppress(Ended):
        recorder = Recorder(patch)
        for function in ("start", "keep_compiled"):
            recorder.record(f"tdanet_jax.training.devices.{function}")
        PREPARE[name](recorder)
        main([*sub.split(), *words.split()])
    return [*recorder.calls, *sorted(map(str, Path().rglob("*")))]


@pytest.mark.parametrize(("command", "flag"), CASES)
def test_two_values_of_a_flag_are_two_things_to_do(
    command: str, flag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, typed = ROWS[command][0], ROWS[command][1][flag]
    one, other = typed if isinstance(typed, tuple) else (base, f"{base} {typed}")
    ours, theirs = (asked(command, words, monkeypatch) for words in (one, other))
    assert min(len(ours), len(theirs)) > 4  # the two runs are four paths
    assert ours != theirs


def flags_of(command: type) -> Iterator[str]:
    """The flags of a command's dataclass; those of a run's configuration are in `SHOWN`."""
    hints = typing.get_type_hints(command, include_extras=True)
    for field in dataclasses.fields(command):
        hint = hints[field.name]
        inner, marks = (
            (typing.get_args(hint)[0], typing.get_args(hint)[1:])
            if typing.get_origin(hint) is typing.Annotated else (hint, ())
        )  # fmt: skip
        if dataclasses.is_dataclass(inner):
            yield from () if inner is TrainConfig else flags_of(typing.cast(type, inner))
        elif not any("Positional" in str(mark) for mark in marks):
            named = [mark.name for mark in marks if getattr(mark, "name", None)]
            yield f"--{(named or [field.name])[0].replace('_', '-')}"


def test_every_flag_has_a_row() -> None:
    modules = {name: importlib.import_module(f"tdanet_jax.commands.{name}") for name in PREPARE}
    classes = {name: m.Command for name, m in modules.items() if name != "scenes"}
    classes |= {f"scenes {name}": one for name, one in scenes_command.COMMANDS.items()}
    for name, command in classes.items():
        assert set(flags_of(command)) == set(ROWS[name][1]), name
    assert set(classes) == {name.strip() for name in ROWS}


#: Settings of a run -> the test that shows what they do.
SHOWN = {
    "num_envs": "system/test_random_keys.py::test_no_key_repeats_in_a_run_of_two_updates",
    "rollout_steps": "system/test_random_keys.py::test_no_key_repeats_in_a_run_of_two_updates",
    **dict.fromkeys(
        ("num_minibatches", "update_epochs", "clip_coef"),
        "training/test_learner.py::test_several_optimiser_steps_are_ppo_on_minibatches",
    ),
    "amsgrad": "training/test_learner.py::test_an_update_is_one_step_of_clipped_adam_on_the"
    "_gradient_of_the_loss",
    "bootstrap_truncated": "training/test_learner.py::test_rollouts_follow_the_slow_world_and_value"
    "_time_outs_in_one_more_step",
    "image": "commands/test_pictures_of_runs.py::test_a_model_that_was_trained_on_feature_maps"
    "_sees_those_of_the_rooms",
    "steps": "training/test_run.py::test_the_budget_in_steps_is_kept_and_every_chunk_has_a_row",
    "episodes": "training/test_run.py::test_the_budget_in_episodes_ends_the_run",
    "targets": "test_targets.py::test_any_target_can_be_unseen",
    "extra_targets": "test_task.py::test_extra_targets_are_for_training_alone_and_half_of_it",
    "variants": "scenes/test_variants.py::test_a_run_trains_in_variants_and_is_evaluated_as_ever",
    "generated": "scenes/test_generated.py::test_a_run_trains_in_generated_rooms_and_is_evaluated_"
    "as_ever",
    "generated_only": "scenes/test_generated.py::test_a_run_trains_in_generated_rooms_and_is_"
    "evaluated_as_ever",
    "pool_rooms": "scenes/test_generated.py::test_rooms_that_are_too_many_are_dealt_to_pools",
    "pool_updates": "training/test_pools.py::test_turns_are_whole_chunks_and_one_pool_has_no_turns",
    "imitation_weight": "training/test_imitation.py::test_its_weight_falls_to_nothing_at_half_"
    "of_the_budget",
    "imitation_until": "training/test_imitation.py::test_its_weight_reaches_nothing_at_the_share_"
    "that_is_chosen",
    "minutes": "training/test_run_bookkeeping.py::test_time_and_rows_continue",
    "seed": "training/test_run.py::test_another_seed_gives_another_run",
    "validation": "test_splits.py::test_validation_touches_neither_test_rooms_nor_unseen_classes",
    "chunk_updates": "training/test_run.py::test_the_budget_in_steps_is_kept_and_every_chunk_has_a"
    "_row",
    "history": "training/test_run.py::test_the_history_holds_the_parameters_at_each_point",
    "max_skipped": "training/test_run.py::test_a_run_that_is_no_longer_finite_stops_with_its_state"
    "_saved",
}
#: Numbers of the learner -> another value than the default.
NUMBERS = {
    "learning_rate": 1e-3, "final_learning_rate": 1e-3, "adam_epsilon": 1e-3,
    "max_grad_norm": 1e-4, "gamma": 0.5, "gae_lambda": 0.5, "entropy_weight": 0.5,
    "final_entropy_weight": 0.5, "value_weight": 2.0,
}  # fmt: skip
#: Settings that make another task or network -> another value, and the model if not TDANet.
OF_THE_TASK: dict[str, tuple[Any, str]] = {
    "step_limit": (9, "tdanet"), "partial_reward": ("similarity", "tdanet"),
    "size_noise": (0.5, "tdanet"), "width": (8, "tdanet"), "hidden": (8, "tdanet"),
    "dropout": (0.5, "tdanet"), "rows": ("class", "tdanet"), "word_norm": (1.0, "tdanet"),
    "odometry": (True, "tdanet"), "triangulation": (True, "tdanet"),
    "sensors": (("odometry",), "tdanet"), "inner_rate": (0.1, "savn"),
    "first_order": (True, "savn"), "precision": ("bfloat16", "tdanet"), "split": ("14/8", "tdanet"),
    "model": ("ssnet", "tdanet"), "noise": ("mix", "tdanet"), "scores": (True, "tdanet"),
    "robust_triangulation": (True, "tdanet"), "reach_threshold": (0.5, "tdanet"),
    "temperature": (0.5, "tdanet"), "done_bias": (1.0, "tdanet"), "context": (8, "tdanet"),
}  # fmt: skip
#: Settings with a test of their own below.
HERE = ("data", "word_vectors", "checkpoint_minutes")


def test_every_setting_of_a_run_is_shown_to_matter() -> None:
    classes = (LearnerConfig, NetworkConfig, TrainConfig)
    names = [f.name for kind in classes for f in dataclasses.fields(kind)]
    listed = [*SHOWN, *NUMBERS, *OF_THE_TASK, *HERE, "learner", "network"]
    assert sorted(names) == sorted(listed)
    for place in SHOWN.values():
        file, _, test = place.partition("::")
        assert f"\ndef {test}(" in (TESTS / file).read_text(), place


def changed(config: TrainConfig, name: str, value: Any) -> TrainConfig:
    """The configuration with another value of a setting."""
    for part in ("learner", "network"):
        inner = getattr(config, part)
        if hasattr(inner, name):
            name, value = part, dataclasses.replace(inner, **{name: value})
            break
    return dataclasses.replace(config, **{name: value})


@functools.cache
def contents(config: TrainConfig) -> tuple[Any, ...]:
    """Everything that a run takes from its task, in small rooms."""
    task = make_task(config, *hidden.bases()[1])
    leaves, tree = jax.tree.flatten((task.train_params, task.train_words))
    return task.model, task.split.name, str(tree), [np.asarray(leaf).tobytes() for leaf in leaves]


@pytest.mark.parametrize("name", OF_THE_TASK)
def test_a_setting_makes_another_task(name: str) -> None:
    value, model = OF_THE_TASK[name]
    config = TrainConfig(model=model, network=NetworkConfig(precision="float32", image="raster"))
    if "triangulation" in name or name == "reach_threshold":
        config = changed(config, "odometry", True)
    if name in ("robust_triangulation", "reach_threshold"):
        config = changed(config, "triangulation", True)
    other = changed(config, name, value)
    other.check()
    assert contents(config) != contents(other)


def test_every_number_of_the_learner_changes_an_update() -> None:
    """The numbers are arguments of one compiled update: if one is ignored, nothing changes."""
    tables, model = handmade.lopsided(), ActorCritic(TDANetEncoder(width=4), hidden=4)
    targets = {"kitchen": ("Mug",), "bedroom": ("Mug",)}
    params = make_params(tables, targets, no_parents(tables), (5,) * 4, ObservationSpec())
    words, config = samples.normal(2, 3), LearnerConfig(num_envs=3, rollout_steps=6)

    @jax.jit
    def after(weights: Any, numbers: dict[str, jax.Array]) -> Any:
        given = dataclasses.replace(config, **numbers)
        begin = functools.partial(
            learner.init, config=config, model=model, words=words, params=params
        )
        state = jax.eval_shape(begin, jax.random.key(0))
        state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.replace(key=jnp.zeros(2)))
        begun = learner._reset(jax.random.key(1), params, config.num_envs)
        start = state.replace(
            params=weights, env_state=begun, key=jax.random.key(2),
            opt_state=learner.make_optimizer(config).init(weights),
        )  # fmt: skip
        return learner.update(start, 0.5, given, model, words, params)[0].params

    weights = samples.parameters(model, words)
    defaults = {name: jnp.float32(getattr(config, name)) for name in NUMBERS}
    before = jax.device_get(jax.tree.leaves(after(weights, defaults)))
    for name, value in NUMBERS.items():
        now = jax.device_get(jax.tree.leaves(after(weights, defaults | {name: jnp.float32(value)})))
        assert any((a != b).any() for a, b in zip(before, now, strict=True)), name


def test_the_files_of_a_run_are_opened(
    monkeypatch: pytest.MonkeyPatch, some_rooms: SceneTables
) -> None:
    with pytest.raises(ValueError, match=r"rooms.npz: no such file"):
        load_task(TrainConfig(data="rooms.npz"))
    rooms = SimpleNamespace(tables=some_rooms, extras=None, path=None)
    monkeypatch.setattr("tdanet_jax.task.load_rooms", lambda *given: rooms)
    with pytest.raises(ValueError, match=r"words.txt: no such file"):
        load_task(TrainConfig(word_vectors="words.txt"))


@pytest.mark.parametrize(("minutes", "saves"), [(0.5, 6), (1.5, 4), (100.0, 2)])
def test_checkpoints_are_written_at_their_interval(minutes: float, saves: int) -> None:
    """In five minutes, after whose first and last moment there is one anyway."""
    config = TrainConfig(checkpoint_minutes=minutes)
    run = SimpleNamespace(
        seconds=0.0, config=config, saved=[], pools=SimpleNamespace(unreached=0, close=int)
    )
    run.wait_for_rooms, run.steps = lambda seconds: None, 0
    run.save = lambda: run.saved.append(run.seconds)

    def chunks() -> Iterator[list[dict[str, Any]]]:
        for minute in range(1, 5):
            run.seconds = 60.0 * minute
            yield [{}]
        run.seconds = 300.0

    assert workflow._learn([typing.cast(Any, run)], chunks(), Callbacks())
    assert len(run.saved) == saves
    assert run.saved[0] == 0.0
    assert run.saved[-1] == 300.0
