"""Adds a row to the scoreboard, or makes the tables and pictures of the documentation from it.

    python -m tdanet_jax.tools.scoreboard add runs/mine --name 18-4-mine-0
    python -m tdanet_jax.tools.scoreboard write

In a clone: rows are folders of results/.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from tdanet_jax.commands.console import RunPath, console, fail, one_line_errors, one_line_usage

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"


@dataclasses.dataclass(frozen=True)
class Add:
    """Adds a finished run, or an evaluation that needs no run, to results/."""

    folder: tyro.conf.Positional[RunPath]
    """Its folder, or a bundled agent's name."""
    name: str
    """Name of the row: of its folder in results/. A run with --validation is called
    validation/NAME."""
    command: str | None = None
    """The one plain command by which it was made, in quotes, if its run.json does not tell."""
    machine: str | None = None
    """Where it was made, such as "AMD EPYC 7B13, 2 cores", if its run.json does not tell."""
    evaluation: Path | None = None
    """Folder that `tdanet evaluate --test-targets paper` wrote, if the run was trained for other
    targets."""

    def run(self) -> None:
        """Runs the command."""
        from tdanet_jax.workflows import scoreboard

        out = scoreboard.add(
            self.folder, self.name, RESULTS, self.command, self.machine, self.evaluation
        )
        console.print(f"wrote {out.relative_to(ROOT)}; now run the same tool with write")


@dataclasses.dataclass(frozen=True)
class Write:
    """Makes the tables and pictures of the documentation from results/."""

    def run(self) -> None:
        """Runs the command."""
        from tdanet_jax.workflows import scoreboard, scoreboard_page

        changed = scoreboard_page.write(ROOT, scoreboard.rows(RESULTS))
        for path in changed:
            console.print(f"{'wrote' if path.exists() else 'deleted'} {path.relative_to(ROOT)}")
        if not changed:
            console.print("everything is up to date")


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        with one_line_usage():
            command = tyro.extras.subcommand_cli_from_dict(
                {"add": Add, "write": Write},
                args=arguments,
                prog="python -m tdanet_jax.tools.scoreboard",
                description=__doc__,
            )
        if not (ROOT / "docs").is_dir():
            fail("the scoreboard belongs to a clone: run this in one, after pip install -e .")
        command.run()


if __name__ == "__main__":
    main()
