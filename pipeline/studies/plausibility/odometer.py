"""Unit, direction and clock of the odometer against the positions, and what the vehicle file says of it."""

from __future__ import annotations

from functools import cache

import numpy as np
import polars as pl

from pipeline.studies.plausibility.causes import explain_factor
from pipeline.studies.plausibility.check import (
    VEHICLE_FILE,
    Check,
    FitState,
    KnownCause,
    correction,
    fits,
    misfit,
    not_checked,
)
from pipeline.studies.plausibility.pairs import PairFit, fit_pair
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.records import MOVING_MPS, Places, Record
from pipeline.studies.plausibility.robust import LEAST
from pipeline.studies.plausibility.witnesses import StreamLag
from schemas.arrays import floats, runs_of
from schemas.config import PlausibilityConfig
from schemas.enums import MisfitCause

LATENCY = "GNSS latency of the vehicle file"
_SIGNS = "sign of the odometer's speed against its distance"
_TURNS = "direction of the counter where the train reverses"
# So many windows agree on the factor of a unit. Pulses, which no unit explains, have to be clearer, and far from 1.
_UNIT_WINDOWS = 0.6
_PULSES_WINDOWS = 0.8
_PULSES_FACTOR = 1.5
# The way over this time before and after a stand shows the heading, where the counter shows the same way within this
# share; headings turn back or go on by more than this cosine: a curve of 45 degrees lies within.
_HEADING_S = 20.0
_HEADING_WAY = 0.3
_HEADING_COSINE = 0.7
# Rows of two counters leap to and fro by turns: so large a share of so many rows is no noise of one.
_BY_TURNS = 0.5
_LEAST_BY_TURNS = 30


def odometer_checks(of: Recording, reference: StreamLag | None) -> tuple[list[Check], list[StreamLag]]:
    """All checks of the odometer, and its clock for comparison with those of the others."""
    config = of.config
    pairs = of.pairs
    if not pairs:
        return ([not_checked("odometer against the GNSS", "hardly any row")] if of.run.odometer is not None else []), []
    checks = _interleaved(of.run.odometer) + [_factor_check(name, pairs, config) for name in pairs]
    checks += sign_check(of.counters)
    name = next((name for name, pair in pairs.items() if pair.known), next(iter(pairs)))
    pair = pairs[name]
    if not pair.known:
        return checks, [StreamLag("odometer", reason=pair.reason)]
    checks.append(turn_check(of.gnss, of.counters[name], pair))

    @cache
    def by_reference() -> PairFit | None:
        """The odometer against the reference, which no GNSS drift is in; None where it has none in its own time."""
        if of.reference is None or reference is None or reference.reason:
            return None
        fit = fit_pair(of.reference, of.counters[name])
        return fit if fit.known else None

    scale = _scale_check(pair, of)
    latency = _latency_check(pair, reference, of)
    if scale is not None and scale.state in (FitState.MISFIT, FitState.IMPOSSIBLE):
        # Where there is a reference it has to contradict the file too: else it is the positions that drift.
        referenced = by_reference()
        beside = None if referenced is None else _scale_check(referenced, of, _unit(pair, config))
        scale = fits(scale.what, scale.found) if beside is not None and beside.state is FitState.FITS else scale
    checks += [check for check in (scale, latency) if check is not None]
    if latency is not None and latency.state is FitState.MISFIT:
        return checks, [StreamLag("odometer", reason="the latency of the vehicle file does not fit")]
    lag = _lag(pair, of)
    referenced = by_reference() if lag.sure and abs(lag.lag_s) <= config.lag_limit_s else None
    if referenced is not None and referenced.lag_known and not referenced.other_lag(0.0, config.lag_told_s):
        return checks, [StreamLag("odometer", reason=f"{lag.lag_s:+.2f} s, but none against the reference")]
    return checks, [lag]


def _interleaved(odometer: pl.DataFrame | None) -> list[Check]:
    """Rows of two counters by turns: they leap to and fro, and each second row goes on where the last but one was."""
    way = np.zeros(0) if odometer is None else floats(odometer.drop_nulls("distance_m"), "distance_m")
    if way.size < _LEAST_BY_TURNS:
        return []
    leaps = np.diff(way)
    steps = np.abs(way[2:] - way[:-2])
    to_and_fro = (leaps[1:] * leaps[:-1] < 0) & (np.minimum(np.abs(leaps[1:]), np.abs(leaps[:-1])) > 10.0 * steps)
    share = float(np.mean(to_and_fro))
    if share < _BY_TURNS:
        return []
    words = f"{share:.0%} of its rows leap to and fro by about {np.median(np.abs(leaps)):.3g}"
    advice = "Record each counter under a name of its own, and use one of them."
    return [misfit("odometer distance from row to row", words, MisfitCause.TWO_COUNTERS, advice=advice)]


