"""Time to quality: what training takes until an agent finds as much as the paper's."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping

from tdanet_jax.config import TrainConfig
from tdanet_jax.evaluation import episodes, metrics, paper, policies, rollout
from tdanet_jax.task import load_task
from tdanet_jax.tools.benchmarking import Row, operations_per_step
from tdanet_jax.training.run import Run

#: Steps from one evaluation to the next, rounded to whole chunks of updates.
STEPS = 100_000
#: Evaluations in a row that must pass, so that a lucky one does not count.
IN_A_ROW = 2
#: Random numbers of the sampled actions, the same in every evaluation.
SEED = 0

Bar = Mapping[str, tuple[float, float]]


def papers_bar(split: str) -> Bar:
    """SR and SPL of the paper's TDANet in percent, L >= 1: "seen" and "unseen" -> (SR, SPL)."""
    return {
        rate.group: (rate.sr, rate.spl)
        for rate in paper.RATES
        if (rate.agent, rate.split, rate.bucket) == ("TDANet", split, "L>=1")
    }


def passes(reached: Bar, bar: Bar) -> bool:
    """Whether all figures of a bar are reached."""
    return all(
        has >= least
        for group, wanted in bar.items()
        for has, least in zip(reached[group], wanted, strict=True)
    )


def until_passed(evaluations: Iterable[tuple[Bar, Row]], bar: Bar) -> tuple[bool, Row, Bar]:
    """Goes through evaluations until `IN_A_ROW` of them in a row pass a bar, or to their end.

    Args:
      evaluations: the figures of each, and what had been spent on training by then.

    Returns:
      Whether they did; what had been spent at the first of them, or in the end; the last figures.
    """
    passed = 0
    spent: Row = {}
    figures: Bar = {}
    for figures, now in evaluations:
        passed = passed + 1 if passes(figures, bar) else 0
        if passed <= 1:
            spent = now
        if passed == IN_A_ROW:
            break
    return passed == IN_A_ROW, spent, figures


def quality_row(config: TrainConfig) -> Row:
    """Trains until `IN_A_ROW` evaluations in a row pass the paper's figures, or out of budget.

    Every `STEPS` steps, all episodes of the split's lists are played with sampled actions.

    Args:
      config: what is trained. With `validation`, other rooms and classes are evaluated than those
        of the paper's figures.

    Returns:
      Whether they passed, and what had been spent at the first of them: seconds of training,
      without compilation and evaluation, steps, episodes, and floating-point operations of the
      products; the last SR and SPL; seconds of evaluation, and of all.
    """
    task, began = load_task(config), time.perf_counter()
    policy = policies.network(task.model, task.words)
    lists = episodes.load(task.tables, task.split, task.extras)
    operations = operations_per_step(task)
    evaluating = 0.0

    def evaluated(run: Run) -> Iterator[tuple[Bar, Row]]:
        nonlocal evaluating
        every = max(1, round(STEPS / (config.chunk_updates * config.steps_per_update)))
        for number, _ in enumerate(run.chunks(), start=1):
            if number % every == 0 or run.progress >= 1:
                paused = time.perf_counter()
                played = rollout.evaluate_lists(
                    policy, run.state.params, task.eval_params, lists, SEED
                )
                evaluating += time.perf_counter() - paused
                yield (
                    {group: _rates(records) for group, (_, records) in played.items()},
                    _spent(run, operations),
                )

    with tempfile.TemporaryDirectory() as folder:
        run = Run(folder, dataclasses.replace(config, history=0), task)
        passed, spent, figures = until_passed(evaluated(run), papers_bar(config.split))
    return {
        "part": "quality",
        "seed": config.seed,
        "passed": passed,
        **spent,
        **{f"{group}_sr": round(sr, 2) for group, (sr, _) in figures.items()},
        **{f"{group}_spl": round(spl, 2) for group, (_, spl) in figures.items()},
        "evaluation_seconds": round(evaluating, 1),
        "all_seconds": round(time.perf_counter() - began, 1),
    }


def _rates(records: rollout.Records) -> tuple[float, float]:
    """SR and SPL in percent, L >= 1: of all episodes."""
    efficiency = metrics.spl(records.success, records.shortest, records.length)
    return 100 * float(records.success.mean()), 100 * float(efficiency.mean())


def _spent(run: Run, operations: int) -> Row:
    return {
        "seconds": round(run.seconds, 1),
        "steps": run.steps,
        "episodes": int(run.state.episodes),
        "teraflop": round(operations * run.steps / 1e12, 1),
    }
