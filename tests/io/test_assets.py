"""Bundled files are found and checked."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax import labels, words
from tdanet_jax.commands import scenes
from tdanet_jax.evaluation import episodes
from tdanet_jax.io import assets, files
from tdanet_jax.io.assets import AssetError
from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.splits import OPEN_ASSET
from tdanet_jax.tools import build_assets
from tests.support import toy


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "a.npz").write_bytes(b"content")
    assets.record(tmp_path, ["a.npz"])
    monkeypatch.setattr(assets, "folder", lambda: tmp_path)
    assets.path.cache_clear()
    yield tmp_path
    assets.path.cache_clear()


def test_sound_files_are_found(folder: Path) -> None:
    assert assets.path("a.npz") == folder / "a.npz"


def one_line(error: pytest.ExceptionInfo[AssetError], name: str) -> None:
    assert "\n" not in str(error.value)
    assert name in str(error.value)


def test_corrupt(folder: Path) -> None:
    (folder / "a.npz").write_bytes(b"contenu")
    with pytest.raises(AssetError, match="corrupt") as error:
        assets.path("a.npz")
    one_line(error, "a.npz")


def test_missing(folder: Path) -> None:
    (folder / "a.npz").unlink()
    with pytest.raises(AssetError, match="missing") as error:
        assets.path("a.npz")
    one_line(error, "a.npz")


def test_unlisted(folder: Path) -> None:
    (folder / "b.npz").write_bytes(b"")
    with pytest.raises(AssetError, match="no checksum") as error:
        assets.path("b.npz")
    one_line(error, "b.npz")


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe"])
def test_broken_list(folder: Path, content: bytes) -> None:
    (folder / assets.CHECKSUMS).write_bytes(content)
    with pytest.raises(AssetError, match=r"checksums\.json"):
        assets.path("a.npz")


def test_every_bundled_file_is_listed_and_sound() -> None:
    for path in assets.folder().iterdir():
        if path.name != assets.CHECKSUMS:
            assert assets.path(path.name) == path


def test_the_notice_names_every_source() -> None:
    text = assets.path("NOTICE").read_text()
    for source in build_assets.SOURCES:
        for part in (source.package, source.version, source.sha256, source.licence):
            assert part in text
    assert "Permission is hereby granted" in text  # the MIT licence asks for its own text
    assert "Apache License" in text


def test_the_table_of_labels_is_copied_as_it_was_edited(folder: Path) -> None:
    (folder / labels.ASSET).write_text('{"Mug": ["beaker"]}')  # no checksum is recorded yet
    (folder / "out").mkdir()
    copied = labels.build_asset(folder / "out")
    assert labels.names_in(copied) == ["Mug", "beaker"]


def test_nothing_but_a_wheel_is_downloaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pip runs what a source package says to build it."""
    asked: list[list[str]] = []

    def run(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess(command, 1, "", "ERROR: no network")

    monkeypatch.setattr(build_assets.subprocess, "run", run)
    with pytest.raises(AssetError, match=r"procthor==.*: download failed: ERROR: no network"):
        build_assets.fetch(build_assets.PROCTHOR, tmp_path)
    assert "--only-binary=:all:" in asked[0]


@pytest.mark.parametrize("fails", [True, False])
def test_bundled_files_are_replaced_when_all_new_ones_are_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    def make(name: str) -> Any:
        def write(*given: Any) -> Path:
            [folder] = (one for one in given if isinstance(one, Path) and one.is_dir())
            if fails and name == words.ASSET:
                raise KeyboardInterrupt
            (folder / name).write_text("new")
            return folder / name

        return write

    monkeypatch.setattr(build_assets, "fetch", lambda source, folder: folder / source.wheel)
    monkeypatch.setattr(build_assets, "notice_text", lambda wheels: "new")
    for module in (ithor, catalogue, labels, words, episodes):
        monkeypatch.setattr(module, "build_asset", make(module.ASSET))
    monkeypatch.setattr(words, "load_bundled", lambda path: path.read_text())
    monkeypatch.setattr(build_assets.open_split, "build_asset", make(OPEN_ASSET))
    monkeypatch.setattr(ithor, "load_scenes", lambda path: [toy.corridor()])
    monkeypatch.setattr(labels, "names_in", lambda path: [])
    out = tmp_path / "assets"
    out.mkdir()
    for name in (ithor.ASSET, words.ASSET, "of the user"):
        (out / name).write_text("old")
    with pytest.raises(KeyboardInterrupt) if fails else contextlib.nullcontext():
        made = build_assets.build(out)
    content = {path.name: path.read_text() for path in out.iterdir()}
    if fails:
        assert content == dict.fromkeys((ithor.ASSET, words.ASSET, "of the user"), "old")
    else:
        assert content.pop("of the user") == "old"
        assert {path.name for path in made} == content.keys()
        assert set(json.loads(content.pop(assets.CHECKSUMS))) == content.keys()
        assert set(content.values()) == {"new"}
    assert [path.name for path in tmp_path.iterdir()] == ["assets"]


def test_what_a_killed_build_left_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = tmp_path / f"{files.PARTIAL}999999999-x"  # a process that does not run

    def build(folder: Path, wheels: Path) -> list[Path]:
        shutil.copytree(folder.parent, killed)
        raise KeyboardInterrupt

    monkeypatch.setattr(build_assets, "_build", build)
    with pytest.raises(KeyboardInterrupt):
        build_assets.build(tmp_path / "assets")
    assert [*tmp_path.iterdir()] == [killed]
    monkeypatch.setattr(build_assets, "build", lambda *given: [])
    scenes.main(["build", "--out", str(tmp_path / "assets")])
    assert [*tmp_path.iterdir()] == []
    assert f"removed {killed}" in capsys.readouterr().out


def test_a_wheel_with_other_content_is_refused(tmp_path: Path) -> None:
    (tmp_path / build_assets.ALFWORLD.wheel).write_bytes(b"not the wheel")
    with pytest.raises(AssetError, match="sha256 is not"):
        build_assets.fetch(build_assets.ALFWORLD, tmp_path)
