"""Unit, scale, direction and clock of the odometer against the positions and the vehicle file."""

from __future__ import annotations

import numpy as np

from pipeline.studies.plausibility.causes import explain_factor
from pipeline.studies.plausibility.check import (
    IN_VEHICLE_FILE,
    VEHICLE_FILE,
    Cause,
    Check,
    FitState,
    correction,
    fits,
    misfit,
    not_checked,
)
from pipeline.studies.plausibility.clocks import StreamLag
from pipeline.studies.plausibility.pairs import PairFit, fit_pair
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.records import MOVING_MPS, Places, Record
from pipeline.studies.plausibility.robust import LEAST
from schemas.arrays import runs_of
from schemas.enums import MisfitCause

_SIGNS = "sign of the odometer's speed against its distance"
_TURNS = "direction of the counter where the train reverses"
_COLUMNS = {"distance": "distance_m", "speed": "speed_mps"}
# So many windows agree on the factor of a unit. Pulses, which no unit explains, have to be clearer, and far from 1.
_UNIT_WINDOWS = 0.6
_PULSES_WINDOWS = 0.8
_PULSES_FACTOR = 1.5
# Ways over this time are compared by their signs, except those below this share of the usual one.
_SIGN_S = 10.0
_SIGN_LEAST = 0.2
# The way over this time before and after a stand shows the heading, where the counter shows the same way within this
# share; headings turn back by more than this cosine: a curve of 45 degrees lies within.
_HEADING_S = 20.0
_HEADING_WAY = 0.3
_HEADING_COSINE = 0.7


def odometer_checks(of: Recording) -> tuple[list[Check], list[StreamLag]]:
    """All checks of the odometer, and its clock for comparison with those of the others."""
    if of.run.odometer is None:
        return [], []
    if not of.pairs:
        return [not_checked("odometer against the GNSS", "hardly any row")], []
    checks = [_unit_check(name, of) for name in of.pairs]
    if len(of.counters) == 2:
        checks.append(_sign_check(of.counters))
    name, pair = next((item for item in of.pairs.items() if item[1].known), next(iter(of.pairs.items())))
    if not pair.known:
        return checks, [StreamLag("odometer", reason=pair.reason)]
    checks.append(_turn_check(of.gnss, of.counters[name], pair))
    return [*checks, *_scale_checks(name, of)], [_lag(pair, of)]


def _lag(pair: PairFit, of: Recording) -> StreamLag:
    """The clock of the odometer; it is sure of what is beyond the latency of the vehicle file."""
    if pair.shifted:
        return StreamLag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_known:
        return StreamLag("odometer", reason=pair.clock_reason or "the speed changes too little")
    sure = pair.other_lag(-(of.vehicle.gnss_latency_s or 0.0), of.config.lag_told_s)
    return StreamLag("odometer", pair.lag_s, pair.lag_sigma_s, sure)


def _unit_check(name: str, of: Recording) -> Check:
    """The unit of one counter."""
    what = f"odometer {name} against the positions"
    pair = of.pairs[name]
    limit = of.config.scale_limit
    if not pair.known:
        return misfit(what, pair.reason) if pair.stands else not_checked(what, pair.reason)
    words = f"{pair.factor:.4g} times the way of the positions"
    if abs(pair.factor - 1.0) <= limit:
        return fits(what, words)
    if pair.constant < _UNIT_WINDOWS or not pair.other_scale(1.0, limit):
        return misfit(what, f"no constant factor ({words} usually)")
    # What the other counter shows too, if it counts metres, is of the wheel or of drifting positions.
    others = [other.factor for other in of.pairs.values() if other is not pair and other.known]
    base = next((other for other in others if abs(other - 1.0) <= 2.0 * limit), 1.0)
    explained = explain_factor(pair.factor / base, name == "speed")
    if explained is None and pair.constant >= _PULSES_WINDOWS and abs(np.log(pair.factor)) > np.log(_PULSES_FACTOR):
        explained = Cause(MisfitCause.PULSES), float(f"{pair.factor:.5g}")
    if explained is None:
        return misfit(what, words)
    cause, exact = explained
    return Check(what, FitState.IMPOSSIBLE, words, (cause,), correction("odometer", {_COLUMNS[name]: 1.0 / exact}))


