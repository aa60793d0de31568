"""Rooms: build the bundled files, verify them, draw a room, import and export rooms.

tdanet scenes verify
tdanet scenes inspect FloorPlan228
tdanet scenes vary --copies 16 --out variants.npz
tdanet scenes generate --rooms 1000 --out generated.npz
tdanet scenes compare variants.npz
tdanet scenes import my_rooms.json --out my_rooms.npz
tdanet scenes import --from thor_v1_offline_data --out original.npz
tdanet scenes export --out our_rooms
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import tyro

from tdanet_jax.commands.console import one_line_errors, one_line_usage
from tdanet_jax.commands.scenes.build import Build
from tdanet_jax.commands.scenes.collect import Collect
from tdanet_jax.commands.scenes.compare import Compare
from tdanet_jax.commands.scenes.export import Export
from tdanet_jax.commands.scenes.generate import Generate
from tdanet_jax.commands.scenes.import_ import Import
from tdanet_jax.commands.scenes.inspect import Inspect
from tdanet_jax.commands.scenes.vary import Vary
from tdanet_jax.commands.scenes.verify import Verify

COMMANDS: dict[str, Callable[..., Any]] = {
    "build": Build,
    "verify": Verify,
    "inspect": Inspect,
    "vary": Vary,
    "generate": Generate,
    "compare": Compare,
    "import": Import,
    "export": Export,
    "collect": Collect,
}


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        with one_line_usage():
            command = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, args=arguments, prog="tdanet scenes", description=__doc__
            )
        command.run()
