"""The scoreboard: results that are kept in `results/`, and the tables of the pages made from them.

A folder of `results/` is a row. It holds `results.json` and `episodes.jsonl`, what was reached;
`run.json`, by which command and where; and, if something was trained, `config.json`, and
`metrics.jsonl` if it is known how it learned. Folders of `results/validation/` are runs with
`--validation`, for choosing settings. They hold no episodes, and no test has seen them.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import config as configs
from tdanet_jax.analysis import episode_lookup
from tdanet_jax.config import BUDGETS, CONFIG_FILE, PRESETS, TrainConfig
from tdanet_jax.eval_config import describe_departures
from tdanet_jax.evaluation import comparison, episodes, report, results_file, rollout
from tdanet_jax.evaluation.comparison import Result
from tdanet_jax.evaluation.policies import Policy
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError, jsons, regular
from tdanet_jax.splits import NAMED, OF_VALIDATION, OPEN, is_open, make_split
from tdanet_jax.targets import PAPER
from tdanet_jax.task import Task, load_task
from tdanet_jax.training import journal, run_file
from tdanet_jax.training.journal import METRICS_FILE
from tdanet_jax.training.run_file import Process
from tdanet_jax.vocabulary import Action
from tdanet_jax.workflows.evaluate import UNTRAINED

#: Flags that do not tell agents apart here. The last two are what "auto" became on a machine.
_SHARED = (*comparison.NOT_SETTINGS, "--split", "--model", "--precision", "--image")
#: Flags without effect where variants and generated rooms fit into one pool.
_POOLS = ("--pool-rooms", "--pool-updates")
#: The folder in `results/` of runs with `--validation`; the names of their rows begin with it.
VALIDATION = "validation/"
#: The value of `model` in the `results.json` of a custom policy.
CUSTOM = "custom"
#: What can stand in a command that every shell takes as it is, besides letters and digits.
_PLAIN = r"[\w @%+=:,./'\"-]"
#: Folders that may name their owner: of absolute paths, of those from ~, and of those with "..".
_FOLDERS = re.compile(r"(^|[\s=:,])(?:/|~[^\s=:,/]*|(?:[^\s=:,]*/)?\.\./)(?:[^=:,]*/)?")
#: Takes the actions [B, N] that are given as its weights.
_RECORDED = Policy(
    start=lambda actions, batch: jnp.int32(0),
    act=lambda actions, step, key, state, params: (step + 1, actions[:, step]),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of the scoreboard."""

    name: str  # of its folder
    results: Result  # the content of its `results.json`
    config: TrainConfig | None  # None for a policy that was not trained here
    metrics: Sequence[journal.Row]  # none if it is not known how it learned
    processes: Sequence[Process]  # that trained or evaluated it, oldest first

    @property
    def of_validation(self) -> bool:
        """Whether it is a run for choosing settings, not one on a test."""
        return self.name.startswith(VALIDATION)

    @property
    def agent(self) -> str:
        """What seeds of one configuration share: its model and its flags, as they are typed."""
        return " ".join(self.flags)

    @property
    def flags(self) -> tuple[str, ...]:
        """The model, then each flag with its value.

        They are relative to the preset from which fewest differ, of those with the same senses if
        there are any.
        """
        if self.config is None:
            return (self.name if self.results["model"] == CUSTOM else self.results["model"],)
        differing = {name: _differing(self.config, preset) for name, preset in PRESETS.items()}
        spec = self.config.network.spec
        alike = [name for name, preset in PRESETS.items() if preset.network.spec == spec]
        preset = min(alike or PRESETS, key=lambda name: len(differing[name]))
        chosen = [] if preset == "default" else [f"--preset {preset}"]
        return self.config.model, *chosen, *differing[preset]

    @property
    def senses(self) -> list[str] | None:
        """What the agent senses beyond the paper's inputs; None if unknown."""
        if self.config is None:
            return None
        return [*self.results.get("sensors", ()), *["scores"] * self.config.network.scores]

    @property
    def hours(self) -> float | None:
        """Hours of training; None if unknown."""
        seconds = self.metrics[-1].get("seconds") if self.metrics else None
        return None if seconds is None else seconds / 3600


def _differing(config: TrainConfig, preset: TrainConfig) -> list[str]:
    """The flags in which a configuration differs from a preset, with its values, as typed.

    A limit of the preset that it has not is left out: another one takes its place. So are flags of
    pools, if there is only one.
    """
    values, usual = (
        comparison.flags(one) | {f"--{name}": one.limits.get(name) for name in BUDGETS}
        for one in (config, preset)
    )
    absent = {f"--{name}" for name in BUDGETS if name not in config.limits}
    own = len(make_split("22/0", config.validation).train_scenes)
    if config.variants * own + config.generated <= config.pool_rooms:
        absent |= {*_POOLS}
    return [
        _typed(flag, value)
        for flag, value in values.items()
        if flag not in {*_SHARED, *absent} and value != usual[flag]
    ]


def _typed(flag: str, value: Any) -> str:
    if isinstance(value, bool):
        return flag if value else f"--no-{flag.removeprefix('--')}"
    return f"{flag} {value}"


