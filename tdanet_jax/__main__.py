"""All commands under one name: `tdanet NAME`, or `python -m tdanet_jax NAME`."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Annotated, Any, Union

from tdanet_jax import commands

#: Name -> module, and what it does.
COMMANDS = {
    "demo": ("demo", "shows the bundled agent finding something"),
    "train": ("train_zero_shot", "trains an agent and reports SR and SPL in the test rooms"),
    "evaluate": ("evaluate", "evaluates agents or untrained policies on the test episodes"),
    "sweep": ("sweep", "trains several models, splits and seeds, and compares them"),
    "replay": ("replay", "writes an episode as an interactive page"),
    "trajectories": ("trajectories", "draws the paths of agents on the floor plan"),
    "attention": ("attention", "shows what an agent attends to"),
    "failures": ("failures", "sorts failed episodes by cause, with pages of some"),
    "scenes": ("scenes", "builds, imports, exports, varies, checks and draws rooms"),
    "serve": ("serve", "answers a robot's frames with actions, in lines of JSON"),
    "export": ("export", "makes a folder of an agent for robots without JAX"),
    "noise": ("noise", "measures the noise of a detector on labelled images"),
    "share": ("share", "makes a small folder of a trained agent"),
    "benchmark": ("benchmark", "measures speed"),
    "scaling": ("scaling", "measures how cost grows with rooms and detections"),
}
WIDTH = max(map(len, COMMANDS))
HELP = f"""usage: tdanet COMMAND [OPTIONS]

Zero-shot object-goal navigation in the iTHOR rooms.
`tdanet COMMAND --help` lists a command's options.

{chr(10).join(f"  {name:<{WIDTH}}  {what}" for name, (_, what) in COMMANDS.items())}

  --version, --completion bash|zsh"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command that is named first."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        say(HELP)
    elif name == "--version":
        from tdanet_jax import __version__

        say(f"tdanet_jax {__version__}")
    elif name == "--completion":
        complete(rest)
    elif name not in COMMANDS:
        from tdanet_jax.commands.console import fail

        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(COMMANDS)}"
        fail(f"{name}: no such command; {hint}")
    else:
        load(name).main(rest)


def load(name: str) -> ModuleType:
    """The module of a command."""
    return importlib.import_module(f"tdanet_jax.commands.{COMMANDS[name][0]}")


def say(text: str) -> None:
    """Prints a text."""
    from tdanet_jax.commands.console import console

    console.print(text)


def complete(arguments: Sequence[str]) -> None:
    """Prints the script with which a shell completes the commands and their flags."""
    import tyro

    from tdanet_jax.commands.console import fail, one_line_usage

    if len(arguments) != 1 or arguments[0] not in ("bash", "zsh"):
        fail("--completion: choose bash or zsh")
    parsed: dict[str, Any] = {}
    for name in COMMANDS:
        found = load(name)
        if hasattr(found, "Command"):
            parsed[name] = found.Command
        else:  # it has commands of its own
            kinds = (Annotated[c, tyro.conf.subcommand(n)] for n, c in found.COMMANDS.items())
            parsed[name] = Union[tuple(kinds)]  # noqa: UP007
    with one_line_usage():
        tyro.extras.subcommand_cli_from_dict(
            parsed, prog="tdanet", args=["--tyro-print-completion", arguments[0]]
        )


def script() -> None:
    """The entry point `tdanet`."""
    commands.begin()
    if not sys.flags.safe_path:
        sys.path.append("")  # custom models and sensors of the working folder: they hide nothing
    main()


if __name__ == "__main__":
    script()
