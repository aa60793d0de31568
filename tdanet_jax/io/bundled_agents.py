"""Where runs are, and the agents that come with the package, by name. Imports no JAX."""

from __future__ import annotations

from pathlib import Path

#: How a point of a run's history ends: `history/<updates>.npz`.
SUFFIX = ".npz"
#: The agents that are shipped. In a checkout, there may be others in the same folder.
SHIPPED = (
    "14-8-best",
    "14-8-paper-inputs",
    "18-4-best",
    "18-4-paper-inputs",
    "18-4-robust",
    "18-4-tdanet",
    "22-0-best",
    "22-0-paper-inputs",
    "open-best",
)
_PACKAGE = Path(__file__).resolve().parents[1]


def folder() -> Path:
    """Their folder: inside an installed package, or next to it in a checkout."""
    inside = _PACKAGE / "assets" / "agents"
    return inside if inside.is_dir() else _PACKAGE.parent / "agents"


def names() -> list[str]:
    """Their names."""
    return sorted(path.parent.name for path in folder().glob("*/config.json"))


def find_run(run: Path | str) -> Path:
    """Where a run is: as it is said, or the bundled agent of this name.

    Args:
      run: a folder, a point of its history, or the name of a bundled agent, "18-4-best" or
        "agents/18-4-best". What exists comes first.
    """
    path = Path(run)
    name = path.name if path.parent in (Path(), Path("agents")) else ""
    if not path.exists() and name in names():
        return folder() / name
    return path


def folder_of(run: Path | str) -> Path:
    """The folder of a run, or of the run of a point of history (`history/<updates>.npz`)."""
    path = Path(run)
    return path.parent.parent if path.suffix == SUFFIX else path


def is_bundled(run: Path) -> bool:
    """Whether a run is one of the shipped agents; nothing should be written into its folder."""
    return run.resolve().parent == folder().resolve() and run.resolve().name in SHIPPED
