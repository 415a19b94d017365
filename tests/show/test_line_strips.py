"""Net elements joined to lines, and how they are drawn."""

from __future__ import annotations

import re

import polars as pl
import pytest

from pipeline.show.line_strips import lines_of, strips
from schemas.inputs import Balises, Links
from schemas.line import LinePieces
from tests.tables import table


def links(*rows: tuple[str, int, str, int]) -> pl.DataFrame:
    names = ("netelement_a", "position_a", "netelement_b", "position_b")
    columns = {name: [row[at] for row in rows] for at, name in enumerate(names)}
    return table(Links, len(rows), navigability="both", **columns)


def test_an_element_against_the_line_is_counted_backwards() -> None:
    """A of 1,000 m, then B of 500 m entered at its end: its measure 100 m lies at 1,400 m of the line."""
    (line,) = lines_of({"B": 500.0, "A": 1000.0}, links(("A", 1, "B", 1)))
    first, second = line
    assert [(part.name, part.reversed, part.begin_m) for part in line] == [("B", False, 0.0), ("A", True, 500.0)]
    assert (first.distance_on_line_m(100.0), second.distance_on_line_m(100.0)) == (100.0, 1400.0)


def test_a_branch_is_a_line_of_its_own() -> None:
    """From A over a switch to B or C: the line goes on over B, which comes first in the survey."""
    lengths = {"A": 100.0, "B": 200.0, "C": 300.0}
    found = lines_of(lengths, links(("A", 1, "B", 0), ("A", 1, "C", 0)))
    assert [[part.name for part in line] for line in found] == [["A", "B"], ["C"]]


def test_a_loop_has_one_line() -> None:
    found = lines_of({"A": 100.0, "B": 200.0}, links(("A", 1, "B", 0), ("B", 1, "A", 0)))
    assert [[part.name for part in line] for line in found] == [["A", "B"]]


def test_no_train_turns_on_a_switch() -> None:
    """A and B both join C at its begin: C follows on A; B, which could only go on over C, stands alone."""
    found = lines_of({"A": 1.0, "B": 1.0, "C": 1.0}, links(("A", 1, "C", 0), ("B", 1, "C", 0)))
    assert [[part.name for part in line] for line in found] == [["A", "C"], ["B"]]


def test_one_drawing_per_line_with_kilometres() -> None:
    """A has three pieces of 100 m, B one, entered at its end: growing measure of B is travel against the line."""
    rows = [("A", 0.0), ("A", 100.0), ("A", 200.0), ("B", 0.0)]
    pieces = table(
        LinePieces, 4, piece=[0, 1, 2, 3], netelement_id=[name for name, _ in rows], from_m=[at for _, at in rows],
        to_m=[at + 100.0 for _, at in rows], direction="growing", piece_class="suitable", cause="none",
    )  # fmt: skip
    balises = table(Balises, 1, balise_id="V", netelement_id="B", measure_m=50.0, kind="virtual")
    (drawing,) = strips(pieces, links(("A", 1, "B", 1)), balises)
    assert "Line 1: A to B, 0.40 km" in drawing
    assert re.findall(r">([\d.]+) km</text>", drawing) == ["0"]
    boxes = [(float(x), float(y)) for x, y in re.findall(r'<rect [^>]*x="([\d.]+)" y="([\d.]+)"', drawing)]
    # 11 units per 100 m piece, from 40; upper lane at 2, lower lane at 28.
    assert boxes == [(40.0, 2.0), (51.0, 2.0), (62.0, 2.0), (73.0, 28.0)]
    assert float(re.findall(r'x="([\d.]+)"[^>]*>\|<', drawing)[0]) == pytest.approx(78.5)
