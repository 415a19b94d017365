"""Where the train was between two epochs far apart: the reference stream, else balise reads and the odometer.

A gap of positions is none of the evidence: the recorded streams go on, and say when the train passed a balise there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.hazards.truth import valid_ns
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints, times_ns

Counted = Callable[[pl.Series], pl.Series]
"""Odometer distance at any times, on the scale of the epochs' `odometer_m`; null where not known."""

# Steps between known places shorter than this are interpolated well enough.
LONG_STEP_S = 1.5
# Less way than this between two places tells nothing of how the difference to the odometer is to be shared out.
_LEAST_WAY_M = 1.0


@dataclass(frozen=True)
class _Places:
    """Instants at which the train's place on the path is known, with its speed where known."""

    at_ns: Ints
    path_m: Floats
    speed_mps: Floats

    def within(self, begin_ns: int, end_ns: int) -> _Places:
        first = int(np.searchsorted(self.at_ns, begin_ns, side="right"))
        part = slice(first, max(first, int(np.searchsorted(self.at_ns, end_ns))))
        return _Places(self.at_ns[part], self.path_m[part], self.speed_mps[part])


@dataclass(frozen=True)
class _Gap:
    """Two neighbouring epochs of one leg with truth, more than `LONG_STEP_S` apart."""

    at_ns: tuple[int, int]
    path_m: tuple[float, float]
    leg: int
    counted: bool


def places_between(
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    reference: pl.DataFrame | None,
    balise_reads: pl.DataFrame | None,
    odometer: pl.DataFrame | None,
    counted: Counted,
) -> pl.DataFrame | None:
    """Known places inside gaps of the epochs: `at_ns, path_m, speed_mps, leg`; None where there are none.

    Frames as of `establish_truth`; `odometer`: the recorded stream (`t`). Where the reference is silent the odometer
    leads from one known place to the next, the difference shared out by distance.
    """
    gaps = _gaps(epochs, truth)
    if not gaps:
        return None
    by_reference, reads = _reference_places(reference), _read_places(balise_reads)
    known = [_known_in(gap, by_reference, reads) for gap in gaps]
    found = known if odometer is None else _filled(gaps, known, times_ns(odometer), counted)
    parts = [
        pl.DataFrame({"at_ns": part.at_ns, "path_m": part.path_m, "speed_mps": part.speed_mps, "leg": gap.leg})
        for gap, places in zip(gaps, found, strict=True)
        if (part := places.within(*gap.at_ns)).at_ns.size
    ]
    return pl.concat(parts) if parts else None


def _gaps(epochs: pl.DataFrame, truth: pl.DataFrame) -> list[_Gap]:
    place = floats(truth, "truth_path_m")
    rows = np.flatnonzero(np.isfinite(place))
    at_ns, x = valid_ns(epochs)[rows], place[rows]
    ends = np.flatnonzero(np.diff(at_ns) > LONG_STEP_S * NS_PER_S) + 1
    if ends.size == 0:
        return []
    leg = ints(epochs["leg"].fill_null(strategy="forward").fill_null(strategy="backward"))[rows]
    stretch, counted = ints(epochs["odometer_segment"])[rows], np.isfinite(floats(epochs, "odometer_m"))[rows]
    whole: Bools = np.zeros(rows.size, dtype=np.bool_)
    whole[1:] = (np.diff(stretch) == 0) & counted[1:] & counted[:-1]
    return [
        _Gap((int(at_ns[i - 1]), int(at_ns[i])), (float(x[i - 1]), float(x[i])), int(leg[i]), bool(whole[i]))
        for i in ends.tolist()
        if leg[i] == leg[i - 1]
    ]


def _reference_places(reference: pl.DataFrame | None) -> _Places:
    if reference is None or reference["path_m"].count() < 2:
        return _nowhere()
    known = reference.select("t", "path_m").drop_nulls()
    at_ns, path = times_ns(known), floats(known, "path_m")
    return _Places(at_ns, path, np.gradient(path, (at_ns - at_ns[0]) / NS_PER_S))


def _read_places(balise_reads: pl.DataFrame | None) -> _Places:
    if balise_reads is None:
        return _nowhere()
    known = balise_reads.select("t", "path_m").drop_nulls().sort("t")
    return _Places(times_ns(known), floats(known, "path_m"), np.full(known.height, np.nan))


def _nowhere() -> _Places:
    return _Places(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


def _known_in(gap: _Gap, by_reference: _Places, reads: _Places) -> _Places:
    """Both ends of the gap and what is known between: by the reference, else by reads that an odometer can join."""
    inside = by_reference.within(*gap.at_ns)
    if inside.at_ns.size == 0 and gap.counted:
        inside = reads.within(*gap.at_ns)
    at_ns = np.array([gap.at_ns[0], *inside.at_ns, gap.at_ns[1]], dtype=np.int64)
    path = np.array([gap.path_m[0], *inside.path_m, gap.path_m[1]])
    return _Places(at_ns, path, np.array([np.nan, *inside.speed_mps, np.nan]))


def _filled(gaps: list[_Gap], known: list[_Places], stamps: Ints, counted: Counted) -> list[_Places]:
    """Each gap with the odometer's way where its known places are far apart."""
    spans = [stamps[slice(*np.searchsorted(stamps, gap.at_ns))] for gap in gaps]
    at_ns = np.unique(np.concatenate([*spans, *(places.at_ns for places in known)]))
    distance = floats(counted(_times(at_ns)).rename("odometer_m").to_frame(), "odometer_m")
    return [
        _by_odometer(places, at_ns, distance) if gap.counted else places
        for gap, places in zip(gaps, known, strict=True)
    ]


def _times(at_ns: Ints) -> pl.Series:
    return pl.Series("t", at_ns).cast(pl.Datetime("ns", "UTC"))


def _by_odometer(places: _Places, at_ns: Ints, distance_m: Floats) -> _Places:
    parts = [places]
    for i in np.flatnonzero(np.diff(places.at_ns) > LONG_STEP_S * NS_PER_S).tolist():
        first, last = np.searchsorted(at_ns, places.at_ns[i : i + 2])
        way = distance_m[first : last + 1]
        if np.isfinite(way).all():
            path = _between(places.path_m[i : i + 2], way, at_ns[first : last + 1])
            parts.append(_Places(at_ns[first + 1 : last], path[1:-1], np.full(path.size - 2, np.nan)))
    order = np.argsort(np.concatenate([part.at_ns for part in parts]), kind="stable")
    joined = [np.concatenate([getattr(part, name) for part in parts])[order] for name in _Places.__annotations__]
    return _Places(*joined)


def _between(ends_m: Floats, way_m: Floats, at_ns: Ints) -> Floats:
    """The odometer's way from the one end, what it lacks to the other shared out by distance."""
    moved = way_m - way_m[0]
    whole = moved[-1]
    share = moved / whole if abs(whole) > _LEAST_WAY_M else (at_ns - at_ns[0]) / (at_ns[-1] - at_ns[0])
    path: Floats = ends_m[0] + moved + share * (ends_m[1] - ends_m[0] - whole)
    return path
