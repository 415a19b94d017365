"""Where on the network a valid TVB was available: shares of epochs per piece of track."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.export.places import element_lines_m, ground_of, origin_of, plane_m, thinned
from pipeline.report.columns import Row
from pipeline.report.markup import Json
from schemas.arrays import Floats
from schemas.run import Site

_PIECES = 400
_TRACK_POINTS = 3000
_STEPS_M = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)


def availability_pieces(epochs: pl.LazyFrame) -> pl.DataFrame:
    """Per solution, net element and piece of it: epochs while moving, those with a valid TVB, alarms.

    Where nobody knows whether the train moved, the epoch counts, and its TVB does not.

    Pieces have one length in a campaign, chosen so that there are some hundred of them.
    """
    moving = epochs.filter(
        pl.col("moving").fill_null(value=True)
        & pl.col("netelement_id").is_not_null()
        & pl.col("measure_m").is_not_null()
    )
    extents = (
        moving.group_by("netelement_id").agg(low=pl.col("measure_m").min(), high=pl.col("measure_m").max()).collect()
    )
    total_m = float((extents["high"] - extents["low"]).sum() or 0.0)
    step_m = next((step for step in _STEPS_M if total_m / step <= _PIECES), max(_STEPS_M[-1], total_m / _PIECES))
    valid = pl.col("tvb") & pl.col("moving").fill_null(value=False)
    return (
        moving.group_by("solution", "netelement_id", piece=(pl.col("measure_m") / step_m).floor())
        .agg(
            epochs=pl.len(),
            tvb=valid.sum(),
            alarms=pl.col("alarm").sum(),
        )
        .with_columns(from_m=pl.col("piece") * step_m, to_m=(pl.col("piece") + 1.0) * step_m)
        .drop("piece")
        .collect()
        .sort("solution", "netelement_id", "from_m")
    )


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
    x, y = (np.round(thinned(values, _TRACK_POINTS), 1).tolist() for values in (east, north))
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
