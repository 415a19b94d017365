"""Tables of runs over a straight line with known bad places, as a replay would write them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import moved_deg
from pipeline.studies.line.passes import PieceIndex, passes_of
from pipeline.studies.line.pieces import Pieces, middles_in_plane_m, pieces_of
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.inputs import Links, Track
from schemas.line import LineCriteria
from schemas.run import Site
from schemas.tables import Alarms, Passages

LENGTH_M = 6000.0
SPLIT_M = 2500.0
CRITERIA = LineCriteria()
CONFIG = Configuration()
# From, to, and the causes that the place may be known by.
PLACES = {
    "cutting": (500.0, 700.0, {"few_satellites"}),
    "tunnel": (1500.0, 1800.0, {"outage"}),
    "roof": (3000.0, 3040.0, {"alarm"}),
    "facade": (4000.0, 4100.0, {"wrong", "claimed_wrongly"}),
    "neighbour": (5000.0, 5300.0, {"ambiguous_track", "wrong_track"}),
}
# The wrong position of the facade; what is blocked after the alarm of the roof.
_ERROR_M, BLOCKED_M = 30.0, 200.0
SPEED_MPS = 25.0


def line_site() -> Site:
    """A to the north, B surveyed against it, P beside it at the neighbour's place, 4.5 m to the west."""
    spots = [("A", 0.0, SPLIT_M, 0.0), ("B", LENGTH_M, SPLIT_M, 0.0), ("P", 4900.0, 5400.0, -4.5)]
    rows = []
    for name, begin, end, east in spots:
        north = np.array([begin, end])
        zero = np.zeros(2)
        latitude, longitude = moved_deg(zero + 50.0, zero + 14.0, zero, zero + east, north)
        for index in range(2):
            rows.append((name, abs(end - begin) * index, latitude[index], longitude[index], None, None))
    schema = {name: column.dtype for name, column in Track.columns().items()}
    track = pl.DataFrame(rows, schema=dict(zip(schema, schema.values(), strict=True)), orient="row")
    links = pl.DataFrame(
        {"netelement_a": ["A"], "position_a": [1], "netelement_b": ["B"], "position_b": [1], "navigability": ["both"]}
    )
    return Site(Track.validate(track, cast=True), Links.validate(links, cast=True), digest="line")


def on_element(at_m: float) -> tuple[str, float]:
    return ("A", at_m) if at_m < SPLIT_M else ("B", LENGTH_M - at_m)


NOWHERE: dict[str, object] = {"true_netelement_ids": None, "true_measure_low_m": None, "true_measure_high_m": None}


def nowhere() -> dict[str, pl.Expr]:
    """Columns of an epoch at which the evidence says nothing."""
    return {
        "true_netelement_ids": pl.lit(None, pl.List(pl.String)),
        **dict.fromkeys(("true_measure_low_m", "true_measure_high_m"), pl.lit(None, pl.Float64)),
    }


def true_place(at_m: float, half_m: float = 2.0) -> dict[str, object]:
    """Where the train was by the evidence, to 2 m; where that is over a joint, on both net elements."""
    (one, low_m), (other, high_m) = on_element(at_m - half_m), on_element(at_m + half_m)
    if one != other:
        return NOWHERE | {"true_netelement_ids": [one, other]}
    ends = sorted((low_m, high_m))
    return {"true_netelement_ids": [one], "true_measure_low_m": ends[0], "true_measure_high_m": ends[1]}


def epochs_of(number: int, places: Sequence[str] = tuple(PLACES), falling: bool | None = None) -> pl.DataFrame:
    """One run at 1 Hz, odd numbers from the far end; each starts a little elsewhere, an hour later."""
    back = bool(number % 2) if falling is None else falling
    start = datetime(2026, 3, 2, tzinfo=UTC) + timedelta(hours=number)
    first_m = 1.0 + (number * 7.3) % SPEED_MPS
    along = np.arange(first_m, LENGTH_M, SPEED_MPS)
    rows = [_epoch(float(at), number, back, places) for at in (LENGTH_M - along if back else along)]
    frame = pl.DataFrame(rows, infer_schema_length=None).with_columns(pl.col("path_m").cast(pl.Float64))
    t = pl.Series([start + timedelta(seconds=second) for second in range(len(rows))]).cast(pl.Datetime("ns", "UTC"))
    return frame.with_columns(t=t, solution=pl.lit("primary"), direction=pl.lit(-1 if back else 1, pl.Int8))


