"""What the commands that train share: flags, progress, and stopping."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from tdanet_jax.commands.console import console, parse, print_summary, reporter
from tdanet_jax.commands.signals import Stopped, StopRequest
from tdanet_jax.config import CONFIG_FILE, PRESETS, TRUST, TrainConfig
from tdanet_jax.registry import MODELS
from tdanet_jax.training.callbacks import Callbacks

if TYPE_CHECKING:
    from tdanet_jax.training.journal import Row
    from tdanet_jax.training.run import Run


#: What helps a training that does not fit into memory.
IF_MEMORY_ENDS = "fewer --num-envs, or more --num-minibatches"


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms."""

    run: tyro.conf.OmitArgPrefixes[TrainConfig]
    preset: Literal["default", "best", "robust", "paper-inputs", "paper"] = "default"
    """Defaults of the other flags. best: --odometry, --triangulation, --reach-threshold 0.5,
    --temperature 0.3, --done-bias 2, --gamma 0.97, --size-noise 0.5, --imitation-weight 0.3 and
    --extra-targets all, which did best on validation. robust, for robots, whose senses err:
    --odometry, --triangulation, --robust-triangulation, --scores, --gamma 0.97, --size-noise 0.5
    and --noise. paper-inputs: for the inputs that the paper's agent has, --context 64,
    --temperature 0.7, --gamma 0.97, --imitation-weight 0.3 and --extra-targets all.
    paper: the reference implementation's hyperparameters and its budget of 6 M episodes."""
    out: Path | None = None
    """Folder for everything that the run writes; must be new or empty."""
    resume: Path | None = None
    """Folder of a run to continue. Accepts only --devices, --log, --data where the run's rooms were
    moved to, --word-vectors likewise (the run's own copy comes first), and a new budget, which
    replaces the run's; its schedules then follow the new one."""
    log: tuple[Literal["tensorboard", "wandb", "csv"], ...] = ()
    """Where else the metrics go: TensorBoard events (needs tensorboardX), Weights & Biases (needs
    wandb; WANDB_MODE=offline sends nothing), metrics.csv."""
    tensorboard: bool = False
    """The same as --log tensorboard."""
    devices: int = 1
    """Devices in this process to split the environments over; a CPU is split into as many. Further
    processes, on this or other machines, join if SLURM or Open MPI 4 starts them, or through
    JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID (docs/cluster.md)."""

    @property
    def sinks(self) -> tuple[str, ...]:
        """Where else the metrics go, each once."""
        return tuple(dict.fromkeys([*self.log, *["tensorboard"] * self.tensorboard]))


def parse_command(arguments: Sequence[str], where: str = "") -> Command:
    """The command line of training; `--preset` chooses the defaults of the other flags.

    Args:
      arguments: the command line; a later value of a flag replaces an earlier one.
      where: what the line of an error starts with.
    """
    preset = "default"
    for i, word in enumerate(arguments):
        if word.startswith("--preset"):
            preset = word.partition("=")[2] or "".join(arguments[i + 1 : i + 2])
    default = Command(run=PRESETS.get(preset, PRESETS["default"]))
    return parse(Command, arguments, where, default=default, prog="tdanet train")


@contextlib.contextmanager
def stoppable(advice: Callable[[], str], typed: str | None = None) -> Iterator[Reports]:
    """Inside, SIGTERM or Ctrl-C ends the program: one line of advice, status 128 + signal.

    Args:
      advice: makes the line.
      typed: the command line of what trains inside.
    """
    stop = StopRequest()
    with stop.receiving():
        try:
            with contextlib.ExitStack() as shown:
                yield Reports(stop, shown, typed)
        except Stopped as stopped:
            console.print(f"stopped; {advice()}")
            stopped.answer()


class Reports(Callbacks):
    """Prints notes and results, shows progress, and stops the runs on a signal."""

    def __init__(
        self, stop: StopRequest, shown: contextlib.ExitStack, typed: str | None = None
    ) -> None:
        """`shown` holds the progress bar on the screen, if there is one."""
        self.command = typed
        self._stop = stop
        self._shown = shown
        self._title = ""

    def _show(self, title: str, share: float, figures: str) -> None:
        if title != self._title:
            self._clear(title)
            self._report = self._shown.enter_context(reporter(title, transient=title == "rooms"))
        self._report(share, figures)

    def _clear(self, title: str = "") -> None:
        """Takes the progress bar away; of several processes, the lead alone prints."""
        from tdanet_jax.training import devices

        self._shown.close()
        self._title = title
        console.quiet = not devices.is_lead()

    def on_rooms(self, done: float, total: int) -> None:
        self._show("rooms", done / total, "ready")

    def on_note(self, text: str) -> None:
        self._clear()
        console.print(text)

    def on_rows(self, runs: Sequence[Run], rows: Sequence[Row]) -> None:
        each = f"{len(rows)} seeds, each: " if len(runs) > 1 else ""
        self._show("training", runs[0].progress, each + figures_of(rows[0]))

    def on_results(self, folder: Path, results: Mapping[str, Any]) -> None:
        self._clear()
        print_summary(results)
        console.print(f"wrote {folder / 'results.md'}")

    def should_stop(self) -> bool:
        return self._stop.signal is not None

    def on_stop(self) -> None:
        self._stop.signal = self._stop.signal or signal.SIGTERM

    def shield(self) -> AbstractContextManager[None]:
        return self._stop.deferred()


def figures_of(row: Row) -> str:
    """The figures next to the progress bar; the whole line fits 80 columns."""
    skipped = f"  {row['skipped']} updates skipped" if row["skipped"] else ""

    def shown(name: str, factor: float, digits: int) -> str:
        return "-" if row[name] is None else f"{factor * row[name]:.{digits}f}"

    return (
        f"{row['steps_per_second']:,.0f} steps/s  SR {shown('success', 100, 1)}  "
        f"SPL {shown('spl', 100, 1)}  entropy {shown('entropy', 1, 2)}{skipped}"
    )


def trust(config: TrainConfig) -> str:
    """The setting without which commands refuse a run's custom code; none if it has none."""
    names = [name for name in (config.model,) if name not in MODELS] + [*config.network.sensors]
    return f"{TRUST}={','.join(names)}" if names else ""


def how_to_continue(
    folder: Path, config: TrainConfig, device_count: int = 1, log: Sequence[str] = ()
) -> str:
    """What to say to someone who has stopped a run; the last two are not in the run's folder."""
    from tdanet_jax.training.checkpoint import Checkpoints

    if not (folder / CONFIG_FILE).exists():
        return "the run had not begun"
    again = f"{trust(config)} tdanet train --resume {shlex.quote(str(folder))}".lstrip()
    again += f" --devices {device_count}" if device_count > 1 else ""
    again += f" --log {' '.join(log)}" if log else ""
    return f"{Checkpoints(folder).latest() or 0:,} updates are saved; continue with: {again}"