def _scale_checks(name: str, of: Recording) -> list[Check]:
    """The scale that the run shows against that of the vehicle file, or 1; none of another unit than metres."""
    pair = of.pairs[name]
    config = of.config
    file_scale = of.vehicle.odometer_scale
    what = "odometer scale" if file_scale is None else "odometer scale of the vehicle file"
    metres = abs(pair.factor - 1.0) <= config.scale_limit
    scale = abs(pair.scale)
    lines = f"odometer_scale = {scale:.4f}\nodometer_scale_sigma = {max(2.0 * pair.scale_sigma, 2e-4):.4f}\n"
    if file_scale is not None and abs(file_scale - 1.0) > config.scale_limit:
        causes = (Cause(MisfitCause.IMPOSSIBLE_SCALE),)
        lines = lines if metres else ""
        return [Check(what, FitState.IMPOSSIBLE, f"{file_scale:.4g}", causes, lines, IN_VEHICLE_FILE)]
    if not metres:
        return []
    words = f"the run shows {scale:.4f} (sigma {pair.scale_sigma:.4f})"
    if file_scale is None:
        other = pair.other_scale(1.0, config.scale_told)
        wheel = misfit(what, words, MisfitCause.WHEEL, lines=lines, into=VEHICLE_FILE)
        return [wheel if other else fits(what, words)]
    words = f"{file_scale:.4f}, {words}"
    least = max(config.file_scale, config.file_sigmas * (of.vehicle.odometer_scale_sigma or 0.0))
    # Where a reference says that the file is right the positions drift.
    by_reference = fit_pair(of.reference, of.counters[name]) if of.reference else pair
    if not pair.other_scale(file_scale, least) or (
        by_reference.known and not by_reference.other_scale(file_scale, least)
    ):
        return [fits(what, words)]
    return [misfit(what, words, MisfitCause.SCALE_OF_FILE, lines=lines, into=IN_VEHICLE_FILE)]


def _sign_check(counters: dict[str, Record]) -> Check:
    """Speed and distance of one odometer."""
    starts = counters["speed"].instants(_SIGN_S)
    gained = np.array([counters[name].gained(starts, starts + _SIGN_S) for name in ("distance", "speed")])
    # By the median of what moves: a counter that is reset seems to run far, once.
    moves = np.all(np.nan_to_num(gained) != 0.0, axis=0)
    gained = gained[:, moves]
    gained = gained[:, np.all(np.abs(gained) > _SIGN_LEAST * np.median(np.abs(gained), axis=1, keepdims=True), axis=0)]
    if gained.shape[1] < LEAST:
        return not_checked(_SIGNS, "hardly any movement with both")
    falls, back = gained < 0
    against = float(np.mean(falls != back))
    if against > 0.9:
        # A train that runs backwards all the way is rarer than a counter of the wrong sign.
        name, does = ("distance", "falls") if falls.mean() > 0.5 else ("speed", "grows")
        causes = (Cause(MisfitCause.COUNTS_BACKWARDS, (name,)),)
        lines = correction("odometer", {_COLUMNS[name]: -1.0})
        return Check(_SIGNS, FitState.IMPOSSIBLE, f"the distance {does} at the opposite speed", causes, lines)
    if against > 0.1 and not back.any() and not falls.all():
        return misfit(_SIGNS, "the speed has no sign", MisfitCause.COUNTER_WITHOUT_SIGN)
    return fits(_SIGNS, "the same")


def _turn_check(gnss: Places, counter: Record, pair: PairFit) -> Check:
    """Whether the counter turns where the train does; stands beside a jump of the position show nothing."""
    grid = gnss.instants(1.0)
    firsts, lasts = (grid[rows] for rows in runs_of(gnss.speed(grid) < MOVING_MPS))
    sides = (firsts - _HEADING_S, firsts), (lasts, lasts + _HEADING_S)
    moved = np.stack([gnss.gained(*side) for side in sides])
    sizes = np.linalg.norm(moved, axis=2)
    counted = np.stack([counter.gained(begin + pair.lag_s, end + pair.lag_s) * pair.scale for begin, end in sides])
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", *moved) / sizes.prod(axis=0)
        sure = np.isfinite(cosine) & (sizes.min(axis=0) > 2.0 * MOVING_MPS * _HEADING_S)
        sure &= np.all(np.abs(np.abs(counted) - sizes) < _HEADING_WAY * sizes, axis=0)
    reverses = sure & (cosine < -_HEADING_COSINE)
    if not reverses.any():
        return not_checked(_TURNS, "the train does not reverse on the way")
    if (counted.prod(axis=0)[reverses] >= 0).all():
        words = f"the train reverses {reverses.sum()} times, the counter never does"
        advice = "Let the recorder write the distance falling, and the speed negative, while the train reverses."
        return misfit(_TURNS, words, MisfitCause.COUNTER_WITHOUT_SIGN, advice=advice)
    return fits(_TURNS, f"{reverses.sum()} reversals")
