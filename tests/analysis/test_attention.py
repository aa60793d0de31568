"""Attention by class pair, against a plain loop."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from tdanet_jax.analysis import attention, trace
from tdanet_jax.analysis.attention import ClassPairs
from tdanet_jax.scenes.dataset import Rooms


@pytest.fixture(scope="module")
def player(opinionated_run, some_rooms):
    return trace.load_player(opinionated_run, Rooms(some_rooms, None))


def pairs_of(player, tables, pose, target):
    task = player.task
    return attention.class_pairs(
        player.model, player.weights, task.words, pose, target, task.eval_params,
        tables.targets, tables.classes,
    )  # fmt: skip


def test_means_are_those_of_a_plain_loop(some_rooms, player):
    rng = np.random.default_rng(0)
    some = rng.choice(some_rooms.num_states, 300)
    pose = np.concatenate([some, some[:40]])  # repeated frames count twice
    target = np.resize(rng.integers(len(some_rooms.targets), size=30), len(pose))
    target[300:] = target[:40]
    pairs = pairs_of(player, some_rooms, pose, target)
    task = player.task
    _, frames = attention.attend(
        player.model, player.weights, task.words, pose, target, task.eval_params
    )
    weights = np.asarray(frames.attention, np.float64)
    found: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for i in range(len(pose)):
        rows = slice(some_rooms.row_start[pose[i]], some_rooms.row_start[pose[i] + 1])
        classes = some_rooms.row_class[rows]
        own = some_rooms.classes.index(some_rooms.targets[target[i]])
        for c in set(classes.tolist()):
            if c == own or own not in classes:
                share = (weights[i, : len(classes)][classes == c].sum(), (classes == c).mean())
                found.setdefault((int(target[i]), c), []).append(share)
    counted = np.zeros_like(pairs.frames)
    for (g, c), shares in found.items():
        counted[g, c] = len(shares)
        np.testing.assert_allclose(
            (pairs.attention[g, c], pairs.even[g, c]), np.mean(shares, axis=0), atol=1e-5
        )
    np.testing.assert_array_equal(pairs.frames, counted)
    assert np.isnan(pairs.attention[counted == 0]).all()
    assert len(found) > 200


def handmade():
    frames = np.array([[50, 0, 30], [50, 40, 5]])
    share = np.array([[0.2, np.nan, 0.6], [0.1, 0.9, 1.0]])
    return ClassPairs(("Mug", "Sofa"), ("Mug", "Sofa", "Sink"), frames, share, share / 2)


def test_rows_are_sorted_and_written(tmp_path):
    rows = handmade().rows()
    assert [(r["target"], r["class"]) for r in rows] == [
        ("Mug", "Sink"), ("Mug", "Mug"), ("Sofa", "Sink"), ("Sofa", "Sofa"), ("Sofa", "Mug"),
    ]  # fmt: skip
    attention.write_csv(handmade(), tmp_path / "pairs.csv")
    with (tmp_path / "pairs.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [{k: str(v) for k, v in row.items()} for row in rows] == read


def test_the_page_names_what_is_attended_most_and_leaves_out_the_rare():
    page = attention.markdown(handmade(), "Title", {"Sofa"}, per_target=2)
    assert "| Mug | 20 (10) | Sink 60 (30) |  |" in page
    assert "| Sofa* | 90 (45) | Mug 10 (5) |  |" in page  # Sink: five frames alone
