"""Which episodes an evaluation plays, and in which environment: the official test, or a part of it.

Parts are for a quick look and for questions of one's own; reports say that they are not the test.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Collection, Iterable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from tdanet_jax import sense_noise
from tdanet_jax.env.params import with_noise
from tdanet_jax.env.types import EnvParams
from tdanet_jax.eval_config import EvalConfig
from tdanet_jax.evaluation import episodes
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.sensors.noise import levels_of
from tdanet_jax.splits import labels_of
from tdanet_jax.task import Task


def select(task: Task, test: EvalConfig) -> tuple[EnvParams, dict[str, Episodes]]:
    """The environment of an evaluation, without noise, and its episodes by group.

    Raises:
      ValueError: a value is out of range, a name is unknown, or no episode is left.
    """
    test.check()
    if test.training_rooms:
        lists = episodes.in_training_rooms(task.tables, task.split)
    else:
        lists = episodes.load(task.tables, task.split, task.extras)
    lists = choose(lists, task.tables, test)
    params = task.eval_params
    if test.step_limit is not None:
        params = params.replace(step_limit=jnp.full_like(params.step_limit, test.step_limit))
    return params, lists


def with_senses(task: Task, params: EnvParams, senses: Sequence[SenseNoise]) -> list[EnvParams]:
    """The environment of an evaluation with each of these noises of the senses.

    All have arrays of the same shapes, so that one compiled program plays them.

    Raises:
      ValueError: detections would err, but not the image that the network looks at.
    """
    if params.spec.image is not None:
        for noise in senses:
            noise.check_image()
    if not any(noise.any for noise in senses):
        return [params] * len(senses)
    model = with_noise(params, task.tables, sense_noise.MIX, np.asarray(task.words)).noise
    assert model is not None
    return [params.replace(noise=model.replace(**levels_of(noise))) for noise in senses]


def choose(
    lists: Mapping[str, Episodes], tables: SceneTables, test: EvalConfig
) -> dict[str, Episodes]:
    """The episodes in the chosen rooms, with the chosen targets, and evenly spaced ones of these.

    Groups without any are left out.

    Raises:
      ValueError: no episode has a chosen room or target, or none has both; names the flag.
    """
    scenes = {group: _scene_names(chosen, tables) for group, chosen in lists.items()}
    targets = {group: np.array(tables.targets)[one.target] for group, one in lists.items()}
    kind = "episode in a training room" if test.training_rooms else "test episode"
    wanted_scenes = find_names("scenes", test.scenes, np.unique([*_values(scenes)]), kind)
    played = tuple(map(str, np.unique([*_values(targets)])))
    meant = [labels_of(played).find(label) for label in test.targets]
    asked = [m if m in played else label for m, label in zip(meant, test.targets, strict=True)]
    wanted_targets = find_names("targets", asked, played, kind)
    out = {}
    for group, one in lists.items():
        kept = np.isin(scenes[group], wanted_scenes) & np.isin(targets[group], wanted_targets)
        found = np.flatnonzero(kept)
        if test.episodes is not None and len(found) > test.episodes:
            found = found[np.arange(test.episodes) * len(found) // test.episodes]
        if len(found):
            out[group] = Episodes(one.pose[found], one.target[found])
    if not out:
        raise ValueError(f"--scenes, --targets: no {kind} has one of these targets there")
    return out


def find_names(flag: str, given: Collection[str], known: Iterable[str], kind: str) -> list[str]:
    """The names that a flag gives; all that are known if it gives none.

    Args:
      flag: its name.
      given: its names.
      known: those that occur.
      kind: what they occur in, for errors.

    Raises:
      ValueError: a name is not known; suggests a similar one, or lists them all.
    """
    names = [str(name) for name in known]
    for name in given:
        if name not in names:
            similar = {each.lower(): each for each in names}
            near = difflib.get_close_matches(name.lower(), similar, n=1)
            hint = f"did you mean {similar[near[0]]}?" if near else f"there are {', '.join(names)}"
            if all(part in names for part in name.split(",")):
                hint = "separate names with spaces"
            if flag == "scenes" and os.path.isfile(name):  # of Path, a long name is an error
                hint = "rooms of your own are imported (tdanet scenes import) and given with --data"
            raise ValueError(f"--{flag} {name}: in no {kind}; {hint}")
    return list(given) or names


def _scene_names(chosen: Episodes, tables: SceneTables) -> np.ndarray:
    """The room of each episode, [E] text."""
    return np.array(tables.scenes)[tables.position_scene[tables.grid.split(chosen.pose).position]]


def _values(by_group: Mapping[str, np.ndarray]) -> Iterable[str]:
    return (str(value) for values in by_group.values() for value in values)
