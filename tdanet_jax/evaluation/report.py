"""The report on an evaluation: `results.json`, `results.md` and one record per episode."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import tdanet_jax
from tdanet_jax.config import TrainConfig
from tdanet_jax.eval_config import describe_departures
from tdanet_jax.evaluation import paper
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.metrics import (
    BUCKETS,
    COLLISION_FREE,
    COLUMNS,
    MEASURES,
    grouped,
    shown,
    summarise,
)
from tdanet_jax.evaluation.rollout import Records
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.splits import GROUPS, in_order, is_open
from tdanet_jax.targets import PAPER
from tdanet_jax.task import Task
from tdanet_jax.vocabulary import ACTION_NAMES

#: Episodes and what happened in them, by group ("seen", "unseen").
Played = Mapping[str, tuple[Episodes, Records]]
#: Records as named columns of length E.
Columns = Mapping[str, np.ndarray]

RESULTS_VERSION = 1
#: Sensors with a field of their own in `results.json`, from before there was a list of all.
FLAGS = ("odometry", "triangulation")
#: What an evaluation writes into its folder; `RESULTS_FILE` comes last.
RESULTS_FILE, RESULTS_PAGE, EPISODES_FILE = "results.json", "results.md", "episodes.jsonl"

#: Targets with a near-synonym among the classes that no split hides: similar in meaning, with a
#: cosine of at least 0.84 between the bundled word vectors.
NEAR_SYNONYMS = {
    "Television": ("TVStand",),
    "ArmChair": ("Chair",),
    "DeskLamp": ("FloorLamp",),
    "ToiletPaper": ("ToiletPaperHanger", "PaperTowelRoll"),
    "SoapBar": ("SoapBottle",),
    "Towel": ("HandTowel",),
    "SprayBottle": ("Bottle",),
}


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Where a result comes from: the fields of `results.json` that are not results."""

    split: str
    model: str
    policy: str  # how actions were chosen
    episodes_trained: int
    seed: int  # of the training; for policies without training, of the evaluation
    evaluation_seed: int  # of the actions sampled in the test episodes
    steps: int  # environment steps of the training
    data_version: str  # of the scene tables in the evaluation
    data: str | None = None  # file of their rooms, unless they are the bundled ones
    image: str | None = None  # the image that the model is shown, if there is one
    sensors: tuple[str, ...] = ()  # names of the agent's sensors; the paper's agents have none
    departures: Mapping[str, Any] | None = None  # from the official test, if there are any
    targets: str = PAPER  # those of the test: as in `TrainConfig`, or "data" if the rooms name them
    trained_targets: str | None = None  # those of the training, if they are others

    @classmethod
    def of(
        cls,
        task: Task,
        config: TrainConfig,
        policy: str,
        evaluation_seed: int,
        episodes: int = 0,
        updates: int = 0,
        departures: Mapping[str, Any] | None = None,
        trained_targets: str | None = None,
    ) -> Provenance:
        """The provenance of a network's results, or of a policy's without a network.

        Args:
          task: what was played.
          config: the network's run, with the rooms and targets of the evaluation.
          policy: "sample" or "greedy" for networks, else the policy's name.
          evaluation_seed: of the actions sampled in the test episodes.
          episodes: training episodes of the network.
          updates: training updates of the network.
          departures: from the official test (`EvalConfig.departures`).
          trained_targets: the run's own.
        """
        network = policy in ("sample", "greedy")
        own = config.targets == PAPER and task.extras is not None and task.extras.targets
        return cls(
            split=task.split.name,
            model=config.model if network else policy,
            policy=policy,
            episodes_trained=episodes,
            seed=config.seed if network else evaluation_seed,
            evaluation_seed=evaluation_seed,
            steps=updates * config.steps_per_update,
            data_version=task.tables.data_version,
            data=config.data,
            image=task.image if network else None,
            sensors=task.spec.sensors if network else (),
            departures=departures or None,
            targets="data" if own else config.sought,
            trained_targets=None if trained_targets == config.targets else trained_targets,
        )


def columns(
    tables: SceneTables, episodes: Episodes, records: Records, by_class: bool = False
) -> Columns:
    """Records as named columns of length E, with names instead of indices.

    Args:
      by_class: intervals resample target classes instead of (room, target) pairs.
    """
    pose = tables.grid.split(episodes.pose)
    rotation, horizon = tables.grid.degrees(pose)
    scene = tables.position_scene[pose.position]
    pair = scene.astype(np.int64) * len(tables.targets) + episodes.target
    return {
        "scene": np.array(tables.scenes)[scene],
        "room": np.array(tables.room_types)[tables.position_room_type[pose.position]],
        "target": np.array(tables.targets)[episodes.target],
        "x": tables.position[pose.position, 0],
        "z": tables.position[pose.position, 2],
        "rotation": rotation,
        "horizon": horizon,
        "shortest": records.shortest,
        "length": records.length,
        "success": records.success,
        "collided": records.collided,
        "cluster": episodes.target.astype(np.int64) if by_class else pair,
        "pair": pair,
    }


