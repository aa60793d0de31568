"""The cache: built once, checked when read, safe among processes."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import ModuleType
from typing import IO

import numpy as np
import platformdirs
import pytest

from tdanet_jax.io import files
from tdanet_jax.scenes import cache, generated, ithor, tabulation, variants
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.offline import importer
from tests.support import toy

# Builds, once a line has come, and prints the tables' version.
BUILDER = """
import sys
import numpy as np
from tdanet_jax.scenes import cache, ithor
from tests.support import toy
def rooms():
    print("building", flush=True)
    sys.stdin.readline()
    return [toy.random_room(np.random.default_rng(0))]
ithor.load_scenes = rooms
print(cache.load_tables().data_version)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    rooms = [toy.random_room(np.random.default_rng(0))]
    monkeypatch.setattr(ithor, "load_scenes", lambda: rooms)
    return tmp_path / "cache"


def forbid_building(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*_: object, **__: object) -> None:
        raise AssertionError("built although cached")

    monkeypatch.setattr(tabulation, "build", build)


def test_built_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, int]] = []
    first = cache.load_tables(lambda done, total: calls.append((done, total)))
    assert calls[-1] == (1, 1)  # and before, on a slow machine, shares
    forbid_building(monkeypatch)
    assert cache.load_tables().data_version == first.data_version
    assert sorted(path.suffix for path in files_of(folder)) == [".npz", ".sha256"]


@pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "no checksum"])
def test_damage_is_noticed_and_repaired(folder: Path, damage: str) -> None:
    first = cache.load_tables()
    [path] = folder.glob("*.npz")
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    elif damage == "no checksum":
        path.with_suffix(".sha256").unlink()
    else:
        path.write_bytes(content[: 100 if damage == "truncate" else 0])
    with pytest.warns(UserWarning, match="damaged") as caught:
        again = cache.load_tables()
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert again.data_version == first.data_version
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cache.load_tables().data_version == first.data_version


def test_other_sources_other_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = cache.key()
    monkeypatch.setattr(cache.inspect, "getsource", lambda module: "changed")
    assert cache.key() != before


#: The modules that the names of cached files follow from, those of them where making a file begins,
#: and imported ones that decide nothing in it.
CASES = {
    # They made the asset, which is hashed itself; so it is with `metadata` below.
    "tables": (cache.MODULES, ("tabulation", "ithor"), ("metadata", "reachable")),
    # The first three store rooms or hand them on; the survey serves `tdanet scenes vary`.
    "variants": (
        (*cache.MODULES, *variants._MODULES),
        ("variants", "tabulation", "ithor"),
        ("cache", "dataset", "pools", "checks.survey", "metadata"),
    ),
    # `variants` makes the name alone.
    "generated": (
        (*cache.MODULES, *generated._MODULES),
        ("generated", "tabulation", "ithor"),
        ("cache", "dataset", "pools", "variants", "metadata"),
    ),
    # The last two read what is not in the cache.
    "imports": (
        importer.MODULES,
        ("offline.importer",),
        ("cache", "dataset", "offline.extras", "offline.features"),
    ),
}


def imports_of(module: ModuleType) -> set[str]:
    """The modules of scenes that a module imports, without the package's name."""
    nodes = ast.parse(inspect.getsource(module)).body
    pairs = [(n.module, a.name) for n in nodes if isinstance(n, ast.ImportFrom) for a in n.names]
    found = {f"{m}.{name}" if f"{m}.{name}" in sys.modules else str(m) for m, name in pairs}
    names = {name.removeprefix("tdanet_jax.") for name in found}
    return {name for name in names if name.startswith("scenes.")}


@pytest.mark.parametrize(("modules", "roots", "aside"), CASES.values(), ids=CASES)
def test_names_of_files_follow_from_all_modules_that_make_them(
    modules: tuple[str, ...], roots: tuple[str, ...], aside: tuple[str, ...]
) -> None:
    found, left = set[str](), [f"scenes.{name}" for name in roots]
    while left:
        name = left.pop()
        if name not in found and name.removeprefix("scenes.") not in aside:
            found.add(name)
            left += imports_of(importlib.import_module(f"tdanet_jax.{name}"))
    assert found <= {*modules}


def test_variants_follow_from_numpys_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = Rooms(tabulation.build([toy.corridor()]), Extras())
    before = variants.source(rooms, [])
    monkeypatch.setattr(np, "__version__", "99")
    assert variants.source(rooms, []) != before


def test_scenes_of_an_import_follow_from_the_source(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = importer._cache_folder(folder)
    monkeypatch.setattr(importer, "MODULES", importer.MODULES[1:])
    assert importer._cache_folder(folder) != before


def test_a_cache_that_cannot_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="not cached"):
        assert len(cache.load_tables().scenes) == 1


def start_building(folder: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, cache.VARIABLE: str(folder)}
    command = [sys.executable, "-c", BUILDER]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
    )


def read_until(pipe: IO[str] | None, text: str) -> str:
    """The lines up to the first that holds `text`, or up to the end."""
    assert pipe is not None
    lines = []
    for line in pipe:
        lines.append(line)
        if text in line:
            break
    return "".join(lines)


