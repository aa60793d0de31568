"""Wrong arguments to any command: one clear line, exit status 2, nothing written.

A new command gets its rows in `CASES`.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import pkgutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tdanet_jax import commands
from tdanet_jax import config as configs
from tdanet_jax.config import TrainConfig
from tests.support import command

#: Command -> arguments, typed in a folder made by `folder`, and what the line must contain.
CASES: dict[str, list[tuple[str, str]]] = {
    "train_zero_shot": [
        ("--split 17/5", "--split 17/5: choose one of 22/0, 18/4, 14/8"),
        ("--split Mug,Pilow", "--split Mug,Pilow: no target is called Pilow; did you mean Pillow?"),
        ("--split Mug,mug", "--split Mug,mug: Mug is given twice"),
        ("--split=", "--split : choose one of"),
        ("--targets Ketle", "--targets Ketle: no class of these rooms; did you mean Kettle?"),
        ("--targets kitchen:", "--targets kitchen:: a name is missing; give paper, all, or"),
        ("--model cnn", "--model cnn: choose one of tdanet"),
        ("--model no.such", "--model no.such: No module named 'no'"),
        ("--model os.path", "--model os.path: the module has no function `make`"),
        ("--model ..", "--model ..: "),
        ("--steps -5", "--steps -5: must be positive"),
        ("--steps many", "invalid literal for int() with base 10: 'many'"),
        ("--history=-1", "--history -1: must not be negative"),
        ("--episodes 0", "--episodes 0: must be positive"),
        ("--minutes inf", "--minutes inf: must be finite"),
        ("--num-envs 1.5", "invalid literal for int() with base 10: '1.5'"),
        ("--learning-rate inf", "--learning-rate inf: must be finite"),
        ("--entropy-weight nan", "--entropy-weight nan: must be finite"),
        ("--entropy-weight=-1", "--entropy-weight -1.0: must not be negative"),
        ("--max-grad-norm 0", "--max-grad-norm 0.0: must be positive"),
        ("--gamma 1.5", "--gamma 1.5: must be between 0 and 1"),
        ("--seed=-1", "--seed -1: must be between 0 and 4294967295"),
        ("--variants=-1", "--variants -1: must not be negative"),
        ("--variants 1000", "--variants 1000: must be at most 400"),
        ("--generated=-1", "--generated -1: must not be negative"),
        ("--generated 10001", "--generated 10001: must be at most 10,000"),
        ("--generated-only", "--generated-only: needs --generated, the number of rooms"),
        (
            "--generated 1 --generated-only --variants 1",
            "--generated-only: not with --variants, which are of other rooms",
        ),
        ("--seed 99999999999999999999", "--seed 99999999999999999999: must be between 0 and"),
        ("--rows all", "invalid choice 'all' for argument '--rows'. Expected one of ('class'"),
        ("--preset fast", "invalid choice 'fast' for argument '--preset'"),
        ("--stepz 5", "Unrecognized options: --stepz, 5; did you mean --steps?"),
        ("--num-env 5 --zzqx", "Unrecognized options: --num-env, 5, --zzqx; did you mean --num-"),
        ("extra", "Unrecognized options: extra"),
        ("--out", "Missing value for argument '--out'"),
        ("--out full", "--out full: exists and is not empty (to continue there: --resume full)"),
        ("--out full/file", "--out full/file: exists and is not empty"),
        ("--out full/file/below", "full/file/below: Not a directory"),
        ("--resume nowhere", "nowhere/config.json: no such file; is this the folder of a run?"),
        ("--devices 0", "--devices 0: must be positive"),
        ("--steps 1.5", "invalid literal for int() with base 10: '1.5'"),
        ("--steps 1e6.5", "invalid literal for int() with base 10: '1e6.5'"),
        ("--steps 1e-6", "invalid literal for int() with base 10: '1e-6'"),
        ("--steps=-1e6", "invalid literal for int() with base 10: '-1e6'"),
        ("--resume nowhere --seed 5", "--resume continues a run as it began: it takes a new"),
        ("--resume full/file", "full/file/config.json: Not a directory"),
        ("--resume broken", "broken/config.json: not JSON (Expecting property name"),
        ("--resume binary", "binary/config.json: not UTF-8"),
        ("--resume typed", "typed/config.json: --steps many: must be a whole number"),
        ("--tensorboard", "--log tensorboard needs tensorboardX: pip install"),
    ],
    "evaluate": [
        ("", "--policy sample needs --checkpoint"),
        ("--policy random --checkpoint full", "--policy random takes no --checkpoint"),
        ("--policy random --split 17/5", "--split 17/5: choose one of"),
        ("--policy random --split=", "--split : choose one of"),
        ("--policy random --split Mug,", "--split Mug,: a comma without a class on both sides"),
        ("--checkpoint full --split 18/4", "--split 18/4: a run is evaluated on its own split"),
        ("--policy random --history", "--policy random has no --history"),
        ("--checkpoint full --validation", "--validation: a trained run has its own rooms"),
        ("--policy random --word-vectors x.txt", "x.txt: no such file"),
        ("--checkpoint a --checkpoint a", "--checkpoint: a run is given twice"),
        ("--checkpoint full --checkpoint full/../full", "--checkpoint: a run is given twice"),
        ("--checkpoint a --checkpoint b", "several checkpoints need --out"),
        ("--policy random --step-limit 0", "--step-limit 0: must be positive"),
        ("--policy random --step-limit 1000000000", "must be at most 1,000,000"),
        ("--checkpoint full --policy greedy --temperature 2", "--temperature: has no effect on"),
        ("--policy random --temperature 0", "--temperature 0.0: must be between 0.01 and 100"),
        ("--policy random --done-bias 1", "--done-bias: is for trained agents"),
        ("--policy random --episodes=-1", "--episodes -1: must be positive"),
        ("--policy random --targets Lamp", "--targets Lamp: in no test episode; did you mean"),
        ("--policy random --scenes FloorPlan1", "--scenes FloorPlan1: in no test episode; did"),
        ("--policy random --seed x", "invalid literal for int() with base 10: 'x'"),
        ("--policy random --seed=-1", "--seed -1: must be between 0 and"),
        ("--policy random --out full", "--out full: exists and is not empty"),
        ("--policy random --out full/file", "--out full/file: exists and is not empty"),
        ("--policy random --out full/file/below", "--out full/file/below: Not a directory"),
        ("--policy dance", "invalid choice 'dance' for argument '--policy'"),
        ("--checkpoint nowhere", "nowhere/config.json: no such file"),
        ("--checkpoint binary", "binary/config.json: not UTF-8"),
        ("--checkpoint bare", "bare: no checkpoint"),
        ("--checkpoint full/1.npz", "--checkpoint full/1.npz: give the run; --history plays"),
    ],
    "benchmark": [
        ("--repeats 0", "--repeats 0: must be positive"),
        ("--repeats x", "invalid literal for int() with base 10: 'x'"),
        ("--devices 0", "--devices 0: must be positive"),
        ("--environments 8 0", "--environments 0: must be positive"),
        ("--batches=-5", "--batches -5: must be positive"),
        ("--precisions int8", "invalid choice 'int8' for argument '--precisions'"),
        ("--parts everything", "invalid choice 'everything'"),
        ("--context 1", "--context 1: must be 0, or from 2 to 8192"),
        ("--parts quality --num-envs 0", "--num-envs 0: must be positive"),
        ("--parts quality --units 9000", "--units 9000: must"),
        ("--parts quality --most-steps 0", "--most-steps 0: must be positive"),
        ("--parts quality --most-steps 9000000000000000", "--most-steps 9000000000000000: must"),
        ("--parts quality --seeds=-1", "--seeds -1: must be between 0 and"),
        ("--num-envs 1024", "--num-envs: is for --parts quality"),
        ("--preset best --parts machine", "--preset: is for --parts rollout, update, profile"),
        ("--odometry --parts machine", "--odometry: is for --parts rollout, update, profile"),
        ("--checkpoint bare --parts update", "--checkpoint: is for --parts evaluation, agent"),
        ("--out full", "--out full: exists"),
        ("--out full/file/below", "full/file/below: Not a directory"),
    ],
    "share": [
        ("", "Missing from tdanet share: --checkpoint RUN"),
        ("--checkpoint bare --out full", "--out full: exists and is not empty"),
        ("--checkpoint bare --out .", "--out .: is the working folder; name a folder in it"),
        ("--checkpoint bare --out new", "bare: no checkpoint"),
        ("--checkpoint bare --out full/file/below", "--out full/file/below: Not a directory"),
        ("--checkpoint nowhere --out new", "nowhere/config.json: no such file"),
    ],
    "export": [
        ("", "Missing from tdanet export: --checkpoint RUN"),
        ("--checkpoint bare --out full", "--out full: exists and is not empty"),
        ("--checkpoint bare --out .", "--out .: is the working folder; name a folder in it"),
        ("--checkpoint bare --out new", "bare/checkpoints: no checkpoint"),
        ("--checkpoint bare --out full/file/below", "--out full/file/below: Not a directory"),
        ("--checkpoint nowhere --out new", "nowhere/config.json: no such file"),
    ],
    "noise": [
        ("--truth nowhere.json --found x", "nowhere.json: no such file"),
        ("--truth full/file --found x", "full/file: not JSON"),
        ("--truth a --found b --min-score 25", "--min-score 25.0: must be from 0 to 1"),
        ("--truth a --found b --min-score nan", "--min-score nan: must be from 0 to 1"),
        ("--truth a --found b --iou 50", "--iou 50.0: must be between 0 and 1"),
    ],
    "demo": [
        (
            "--scene FloorPlan31 --no-show",
            "--scene FloorPlan31: no such room; there are",
        ),
        ("--checkpoint nowhere", "nowhere/config.json: no such file"),
        ("--seed=-1", "--seed -1: must be between 0 and 4294967295"),
        ("--out full", "--out full: is a folder"),
        ("--out laptop.png", "--out laptop.png: end it in .html or .gif"),
    ],
    "serve": [
        ("", "Missing from tdanet serve: --checkpoint RUN"),
        ("--checkpoint nowhere", "nowhere/config.json: no such file"),
        ("--checkpoint bare", "bare/checkpoints: no checkpoint"),
        ("--checkpoint bare --grid-size 3", "--grid-size 3: must be from"),
        ("--checkpoint bare --turn 50", "--turn 50: choose one of 15, 30, 45, 60, 90"),
        ("--checkpoint bare --hfov 200 --vfov 50", "--hfov 200.0: must be between 5 and 180"),
        ("--checkpoint bare --hfov 60", "--hfov: give either vfov, in degrees, or aspect"),
        ("--checkpoint bare --vfov 60", "--vfov and --aspect need --hfov"),
        ("--checkpoint bare --temperature 2", "--temperature: has no effect without --seed"),
        ("--checkpoint bare --forbid Jump", "invalid choice 'Jump' for argument '--forbid'"),
        ("--checkpoint bare --min-score nan", "--min-score nan: must be from 0 to 1"),
        ("--checkpoint bare --max-steps 0", "--max-steps 0: must be positive"),
        ("--checkpoint bare --keep-frames=-1", "--keep-frames -1: must not be negative"),
        ("--checkpoint bare --seed=-1", "--seed -1: must be between 0 and"),
    ],
    "replay": [
        ("", "give --checkpoint"),
        ("--checkpoint bare", "give --scene and --target, or --episode"),
        ("--checkpoint nowhere --episode 3", "nowhere/config.json: no such file"),
        ("--checkpoint bare --episode 3 --scene X", "--episode takes no --scene, --target or"),
        ("--checkpoint bare --scene FloorPlan1 --target Mug", "bare/checkpoints: no checkpoint"),
        ("--checkpoint bare --episode 3 --out full", "--out full: is a folder"),
        (
            "--checkpoint bare/history/00000020.npz --episode 3",
            "--checkpoint bare/history/00000020.npz: give the run",
        ),
        ("--checkpoint bare --episode 3 --seed 5", "--seed: has no effect on --episode"),
        ("--checkpoint bare --episode 3 --policy greedy", "--policy: has no effect on --episode"),
        ("--checkpoint bare --episode 3 --done-bias 1", "--done-bias: has no effect on --episode"),
        (
            "--checkpoint bare --checkpoint bare --episode 3 --seed 5 --done-bias 1",
            "bare/checkpoints: no checkpoint",  # the second plays
        ),
        (
            "--checkpoint bare --scene FloorPlan1 --target Mug --policy greedy --temperature 0.5",
            "--temperature: has no effect on --policy greedy",
        ),
        ("--checkpoint bare --episode 3 --out x.gif", "--out x.gif: end it in .html"),
        ("--checkpoint bare --episode 3 --out full/file/a.html", "full/file/a.html: Not a"),
        ("--checkpoint bare --episode x", "invalid literal for int() with base 10: 'x'"),
        ("--checkpoint bare --episode 3 --seed=-1", "--seed -1: must be between 0 and 4294967295"),
        (
            "--checkpoint bare --episode 3 --seed 99999999999999999999",
            "--seed 99999999999999999999",
        ),
    ],
    "trajectories": [
        ("", "give --checkpoint"),
        ("--checkpoint bare", "give --scene and --target, or --episode"),
        ("--checkpoint binary --episode 3", "binary/config.json: not UTF-8"),
        ("--checkpoint bare --start nan 0 0", "--start nan 0.0 0: must be finite"),
        ("--checkpoint bare --start 0 inf 0", "--start 0.0 inf 0: must be finite"),
        ("--checkpoint bare --start 0 0 20", "--start 0.0 0.0 20: rotation 20: not a multiple of"),
        ("--checkpoint bare --episode 3 --seed=-1", "--seed -1: must be between 0 and 4294967295"),
        ("--checkpoint bare --episode 3 --out a.doc", "--out a.doc: end it in one of ."),
        ("--checkpoint bare --episode 3 --out full/file/a.png", "full/file/a.png: Not a directory"),
        ("--checkpoint bare --episode 3 --out full/file/a.gif", "full/file/a.gif: Not a directory"),
    ],
    "failures": [
        ("", "Missing from tdanet failures: --checkpoint RUN"),
        ("--checkpoint nowhere", "nowhere/config.json: no such file"),
        ("--checkpoint bare", "bare/episodes.jsonl: no such file; a run writes it when training"),
        ("--checkpoint bare --replays=-1", "--replays -1: must not be negative"),
        ("--checkpoint bare --out full/file/a", "full/file/a: Not a directory"),
        ("--checkpoint bare --data nowhere.npz", "nowhere.npz: no such file"),
    ],
    "attention": [
        ("", "Missing from tdanet attention: --checkpoint"),
        ("--checkpoint bare --scene FloorPlan1", "give --scene and --target, or --episode"),
        ("--checkpoint bare", "bare/checkpoints: no checkpoint"),
        ("--checkpoint bare --out full/file", "--out full/file: is a file"),
        ("--checkpoint bare --out full/file/a", "--out full/file/a: Not a directory"),
        ("--checkpoint bare --seed=-1", "--seed -1: must be between 0 and 4294967295"),
    ],
    "sweep": [
        ("", "Missing from tdanet sweep: --out"),
        ("--out new --seed 3", "a sweep takes"),
        ("--out new --splits 17/5", "--splits 17/5: choose one of 22/0, 18/4, 14/8"),
        ("--out new --splits Mug,CD CD,Mug", "--splits: a value is given twice"),
        ("--out new --stepz 5", "Unrecognized options: --stepz, 5"),
        ("--out new --shard 1/2 --include full", "--include: --shard reports nothing"),
        ("--out new --per-model tdanet:--gama=1", "--gama=1; did you mean --gamma?"),
        ("--out new --vmap-seeds --minutes 3", "--vmap-seeds needs a budget in --steps"),
        ("--out new --report-only --steps 5", "--report-only trains nothing and takes no --steps"),
        ("--out new --include full", "full"),
        ("--out full/file", "--out full/file: is a file"),
        ("--out full/file/below", "--out full/file/below: Not a directory"),
    ],
    "scaling": [
        ("--rooms 10 0", "--rooms 0: must be positive"),
        ("--repeats=-1", "--repeats -1: must be positive"),
        ("--classes 10", "--classes 10: the rooms need at least 117"),
        ("--detections 3", "--detections 3: the rooms need at least"),
        ("--out full", "--out full: exists and is not empty"),
        ("--out full/file/below", "--out full/file/below: Not a directory"),
    ],
    "scenes": [
        ("", "Expected one of {build"),
        ("fly", "Unrecognized options: fly"),
        ("build --wheels wheels", "reading it needs pyarrow: pip install pyarrow"),
        ("verify --rooms 0", "--rooms 0: must be positive"),
        ("verify --rooms 121", "--rooms 121: at most 120"),
        ("verify --views 5000", "--views 5000: at most 560"),
        ("verify --views x", "invalid literal for int() with base 10: 'x'"),
        ("inspect", "Missing from tdanet scenes inspect: STR"),
        (
            "inspect FloorPlan0",
            "FloorPlan0: no such room; there are FloorPlan1-30, FloorPlan201-230, F",
        ),
        ("inspect FloorPlan1 --rotation 90", "--rotation and --horizon need --position"),
        ("inspect FloorPlan1 --position 0 0 --rotation 50", "rotation 50: not a multiple of 45"),
        ("inspect FloorPlan1 --position 0 0 --horizon 5", "horizon 5: not among 0, 30 degrees"),
        ("inspect FloorPlan1 --position nan 0", "--position nan 0.0: must be finite"),
        ("inspect FloorPlan1 --out a.doc", "--out a.doc: end it in one of ."),
        ("inspect FloorPlan1 --out full/file/a.png", "--out full/file/a.png: Not a directory"),
        ("inspect FloorPlan1 --variants=-1", "--variants -1: must be positive"),
        ("inspect FloorPlan1 --variants 401", "--variants 401: at most 400"),
        ("inspect FloorPlan1 --variants 1 --rotation 90", "--variants takes no --position, --rot"),
        ("vary", "Missing from tdanet scenes vary: --out PATH"),
        ("vary --out full", "--out full: exists"),
        ("vary --out no/a.npz", "--out no/a.npz: no such folder"),
        ("vary --out a.npz --copies 0", "--copies 0: must be positive"),
        ("vary --out a.npz --copies 401", "--copies 401: at most 400"),
        ("vary --out a.npz --seed=-1", "--seed -1: must be between 0 and"),
        ("vary --out a.npz --part half", "invalid choice 'half' for argument '--part'"),
        ("vary --out a.npz --data full/file", "full/file: not an npz archive"),
        ("generate", "Missing from tdanet scenes generate: --out PATH"),
        ("generate --out full", "--out full: exists"),
        ("generate --out no/a.npz", "--out no/a.npz: no such folder"),
        ("generate --out a.npz --rooms 0", "--rooms 0: must be positive"),
        ("generate --out a.npz --rooms 10001", "--rooms 10001: at most 10,000"),
        ("generate --out a.npz --seed=-1", "--seed -1: must be between 0 and"),
        ("compare", "Missing from tdanet scenes compare: STR"),
        ("compare nope.npz", "nope.npz: no such file"),
        ("build --wheels wheels --out full/file", "--out full/file: is a file"),
        ("export --out full/file/below", "--out full/file/below: Not a directory"),
        ("inspect Lab --scenes nope.json", "nope.json: no such file"),
        ("import nope.json", "nope.json: no such file"),
        ("import full", "full: not a regular file"),
        ("import binary/config.json", "binary/config.json: not UTF-8"),
        ("import broken/config.json --out full", "--out full: exists"),
        ("import broken/config.json", "broken/config.json: not JSON"),
        ("export --out new --word-vectors nofile.txt", "--word-vectors nofile.txt: only with --v"),
        ("collect FloorPlan1=kitchen --out full/file", "--out full/file: exists"),
        ("collect FloorPlan1=kitchen --out no/a.json", "--out no/a.json: no such folder"),
        ("collect", "collect: name a room, say FloorPlan1=kitchen"),
        ("collect FloorPlan1", "FloorPlan1: not NAME=TYPE, with a type such as kitchen"),
        ("collect FloorPlan1=a/b", "room_type 'a/b': is a path"),
        ("collect FloorPlan1=hall --grid-size 1", "gridSize 1.0: must be from 0.05 to 0.5 metres"),
        ("import --from empty --room-type Kitchen", "room_type 'Kitchen': did you mean kitchen?"),
    ],
}

#: What is typed before a case: if a check is missing, the command ends soon all the same.
BUDGETS = {
    "train_zero_shot": "--steps 1",
    "sweep": "--seeds 0 --steps 1 --num-envs 1 --rollout-steps 1",
    "evaluate": "--episodes 1",
    "benchmark": "--parts machine --repeats 1",
    "scaling": "--environments 1 --rooms 4 --classes 117 --detections 74 --repeats 1",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a full folder in it and damaged runs."""
    written = configs.to_json(TrainConfig())
    for name, content in {
        "full/file": b"kept",
        "broken/config.json": b"{",
        "binary/config.json": b"\xff\xfe\x00",
        "typed/config.json": json.dumps(written | {"steps": "many"}).encode(),
        "bare/config.json": json.dumps(written).encode(),
        "wheels/procthor-0.0.1.dev2-py3-none-any.whl": b"no wheel",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)  # no optional packages
    return tmp_path


