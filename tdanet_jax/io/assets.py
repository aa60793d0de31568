"""The bundled data files: where they are, and whether their checksums are right."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

CHECKSUMS = "checksums.json"


class AssetError(ValueError):
    """A bundled file is missing or is not the one whose checksum was recorded."""


def folder() -> Path:
    """The folder of bundled files: inside an installed package, or next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "assets", package.parent / "assets"):
        if (candidate / CHECKSUMS).is_file():
            return candidate
    raise AssetError(
        f"{package.parent / 'assets' / CHECKSUMS}: missing; "
        "reinstall tdanet_jax or run `tdanet scenes build`"
    )


def sha256(path: Path) -> str:
    """Hex digest of a file's content."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


@cache
def path(name: str) -> Path:
    """Path of the bundled file `name`, whose checksum is verified once per process.

    Raises:
      AssetError: the file is missing, unlisted or corrupt.
    """
    root = folder()
    file = root / name
    if not file.is_file():
        raise AssetError(f"{file}: missing; reinstall tdanet_jax")
    try:
        expected = json.loads((root / CHECKSUMS).read_text(encoding="utf-8")).get(name)
    except (ValueError, AttributeError):
        raise AssetError(f"{root / CHECKSUMS}: not a JSON object; reinstall tdanet_jax") from None
    if expected is None:
        raise AssetError(f"{root / CHECKSUMS}: no checksum for {name}; reinstall tdanet_jax")
    if sha256(file) != expected:
        raise AssetError(f"{file}: corrupt (sha256 differs from {CHECKSUMS}); reinstall tdanet_jax")
    return file


def record(root: Path, names: list[str]) -> None:
    """Writes the checksums of `names` in `root`, sorted, so that a rebuild gives equal bytes."""
    sums = {name: sha256(root / name) for name in sorted(names)}
    (root / CHECKSUMS).write_text(json.dumps(sums, indent=2) + "\n")
