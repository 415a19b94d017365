"""Where on the network a valid TVB was available: shares of epochs per piece of track."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.export.places import Ground, ground_of, plane_m
from pipeline.report.markup import Json
from pipeline.track.survey import track_of
from schemas.run import Site

_PIECES = 400
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
        "track": _track_lines(site) if site is not None else [],
        "pieces": [_piece(row, elements, site) for row in pieces.iter_rows(named=True)],
        "hazards": _hazards(placed, elements, site),
    }


def _hazards(hazards: pl.DataFrame, elements: list[str], site: Site | None) -> list[Json]:
    """Place and name of each hazard."""
    measure_m = hazards["measure_m"].to_numpy()
    if site is None:
        x, y = measure_m, np.array([float(elements.index(name)) for name in hazards["netelement_id"]])
    else:
        x, y = plane_m(ground_of(site.track, hazards["netelement_id"], measure_m), _origin(site))
    names = hazards.select("run_id", "hazard_id", pl.col("hazard").cast(pl.String)).iter_rows()
    return [
        [round(float(east), 1), round(float(north), 1), f"{run} {number}: {kind}"]
        for east, north, (run, number, kind) in zip(x, y, names, strict=True)
        if np.isfinite(east) and np.isfinite(north)
    ]


def _piece(row: dict[str, object], elements: list[str], site: Site | None) -> Json:
    from_m, to_m = float(str(row["from_m"])), float(str(row["to_m"]))
    name, count, tvb = str(row["netelement_id"]), int(str(row["epochs"])), int(str(row["tvb"]))
    if site is None:
        x, y = np.array([from_m, to_m]), np.full(2, float(elements.index(name)))
    else:
        x, y = _line(site, name, np.linspace(from_m, to_m, 5))
    known = np.isfinite(x) & np.isfinite(y)
    return {
        "name": name,
        "from_m": from_m,
        "to_m": to_m,
        "epochs": count,
        "share": round(tvb / count, 4),
        "x": np.round(x[known], 1).tolist(),
        "y": np.round(y[known], 1).tolist(),
    }


def _line(site: Site, name: str, measure_m: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[np.ndarray, ...]:
    own = site.track.filter(pl.col("netelement_id") == name)
    if own.is_empty():
        return np.full(len(measure_m), np.nan), np.full(len(measure_m), np.nan)
    inside = np.clip(measure_m, float(own["measure_m"][0]), float(own["measure_m"][-1]))
    return plane_m(ground_of(own, pl.Series([name] * len(inside)), inside), _origin(site))


def _track_lines(site: Site) -> list[Json]:
    survey = track_of(site.track)
    nothing = np.full(len(survey.latitude_deg), np.nan)
    east, north = plane_m(Ground(survey.latitude_deg, survey.longitude_deg, nothing, nothing), _origin(site))
    stride = max(1, len(east) // 20_000)
    return [
        {"name": name, "x": _thin(east[rows], stride), "y": _thin(north[rows], stride)}
        for _, name, rows in survey.elements()
    ]


def _thin(values: np.ndarray[tuple[int], np.dtype[np.float64]], stride: int) -> list[float]:
    kept: list[float] = np.round(np.append(values[:-1:stride], values[-1:]), 1).tolist()
    return kept


def _origin(site: Site) -> tuple[float, float]:
    first = site.track.row(0, named=True)
    return float(first["latitude_deg"]), float(first["longitude_deg"])