def content_of(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_line(said: str, message: str) -> None:
    assert said.startswith("error: ")
    assert message in said
    assert len(said.strip().splitlines()) == 1
    assert "Traceback" not in said


def main_of(name: str) -> Callable[[list[str]], None]:
    """The function behind a command."""
    main: Callable[[list[str]], None] = importlib.import_module(f"tdanet_jax.commands.{name}").main
    return main


def flat(cases: dict[str, list[tuple[str, str]]]) -> list[tuple[str, str, str]]:
    return [(name, *case) for name, rows in cases.items() for case in rows]


@pytest.mark.usefixtures("ithor")  # the rooms are there: no line about computing them
@pytest.mark.parametrize(("name", "arguments", "message"), flat(CASES))
def test_wrong_arguments_give_one_line_and_write_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str, arguments: str, message: str
) -> None:
    before, folders = content_of(folder), sorted(folder.rglob("*"))
    with pytest.raises(SystemExit) as stopped:
        main_of(name)([*BUDGETS.get(name, "").split(), *arguments.split()])
    assert stopped.value.code == 2
    assert_one_line(capsys.readouterr().err, message)
    assert content_of(folder) == before
    assert sorted(folder.rglob("*")) == folders


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("train_zero_shot", "scenes") else pytest.mark.slow)
        for name in CASES
    ],
)
def test_in_a_process_of_its_own(name: str) -> None:
    """The same, once for each command, with nothing of the test's process in the way."""
    arguments, message = CASES[name][0]
    done = command.run(name, *arguments.split())
    assert done.returncode == 2
    assert done.stdout == ""
    assert_one_line(done.stderr, message)


def test_every_command_is_in_the_table() -> None:
    names = [found.name for found in pkgutil.iter_modules(commands.__path__)]
    modules = {name: importlib.import_module(f"tdanet_jax.commands.{name}") for name in names}
    assert {name for name, module in modules.items() if hasattr(module, "main")} == set(CASES)
