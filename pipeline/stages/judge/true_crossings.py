"""When the train itself passed each balise, by the evidence alone (CONTRACT section 3, `t_true`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.epochs.passing import passings
from pipeline.stages.evidence.evidence import Alternative, EvidenceSet
from pipeline.stages.judge.case import Case
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration

# Numerics: so many instants before and after a track show where the train came from and went on to.
_BESIDE = 100


class TrueCrossing(NamedTuple):
    """Instant [ns] by the middle of the interval; `sense` +1 with the measure of the balise's net element, else -1.

    `clear`: the train came from beyond the re-arming distance and went on beyond it.
    """

    t_ns: int
    sense: int
    clear: bool


Crossings = dict[str, list[TrueCrossing]]
"""Of each balise, in order of time."""


def crossings_of(case: Case) -> Crossings:
    """Crossings of each balise of the path by the train, in a direction in which the balise is valid."""
    balises = case.solution.balises.unique("balise_id", keep="first")
    elements = case.element_numbers(balises["netelement_id"]).tolist()
    spots = zip(balises["balise_id"], elements, balises["measure_m"], strict=True)
    places = {name: Place(element, measure_m) for name, element, measure_m in spots}
    at_ns = between_far_epochs(case.instants_of_epochs(), case.config.align.speed_window_s)
    crossings = true_crossings(at_ns, case.evidence.at(at_ns), places, case.config)
    # `valid_direction` is along the path, `sense` of a crossing along the measure; 0 is both ways.
    valid = dict(balises.select("balise_id", pl.col("valid_direction") * pl.col("sense")).iter_rows())
    return {
        name: [crossing for crossing in crossed if valid[name] in (0, crossing.sense)]
        for name, crossed in crossings.items()
    }


def between_far_epochs(at_ns: Ints, step_s: float) -> Ints:
    """The instants of the positions, and others between those that are far apart."""
    step_ns = round(step_s * NS_PER_S)
    far = np.flatnonzero(np.diff(at_ns) > 1.5 * step_ns)
    gaps = zip(at_ns[far].tolist(), at_ns[far + 1].tolist(), strict=True)
    between = [np.arange(begin, end, step_ns, dtype=np.int64)[1:] for begin, end in gaps]
    return np.unique(np.concatenate([at_ns, *between]))


class _Train(NamedTuple):
    """Where the train was at each instant, NaN where not known: net element, measure, half the interval."""

    t_ns: Ints
    element: Floats
    measure_m: Floats
    half_m: Floats


def true_crossings(t_ns: Ints, evidence: EvidenceSet, places: dict[str, Place], config: Configuration) -> Crossings:
    """Crossings where the evidence leaves one track; `t_ns`: of the evidence.

    Where the half interval is at most `known_error_m`, its middle counts; else the whole interval has to pass from one
    side of the balise to the other.
    """
    alternatives = np.bincount(
        np.concatenate([track.rows for track in evidence.alternatives] or [np.zeros(0, np.int64)]), minlength=t_ns.size
    )
    tracks = [track.where(alternatives[track.rows] == 1) for track in evidence.alternatives]
    train = _Train(t_ns, *np.full((3, t_ns.size), np.nan))
    for track in tracks:
        train.element[track.rows], train.measure_m[track.rows], _ = track.route.locate(track.middle_m)
        train.half_m[track.rows] = 0.5 * (track.high_m - track.low_m)
    names = list(places)
    elements = np.array([place.element for place in places.values()])
    measures_m = np.array([place.measure_m for place in places.values()])
    crossings: Crossings = {name: [] for name in names}
    for track in tracks:
        if track.rows.size == 0:
            continue
        rows, at_m = _with_beside(track, train)
        on_track = np.isin(rows, track.rows)
        for balise, visit_m, sense in zip(*track.route.places(elements, measures_m), strict=True):
            if at_m.min() <= visit_m <= at_m.max():
                crossed = _crossed(train, rows, on_track, at_m - visit_m, config)
                turned = [crossing._replace(sense=int(crossing.sense * sense)) for crossing in crossed]
                crossings[names[balise]] += turned
    return {name: sorted(crossed) for name, crossed in crossings.items()}


def _with_beside(track: Alternative, train: _Train) -> tuple[Ints, Floats]:
    """Rows and coordinates on a track, also of the rows just before and after, where the train's place lies on it."""
    rows = track.rows
    around = np.arange(max(rows[0] - _BESIDE, 0), min(rows[-1] + _BESIDE + 1, train.t_ns.size))
    beside = np.setdiff1d(around, rows)
    element = np.nan_to_num(train.element[beside], nan=-1).astype(np.int64)
    near_m = track.middle_m[np.searchsorted(rows, beside).clip(0, rows.size - 1)]
    there_m, _ = track.route.coordinate(element, train.measure_m[beside], near_m)
    known = np.isfinite(there_m)
    both = np.concatenate([rows, beside[known]])
    order = np.argsort(both, kind="stable")
    return both[order], np.concatenate([track.middle_m, there_m[known]])[order]


def _crossed(train: _Train, rows: Ints, on_track: Bools, away_m: Floats, config: Configuration) -> list[TrueCrossing]:
    """Instants, the later one `on_track`, at which the train went from one side of the balise to the other.

    A train that came no farther than `rearm_m` from a balise since it passed it has not passed it again.
    """
    half_m = train.half_m[rows]
    close = half_m <= config.hazards.known_error_m
    beyond = np.abs(away_m) >= np.maximum(config.lds.rearm_m, half_m)
    ahead = away_m >= 0.0
    crossings: list[TrueCrossing] = []
    armed_from = 0
    passed = False
    far = np.flatnonzero(beyond)
    for passing in passings(away_m, [0.0]):
        change = passing.after
        if rows[change] - rows[change - 1] != 1:
            continue
        armed = bool((beyond & (ahead != ahead[change]))[armed_from:change].any())
        # However often its middle wavers at the balise: on which side the train is next known to be beyond it.
        next_far = int(np.searchsorted(far, change))
        clear = armed and next_far < far.size and bool(ahead[far[next_far]] == ahead[change])
        if not clear and not (close[change - 1 : change + 1].all() and (armed or not passed)):
            continue
        armed_from = change
        passed = True
        if on_track[change]:
            instant_ns = passing.instant_ns(*train.t_ns[rows[change - 1 : change + 1]].tolist())
            crossings.append(TrueCrossing(instant_ns, passing.sense, clear))
    return crossings
