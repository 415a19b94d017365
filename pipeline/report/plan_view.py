"""The run seen from above: track, GNSS positions as they were judged, balises and what became of them.

With a site in metres east and north of its first point; without one along the path and across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.export.places import (
    Stretches,
    beside,
    element_lines_m,
    ground_at,
    ground_of,
    origin_of,
    plane_m,
    sign_of,
    stretches_of,
)
from pipeline.report.balises import OUTCOMES, outcome
from pipeline.report.decimate import detail_rows, worst_rows
from pipeline.report.markup import Json, packed, packed_line
from schemas.arrays import Floats, Ints, floats
from schemas.enums import Judgement
from schemas.run import Site

STATES = (Judgement.RIGHT.value, Judgement.UNKNOWN.value, Judgement.WRONG.value)
"""From harmless to bad."""

_POINTS = 8000
_AROUND_M = 500.0


@dataclass(frozen=True)
class _View:
    """How path positions and epochs become points of the drawing."""

    site: Site | None
    stretches: Stretches
    origin: tuple[float, float]

    def at(self, path_m: Floats) -> tuple[Floats, Floats]:
        if self.site is None:
            return path_m, np.where(np.isfinite(path_m), 0.0, np.nan)
        return plane_m(ground_at(self.site.track, self.stretches, path_m), self.origin)

    def gnss(self, epochs: pl.DataFrame) -> tuple[Floats, Floats]:
        cross_m = floats(epochs, "cross_track_m")
        if self.site is None:
            return floats(epochs, "path_m"), cross_m
        rails = ground_of(self.site.track, epochs["netelement_id"], floats(epochs, "measure_m"))
        sign = sign_of(epochs, self.stretches)
        return plane_m(beside(rails, sign, cross_m, np.zeros(len(cross_m))), self.origin)


def plan_data(epochs: pl.DataFrame, passages: pl.DataFrame, site: Site | None, moments_ns: Ints) -> Json:
    """Everything that the plan of one solution draws; lengths in metres."""
    view = _View(site, stretches_of(epochs), (0.0, 0.0) if site is None else origin_of(site))
    shown = epochs.filter(pl.col("path_m").is_not_null())
    t_ns = shown["t"].to_physical().to_numpy()
    order = pl.Series(range(len(STATES)), dtype=pl.Int64)
    codes = shown["judgement"].cast(pl.String).replace_strict(pl.Series(STATES), order).to_numpy()
    rows = _shown_rows(t_ns, codes, moments_ns)
    x, y = view.gnss(shown[rows])
    t0_ns = int(epochs["t"].to_physical()[0]) if epochs.height else 0
    return {
        "geographic": site is not None,
        "states": list(STATES),
        "track": _track(site, x, y) if site is not None else _axis(x),
        "x": packed(x, "f4"),
        "y": packed(y, "f4"),
        "t": packed((t_ns[rows] - t0_ns) // 1_000_000, "u4"),
        "codes": packed(codes[rows], "u1"),
        "balises": _balises(view, passages),
    }


def _shown_rows(t_ns: Ints, codes: Ints, moments_ns: Ints) -> Ints:
    """So many rows at even distances, the worst in between, and all near the moments that matter."""
    stride = -(-len(t_ns) // _POINTS)
    if stride <= 1:
        return np.arange(len(t_ns))
    near = detail_rows(t_ns, moments_ns, reach_s=30.0)
    near[worst_rows(codes, stride)] = True
    return np.flatnonzero(near)


def _track(site: Site, x: Floats, y: Floats) -> list[Json]:
    """The net elements near the run, as lines."""
    known = np.isfinite(x)
    if not known.any():
        return []
    low = np.array([x[known].min(), y[known].min()]) - _AROUND_M
    high = np.array([x[known].max(), y[known].max()]) + _AROUND_M
    return [
        packed_line(name, east, north)
        for name, east, north in element_lines_m(site)
        if (low <= [east.max(), north.max()]).all() and (high >= [east.min(), north.min()]).all()
    ]


def _axis(x: Floats) -> list[Json]:
    known = x[np.isfinite(x)]
    if not len(known):
        return []
    ends = np.array([known.min(), known.max()])
    return [packed_line("path", ends, np.zeros(2))]


def _balises(view: _View, passages: pl.DataFrame) -> list[Json]:
    """One entry per balise with the worst that became of it; the worst balises last, so that they lie on top."""
    worst = pl.col("outcome").replace_strict({name: code for code, name in enumerate(OUTCOMES)}, return_dtype=pl.Int64)
    groups = (
        passages.with_columns(outcome=outcome())
        .group_by("balise_id", "netelement_id", "measure_m", maintain_order=True)
        .agg(pl.col("path_m").first(), worst=worst.max(), told=pl.col("outcome").value_counts(sort=True))
        .sort("worst", maintain_order=True)
    )
    x, y = view.at(floats(groups, "path_m"))
    return [
        {
            "id": row["balise_id"],
            "outcome": OUTCOMES[row["worst"]],
            "told": ", ".join(sorted(f"{one['count']} {one['outcome']}" for one in row["told"])),
            "place": f"{row['netelement_id']} at {row['measure_m']:.1f} m",
            "x": _rounded(x[number]),
            "y": _rounded(y[number]),
        }
        for number, row in enumerate(groups.iter_rows(named=True))
    ]


def _rounded(value: float) -> float | None:
    return round(float(value), 2) if np.isfinite(value) else None