def test_one_of_several_processes_builds_and_the_others_wait(tmp_path: Path) -> None:
    first = start_building(tmp_path)
    began = read_until(first.stdout, "building")
    running = [first, start_building(tmp_path), start_building(tmp_path)]
    told = ["", *(read_until(p.stderr, "waiting for it") for p in running[1:])]  # now they wait
    rest = [process.communicate("go\n") for process in running]
    said = [(out, line + err) for (out, err), line in zip(rest, told, strict=True)]
    said[0] = (began + said[0][0], said[0][1])
    assert [process.returncode for process in running] == [0, 0, 0]
    assert sum("building" in out for out, _ in said) == 1
    assert len({out.splitlines()[-1] for out, _ in said}) == 1  # the tables' version
    for out, err in said:
        assert ("waiting for it" in err) == ("building" not in out)
        assert "damaged" not in err
    assert len(files_of(tmp_path)) == 2


def test_nobody_waits_for_what_he_does_not_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While one process builds the rooms, another one computes and stores something else."""
    first = start_building(tmp_path)
    read_until(first.stdout, "building")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache.load(f"{cache.DISTANCES}1.npz", lambda: {"distance": np.arange(3)})
        again = cache.load(f"{cache.DISTANCES}1.npz", lambda: pytest.fail("computed again"))
    assert again["distance"].tolist() == [0, 1, 2]
    first.communicate("go\n")
    assert first.returncode == 0
    assert {path.suffix for path in files_of(tmp_path)} == {".npz", ".sha256"}
    assert len(files_of(tmp_path)) == 4


def test_what_cannot_be_computed_leaves_nothing(folder: Path) -> None:
    with pytest.raises(RuntimeError, match="no rooms"):
        cache.load("variants-1.npz", stopped)
    assert not folder.exists()
    cache.load("variants-2.npz", lambda: {"distance": np.arange(3)})
    with pytest.raises(RuntimeError, match="no rooms"):
        cache.load("variants-1.npz", stopped)
    assert {path.name for path in files_of(folder)} == {"variants-2.npz", "variants-2.sha256"}


def stopped() -> dict[str, np.ndarray]:
    raise RuntimeError("no rooms")


def test_a_lock_that_cannot_be_removed_loses_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError("not yours")

    monkeypatch.setattr(Path, "unlink", refuse)
    found = cache.load("variants-1.npz", lambda: {"distance": np.arange(3)})
    assert found["distance"].tolist() == [0, 1, 2]


def test_a_killed_builder_leaves_no_lock_and_no_partial_file(tmp_path: Path) -> None:
    killed = start_building(tmp_path)
    assert killed.stdout is not None
    assert killed.stdout.readline() == "building\n"
    assert {path.name for path in files_of(tmp_path)} == {f".ithor-{cache.key()}.lock"}
    killed.kill()
    killed.communicate()
    (tmp_path / f"{files.PARTIAL}{killed.pid}-tables.npz").write_text("half")
    out, _ = start_building(tmp_path).communicate("go\n")
    assert out.startswith("building\n")
    assert len(files_of(tmp_path)) == 2


def files_of(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name != files.LOCK_FILE]


def test_unused_files_are_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When tables are stored: other tables and parts of imports, and nothing else."""
    before = time.time() - 86400 * (cache.UNUSED_DAYS + 1)
    folder.mkdir()
    for name in ("old", "used", "new"):
        for path in (folder / f"ithor-{name}.npz", folder / f"ithor-{name}.sha256",
                     folder / f"import-1-{name}" / "FloorPlan1.npz"):  # fmt: skip
            path.parent.mkdir(exist_ok=True)
            path.write_text(name)
    (folder / "compiled").mkdir()
    (folder / "mine.npz").write_text("of the user")
    for path in folder.iterdir():
        if "-new" not in path.name:
            os.utime(path, (before, before))
    cache.touch(folder / "ithor-used.npz")  # as reading them does
    cache.touch(folder / "import-1-used")
    cache.touch(folder / "nowhere")
    for name in (".variants-old.lock", ".variants-new.lock"):  # of builders that were killed
        (folder / name).touch()
    os.utime(folder / ".variants-old.lock", (before, before))
    monkeypatch.setattr(cache, "key", lambda: "now")
    cache.load_tables()
    left = {"ithor-now.npz", "ithor-now.sha256", "compiled", "mine.npz", files.LOCK_FILE}
    left.add(".variants-new.lock")
    for name in ("used", "new"):
        left |= {f"ithor-{name}.npz", f"ithor-{name}.sha256", f"import-1-{name}"}
    assert {path.name for path in folder.iterdir()} == left
    os.utime(folder / "ithor-now.npz", (before, before))
    cache.load_tables()
    assert (folder / "ithor-now.npz").stat().st_mtime > time.time() - 3600


def test_the_platforms_place_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    assert "tdanet_jax" in str(cache.folder())


def test_a_user_without_a_home_gets_a_temporary_folder_and_one_warning(
    folder: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """As a user id that a container does not know, with HOME unset."""

    def no_home(name: str) -> str:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.delenv(cache.VARIABLE)
    monkeypatch.setattr(platformdirs, "user_cache_dir", no_home)
    cache._temporary.cache_clear()
    version = cache.load_tables().data_version
    forbid_building(monkeypatch)
    assert cache.load_tables().data_version == version
    [warning] = recwarn
    assert "no home folder for the cache" in str(warning.message)
    assert cache.VARIABLE in str(warning.message)
    place = cache.folder()
    assert files_of(place)
    cache._temporary.cache_clear()  # as at the end of the process
    assert not place.exists()
