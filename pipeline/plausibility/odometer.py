"""Unit, direction and clock of the odometer against the positions, and what the vehicle file says of it."""

from __future__ import annotations

from functools import cache

from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, correction, fits, not_checked
from pipeline.plausibility.counter import sign_check, turn_check
from pipeline.plausibility.course import Places, courses_of, places_of
from pipeline.plausibility.pairs import PairFit, fit_pair
from pipeline.plausibility.witnesses import Lag
from schemas.config import PlausibilityConfig, Vehicle
from schemas.run import RunLog

LATENCY = "GNSS latency of the vehicle file"
_TO_VEHICLE = "append to the vehicle file"


def odometer_checks(
    run: RunLog, gnss: Places, epoch_ns: int, vehicle: Vehicle, config: PlausibilityConfig, reference: Lag | None
) -> tuple[list[Check], list[Lag]]:
    """All checks of the odometer, and its clock for comparison with those of the others."""
    courses = courses_of(run.odometer, epoch_ns)
    if not courses:
        return ([not_checked("odometer against the GNSS", "hardly any row")] if run.odometer is not None else []), []
    fitted = {name: fit_pair(gnss, course, config) for name, course in courses.items()}
    checks = [_factor_check(name, fitted, config) for name in fitted] + sign_check(courses)
    name = next((name for name, pair in fitted.items() if pair.told), next(iter(fitted)))
    pair, counter = fitted[name], courses[name]
    if not pair.told:
        return checks, [Lag("odometer", reason=pair.reason)]
    checks.append(turn_check(gnss, counter, pair.factor, pair.lag_s, config.moving_mps))

    @cache
    def by_reference() -> PairFit | None:
        """The odometer against the reference, which no GNSS drift is in; None where it has none in its own time."""
        own_time = run.reference is not None and reference is not None and not reference.reason
        places = places_of(run.reference, epoch_ns) if run.reference is not None and own_time else None
        found = None if places is None else fit_pair(places, counter, config)
        return found if found is not None and found.told else None

    scale, latency = _scale_check(pair, vehicle, config), _latency_check(pair, reference, vehicle, config)
    if scale is not None and scale.state in (State.MISFIT, State.IMPOSSIBLE):
        # Where there is a reference it has to contradict the file too: else it is the positions that drift.
        other = by_reference()
        beside = None if other is None else _scale_check(other, vehicle, config, _unit(pair, config))
        scale = fits(scale.what, scale.found) if beside is not None and beside.state is State.FITS else scale
    checks += [check for check in (scale, latency) if check is not None]
    if latency is not None and latency.state is State.MISFIT:
        return checks, [Lag("odometer", reason="the latency of the vehicle file does not fit")]
    lag = _lag(pair, vehicle, config)
    small = lag.sure and abs(lag.lag_s) <= config.lag_limit_s
    other = by_reference() if small else None
    if other is not None and other.lag_told and not other.other_lag(0.0, config.lag_told_s):
        return checks, [Lag("odometer", reason=f"{lag.lag_s:+.2f} s, but none against the reference")]
    return checks, [lag]


def _lag(pair: PairFit, vehicle: Vehicle, config: PlausibilityConfig) -> Lag:
    """The clock of the odometer; it is sure of what is beyond the latency that the vehicle file tells."""
    if pair.shifted:
        return Lag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_told:
        return Lag("odometer", reason=pair.clock_reason or "the speed changes too little")
    from_file_s = -(vehicle.gnss_latency_s or 0.0)
    sure = pair.other_lag(from_file_s, config.lag_told_s) and abs(pair.lag_s - from_file_s) <= config.lag_limit_s
    return Lag("odometer", pair.lag_s, pair.lag_sigma_s, sure, latency_known=vehicle.gnss_latency_s is not None)