def figures(tables: SceneTables, played: Played, by_class: bool = False) -> dict[str, Any]:
    """What follows from the records of an evaluation alone: the results in `results.json`.

    Args:
      tables: the rooms.
      played: the episodes and what happened in them, by group.
      by_class: intervals resample target classes instead of (room, target) pairs.
    """
    groups = {name: columns(tables, *pair, by_class) for name, pair in played.items()}

    def by(key: str, names: tuple[str, ...]) -> dict:
        pairs = {"cluster": "pair"} if key == "target" else {}  # one class cannot be resampled
        split = {
            group: grouped({n: c[pairs.get(n, n)] for n in c}, key, names)
            for group, c in groups.items()
        }
        found = (name for name in names if any(name in parts for parts in split.values()))
        return {
            name: {group: parts[name] for group, parts in split.items() if name in parts}
            for name in found
        }

    return {
        **{name: _summary(groups[name]) if name in groups else None for name in GROUPS},
        "by_room": by("room", tables.room_types),
        "by_target": by("target", in_order(tables.targets)),
        "actions": {name: _shares(records) for name, (_, records) in played.items()},
    }


def _shares(records: Records) -> dict[str, float]:
    """The share of each action among all that were taken, in percent."""
    count = np.bincount(records.actions[records.actions >= 0], minlength=len(ACTION_NAMES))
    shares = 100 * count / max(count.sum(), 1)
    return {name: round(float(x), 2) for name, x in zip(ACTION_NAMES, shares, strict=True)}


def _summary(column: Columns) -> dict[str, dict[str, Any]]:
    return summarise(*(column[name] for name in COLUMNS))


#: What `results.json` begins with.
_HEAD = ("split", "model", "policy", "episodes_trained")


@functools.cache
def code_version() -> str:
    """The commit of the checkout that the code runs from, else the package's version.

    Of the first call: what a process runs does not change if the checkout does.
    """
    here = Path(str(importlib.resources.files(tdanet_jax))).parent
    if (here / ".git").exists():
        command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=12"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return done.stdout.strip()
    return tdanet_jax.__version__


def episode_rows(group: str, column: Columns, records: Records) -> list[dict[str, Any]]:
    """One plain record per episode; L and e as in the paper, both with Done."""
    rows = []
    for i in range(len(records.length)):
        taken = records.actions[i, : records.length[i]]
        rows.append(
            {
                "group": group,
                **{k: str(column[k][i]) for k in ("scene", "room", "target")},
                **{k: float(column[k][i]) for k in ("x", "z")},
                **{k: int(column[k][i]) for k in ("rotation", "horizon")},
                "L": int(records.shortest[i]),
                "e": int(records.length[i]),
                "success": bool(records.success[i]),
                "collided": bool(records.collided[i]),
                "actions": [ACTION_NAMES[a] for a in taken],
            }
        )
    return rows


def results(
    provenance: Provenance, tables: SceneTables, played: Played, folder: Path | str | None = None
) -> dict[str, Any]:
    """The content of `results.json` from the records of an evaluation.

    Args:
      provenance: what was evaluated.
      tables: the rooms.
      played: the episodes and what happened in them, by group.
      folder: where to write `results.json`, `results.md` and `episodes.jsonl`; created if need be.
        None writes nothing.
    """
    folder = None if folder is None else Path(folder)
    by_class = is_open(provenance.split)
    origin = dataclasses.asdict(provenance)
    origin |= {name: name in provenance.sensors for name in FLAGS}
    origin["sensors"] = list(provenance.sensors)
    out = {
        "version": RESULTS_VERSION,
        **{name: origin.pop(name) for name in _HEAD},
        **figures(tables, played, by_class),
        **origin,
        "commit": code_version(),
    }
    if folder is not None:
        groups = {name: columns(tables, *pair, by_class) for name, pair in played.items()}
        folder.mkdir(parents=True, exist_ok=True)
        write_rows(folder, all_rows(tables, played))
        files.write_text(folder / RESULTS_PAGE, markdown(out, groups))
        # Last and atomically: where it is, the others are complete.
        files.write_text(folder / RESULTS_FILE, json.dumps(out, indent=2) + "\n")
    return out


