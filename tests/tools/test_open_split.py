"""The open benchmark's classes are those that the documented procedure chooses, and balanced."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tdanet_jax.config import TrainConfig
from tdanet_jax.io import assets
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import Rooms, find_targets
from tdanet_jax.splits import OPEN, OPEN_ASSET, make_split, split_name
from tdanet_jax.tools import open_split
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.words import WordVectors


def test_the_committed_choice_is_the_procedures(ithor: SceneTables, glove: WordVectors) -> None:
    committed = json.loads(assets.path(OPEN_ASSET).read_text())
    assert json.loads(json.dumps(open_split.choose(ithor, glove))) == committed


def test_a_fifth_of_the_classes_is_unseen_everywhere(ithor: SceneTables) -> None:
    split, held = make_split(OPEN), make_split(OPEN, validation=True)
    classes = {c for group in (split.seen, split.unseen) for names in group.values() for c in names}
    assert len(split.hidden) == round(len(classes) / 5)
    assert not classes & {*open_split.LEFT_OUT}
    for room in ROOM_TYPES:
        both = len(split.seen[room]) + len(split.unseen[room])
        assert len(split.unseen[room]) == pytest.approx(both / 5, abs=1.5)
        assert not set(split.seen[room]) & split.hidden
        assert set(held.unseen[room]) <= set(split.seen[room])
    assert split.hidden < held.hidden
    assert not set(held.eval_scenes) & set(split.eval_scenes)
    size = open_split.sizes(ithor, sorted(classes))
    unseen = np.isin(sorted(classes), sorted(split.hidden))
    for third in np.array_split(np.argsort(size), 3):
        assert unseen[third].sum() == pytest.approx(len(third) / 5, abs=1.5)


def test_the_split_brings_its_targets(ithor: SceneTables) -> None:
    config = TrainConfig(split=OPEN)
    config.check()
    assert split_name(OPEN) == config.normalised().split == OPEN
    tables, targets = find_targets(config.sought, Rooms(ithor, None))
    assert make_split(OPEN, False, targets) == make_split(OPEN)
    for room, names in targets.items():
        here = tables.position_room_type == ROOM_TYPES.index(room)
        goals = [tables.targets.index(name) for name in names]
        assert tables.reachable[here][:, goals].any(axis=0).all()
    with pytest.raises(ValueError, match="--targets all: --split open has its own targets"):
        TrainConfig(split=OPEN, targets="all").check()
