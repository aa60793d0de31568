"""Files appear whole or not at all."""

from pathlib import Path

import pytest

from tdanet_jax import files


def test_a_file_is_replaced_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with files.replacing(path) as fresh:
        fresh.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")

    def write() -> None:
        with files.replacing(path) as fresh:
            fresh.write_text("half")
            raise error

    with pytest.raises(type(error)) as caught:
        write()
    if isinstance(error, OSError):
        assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_was_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("whole")
    (tmp_path / f"{files.PARTIAL}b.json").write_text("half")
    (tmp_path / f"{files.PARTIAL}7" / "state").mkdir(parents=True)
    assert len(files.remove_partial(tmp_path)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert files.remove_partial(tmp_path / "missing") == []