def write_rows(folder: Path | str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes `episodes.jsonl`."""
    folder = Path(folder)
    with files.replacing(folder / EPISODES_FILE) as path, path.open("w") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)


def all_rows(tables: SceneTables, played: Played) -> Iterator[dict[str, Any]]:
    """The records of every group, as plain values."""
    for name, (episodes, records) in played.items():
        yield from episode_rows(name, columns(tables, episodes, records), records)


def _trained_for(out: Mapping[str, Any]) -> list[str]:
    """A sentence on an agent that was trained for other targets than those of its test."""
    if out.get("trained_targets") is None:
        return []
    targets = in_markdown(out["trained_targets"])
    return [f"Trained for the targets {targets}; *seen* means that training did not hide them."]


def markdown(out: Mapping[str, Any], groups: Mapping[str, Columns]) -> str:
    """`results.md`: tables as in the paper, with the paper's rows next to ours."""
    agent = ObservationSpec(sensors=tuple(out["sensors"])).agent_name(out["model"])
    departures = out.get("departures")
    published = {} if departures else paper.rates(out["split"], out["targets"])
    lines = [
        f"# {in_markdown(agent)}, split {in_markdown(out['split'])}, seed {out['seed']}",
        "",
        f"{out['episodes_trained']:,} training episodes, {out['steps']:,} environment steps; "
        f"{out['policy']} actions, evaluation seed {out['evaluation_seed']}; scene tables "
        f"{out['data_version']}, code {out['commit']}.",
        *(["", f"**{in_markdown(describe_departures(departures))}.**", ""] if departures else []),
        *([f"Targets: {in_markdown(out['targets'])}."] if out["targets"] != PAPER else []),
        *_trained_for(out),
        *(f"{n.capitalize()}: {in_markdown(out[n])}." for n in ("data", "image") if out[n]),
        "",
        "SR and SPL in percent, with 95 % bootstrap intervals over "
        f"{'target classes' if is_open(out['split']) else '(room, target) pairs'}. "
        + COLLISION_FREE,
        "",
        *_header("Targets", "Agent"),
    ]
    for group in GROUPS:
        if out[group] is None:
            continue
        lines.append(_row((group, f"**{in_markdown(agent)} (ours)**"), out[group]))
        for name, theirs in published.items():
            if group in theirs:
                lines.append(_row((group, f"{name} (paper)"), theirs[group]))
    if published:
        lines += ["", paper.worlds(out["data"])]
    paired = out["targets"] == PAPER and "unseen" in groups
    if paired and (apart := _near_synonyms(groups["unseen"])):
        known = "; ".join(
            f"{name}: {', '.join(like)}"
            for name, like in NEAR_SYNONYMS.items()
            if name in groups["unseen"]["target"]
        )
        lines += ["", f"Unseen classes with a near-synonym known in training ({known}) apart:"]
        lines += ["", *_header("Targets", "Classes"), *apart]
    lines.append("")
    for group, column in groups.items():
        share = 100 * float((column["shortest"] == 1).mean())
        lines.append(f"Target in view at the start (L = 1), {group}: {share:.1f} % of episodes.")
    for group, shares in out.get("actions", {}).items():
        parts = (f"{name} {share:.1f} %" for name, share in shares.items())
        lines.append(f"Actions taken, {group}: {', '.join(parts)}.")
    for title, key in (("Room", "by_room"), ("Target", "by_target")):
        lines += ["", f"## By {title.lower()}", "", *_header(title, "Group")]
        for name, parts in out[key].items():
            lines += [_row((in_markdown(name), group), buckets) for group, buckets in parts.items()]
    return "\n".join(lines) + "\n"


def _near_synonyms(column: Columns) -> list[str]:
    """Rows for the unseen classes with and without a near-synonym known in training."""
    like = np.isin(column["target"], list(NEAR_SYNONYMS))
    present = sorted(set(column["target"][like].tolist()))
    lines = []
    for chosen, title in ((like, ", ".join(present)), (~like, f"without {', '.join(present)}")):
        if like.any() and chosen.any():
            part = {name: values[chosen] for name, values in column.items()}
            lines.append(_row(("unseen", title), _summary(part)))
    return lines


def _header(*first: str) -> list[str]:
    names = [*first, *(f"{m} {bucket}" for bucket in BUCKETS for m in (*MEASURES, "n"))]
    return [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]


def _row(first: tuple[str, ...], buckets: Mapping[str, Mapping[str, Any]]) -> str:
    cells = [*first]
    for part in (buckets.get(bucket, {}) for bucket in BUCKETS):
        cells += [*(shown(part, measure) for measure in MEASURES), str(part.get("n", ""))]
    return f"| {' | '.join(cells)} |"
