"""Tables that fit a width."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.show.terminal import table_lines

WIDE = pl.DataFrame({f"column_{number}": [number * 1000.0 + row for row in range(9)] for number in range(30)})


@pytest.mark.parametrize("width", [80, 120, 200])
def test_columns_that_do_not_fit_are_counted(width: int) -> None:
    lines = table_lines(WIDE, width)
    assert max(map(len, lines)) <= width
    told = " ".join(lines[-2:])
    # `column_29` takes seven characters where it breaks behind the underscore, and two blanks part columns.
    fitting = (width + 2) // 9
    assert f"{30 - fitting} of 30 columns are left out: they do not fit {width} characters" in told
    assert len(lines[2].split()) == fitting
    assert len([line for line in lines if line.split()[0].isdigit()]) == 1 + WIDE.height + 1


def test_a_table_that_fits_stays_as_it_is() -> None:
    assert table_lines(pl.DataFrame({"run_id": ["a", "bc"], "n": [1, 20]}), 80) == [
        "run_id   n",
        "a        1",
        "bc      20",
    ]


def test_few_rows_are_printed_downwards() -> None:
    lines = table_lines(WIDE.head(2), 40)
    assert lines[0].split() == ["row", "1", "row", "2"]
    assert lines[1].split() == ["column_0", "0", "1"]
    assert lines[30].split() == ["column_29", "29000", "29001"]
    assert len(lines) == 31


def test_long_texts_are_folded_at_blanks_and_headings_at_underscores() -> None:
    frame = pl.DataFrame({"a_very_long_heading": [1], "why": ["one two three four five six seven"]})
    lines = table_lines(frame, 28)
    assert max(map(len, lines)) <= 28
    assert " ".join(" ".join(line.split()) for line in lines).endswith("five six seven")
    assert lines[0].split() == ["a_very_"]


def test_columns_without_any_value_go_first() -> None:
    frame = WIDE.with_columns(column_0=pl.lit(None, pl.Float64))
    assert all(not line.strip().startswith("-") for line in table_lines(frame, 80))


def test_in_a_pipe_nothing_is_left_out() -> None:
    assert len(table_lines(WIDE)[0].split()) == 30