def _factor_check(name: str, fitted: dict[str, PairFit], config: PlausibilityConfig) -> Check:
    what, pair = f"odometer {name} against the positions", fitted[name]
    if not pair.told:
        return Check(what, State.MISFIT, pair.reason) if pair.stands else not_checked(what, pair.reason)
    factor = abs(pair.factor)
    found = f"{factor:.4g} times the way of the positions"
    column = "speed_mps" if name == "speed" else "distance_m"
    if abs(factor - 1.0) <= config.scale_limit:
        if not pair.other_factor(1.0, config.scale_told):
            return fits(what, found)
        return Check(
            what, State.MISFIT, found, "a wheel diameter that is set wrongly", _scale_lines(pair, 1.0), _TO_VEHICLE
        )
    if pair.constant < config.unit_windows or not pair.other_factor(1.0, config.scale_limit):
        return Check(what, State.MISFIT, f"no constant factor ({found} usually)")
    # What the other column shows too, if it is near 1, is of the wheel or of drifting positions.
    others = [abs(one.factor) for other, one in fitted.items() if other != name and one.told]
    base = next((one for one in others if abs(one - 1.0) <= 2.0 * config.scale_limit), 1.0)
    if (explained := explain_factor(factor / base, name == "speed", config)) is not None:
        lines = correction("odometer", {column: 1.0 / explained.exact})
        return Check(what, State.IMPOSSIBLE, found, f"the {name} is {explained.cause}", lines)
    if pair.constant >= config.pulses_windows and max(factor, 1.0 / factor) > config.pulses_factor:
        lines = correction("odometer", {column: float(f"{1.0 / factor:.5g}")})
        return Check(what, State.IMPOSSIBLE, found, "pulses, or a unit that this program does not know", lines)
    return Check(what, State.MISFIT, found)


def _scale_lines(pair: PairFit, unit: float) -> str:
    sigma = max(2.0 * unit * pair.factor_sigma / pair.factor**2, 2e-4)
    return f"odometer_scale = {unit / abs(pair.factor):.4f}\nodometer_scale_sigma = {sigma:.4f}\n"


def _unit(pair: PairFit, config: PlausibilityConfig) -> float | None:
    """Units of the odometer in a metre, by what the run shows: a unit has a line of its own. None: not known."""
    if abs(abs(pair.factor) - 1.0) <= config.scale_limit:
        return 1.0
    explained = explain_factor(abs(pair.factor), False, config)
    return None if explained is None else explained.exact


def _scale_check(
    pair: PairFit, vehicle: Vehicle, config: PlausibilityConfig, unit: float | None = None
) -> Check | None:
    """The file's odometer scale against what the run shows, in metres."""
    if vehicle.odometer_scale is None:
        return None
    what, unit = "odometer scale of the vehicle file", unit or _unit(pair, config)
    if unit is None:
        return not_checked(what, "the unit of the odometer is not known")
    least = max(config.file_scale, config.file_sigmas * (vehicle.odometer_scale_sigma or 0.0))
    sigma = unit * pair.factor_sigma / pair.factor**2
    found = f"{vehicle.odometer_scale:.4f}, the run shows {unit / abs(pair.factor):.4f} (sigma {sigma:.4f})"
    if not pair.other_factor(unit / vehicle.odometer_scale, least):
        return fits(what, found)
    no_train = abs(vehicle.odometer_scale - 1.0) > config.scale_limit
    return _wrong_file(what, found, _scale_lines(pair, unit), State.IMPOSSIBLE if no_train else State.MISFIT)


def _latency_check(pair: PairFit, reference: Lag | None, vehicle: Vehicle, config: PlausibilityConfig) -> Check | None:
    """The file's GNSS latency against what the run shows; a reference that agrees with it is believed."""
    if vehicle.gnss_latency_s is None or pair.shifted:
        return None
    if not pair.lag_told:
        return not_checked(LATENCY, "the speed changes too little")
    least_s = max(config.lag_told_s / 2.0, config.file_sigmas * (vehicle.gnss_latency_sigma_s or 0.0))
    if reference is not None and not reference.reason and abs(reference.lag_s + vehicle.gnss_latency_s) < least_s:
        return fits(LATENCY, f"{vehicle.gnss_latency_s:.2f} s, by the reference {-reference.lag_s:.2f} s")
    found = f"{vehicle.gnss_latency_s:.2f} s, the run shows {-pair.lag_s:.2f} s (sigma {pair.lag_sigma_s:.2f} s)"
    if not pair.other_lag(-vehicle.gnss_latency_s, least_s):
        return fits(LATENCY, found)
    sigma_s = max(2 * pair.lag_sigma_s, 0.02)
    lines = f"gnss_latency_s = {-pair.lag_s:.2f}\ngnss_latency_sigma_s = {sigma_s:.2f}\n"
    return _wrong_file(LATENCY, found, lines, State.MISFIT)


def _wrong_file(what: str, found: str, lines: str, state: State) -> Check:
    cause = "the vehicle file is of another vehicle or out of date, or the GNSS drifts over the whole run"
    cause = "no odometer has such a scale" if state is State.IMPOSSIBLE else cause
    return Check(what, state, found, cause, lines, "write instead in the vehicle file")
