"""Tables that fit a width."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.show.progress import as_fits
from pipeline.show.terminal import table_lines

WIDE = pl.DataFrame({f"column_{number}": [number * 1000.0 + row for row in range(9)] for number in range(30)})


@pytest.mark.parametrize("width", [80, 120, 200])
def test_columns_that_do_not_fit_are_counted(width: int) -> None:
    lines = table_lines(WIDE, width)
    assert max(map(len, lines)) <= width
    remark = " ".join(lines[-2:])
    # `column_29` takes seven characters where it breaks behind the underscore, and two blanks part columns.
    fitting = (width + 2) // 9
    assert f"{30 - fitting} of 30 columns are left out: they do not fit {width} characters" in remark
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


RUN = "2025-03-03_jump_one_no_odometer_train00"
COUNTS = ("unsafe_accepted", "failures", "hazards_1b")
RUNS = pl.DataFrame(
    {"verdict": ["unsafe"] * 9, "run_id": [RUN] * 9, **{f"column_{number}": [0.25] * 9 for number in range(20)}}
    | {name: [3] * 9 for name in COUNTS}
    | {"why": ["VBs accepted despite a wrong position: 1; position failures in use for longer than allowed: 1"] * 9}
)  # fmt: skip


@pytest.mark.parametrize("width", [80, 120])
def test_what_matters_stays_and_no_word_breaks(width: int) -> None:
    """Counts of what went wrong stand behind twenty others; the reason stands below each run."""
    lines = table_lines(RUNS, width)
    assert max(map(len, lines)) <= width
    heading, first = " ".join(lines[:3]), next(at for at, line in enumerate(lines) if line.startswith("unsafe"))
    assert {"unsafe_", "accepted", "failures", "hazards_"} <= set(heading.split())
    assert lines[first].split()[:2] == ["unsafe", RUN]
    assert lines[first].split().count("3") == 3
    assert lines[first + 1].startswith("    why: VBs accepted despite a wrong position: 1; ")
    words = {word for line in lines[first : first + 3] for word in line.split()}
    assert words <= {"why:", RUN, *" ".join(map(str, RUNS.row(0))).split()}


def test_a_word_longer_than_the_line_breaks_behind_its_signs() -> None:
    path = "results/of_week_12/" + "x" * 30 + "/runs.parquet"
    lines = table_lines(pl.DataFrame({"file": [path]}), 40)
    assert lines[1].endswith("/")
    assert "".join(lines[1:]) == path


@pytest.mark.parametrize(
    ("room", "fitting"), [(10, "2 failed or partial"), (44, "2 failed or partial, 5 min 3 s left")]
)
def test_progress_says_what_fits(room: int, fitting: str) -> None:
    assert as_fits(["2 failed or partial", "5 min 3 s left", "1.32 runs/s"], room) == fitting


def test_in_a_pipe_nothing_is_left_out() -> None:
    assert len(table_lines(WIDE)[0].split()) == 30
