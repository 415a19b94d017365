"""When the train itself passed each balise, by the evidence alone (CONTRACT section 3, `t_true`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.stages.evidence.evidence import EvidenceSet
from pipeline.stages.track.path import Place, Route
from schemas.arrays import Bools, Floats, Ints


class TrueCrossing(NamedTuple):
    """Instant [ns]; `sense` +1 where the train moved with the measure of the balise's net element, else -1.

    `clear`: it came from beyond the re-arming distance and went on beyond it.
    """

    t_ns: int
    sense: int
    clear: bool


def true_crossings(
    t_ns: Ints, evidence: EvidenceSet, places: dict[str, Place], known_to_m: float, rearm_m: float
) -> dict[str, list[TrueCrossing]]:
    """Crossings of each balise in order of time, where the evidence leaves one track and the place to `known_to_m`.

    `t_ns`: the instants of the evidence, in order, close enough for straight lines. A train that came no farther than
    `rearm_m` from a balise since it passed it has not passed it again.
    """
    alone = _alone(evidence, t_ns.size)
    certain: list[tuple[Route, Ints, Floats]] = []
    element, measure_m = np.full(alone.size, -1), np.full(alone.size, np.nan)
    for one in evidence.alternatives:
        close = (one.high_m - one.low_m <= 2.0 * known_to_m) & alone[one.rows]
        rows, at_m = one.rows[close], (0.5 * (one.low_m + one.high_m))[close]
        certain.append((one.route, rows, at_m))
        element[rows], measure_m[rows], _ = one.route.locate(at_m)
    names, spots = list(places), list(places.values())
    balises = np.array([place.element for place in spots]), np.array([place.measure_m for place in spots])
    found: dict[str, list[TrueCrossing]] = {name: [] for name in names}
    for route, told, told_m in certain:
        rows, at_m = _with_places_before(told, told_m, route, element, measure_m)
        least_m, most_m = at_m.min(initial=np.inf), at_m.max(initial=-np.inf)
        for balise, visit_m, sense in zip(*route.places(*balises), strict=True):
            if least_m <= visit_m <= most_m:
                instants = _crossed(t_ns, rows, at_m - visit_m, rearm_m)
                found[names[balise]] += [one._replace(sense=int(one.sense * sense)) for one in instants]
    return {name: sorted(instants) for name, instants in found.items()}


def _alone(evidence: EvidenceSet, size: int) -> Bools:
    """Instants at which the train was on one track for sure."""
    count = np.zeros(size, dtype=np.int64)
    for alternative in evidence.alternatives:
        count[alternative.rows] += 1
    alone: Bools = count == 1
    return alone


def _with_places_before(
    rows: Ints, at_m: Floats, route: Route, element: Ints, measure_m: Floats
) -> tuple[Ints, Floats]:
    """The instants just before the route is told of, where the train was on it by what was told before.

    `element`, `measure_m`: per instant the place of the train, -1 and NaN where not known.
    """
    before = np.setdiff1d(rows[rows > 0] - 1, rows)
    there_m, _ = route.coordinate(element[before], measure_m[before], at_m[np.searchsorted(rows, before)])
    known = np.isfinite(there_m)
    order = np.argsort(np.concatenate([rows, before[known]]), kind="stable")
    return np.concatenate([rows, before[known]])[order], np.concatenate([at_m, there_m[known]])[order]


def _crossed(t_ns: Ints, rows: Ints, away_m: Floats, rearm_m: float) -> list[TrueCrossing]:
    """Instants at which the train went from one side of the balise to the other, and which way."""
    side = away_m >= 0.0
    changes = np.flatnonzero((side[1:] != side[:-1]) & (np.diff(rows) == 1)) + 1
    found: list[TrueCrossing] = []
    armed_from = 0
    for change in changes.tolist():
        if found and float(np.abs(away_m[armed_from:change]).max(initial=0.0)) < rearm_m:
            continue
        before, after = float(away_m[change - 1]), float(away_m[change])
        begin, end = int(t_ns[rows[change - 1]]), int(t_ns[rows[change]])
        later = changes[changes > change]
        beyond = away_m[change : int(later[0]) if later.size else away_m.size]
        clear = min(np.abs(away_m[armed_from:change]).max(), np.abs(beyond).max()) >= rearm_m
        instant = begin + round((end - begin) * before / (before - after))
        found.append(TrueCrossing(instant, 1 if after > before else -1, bool(clear)))
        armed_from = change
    return found
