"""How rooms differ from other rooms: sizes, what is in view, and how hard it is to find targets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import jax
import numpy as np

from tdanet_jax.env.params import limits_of_tests, make_params
from tdanet_jax.env.reward import NEAR, PARENT_CANDIDATES, nearest_distances, no_parents
from tdanet_jax.evaluation import episodes, policies, rollout
from tdanet_jax.evaluation.metrics import spl
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes.dataset import Rooms, find_targets
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.targets import PAPER

#: Episodes of each room type, of which L and the random agent's SR are.
EPISODES = 1000
SEED = 0


def table(columns: Mapping[str, SceneTables]) -> Iterator[str]:
    """Lines of a table with a column for each set of rooms.

    Args:
      columns: title -> rooms, with the same target classes.
    """
    found = {title: statistics(tables) for title, tables in columns.items()}
    yield f"{'':46}" + "".join(f"{title:>12}" for title in found)
    for name in next(iter(found.values())):
        yield f"{name:46}" + "".join(f"{rows[name]:>12}" for rows in found.values())


def statistics(tables: SceneTables) -> dict[str, str]:
    """What rooms are like: title -> figure."""
    rooms, counts = len(tables.scenes), np.diff(tables.row_start)
    seen = [len(np.unique(found)) for found in np.split(tables.row_class, tables.row_start[1:-1])]
    greatest = np.zeros((rooms, len(tables.targets)), bool)
    np.logical_or.at(greatest, tables.position_scene, tables.reachable)
    gaps = _distances(tables)
    some = len(gaps) > 0
    return {
        "rooms": f"{rooms:,}",
        "reachable points in a room": f"{len(tables.position) / rooms:.1f}",
        "objects in a room": f"{len(tables.object_id) / rooms:.1f}",
        "target classes that can be found in a room": f"{greatest.sum() / rooms:.2f}",
        "detections in a state": f"{counts.mean():.2f}",
        "  at most": f"{counts.max()}",
        "classes in a state": f"{np.mean(seen):.2f}",
        "states with a target within reach": f"{100 * (tables.distance == 0).any(1).mean():.1f} %",
        "nearest target and furniture, median distance": f"{np.median(gaps):.2f} m"
        if some
        else "-",
        f"  within {NEAR} m": f"{100 * (gaps <= NEAR).mean():.1f} %" if some else "-",
        **_episodes(tables),
    }


def _distances(tables: SceneTables) -> np.ndarray:
    """Distances in metres of each target from the nearest object of each possible parent's class,
    in the rooms that hold both."""
    scenes = np.arange(len(tables.scenes))
    found = [
        nearest_distances(tables, target, parent, scenes)
        for target in tables.targets
        for parent in PARENT_CANDIDATES
        if parent != target
    ]
    gaps = np.concatenate(found)
    return gaps[np.isfinite(gaps)]


def _episodes(tables: SceneTables) -> dict[str, str]:
    """L, and how often a uniformly random agent succeeds."""
    asked = find_targets(PAPER, Rooms(tables, extras=None))[1]  # of custom room types, too
    targets = {
        room: tuple(name for name in names if name in tables.targets)
        for room, names in asked.items()
    }
    params = make_params(
        tables, targets, no_parents(tables), limits_of_tests(tables), ObservationSpec()
    )
    drawn = episodes.draw(tables, tables.scenes, targets, EPISODES, SEED)
    played = rollout.evaluate(policies.random(), None, params, drawn, jax.random.key(SEED))
    rate = spl(played.success, played.shortest, played.length).mean()
    return {
        "L, mean": f"{played.shortest.mean():.2f}",
        "  median": f"{np.median(played.shortest):.0f}",
        "random agent, SR": f"{100 * played.success.mean():.1f} %",
        "  SPL": f"{100 * rate:.1f} %",
    }
