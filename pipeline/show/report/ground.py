"""Drawings of the ground: the run seen from above, and where on the network a valid TVB was available.

Metres east and north of the site's first point; without a site along the path and across it, or along each net element.
"""

from __future__ import annotations

from math import ceil

import numpy as np
import polars as pl

from pipeline.results.places import (
    element_lines_m,
    ground_at,
    ground_of,
    offset_positions,
    origin_of,
    plane_m,
    sign_of,
    stretches_of,
)
from pipeline.show.report.balises import OUTCOMES, outcome_of_passage
from pipeline.show.report.decimate import detail_rows, worst_rows
from pipeline.show.report.markup import Json, pack_line, pack_numbers
from schemas.arrays import Floats, Ints, floats
from schemas.enums import Judgement
from schemas.frozen import frozen
from schemas.run import Site

STATES = (Judgement.RIGHT.value, Judgement.UNKNOWN.value, Judgement.WRONG.value)
"""From harmless to bad."""

_POINTS = 8000
_AROUND_M = 500.0


@frozen
class _View:
    """How path positions and epochs become points of the drawing."""

    site: Site | None
    stretches: pl.DataFrame
    origin: tuple[float, float]

    def plane_of_path_m(self, path_m: Floats) -> tuple[Floats, Floats]:
        """East and north [m] of path positions; without a site the path is drawn straight."""
        if self.site is None:
            return path_m, np.where(np.isfinite(path_m), 0.0, np.nan)
        return plane_m(ground_at(self.site.track, self.stretches, path_m), self.origin)

    def plane_of_positions_m(self, epochs: pl.DataFrame) -> tuple[Floats, Floats]:
        """East and north [m] of the positions themselves, off the track as far as they were."""
        cross_m = floats(epochs, "cross_track_m")
        if self.site is None:
            return floats(epochs, "path_m"), cross_m
        rails = ground_of(self.site.track, epochs["netelement_id"], floats(epochs, "measure_m"))
        sign = sign_of(epochs, self.stretches)
        return plane_m(offset_positions(rails, sign, cross_m, np.zeros(len(cross_m))), self.origin)


