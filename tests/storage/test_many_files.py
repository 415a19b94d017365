"""Many small files of one kind as one frame."""

from pathlib import Path

import polars as pl

from pipeline.storage.parquet import ParquetError, TableReader, parquet_bytes, read_parquet

WORDS = pl.Enum(["none", "early", "late"])
FRAMES = [
    pl.DataFrame(
        {"word": [word], "words": [words], "x": [x]}, schema={"word": WORDS, "words": pl.List(WORDS), "x": pl.Float64}
    )
    for word, words, x in (
        ("late", ["none", "late"], 1.0),
        ("early", [], None),
        (None, None, 2.0),
        ("none", ["early"], 3.0),
    )
]


def test_files_with_other_words_of_an_enum_are_read_as_each_alone() -> None:
    """Each file holds a dictionary of its own words: read together, no word may become another."""
    reader = TableReader(lambda found: [name for name in found if name != "x"])
    for number, frame in enumerate([*FRAMES, FRAMES[0].clear()]):
        reader.add(parquet_bytes(frame, {"file": str(number)}))
    assert reader.heights == [1, 1, 1, 1, 0]
    assert reader.frame().equals(pl.concat(FRAMES).drop("x"))
    assert reader.frame().schema == FRAMES[0].drop("x").schema


def test_every_other_kind_of_columns_is_asked_for() -> None:
    asked: list[list[str]] = []
    reader = TableReader(lambda found: asked.append(list(found)) or list(found))  # type: ignore[func-returns-value]
    for frame in (FRAMES[0], FRAMES[1], FRAMES[2].drop("x")):
        reader.add(parquet_bytes(frame))
    assert asked == [["word", "words", "x"], ["word", "words"]]


def test_a_damaged_file_among_others_is_an_error() -> None:
    """Of the bytes of its first page none may change a value undetected."""
    good, refused = parquet_bytes(FRAMES[0]), 0
    for place in range(4, 60):
        reader = TableReader()
        reader.add(parquet_bytes(FRAMES[1]))
        try:
            reader.add(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        except ParquetError:
            refused += 1
        else:
            assert reader.frame().equals(pl.concat([FRAMES[1], FRAMES[0]]))
    assert refused > 40


def test_no_columns_are_rows_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(parquet_bytes(FRAMES[0]))
    assert read_parquet(tmp_path / "a.parquet", lambda _: []).height == 1