def _lag(pair: PairFit, of: Recording) -> StreamLag:
    """The clock of the odometer; it is sure of what is beyond the latency of the vehicle file."""
    if pair.shifted:
        return StreamLag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_known:
        return StreamLag("odometer", reason=pair.clock_reason or "the speed changes too little")
    latency_s = of.vehicle.gnss_latency_s
    from_file_s = -(latency_s or 0.0)
    small = abs(pair.lag_s - from_file_s) <= of.config.lag_limit_s
    sure = small and pair.other_lag(from_file_s, of.config.lag_told_s)
    return StreamLag("odometer", pair.lag_s, pair.lag_sigma_s, sure, latency_known=latency_s is not None)


def _metres(pair: PairFit, config: PlausibilityConfig) -> bool:
    """Whether the counter counts metres, as far as any odometer may be off."""
    return abs(abs(pair.factor) - 1.0) <= config.scale_limit


def _factor_check(name: str, pairs: dict[str, PairFit], config: PlausibilityConfig) -> Check:
    what = f"odometer {name} against the positions"
    pair = pairs[name]
    if not pair.known:
        return misfit(what, pair.reason) if pair.stands else not_checked(what, pair.reason)
    factor = abs(pair.factor)
    words = f"{factor:.4g} times the way of the positions"
    column = "speed_mps" if name == "speed" else "distance_m"
    if _metres(pair, config):
        if not pair.other_factor(1.0, config.scale_told):
            return fits(what, words)
        return misfit(what, words, MisfitCause.WHEEL, lines=_scale_lines(pair, 1.0), into=VEHICLE_FILE)
    if pair.constant < _UNIT_WINDOWS or not pair.other_factor(1.0, config.scale_limit):
        return misfit(what, f"no constant factor ({words} usually)")
    # What the other column shows too, if it is near 1, is of the wheel or of drifting positions.
    factors = [abs(fit.factor) for pair_name, fit in pairs.items() if pair_name != name and fit.known]
    base = next((pair_name for pair_name in factors if abs(pair_name - 1.0) <= 2.0 * config.scale_limit), 1.0)
    if (explained := explain_factor(factor / base, name == "speed")) is not None:
        lines = correction("odometer", {column: 1.0 / explained.exact})
        return Check(what, FitState.IMPOSSIBLE, words, explained.causes, lines)
    if pair.constant >= _PULSES_WINDOWS and max(factor, 1.0 / factor) > _PULSES_FACTOR:
        lines = correction("odometer", {column: float(f"{1.0 / factor:.5g}")})
        return Check(what, FitState.IMPOSSIBLE, words, (KnownCause(MisfitCause.PULSES),), lines)
    return misfit(what, words)


def _scale_lines(pair: PairFit, unit: float) -> str:
    sigma = max(2.0 * pair.scale_sigma(unit), 2e-4)
    return f"odometer_scale = {pair.scale(unit):.4f}\nodometer_scale_sigma = {sigma:.4f}\n"


def _unit(pair: PairFit, config: PlausibilityConfig) -> float | None:
    """Units of the odometer in a metre, by what the run shows: a unit has a line of its own. None: not known."""
    if _metres(pair, config):
        return 1.0
    explained = explain_factor(abs(pair.factor), False)
    return None if explained is None else explained.exact


def _scale_check(pair: PairFit, of: Recording, unit: float | None = None) -> Check | None:
    """The file's odometer scale against what the run shows, in metres."""
    config = of.config
    file_scale = of.vehicle.odometer_scale
    if file_scale is None:
        return None
    what = "odometer scale of the vehicle file"
    unit = unit or _unit(pair, config)
    if unit is None:
        return not_checked(what, "the unit of the odometer is not known")
    least = max(config.file_scale, config.file_sigmas * (of.vehicle.odometer_scale_sigma or 0.0))
    words = f"{file_scale:.4f}, the run shows {pair.scale(unit):.4f} (sigma {pair.scale_sigma(unit):.4f})"
    no_train = abs(file_scale - 1.0) > config.scale_limit
    code = MisfitCause.IMPOSSIBLE_SCALE if no_train else MisfitCause.SCALE_OF_FILE
    return _of_file(what, words, pair.other_factor(unit / file_scale, least), code, _scale_lines(pair, unit))