def plan_data(epochs: pl.DataFrame, passages: pl.DataFrame, site: Site | None, moments_ns: Ints) -> Json:
    """Everything that the plan of one solution draws; lengths in metres."""
    view = _View(site, stretches_of(epochs), (0.0, 0.0) if site is None else origin_of(site))
    shown = epochs.filter(pl.col("path_m").is_not_null())
    t_ns = shown["t"].to_physical().to_numpy()
    order = pl.Series(range(len(STATES)), dtype=pl.Int64)
    codes = shown["judgement"].cast(pl.String).replace_strict(pl.Series(STATES), order).to_numpy()
    rows = _shown_rows(t_ns, codes, moments_ns)
    x, y = view.plane_of_positions_m(shown[rows])
    t0_ns = int(epochs["t"].to_physical()[0]) if epochs.height else 0
    return {
        "geographic": site is not None,
        "states": list(STATES),
        "track": _track_lines(site, x, y) if site is not None else _path_line(x),
        "x": pack_numbers(x, "f4"),
        "y": pack_numbers(y, "f4"),
        "t": pack_numbers((t_ns[rows] - t0_ns) // 1_000_000, "u4"),
        "codes": pack_numbers(codes[rows], "u1"),
        "balises": _balise_entries(view, passages),
    }


def _shown_rows(t_ns: Ints, codes: Ints, moments_ns: Ints) -> Ints:
    """At most so many rows at even distances, the worst in between, and all near the moments that matter."""
    stride = -(-len(t_ns) // _POINTS)
    if stride <= 1:
        return np.arange(len(t_ns))
    near = detail_rows(t_ns, moments_ns, reach_s=30.0)
    near[worst_rows(codes, stride)] = True
    return np.flatnonzero(near)


def _track_lines(site: Site, x: Floats, y: Floats) -> list[Json]:
    """The net elements near the run, as lines."""
    known = np.isfinite(x)
    if not known.any():
        return []
    low = np.array([x[known].min(), y[known].min()]) - _AROUND_M
    high = np.array([x[known].max(), y[known].max()]) + _AROUND_M
    return [
        pack_line(name, east, north)
        for name, east, north in element_lines_m(site)
        if (low <= [east.max(), north.max()]).all() and (high >= [east.min(), north.min()]).all()
    ]


def _path_line(x: Floats) -> list[Json]:
    """The path drawn straight; nothing where no place is known."""
    known = x[np.isfinite(x)]
    if not len(known):
        return []
    ends = np.array([known.min(), known.max()])
    return [pack_line("path", ends, np.zeros(2))]


def _balise_entries(view: _View, passages: pl.DataFrame) -> list[Json]:
    """One entry per balise with the worst that became of it; the worst balises last, so that they lie on top."""
    worst = pl.col("outcome").replace_strict({name: code for code, name in enumerate(OUTCOMES)}, return_dtype=pl.Int64)
    groups = (
        passages.with_columns(outcome=outcome_of_passage())
        .group_by("balise_id", "netelement_id", "measure_m", maintain_order=True)
        .agg(pl.col("path_m").first(), worst=worst.max(), outcomes=pl.col("outcome").value_counts(sort=True))
        .sort("worst", maintain_order=True)
    )
    x, y = view.plane_of_path_m(floats(groups, "path_m"))
    return [
        {
            "id": row["balise_id"],
            "outcome": OUTCOMES[row["worst"]],
            "outcomes": ", ".join(sorted(f"{entry['count']} {entry['outcome']}" for entry in row["outcomes"])),
            "place": f"{row['netelement_id']} at {row['measure_m']:.1f} m",
            "x": _round_known(x[number]),
            "y": _round_known(y[number]),
        }
        for number, row in enumerate(groups.iter_rows(named=True))
    ]


def _round_known(value: float) -> float | None:
    """A length to the centimetre; None where not known."""
    return round(float(value), 2) if np.isfinite(value) else None


_PIECES = 400
# Each a multiple of the one before, so that pieces of runs go together without their epochs.
_STEPS_M = (10.0, 50.0, 100.0, 500.0, 1000.0, 5000.0)
_PLACE = ("solution", "netelement_id", "from_m")


PIECE_COLUMNS = ("solution", "netelement_id", "measure_m", "moving", "tvb", "alarm")
"""Columns of the epochs that `availability_pieces` takes."""


def availability_pieces(epochs: pl.LazyFrame) -> pl.DataFrame:
    """Epochs while moving, those with a valid TVB, and alarms, per solution, net element and piece of it.

    Where nobody knows whether the train moved, the epoch counts, and its TVB does not; `known` counts the others.

    Pieces have one length, `step_m`, chosen so that there are some hundred of them.
    """
    moving = epochs.filter(
        pl.col("moving").fill_null(value=True)
        & pl.col("netelement_id").is_not_null()
        & pl.col("measure_m").is_not_null()
    )
    extents = moving.group_by("netelement_id").agg(low_m=pl.col("measure_m").min(), high_m=pl.col("measure_m").max())
    step_m = _piece_length_m(extents.collect())
    valid = pl.col("tvb") & pl.col("moving").fill_null(value=False)
    counted = moving.group_by(_PLACE[:2], from_m=_piece_begin_m(pl.col("measure_m"), step_m)).agg(
        epochs=pl.len().cast(pl.Int64),
        known=pl.col("moving").count().cast(pl.Int64),
        tvb=valid.sum().cast(pl.Int64),
        alarms=pl.col("alarm").sum().cast(pl.Int64),
        low_m=pl.col("measure_m").min(),
        high_m=pl.col("measure_m").max(),
    )
    return _with_ends(counted.collect(), step_m)


def combine_pieces(pieces: pl.DataFrame) -> pl.DataFrame:
    """The pieces of several runs as pieces of one length, none shorter than those of any run."""
    step_m = _piece_length_m(pieces)
    sums = (pl.col(name).sum() for name in ("epochs", "known", "tvb", "alarms"))
    merged = pieces.with_columns(from_m=_piece_begin_m(pl.col("from_m"), step_m)).group_by(_PLACE)
    return _with_ends(merged.agg(*sums, pl.col("low_m").min(), pl.col("high_m").max()), step_m)


def _piece_length_m(extents: pl.DataFrame) -> float:
    """Length of pieces for net elements of which these parts were ridden."""
    extent = extents.group_by("netelement_id").agg(pl.col("low_m").min(), pl.col("high_m").max())
    total_m = float((extent["high_m"] - extent["low_m"]).sum() or 0.0)
    long_m = _STEPS_M[-1]
    return next((step for step in _STEPS_M if total_m / step <= _PIECES), long_m * ceil(total_m / _PIECES / long_m))


def _piece_begin_m(measure_m: pl.Expr, step_m: float) -> pl.Expr:
    """Begin of the piece that a measure lies in [m]."""
    return (measure_m / step_m).floor() * step_m


def _with_ends(pieces: pl.DataFrame, step_m: float) -> pl.DataFrame:
    """Pieces with their ends."""
    return pieces.with_columns(to_m=pl.col("from_m") + step_m).sort(_PLACE)


def availability_map(pieces: pl.DataFrame, hazards: pl.DataFrame, site: Site | None) -> Json:
    """Pieces of one solution as lines, and where its hazards were.

    In plan with a site, else one row per net element along its measure.
    """
    placed = hazards.filter(pl.col("netelement_id").is_not_null() & pl.col("measure_m").is_not_null())
    elements = sorted({*pieces["netelement_id"].to_list(), *placed["netelement_id"].to_list()})
    track = (
        []
        if site is None
        else [(name, *_round_to_decimetres(east, north)) for name, east, north in element_lines_m(site)]
    )
    return {
        "geographic": site is not None,
        "elements": elements,
        "track": [{"name": name, "x": x, "y": y} for name, x, y in track],
        "pieces": _piece_lines(pieces, elements, site),
        "hazards": _hazard_entries(placed, elements, site),
    }


def _plane_places_m(
    names: pl.Series, measure_m: Floats, elements: list[str], site: Site | None
) -> tuple[Floats, Floats]:
    """Places where measures on net elements are drawn."""
    if site is None:
        return measure_m, np.array([float(elements.index(name)) for name in names])
    return plane_m(ground_of(site.track, names, measure_m), origin_of(site))


def _hazard_entries(hazards: pl.DataFrame, elements: list[str], site: Site | None) -> list[Json]:
    """Place and name of each hazard."""
    x, y = _plane_places_m(hazards["netelement_id"], floats(hazards, "measure_m"), elements, site)
    names = hazards.select("run_id", "hazard_id", pl.col("hazard").cast(pl.String)).iter_rows()
    return [
        [round(float(east), 1), round(float(north), 1), f"{run} {number}: {kind}"]
        for east, north, (run, number, kind) in zip(x, y, names, strict=True)
        if np.isfinite(east) and np.isfinite(north)
    ]


def _piece_lines(pieces: pl.DataFrame, elements: list[str], site: Site | None) -> list[Json]:
    """Lines of the pieces; on the ground through five points, none beyond the ends of its element."""
    points = 2 if site is None else 5
    measure_m = np.linspace(pieces["from_m"], pieces["to_m"], points, axis=1)
    if site is not None:
        ends = site.track.group_by("netelement_id").agg(
            first=pl.col("measure_m").first(), last=pl.col("measure_m").last()
        )
        first, last = pieces.join(ends, on="netelement_id", how="left", maintain_order="left").select("first", "last")
        measure_m = np.clip(measure_m, first.to_numpy()[:, None], last.to_numpy()[:, None])
    names = pl.Series(np.repeat(pieces["netelement_id"].to_numpy(), points), dtype=pl.String)
    x, y = (part.reshape(-1, points) for part in _plane_places_m(names, measure_m.ravel(), elements, site))
    lines = [
        _round_to_decimetres(*(axis[row][np.isfinite(x[row] + y[row])] for axis in (x, y))) for row in range(len(x))
    ]
    return [
        {
            "name": row["netelement_id"],
            "from_m": row["from_m"],
            "to_m": row["to_m"],
            "epochs": row["epochs"],
            # As `runs.availability`: not known where nothing shows the train moving.
            "share": round(row["tvb"] / row["epochs"], 4) if row["known"] else None,
            "x": line[0],
            "y": line[1],
        }
        for row, line in zip(pieces.iter_rows(named=True), lines, strict=True)
    ]


def _round_to_decimetres(x: Floats, y: Floats) -> tuple[list[float], list[float]]:
    """Places to the decimetre."""
    return np.round(x, 1).tolist(), np.round(y, 1).tolist()