def rows(folder: Path | str) -> list[Row]:
    """The rows in a folder, by name: those of tests, then those of validation.

    Raises:
      FileError: a file of a row cannot be read.
    """
    folder = Path(folder)
    return [
        read(path.parent, path.parent.relative_to(folder).as_posix())
        for kind in ("", VALIDATION)
        for path in sorted(folder.glob(f"{kind}*/{report.RESULTS_FILE}"))
    ]


def read(folder: Path | str, name: str | None = None) -> Row:
    """The row, or the finished run, in a folder.

    Args:
      name: of the row; by default that of the folder.

    Raises:
      FileError: a file is missing or cannot be read.
    """
    folder = Path(folder)
    return Row(
        name=folder.name if name is None else name,
        results=results_file.read(folder / report.RESULTS_FILE),
        config=_read_config(folder / CONFIG_FILE) if (folder / CONFIG_FILE).exists() else None,
        metrics=journal.read_metrics(folder) if (folder / METRICS_FILE).exists() else [],
        processes=run_file.read(folder),
    )


def _read_config(path: Path) -> TrainConfig:
    """A configuration; one that names custom code is read, too, as nothing runs it here."""
    try:
        return configs.from_json(jsons.load(path, links=False))
    except FileError:
        raise
    except ValueError as error:
        raise FileError(path, error) from None


def add(
    run: Path | str,
    name: str,
    folder: Path | str,
    command: str | None = None,
    machine: str | None = None,
    evaluation: Path | str | None = None,
) -> Path:
    """Copies what a row needs of a finished run, or of an evaluation that needs no run.

    Folders in its command, which may name their owner, are left out.

    Args:
      run: its folder.
      name: of the row.
      folder: the folder of all rows.
      command: by which it was made, if its `run.json` does not tell.
      machine: on which, if its `run.json` does not tell.
      evaluation: the folder of its results, if it was trained for other targets than those of the
        test: what `tdanet evaluate --test-targets paper` wrote.

    Returns:
      The folder of the row.

    Raises:
      ValueError: a file is missing or cannot be read, it is no result of the official test or
        validation in today's rooms, its code was not committed, or the name or the seed are there
        already; one line that names it.
    """
    run, out = Path(run), Path(folder) / name
    if not re.fullmatch(r"\w[\w.-]*", name.removeprefix(VALIDATION)):
        raise ValueError(f"--name {name}: letters, digits and _; after the first, . and - as well")
    if name in NAMED:
        raise ValueError(f"--name {name}: is the name of a split")
    if f"{name}/" == VALIDATION:
        raise ValueError(f"--name {name}: is the folder of runs with --validation")
    if out.exists():
        raise ValueError(f"--name {name}: {out} exists")
    if not (run / report.RESULTS_FILE).exists():
        raise FileError(run / report.RESULTS_FILE, "no such file; is the run finished?")
    row = dataclasses.replace(read(run), name=name)
    processes, played = _processes(run, row, command, machine), run
    if evaluation is not None:
        played = Path(evaluation)
        results = _evaluated(played, row.results)
        row = dataclasses.replace(row, results=results)
        again = f"tdanet evaluate --checkpoint {run.name} --test-targets {results['targets']}"
        processes.append(Process(command=again, commit=results["commit"]))
    for commit in (row.results.get("commit"), *(process.commit for process in row.processes)):
        if str(commit).endswith("-dirty"):
            raise ValueError(f"{run}: made with changes that are not committed, {commit}")
    check(played, row)
    if row.config is not None:
        row = dataclasses.replace(row, config=_without_folders(row.config))
    for other in rows(folder):
        if _identity(other) == _identity(row):
            raise ValueError(f"{run}: {folder}/{other.name} has this agent with this seed")
    out.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(out) as fresh:
        fresh.mkdir()
        if row.config is not None:
            configs.save(row.config, fresh / CONFIG_FILE)
        if row.metrics:
            metrics = regular.read_bytes(run / METRICS_FILE, links=False)
            (fresh / METRICS_FILE).write_bytes(metrics)
        run_file.write(fresh, processes)
        if not row.of_validation:
            records = regular.read_bytes(played / report.EPISODES_FILE, links=False)
            (fresh / report.EPISODES_FILE).write_bytes(records)
        content = regular.read_bytes(played / report.RESULTS_FILE, links=False)
        (fresh / report.RESULTS_FILE).write_bytes(content)
    return out


def _evaluated(folder: Path, own: Result) -> Result:
    """The results in a folder. Raises ValueError unless they are of the run with these results."""
    results = results_file.read(folder / report.RESULTS_FILE)
    for name in (
        "model",
        "split",
        "policy",
        "seed",
        "evaluation_seed",
        "steps",
        "episodes_trained",
    ):
        if results[name] != own[name]:
            text = f"{name} {results[name]}: the run has {own[name]}"
            raise FileError(folder / report.RESULTS_FILE, text)
    return results