def inside(name: str, at_m: float, places: Sequence[str]) -> bool:
    return name in places and PLACES[name][0] <= at_m < PLACES[name][1]


def _epoch(at_m: float, number: int, back: bool, places: Sequence[str]) -> dict[str, object]:
    """The path is the chainage; a falling run's path falls."""
    error_m = _ERROR_M if inside("facade", at_m, places) else 1.0
    claimed_m = at_m - error_m if back else at_m + error_m
    element, measure_m = on_element(claimed_m)
    row: dict[str, object] = {
        "path_m": claimed_m,
        "netelement_id": element,
        "measure_m": measure_m,
        "error_low_m": error_m - 2.0,
        "error_high_m": error_m + 2.0,
        **true_place(at_m),
        "judgement": "wrong" if error_m > 22.0 else "right",
        "in_use": True,
        "on_track": True,
        "gate_probability": 1.0,
        "confidence_m": 5.0,
        "satellites": 12,
        "alarm": False,
    }
    since_roof_m = (PLACES["roof"][1] - at_m) if back else at_m - PLACES["roof"][0]
    if inside("tunnel", at_m, places):
        nothing = dict.fromkeys(("path_m", "netelement_id", "measure_m", "error_low_m", "error_high_m", "confidence_m"))
        return row | nothing | NOWHERE | {"judgement": "unknown", "in_use": False, "on_track": False}
    if inside("cutting", at_m, places):
        return row | {"confidence_m": 25.0, "in_use": False, "satellites": 5}
    if "roof" in places and 0.0 <= since_roof_m < BLOCKED_M:
        return row | {"alarm": True, "in_use": False}
    if inside("neighbour", at_m, places):
        if number % 10 < 2:
            other = {"netelement_id": "P", "measure_m": at_m - 4900.0, "judgement": "wrong"}
            return row | other | {"error_low_m": None, "error_high_m": None}
        return row | {"gate_probability": 0.6, "in_use": False}
    return row


def alarms_of(epochs: pl.DataFrame) -> pl.DataFrame:
    """The first epoch under alarm, as the alarms table has it."""
    first = epochs.filter("alarm").head(1).select(t_start="t", monitors=pl.concat_list(pl.lit("along_raw")))
    return first if first.height else pl.DataFrame(schema=dtypes(Alarms)).select("t_start", "monitors")


def no_passages() -> pl.DataFrame:
    return pl.DataFrame(schema=dtypes(Passages))


def ground_of_line(site: Site, criteria: LineCriteria = CRITERIA) -> PieceIndex:
    pieces = pieces_of(site, criteria.piece_m)
    return PieceIndex.of_pieces(site, pieces, middles_in_plane_m(site, pieces))


def passes_over(epochs: Sequence[pl.DataFrame], site: Site, criteria: LineCriteria = CRITERIA) -> pl.DataFrame:
    """Passes of all these runs."""
    ground = ground_of_line(site, criteria)
    found = [passes_of(one, no_passages(), alarms_of(one), ground, criteria, CONFIG) for one in epochs]
    return pl.concat(part.with_columns(run_id=pl.lit(f"r{number:02d}")) for number, part in enumerate(found))


def chainage(pieces: Pieces) -> pl.Expr:
    """Middle of a row's piece along the line."""
    middle = 0.5 * (pl.col("from_m") + pl.col("to_m"))
    on = pl.col("netelement_id")
    return pl.when(on == "A").then(middle).when(on == "B").then(LENGTH_M - middle).otherwise(middle + 4900.0)
