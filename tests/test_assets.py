"""Bundled files are found and checked."""

from pathlib import Path

import pytest

from tdanet_jax import assets, bundle
from tdanet_jax.assets import AssetError


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


@pytest.mark.parametrize("content", ["", "[]", "{"])
def test_broken_list(folder: Path, content: str) -> None:
    (folder / assets.CHECKSUMS).write_text(content)
    with pytest.raises(AssetError, match=r"checksums\.json"):
        assets.path("a.npz")


def test_every_bundled_file_is_listed_and_sound() -> None:
    for path in assets.folder().iterdir():
        if path.name != assets.CHECKSUMS:
            assert assets.path(path.name) == path


def test_the_notice_names_every_source() -> None:
    text = assets.path("NOTICE").read_text()
    for source in bundle.SOURCES:
        for part in (source.package, source.version, source.sha256, source.licence):
            assert part in text
    assert "Permission is hereby granted" in text  # the MIT licence asks for its own text
    assert "Apache License" in text


def test_a_wheel_with_other_content_is_refused(tmp_path: Path) -> None:
    (tmp_path / bundle.ALFWORLD.wheel).write_bytes(b"not the wheel")
    with pytest.raises(AssetError, match="sha256 is not"):
        bundle.fetch(bundle.ALFWORLD, tmp_path)