def check(run: Path, row: Row) -> None:
    """Raises ValueError unless results are those of the official test, as its episodes give them,
    or of validation.

    Args:
      run: the folder of the run, or of the row.
      row: what was read from it.
    """
    results, path = row.results, run / report.RESULTS_FILE
    split, policy = results["split"].removesuffix(OF_VALIDATION), results["policy"]
    if row.of_validation != (split != results["split"]):
        name = "NAME" if row.of_validation else f"{VALIDATION}NAME"
        raise FileError(path, f"split {results['split']}: call the row {name}")
    if results.get("departures"):
        raise FileError(path, describe_departures(results["departures"]))
    if split not in NAMED:
        raise FileError(path, f"split {split}: the scoreboard has {', '.join(NAMED)}")
    version = episodes.stored_version(is_open(split))
    if results.get("data") is not None:
        raise FileError(path, f"in the rooms of {results['data']}: not in the bundled ones")
    if results["data_version"] != version:
        raise FileError(path, f"of scene tables {results['data_version']}, today's are {version}")
    if results.get("targets", PAPER) != (OPEN if is_open(split) else PAPER):
        raise FileError(path, f"targets {results['targets']}: not those of the split")
    if row.config is None and policy not in (*UNTRAINED, CUSTOM):
        raise FileError(run / CONFIG_FILE, "no such file; is this the folder of a run?")
    if row.config is not None and policy != "sample":
        raise FileError(path, f"{policy} actions: the scoreboard is of sampled ones")
    if not row.of_validation:
        if not (run / report.EPISODES_FILE).exists():
            raise FileError(run / report.EPISODES_FILE, "no such file")
        _check_episodes(run, results)


def _check_episodes(run: Path, results: Result) -> None:
    """Raises ValueError unless the episodes are the test's, and the results follow from them.

    The recorded actions are taken again in the official episodes.
    """
    path, split = run / report.EPISODES_FILE, results["split"]
    task = _task(is_open(split))
    lists = episodes.load(task.tables, make_split(split))
    records = episode_lookup.read_records(run, task.tables)
    if [record.group for record in records] != [g for g, one in lists.items() for _ in one.pose]:
        raise FileError(path, f"not the {sum(map(len, lists.values())):,} test episodes of {split}")
    limit = int(task.eval_params.step_limit.max())
    actions = np.full((len(records), limit), Action.DONE)
    for row, record in zip(actions, records, strict=True):
        row[: len(record.actions)] = record.actions[:limit]
    played = {}
    for group, chosen in lists.items():
        own = jnp.asarray(actions[[record.group == group for record in records]])
        params, key = task.eval_params, jax.random.key(0)
        played[group] = chosen, rollout.evaluate(_RECORDED, own, params, chosen, key)
    expected = report.all_rows(task.tables, played)
    for (number, line), right in zip(jsons.load_lines(path, links=False), expected, strict=True):
        if line != right:
            raise FileError(f"{path}, line {number}", "not what these actions do in this episode")
    for name, value in report.figures(task.tables, played, by_class=is_open(split)).items():
        if results.get(name) != value:
            raise FileError(run / report.RESULTS_FILE, f"{name}: not what the episodes give")


@functools.cache
def _task(of_open: bool) -> Task:
    """The rooms in which the open-vocabulary benchmark, or any other split, is played."""
    return load_task(TrainConfig(split=OPEN if of_open else TrainConfig().split))


def _processes(run: Path, row: Row, command: str | None, machine: str | None) -> list[Process]:
    """The processes of a row, whose first one has the command and the machine that are given.

    Raises:
      ValueError: nobody says by which command the row was made.
    """
    first, *later = row.processes or [Process(commit=row.results.get("commit"))]
    for flag, given, known in (
        ("--command", command, first.command),
        ("--machine", machine, first.machine),
    ):
        if given is not None and known is not None:
            raise ValueError(f"{flag}: {run / run_file.RUN_FILE} says it")
    if command is not None and (found := re.sub(_PLAIN, "", command)):
        raise ValueError(f"--command: give one plain command, without {found[0]!r}")
    first = dataclasses.replace(
        first, command=first.command or command, machine=first.machine or machine
    )
    if not first.command:
        raise ValueError(f"{run}: no {run_file.RUN_FILE} says how it was made; give --command")
    try:
        return [
            dataclasses.replace(one, command=one.command and _typed_anywhere(one.command))
            for one in (first, *later)
        ]
    except ValueError as error:
        where = run / run_file.RUN_FILE if command is None else "--command"
        raise ValueError(f"{where}: {error}") from None


def _typed_anywhere(command: str) -> str:
    """A command without the folders that may name their owner."""
    return shlex.join(_FOLDERS.sub(r"\1", word) for word in shlex.split(command))


def _without_folders(config: TrainConfig) -> TrainConfig:
    """A configuration that names its file of word vectors, but not the folder."""
    path = config.word_vectors
    return dataclasses.replace(config, word_vectors=path and Path(path).name)


def _identity(row: Row) -> tuple[object, ...]:
    """What no two rows share."""
    return row.agent, row.results["split"], row.results["policy"], row.results["seed"]
