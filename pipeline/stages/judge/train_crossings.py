"""When the train itself passed each balise, by the evidence alone (CONTRACT section 3, `t_true`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.stages.epochs.clock import passings
from pipeline.stages.evidence.evidence import Alternative, EvidenceSet
from pipeline.stages.judge.judgement import JudgeInput
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration

# Numerics: so many instants before and after a track show where the train came from and went on to.
_NEIGHBOURS = 100
# Numerics: so many rows are looked at for a place that is mostly near.
_BLOCK = 256


class TrueCrossing(NamedTuple):
    """Instant [ns] by the middle of the interval; `sense` +1 with the measure of the balise's net element, else -1.

    `clear`: the train came from beyond the re-arming distance and went on beyond it.
    """

    t_ns: int
    sense: int
    clear: bool


Crossings = dict[str, list[TrueCrossing]]
"""Of each balise, in order of time."""


def crossings_of(given: JudgeInput) -> Crossings:
    """Crossings of each balise of the path by the train, in a direction in which the balise is valid.

    Args:
        given: the balises of the path, and the evidence.

    Returns:
        Crossings of each balise in order of time.
    """
    rows = reversed(given.solution.balises.rows(named=True))
    # Of a balise that is passed twice the first place stands for all: its element and measure are the same.
    balises = {row["balise_id"]: row for row in rows}
    index = given.evidence.network.track.index
    places = {name: Place(index.get(row["netelement_id"], -1), row["measure_m"]) for name, row in balises.items()}
    at_ns = with_instants_between(given.epochs_valid_at_ns(), given.config.align.speed_window_s)
    crossings = true_crossings(at_ns, given.evidence.at(at_ns), places, given.config)
    # `valid_direction` is along the path, `sense` of a crossing along the measure; 0 is both directions.
    valid = {name: row["valid_direction"] * row["sense"] for name, row in balises.items()}
    return {
        name: [crossing for crossing in crossed if valid[name] in (0, crossing.sense)]
        for name, crossed in crossings.items()
    }


def with_instants_between(at_ns: Ints, step_s: float) -> Ints:
    """The instants of the positions [ns], and others every `step_s` between those that are farther apart."""
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


class _Approach(NamedTuple):
    """The train on one track, with the rows next to it: `on_track` on itself; beyond a balise if `reach_m` away."""

    rows: Ints
    at_m: Floats
    on_track: Bools
    reach_m: Floats

    def beyond(self, balise_m: float, begin: int, end: int) -> tuple[Bools, Bools]:
        """Whether the train is beyond a balise at some of its rows, and whether it is ahead of it."""
        away_m = self.at_m[begin:end] - balise_m
        return np.abs(away_m) >= self.reach_m[begin:end], away_m >= 0.0

    def was_beyond(self, balise_m: float, begin: int, end: int, ahead: bool) -> bool:
        """Whether the train is beyond the balise on this side of it at one of some rows; mostly at one of the last."""
        for last in range(end, begin, -_BLOCK):
            beyond, side = self.beyond(balise_m, max(last - _BLOCK, begin), last)
            if (beyond & (side == ahead)).any():
                return True
        return False

    def next_beyond(self, balise_m: float, begin: int) -> bool | None:
        """On which side the train is next beyond the balise; None where it never is."""
        for first in range(begin, self.at_m.size, _BLOCK):
            beyond, side = self.beyond(balise_m, first, first + _BLOCK)
            if beyond.any():
                return bool(side[beyond.argmax()])
        return None


def true_crossings(t_ns: Ints, evidence: EvidenceSet, places: dict[str, Place], config: Configuration) -> Crossings:
    """Crossings of balises at `places` by the train, where the evidence (at instants `t_ns`) leaves one track.

    Where the half interval is at most `known_error_m`, its middle counts; else the whole interval has to pass from one
    side of the balise to the other.
    """
    alternatives = np.bincount(
        np.concatenate([track.rows for track in evidence.alternatives] or [np.zeros(0, np.int64)]), minlength=t_ns.size
    )
    tracks = [track.some_rows(alternatives[track.rows] == 1) for track in evidence.alternatives]
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
        rows, at_m = _rows_about_track(track, train)
        reach_m = np.maximum(config.lds.rearm_m, train.half_m[rows])
        approach = _Approach(rows, at_m, np.isin(rows, track.rows), reach_m)
        balises, visits_m, senses = track.route.visits_of_places(elements, measures_m)
        for balise, visit_m, sense, steps in zip(balises, visits_m, senses, _steps_past(at_m, visits_m), strict=True):
            crossed = _crossings_of_place(train, approach, visit_m, steps, config)
            turned = [crossing._replace(sense=int(crossing.sense * sense)) for crossing in crossed]
            crossings[names[balise]] += turned
    return {name: sorted(crossed) for name, crossed in crossings.items()}


def _rows_about_track(track: Alternative, train: _Train) -> tuple[Ints, Floats]:
    """Rows of the train on a track and of the instants just before and after, with their coordinates on it [m]."""
    rows = track.rows
    around = np.arange(max(rows[0] - _NEIGHBOURS, 0), min(rows[-1] + _NEIGHBOURS + 1, train.t_ns.size))
    neighbours = np.setdiff1d(around, rows)
    element = np.nan_to_num(train.element[neighbours], nan=-1).astype(np.int64)
    near_m = track.middle_m[np.searchsorted(rows, neighbours).clip(0, rows.size - 1)]
    there_m, _ = track.route.coordinates_of(element, train.measure_m[neighbours], near_m)
    known = np.isfinite(there_m)
    both = np.concatenate([rows, neighbours[known]])
    order = np.argsort(both, kind="stable")
    return both[order], np.concatenate([track.middle_m, there_m[known]])[order]


def _steps_past(at_m: Floats, places_m: Floats) -> list[list[int]]:
    """The later row of each step that passes each of some places, in order."""
    order = np.argsort(places_m, kind="stable")
    steps: list[list[int]] = [[] for _ in order]
    for passing in passings(at_m, places_m[order]):
        steps[order[passing.place]].append(passing.after)
    return steps


def _crossings_of_place(
    train: _Train, approach: _Approach, balise_m: float, steps: Sequence[int], config: Configuration
) -> list[TrueCrossing]:
    """Instants at which the train went from one side of a balise to the other, of the `steps` past it.

    A train that came no farther than `rearm_m` from a balise since it passed it has not passed it again.
    """
    crossings: list[TrueCrossing] = []
    armed_from = 0
    for change in steps:
        around = approach.rows[change - 1 : change + 1]
        if around[1] - around[0] != 1:
            continue
        (passing,) = passings(approach.at_m[change - 1 : change + 1] - balise_m, [0.0])
        ahead = passing.sense > 0
        armed = approach.was_beyond(balise_m, armed_from, change, not ahead)
        # However often its middle wavers at the balise: on which side the train is next known to be beyond it.
        clear = armed and approach.next_beyond(balise_m, change) is ahead
        close = (train.half_m[around] <= config.hazards.known_error_m).all()
        if not clear and not (close and (armed or armed_from == 0)):
            continue
        armed_from = change
        if approach.on_track[change]:
            instant_ns = passing.instant_ns(*train.t_ns[around].tolist())
            crossings.append(TrueCrossing(instant_ns, passing.sense, clear))
    return crossings
