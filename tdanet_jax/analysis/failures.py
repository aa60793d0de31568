"""Why episodes failed, the cause of each, and where the paths of the others were long."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.analysis import paths
from tdanet_jax.analysis.episode_lookup import Recorded
from tdanet_jax.analysis.paths import PARTS, Parts, Trajectory
from tdanet_jax.env.types import EnvParams
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.scenes import camera_view
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.vocabulary import Action


class Cause(NamedTuple):
    """Why an episode failed."""

    name: str
    meaning: str


#: By the key in `failures.json`; each failure has exactly one. "In reach" is the condition of
#: success: the target is in view within 1.5 m.
CAUSES = {
    "done_out_of_reach": Cause("Done out of reach", "Done with the target in view, out of reach"),
    "done_lost": Cause("Done, lost", "Done with the target out of view, which was in view before"),
    "done_never_in_view": Cause("Done, never in view", "Done, the target was never in view"),
    "limit_in_reach": Cause("In reach, no Done", "Step limit, the target was in reach"),
    "limit_in_view": Cause("Not reached", "Step limit, the target was in view but never in reach"),
    "limit_never_in_view": Cause("Not found", "Step limit, the target was never in view"),
}
TOO_EARLY = "done_out_of_reach"
#: Upper edges of the bins of `Failure.missing_metres`; at 0, the target is near enough, but too
#: little of it is in sight.
METRES = (0.0, 0.1, 0.25, 0.5, 1.0, np.inf)
METRES_NAMES = (
    "near enough, too little in sight",
    "up to 0.10 m",
    "0.10 to 0.25 m",
    "0.25 to 0.50 m",
    "0.50 to 1 m",
    "more than 1 m",
    "unknown",
)


class Failure(NamedTuple):
    """A failed episode."""

    episode: int  # its line in episodes.jsonl, from 0
    group: str  # "seen" or "unseen"
    scene: str
    room: str  # type of the room in which it started
    target: str
    cause: str  # a key of CAUSES
    shortest: int  # L, actions on the shortest path from the start, including Done
    length: int  # actions taken
    #: How much nearer the agent had to be when it said Done, horizontally and in metres: 0 if it
    #: was near enough. None unless it said Done with the target in view, or if the rooms' file does
    #: not tell where the target's sides are.
    missing_metres: float | None
    #: Actions, without Done, on the shortest path from where it said Done to where the target is in
    #: reach. None unless it said Done with the target in view.
    missing_actions: int | None


def find(records: Sequence[Recorded], tables: SceneTables, params: EnvParams) -> list[Failure]:
    """The failures among recorded episodes, in their order.

    Args:
      records: all episodes of a run, as `episode_lookup.read_records` gives them.
      tables: the rooms in which they were recorded.
      params: of the same rooms (`Task.eval_params`).
    """
    return _failures(paths.follow(records, tables, params), tables)


def _failures(followed: Iterable[Trajectory], tables: SceneTables) -> list[Failure]:
    found = []
    for i, path in enumerate(followed):
        if path.success:
            continue
        record, pose = path.record, path.pose
        done = record.actions[-1] == Action.DONE
        cause = _cause(bool(done), path.distance == 0, path.in_view)
        early = cause == TOO_EARLY
        found.append(
            Failure(
                episode=i,
                group=record.group,
                scene=tables.scenes[tables.position_scene[tables.grid.split(pose[0]).position]],
                room=tables.room_at(pose[0]),
                target=tables.targets[path.goal],
                cause=cause,
                shortest=int(path.distance[0]) + 1,
                length=len(record.actions),
                missing_metres=_missing(tables, int(pose[-1]), path.goal) if early else None,
                missing_actions=int(path.distance[-1]) if early else None,
            )
        )
    return found


def _cause(done: bool, in_reach: np.ndarray, in_view: np.ndarray) -> str:
    """The cause, from what held at each pose [T + 1]."""
    if done:
        return TOO_EARLY if in_view[-1] else "done_lost" if in_view.any() else "done_never_in_view"
    if in_reach.any():
        return "limit_in_reach"
    return "limit_in_view" if in_view.any() else "limit_never_in_view"


def _missing(tables: SceneTables, pose: int, goal: int) -> float | None:
    """`Failure.missing_metres`: to the nearest target in view, minus the reach."""
    objects = tables.row_object[camera_view.rows_of_pose(tables, pose)]
    named = [tables.classes[c] == tables.targets[goal] for c in tables.object_class[objects]]
    boxes = tables.object_box[objects[named]]
    # Imported rooms may know no box of an object, or a point alone.
    boxes = boxes[(boxes[:, 3:] > boxes[:, :3]).any(axis=1)][:, [0, 2, 3, 5]]
    if not len(boxes):
        return None
    place = tables.position[tables.grid.split(pose).position][[0, 2]]
    away = np.maximum(np.maximum(boxes[:, :2] - place, place - boxes[:, 2:]), 0)
    return max(float(np.hypot(*away.T).min()) - RULES.reach, 0.0)


@dataclasses.dataclass(frozen=True)
class Summary:
    """The failures of an agent, and the parts of its other paths.

    Attributes:
      agent: its name.
      split: of its episodes.
      failures: all of them.
      played: episodes by (group, room type, target).
      parts: of the paths of a group's successes, if it has any.
    """

    agent: str
    split: str
    failures: Sequence[Failure]
    played: Mapping[tuple[str, str, str], int]
    parts: Mapping[str, Parts]

    @property
    def groups(self) -> list[str]:
        """Groups that were played."""
        return [*dict.fromkeys(group for group, _, _ in self.played)]

    def episodes(self, **chosen: str) -> int:
        """Number of episodes with this `group`, `room` or `target`."""
        kept = [
            count
            for (group, room, target), count in self.played.items()
            if {"group": group, "room": room, "target": target}.items() >= chosen.items()
        ]
        return sum(kept)

    def count(self, **chosen: Any) -> int:
        """Number of failures with these fields."""
        return sum(all(getattr(f, k) == v for k, v in chosen.items()) for f in self.failures)

    def missing(self, group: str) -> np.ndarray:
        """Failures by missing metres, as in METRES_NAMES: [7] int."""
        early = [f for f in self.failures if (f.group, f.cause) == (group, TOO_EARLY)]
        known = [f.missing_metres for f in early if f.missing_metres is not None]
        counts = np.bincount(np.searchsorted(METRES, known), minlength=len(METRES))
        return np.append(counts, len(early) - len(known))

    def rooms(self) -> list[dict[str, str]]:
        """The fields `group` and `room` of each kind of episode."""
        return [
            {"group": g, "room": r} for g, r in dict.fromkeys((g, r) for g, r, _ in self.played)
        ]

    def targets(self) -> list[dict[str, str]]:
        """The fields `group` and `target` of those with failures; most per episode first."""
        pairs = dict.fromkeys((group, target) for group, _, target in self.played)
        keys = [{"group": group, "target": target} for group, target in pairs]
        failed = [key for key in keys if self.count(**key)]
        return sorted(failed, key=lambda k: self.count(**k) / self.episodes(**k), reverse=True)


def summarise(
    agent: str, split: str, records: Sequence[Recorded], tables: SceneTables, params: EnvParams
) -> Summary:
    """What all recorded episodes of an agent show; arguments as for `find`."""
    followed = list(paths.follow(records, tables, params))
    parts = {
        group: found
        for group in dict.fromkeys(record.group for record in records)
        if (found := paths.parts([p for p in followed if p.record.group == group]))
    }
    played = Counter(
        (r.group, tables.room_at(int(r.episode.pose[0])), tables.targets[int(r.episode.target[0])])
        for r in records
    )
    return Summary(agent, split, _failures(followed, tables), dict(played), parts)


def examples(summary: Summary, most: int) -> list[Failure]:
    """At most so many failures to look at: of each cause in turn, the commonest first; and of each
    cause one of each target in turn, those that fail most first.
    """
    causes = Counter(failure.cause for failure in summary.failures)
    turns: list[list[Failure]] = []
    for cause, _ in causes.most_common():
        by_target = [
            [f for f in summary.failures if (f.cause, f.group, f.target) == (cause, *key.values())]
            for key in summary.targets()
        ]
        turns.append(_in_turn(by_target))
    return _in_turn(turns)[:most]


def _in_turn(lists: Sequence[Sequence[Failure]]) -> list[Failure]:
    """The first of each, then the second of each, and so on."""
    return [f for rank in itertools.zip_longest(*lists) for f in rank if f is not None]


def to_json(summary: Summary) -> dict[str, Any]:
    """The content of `failures.json`."""
    return {
        "agent": summary.agent,
        "split": summary.split,
        "episodes": {group: summary.episodes(group=group) for group in summary.groups},
        "causes": {
            group: {cause: summary.count(group=group, cause=cause) for cause in CAUSES}
            for group in summary.groups
        },
        "paths": {group: _parts_as_json(parts) for group, parts in summary.parts.items()},
        "failures": [failure._asdict() for failure in summary.failures],
    }


def markdown(summary: Summary, picture: str, replays: Mapping[str, Failure]) -> str:
    """`failures.md`.

    Args:
      picture: file name of the picture.
      replays: the failure that each page shows, by file name.
    """
    failed = ", ".join(
        f"{summary.count(group=g):,} of {summary.episodes(group=g):,} {g}" for g in summary.groups
    )
    lines = [
        f"# Failures of {in_markdown(summary.agent)}, split {in_markdown(summary.split)}",
        "",
        f"Failed episodes: {failed}. In reach: in view within 1.5 m, the condition of success.",
        "",
        f"![Failures by cause, missing distance and target]({picture})",
        "",
        *_row("Cause", "Meaning", *summary.groups, head=True),
    ]
    for key, cause in CAUSES.items():
        counts = (summary.count(group=group, cause=key) for group in summary.groups)
        lines += _row(*cause, *counts)
    lines += [
        "",
        "## Done out of reach",
        "",
        "How much nearer the agent had to be, horizontally, to the nearest target in view; and how "
        "many more actions would have led to where it is in reach (median).",
        "",
        *_row("Missing", *summary.groups, head=True),
        *_missing_rows(summary),
    ]
    for title, keys in (("room type", summary.rooms()), ("target", summary.targets())):
        lines += ["", f"## By {title}", "", *_by_cause(summary, title, keys)]
    lines += _paths(summary)
    if replays:
        lines += ["", "## Replays", ""]
    for page, f in replays.items():
        lines.append(
            f"- [{in_markdown(f.target)} in {in_markdown(f.scene)}]({page}): "
            f"{CAUSES[f.cause].name}; {f.length} actions, shortest {f.shortest}; "
            f"episode {f.episode}"
        )
    return "\n".join(lines) + "\n"


def _parts_as_json(parts: Parts) -> dict[str, Any]:
    """Means of the actions, of the excess, and SPL without it, by part."""
    by_part = {
        name: {
            "actions": round(float(parts.actions[i]), 2),
            "excess": round(float(parts.excess[i]), 2),
            "SPL_without_excess": round(float(parts.spl_without[i]), 2),
        }
        for i, name in enumerate(PARTS)
    }
    return {"successes": parts.successes, "SPL": round(parts.spl, 2), **by_part}


def _paths(summary: Summary) -> Iterator[str]:
    """The section on the paths of the successes."""
    yield from ("", "## Paths of the successes", "")
    yield (
        "Mean actions of each part of a path, how many of them the shortest path does without (the "
        "excess), and what SPL over all episodes would be without these."
    )
    yield ""
    yield from _row("Part", "Group", "Actions", "Excess", "SPL without", head=True)
    for group, parts in summary.parts.items():
        for i, (name, meaning) in enumerate(PARTS.items()):
            values = (parts.actions[i], parts.excess[i], parts.spl_without[i])
            yield from _row(f"{name}: {meaning}", group, *(f"{value:.1f}" for value in values))
        yield from _row(
            "all",
            group,
            f"{parts.actions.sum() + 1:.1f} with Done",
            f"{parts.excess.sum():.1f}",
            f"{parts.spl:.1f} with all",
        )


def _row(*cells: Any, head: bool = False) -> list[str]:
    """The lines of a table's row, or of its head."""
    line = f"| {' | '.join(in_markdown(str(cell)) for cell in cells)} |"
    return [line, f"|{'---|' * len(cells)}"] if head else [line]


def _missing_rows(summary: Summary) -> Iterator[str]:
    counts = [summary.missing(group) for group in summary.groups]
    for name, *values in zip(METRES_NAMES, *counts, strict=True):
        yield from _row(name, *values)
    medians = []
    for group in summary.groups:
        actions = [f.missing_actions for f in summary.failures if f.group == group]
        known = [count for count in actions if count is not None]
        medians.append(f"{np.median(known):g}" if known else "-")
    yield from _row("more actions, median", *medians)


def _by_cause(summary: Summary, title: str, keys: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Failures by cause of the episodes with these fields, a row each."""
    names = (cause.name for cause in CAUSES.values())
    yield from _row(title.capitalize(), "Group", "Episodes", "Failed", "%", *names, head=True)
    for key in keys:
        group, name = key.values()
        episodes, failed = summary.episodes(**key), summary.count(**key)
        counts = (summary.count(**key, cause=cause) or "" for cause in CAUSES)
        share = f"{100 * failed / episodes:.1f}"
        yield from _row(name, group, f"{episodes:,}", failed, share, *counts)