def _latency_check(pair: PairFit, reference: StreamLag | None, of: Recording) -> Check | None:
    """The file's GNSS latency against what the run shows; a reference that agrees with it is believed."""
    config = of.config
    file_s = of.vehicle.gnss_latency_s
    if file_s is None or pair.shifted:
        return None
    if not pair.lag_known:
        return not_checked(LATENCY, "the speed changes too little")
    least_s = max(config.lag_told_s / 2.0, config.file_sigmas * (of.vehicle.gnss_latency_sigma_s or 0.0))
    if reference is not None and not reference.reason and abs(reference.lag_s + file_s) < least_s:
        return fits(LATENCY, f"{file_s:.2f} s, by the reference {-reference.lag_s:.2f} s")
    words = f"{file_s:.2f} s, the run shows {-pair.lag_s:.2f} s (sigma {pair.lag_sigma_s:.2f} s)"
    sigma_s = max(2 * pair.lag_sigma_s, 0.02)
    lines = f"gnss_latency_s = {-pair.lag_s:.2f}\ngnss_latency_sigma_s = {sigma_s:.2f}\n"
    return _of_file(LATENCY, words, pair.other_lag(-file_s, least_s), MisfitCause.LATENCY_OF_FILE, lines)


def _of_file(what: str, words: str, wrong: bool, code: MisfitCause, lines: str) -> Check:
    """What a figure of the vehicle file shows; `code`: why, where it is wrong."""
    if not wrong:
        return fits(what, words)
    state = FitState.IMPOSSIBLE if code is MisfitCause.IMPOSSIBLE_SCALE else FitState.MISFIT
    return Check(what, state, words, (KnownCause(code),), lines, "write instead in the vehicle file")


def sign_check(counters: dict[str, Record]) -> list[Check]:
    """Speed and distance of one odometer; none where it has not both."""
    if len(counters) < 2:
        return []
    begin_s = max(counter.t_s[0] for counter in counters.values())
    end_s = min(counter.t_s[-1] for counter in counters.values())
    starts = np.linspace(begin_s, max(end_s - 10.0, begin_s), 300)
    gained = np.array([counters[name].gained(starts, starts + 10.0) for name in ("distance", "speed")])
    # By the median of what moves: a counter that is reset seems to run far, once.
    moves = np.all(np.nan_to_num(gained) != 0.0, axis=0)
    least = 0.2 * np.median(np.abs(gained[:, moves]), axis=1, keepdims=True) if moves.any() else 0.0
    moves &= np.all(np.abs(gained) > least, axis=0)
    if moves.sum() < LEAST:
        return [not_checked(_SIGNS, "hardly any movement with both")]
    falls, back = gained[:, moves] < 0
    against = float(np.mean(falls != back))
    if against > 0.9:
        # A train that runs backwards all the way is rarer than a counter of the wrong sign.
        name, does = ("distance", "falls") if falls.mean() > 0.5 else ("speed", "grows")
        lines = correction("odometer", {"distance_m" if name == "distance" else "speed_mps": -1.0})
        finding = f"the distance {does} at the opposite speed"
        return [
            Check(_SIGNS, FitState.IMPOSSIBLE, finding, (KnownCause(MisfitCause.COUNTS_BACKWARDS, (name,)),), lines)
        ]
    if against > 0.1 and not back.any() and not falls.all():
        return [misfit(_SIGNS, "the speed has no sign", MisfitCause.SPEED_WITHOUT_SIGN)]
    return [fits(_SIGNS, "the same")]


def turn_check(gnss: Places, counter: Record, pair: PairFit) -> Check:
    """Whether the counter turns where the train does; stands beside a jump of the position show nothing."""
    grid = gnss.instants(1.0)
    firsts, lasts = (grid[rows] for rows in runs_of(gnss.speed(grid) < MOVING_MPS))
    sides = (firsts - _HEADING_S, firsts), (lasts, lasts + _HEADING_S)
    moved = np.stack([gnss.gained(*side) for side in sides])
    sizes = np.linalg.norm(moved, axis=2)
    counted = [counter.gained(begin + pair.lag_s, end + pair.lag_s) / pair.factor for begin, end in sides]
    gained = np.stack(counted)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", *moved) / sizes.prod(axis=0)
        sure = np.isfinite(cosine) & (sizes.min(axis=0) > 2.0 * MOVING_MPS * _HEADING_S)
        sure &= np.all(np.abs(np.abs(gained) - sizes) < _HEADING_WAY * sizes, axis=0)
    reversal = sure & (cosine < -_HEADING_COSINE)
    onward = sure & (cosine > _HEADING_COSINE)
    turns = gained.prod(axis=0) < 0
    never = int((reversal & ~turns).sum())
    wrongly = int((onward & turns).sum())
    if never and never == reversal.sum():
        words = f"the train reverses {never} times, the counter never does"
        advice = "Let the recorder write the distance falling, and the speed negative, while the train reverses."
        return misfit(_TURNS, words, MisfitCause.COUNTER_WITHOUT_SIGN, advice=advice)
    if wrongly and wrongly > 0.5 * onward.sum():
        words = f"the counter turns {wrongly} times where the train goes on"
        return misfit(_TURNS, words, MisfitCause.SIGN_OF_SOMETHING_ELSE)
    if not (reversal | onward).any():
        return not_checked(_TURNS, "the train does not stop on the way")
    return fits(_TURNS, f"{reversal.sum()} reversals, {onward.sum()} stops")
