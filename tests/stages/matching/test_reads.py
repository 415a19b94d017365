"""A balise that was read says which track the train was on, however short its net elements are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import polars as pl
import pytest

from pipeline.stages.matching import Match
from schemas.arrays import floats
from schemas.inputs import Balises
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site

SPEED_MPS, BEGIN_M, LENGTH_M, SECONDS = 30.0, 20.0, 3400.0, 110
SHORT_M = (1500.0, 2100.0)


def pieces(piece_m: float) -> Site:
    """Track A along y = 0, for 600 m in pieces of one length, B 5 m beside it; a balise at the middle of each piece."""
    ends = np.array([0.0, *np.arange(*SHORT_M, piece_m), SHORT_M[1], LENGTH_M])
    names = [f"A{n}" for n in range(ends.size - 1)]
    elements = {name: line((a, 0.0), (b, 0.0)) for name, a, b in zip(names, ends, ends[1:], strict=False)}
    links: list[Link] = [(one, 1, other, 0, "both") for one, other in pairwise(names)]
    bare = site({**elements, "B": line((0.0, 5.0), (LENGTH_M, 5.0))}, links, sigma_m=1.0)
    balises = pl.DataFrame(
        {"balise_id": [*names, "B"], "netelement_id": [*names, "B"], "measure_m": [*(0.5 * np.diff(ends)), 1810.0]}
    ).with_columns(
        kind=pl.lit("physical"),
        location_accuracy_m=pl.lit(12.0),
        linked=pl.lit(True),
        link_reaction=pl.lit("none"),
        direction=pl.lit("both"),
    )
    return Site(bare.track, bare.links, balises=Balises.validate(balises, cast=True))


def passed_at(piece_m: float, at_s: float) -> str:
    """The piece of A on which the train is at a time."""
    return f"A{1 + int((BEGIN_M + SPEED_MPS * at_s - SHORT_M[0]) // piece_m)}"


def ridden(piece_m: float, name: str | None, read_s: float) -> Match:
    """On A at 1 Hz with exact positions; a balise read at a time."""
    x = BEGIN_M + SPEED_MPS * np.arange(float(SECONDS))
    fixes = run(x, np.zeros(x.size))
    time = pl.Series("t", [round(read_s * 1e9)]).cast(fixes.schema["t"])
    reads = None if name is None else pl.DataFrame([time, pl.Series("balise_id", [name])])
    return matched(fixes, pieces(piece_m), odometer(x), reads=reads)


@pytest.mark.parametrize("piece_m", [12.0, 40.0, 600.0])
@pytest.mark.parametrize("read_s", [60.05, 60.35, 60.95])
def test_a_true_read_leaves_its_track_alone(piece_m: float, read_s: float) -> None:
    """Between two positions the train runs over several pieces: the read belongs to none of those at the position."""
    epochs = ridden(piece_m, passed_at(piece_m, read_s), read_s).epochs.table
    gate = floats(epochs, "gate_probability")
    # Known with the position after it, and three seconds for that.
    after = np.arange(SECONDS) >= np.ceil(read_s) + 4
    assert not np.isnan(gate).any()
    assert (gate[after] >= 0.99).all()
    assert (gate[: int(read_s)] < 0.99).all()
    assert all(one.startswith("A") for one in epochs["netelement_id"].to_list())


def test_a_read_excludes_the_track_that_the_train_cannot_have_come_from() -> None:
    """A balise of B at its place; one of A 150 m before the train comes to it."""
    beside = ridden(12.0, "B", (1810.0 - BEGIN_M) / SPEED_MPS).epochs.table
    assert beside["netelement_id"][-1] == "B"
    assert floats(beside, "gate_probability")[-1] >= 0.99
    gate = floats(ridden(12.0, passed_at(12.0, 69.0), 64.0).epochs.table, "gate_probability")
    assert not np.isnan(gate[:64]).any()
    assert np.isnan(gate[69:]).all()


def test_without_a_read_nothing_tells_the_two_apart() -> None:
    assert (floats(ridden(12.0, None, 0.0).epochs.table, "gate_probability") < 0.99).all()
