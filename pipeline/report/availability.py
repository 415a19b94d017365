"""Where on the network a valid TVB was available: shares of epochs per piece of track."""

from __future__ import annotations

from math import ceil

import numpy as np
import polars as pl

from pipeline.export.places import element_lines_m, ground_of, origin_of, plane_m
from pipeline.report.columns import Row
from pipeline.report.markup import Json
from schemas.arrays import Floats
from schemas.run import Site

_PIECES = 400
# Each a multiple of the one before, so that pieces of runs go together without their epochs.
_STEPS_M = (10.0, 50.0, 100.0, 500.0, 1000.0, 5000.0)
_PLACE = ("solution", "netelement_id", "from_m")


def availability_pieces(epochs: pl.LazyFrame) -> pl.DataFrame:
    """Per solution, net element and piece of it: epochs while moving, those with a valid TVB, alarms.

    Where nobody knows whether the train moved, the epoch counts, and its TVB does not.

    Pieces have one length, `step_m`, chosen so that there are some hundred of them.
    """
    moving = epochs.filter(
        pl.col("moving").fill_null(value=True)
        & pl.col("netelement_id").is_not_null()
        & pl.col("measure_m").is_not_null()
    )
    extents = moving.group_by("netelement_id").agg(low_m=pl.col("measure_m").min(), high_m=pl.col("measure_m").max())
    step_m = _step_m(extents.collect())
    valid = pl.col("tvb") & pl.col("moving").fill_null(value=False)
    found = moving.group_by(_PLACE[:2], from_m=_piece_m(pl.col("measure_m"), step_m)).agg(
        epochs=pl.len().cast(pl.Int64),
        tvb=valid.sum().cast(pl.Int64),
        alarms=pl.col("alarm").sum().cast(pl.Int64),
        low_m=pl.col("measure_m").min(),
        high_m=pl.col("measure_m").max(),
    )
    return _of_length(found.collect(), step_m)


def together(pieces: pl.DataFrame) -> pl.DataFrame:
    """The pieces of several runs as pieces of one length, none shorter than those of any run."""
    step_m = _step_m(pieces)
    sums = (pl.col(name).sum() for name in ("epochs", "tvb", "alarms"))
    found = pieces.with_columns(from_m=_piece_m(pl.col("from_m"), step_m)).group_by(_PLACE)
    return _of_length(found.agg(*sums, pl.col("low_m").min(), pl.col("high_m").max()), step_m)


def _step_m(extents: pl.DataFrame) -> float:
    """Length of pieces for net elements of which these parts were ridden."""
    found = extents.group_by("netelement_id").agg(pl.col("low_m").min(), pl.col("high_m").max())
    total_m = float((found["high_m"] - found["low_m"]).sum() or 0.0)
    long_m = _STEPS_M[-1]
    return next((step for step in _STEPS_M if total_m / step <= _PIECES), long_m * ceil(total_m / _PIECES / long_m))


def _piece_m(measure_m: pl.Expr, step_m: float) -> pl.Expr:
    return (measure_m / step_m).floor() * step_m


def _of_length(pieces: pl.DataFrame, step_m: float) -> pl.DataFrame:
    return pieces.with_columns(to_m=pl.col("from_m") + step_m).sort(_PLACE)


def availability_map(pieces: pl.DataFrame, hazards: pl.DataFrame, site: Site | None) -> Json:
    """Pieces of one solution as lines, and where its hazards were.

    In plan with a site, else one row per net element along its measure.
    """
    placed = hazards.filter(pl.col("netelement_id").is_not_null() & pl.col("measure_m").is_not_null())
    elements = sorted({*pieces["netelement_id"].to_list(), *placed["netelement_id"].to_list()})
    return {
        "geographic": site is not None,
        "elements": elements,
        "track": [] if site is None else [_track_line(*line) for line in element_lines_m(site)],
        "pieces": [_piece(row, elements, site) for row in pieces.iter_rows(named=True)],
        "hazards": _hazards(placed, elements, site),
    }


def _track_line(name: str, east: Floats, north: Floats) -> Json:
    x, y = (np.round(values, 1).tolist() for values in (east, north))
    return {"name": name, "x": x, "y": y}


def _hazards(hazards: pl.DataFrame, elements: list[str], site: Site | None) -> list[Json]:
    """Place and name of each hazard."""
    measure_m = hazards["measure_m"].to_numpy()
    if site is None:
        x, y = measure_m, np.array([float(elements.index(name)) for name in hazards["netelement_id"]])
    else:
        x, y = plane_m(ground_of(site.track, hazards["netelement_id"], measure_m), origin_of(site))
    names = hazards.select("run_id", "hazard_id", pl.col("hazard").cast(pl.String)).iter_rows()
    return [
        [round(float(east), 1), round(float(north), 1), f"{run} {number}: {kind}"]
        for east, north, (run, number, kind) in zip(x, y, names, strict=True)
        if np.isfinite(east) and np.isfinite(north)
    ]


def _piece(row: Row, elements: list[str], site: Site | None) -> Json:
    name, from_m, to_m = row["netelement_id"], row["from_m"], row["to_m"]
    if site is None:
        x, y = np.array([from_m, to_m]), np.full(2, float(elements.index(name)))
    else:
        x, y = _line(site, name, np.linspace(from_m, to_m, 5))
    known = np.isfinite(x) & np.isfinite(y)
    return {
        "name": name,
        "from_m": from_m,
        "to_m": to_m,
        "epochs": row["epochs"],
        "share": round(row["tvb"] / row["epochs"], 4),
        "x": np.round(x[known], 1).tolist(),
        "y": np.round(y[known], 1).tolist(),
    }


def _line(site: Site, name: str, measure_m: Floats) -> tuple[np.ndarray, ...]:
    own = site.track.filter(pl.col("netelement_id") == name)
    if own.is_empty():
        return np.full(len(measure_m), np.nan), np.full(len(measure_m), np.nan)
    inside = np.clip(measure_m, float(own["measure_m"][0]), float(own["measure_m"][-1]))
    return plane_m(ground_of(own, pl.Series([name] * len(inside)), inside), origin_of(site))
