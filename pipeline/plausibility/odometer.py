"""Unit, direction and clock of the odometer against the positions, and what the vehicle file says of it."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, correction, fits, not_checked
from pipeline.plausibility.counter import sign_check, turn_check
from pipeline.plausibility.course import Course, Places, distance_course, places_of, speed_course
from pipeline.plausibility.pairs import PairFit, fit_pair
from pipeline.plausibility.witnesses import Lag
from schemas.config import IngestConfig, Vehicle
from schemas.run import RunLog

LATENCY = "GNSS latency of the vehicle file"
# So many windows agree on a factor that is a unit's; a factor that no unit explains has to be clearer, and far from 1.
_CONSTANT, _CLEARLY, _UNEXPLAINED = 0.6, 0.8, 1.5
# The vehicle file may differ from the run by so many of its own sigmas, and by this much at least.
_FILE_SIGMAS, _FILE_SCALE = 4.0, 0.005


def courses_of(run: RunLog, epoch_ns: int) -> dict[str, Course]:
    """Distance and summed speed of the odometer, where it has enough rows of them."""
    if run.odometer is None:
        return {}
    courses = {"distance": distance_course(run.odometer, epoch_ns), "speed": speed_course(run.odometer, epoch_ns)}
    return {name: course for name, course in courses.items() if course is not None}


def odometer_checks(
    run: RunLog, gnss: Places, epoch_ns: int, vehicle: Vehicle, config: IngestConfig, reference: Lag | None
) -> tuple[list[Check], list[Lag]]:
    """All checks of the odometer, and its clock for comparison with those of the others."""
    courses = courses_of(run, epoch_ns)
    if not courses:
        return ([not_checked("odometer against the GNSS", "hardly any row")] if run.odometer is not None else []), []
    fitted = {name: fit_pair(gnss, course) for name, course in courses.items()}
    checks = [_factor_check(name, pair, _base(name, fitted, config), config) for name, pair in fitted.items()]
    checks += sign_check(courses.get("distance"), courses.get("speed"))
    name = next((name for name, pair in fitted.items() if pair.told), next(iter(fitted)))
    pair, counter = fitted[name], courses[name]
    if not pair.told:
        return checks, [Lag("odometer", reason=pair.reason)]
    checks.append(turn_check(gnss, counter, pair.factor, pair.lag_s))

    def by_reference() -> PairFit | None:
        """The odometer against the reference, which no GNSS drift is in; None where it has none in its own time."""
        places = (
            None
            if run.reference is None or reference is None or reference.reason
            else places_of(run.reference, epoch_ns)
        )
        found = None if places is None else fit_pair(places, counter)
        return found if found is not None and found.told else None

    scale, latency = _scale_check(pair, by_reference, vehicle, config), _latency_check(pair, reference, vehicle, config)
    checks += [check for check in (scale, latency) if check is not None]
    if latency is not None and latency.state is State.MISFIT:
        return checks, [Lag("odometer", reason="the latency of the vehicle file does not fit")]
    lag = _lag(pair, vehicle, config)
    small = lag.sure and abs(lag.lag_s) <= config.fit_lag_limit_s
    other = by_reference() if small else None
    if other is not None and other.lag_told and not other.other_lag(0.0, config.fit_lag_told_s):
        return checks, [Lag("odometer", reason=f"{lag.lag_s:+.2f} s, but none against the reference")]
    return checks, [lag]


def _lag(pair: PairFit, vehicle: Vehicle, config: IngestConfig) -> Lag:
    """The clock of the odometer; it is sure of what is beyond the latency that the vehicle file tells."""
    if pair.shifted:
        return Lag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_told:
        return Lag("odometer", reason=pair.clock_reason or "the speed changes too little")
    from_file_s = -(vehicle.gnss_latency_s or 0.0)
    sure = pair.other_lag(from_file_s, config.fit_lag_told_s)
    sure &= abs(pair.lag_s - from_file_s) <= config.fit_lag_limit_s
    return Lag("odometer", pair.lag_s, pair.lag_sigma_s, sure, latency_known=vehicle.gnss_latency_s is not None)


def _base(name: str, fitted: dict[str, PairFit], config: IngestConfig) -> float:
    """The factor that both columns of the odometer show, if it is near 1: of the wheel or of drifting positions."""
    others = [abs(pair.factor) for other, pair in fitted.items() if other != name and pair.told]
    return others[0] if others and abs(others[0] - 1.0) <= 2.0 * config.fit_scale_limit else 1.0


def _factor_check(name: str, pair: PairFit, base: float, config: IngestConfig) -> Check:
    what = f"odometer {name} against the positions"
    if not pair.told:
        return Check(what, State.MISFIT, pair.reason) if pair.stands else not_checked(what, pair.reason)
    factor = abs(pair.factor)
    found = f"{factor:.4g} times the way of the positions"
    column = "speed_mps" if name == "speed" else "distance_m"
    if abs(factor - 1.0) <= config.fit_scale_limit:
        if not pair.other_factor(1.0, config.fit_scale_told):
            return fits(what, found)
        lines, into = _scale_lines(pair, 1.0), "append to the vehicle file"
        return Check(what, State.MISFIT, found, "a wheel diameter that is set wrongly", lines, into)
    if pair.constant < _CONSTANT or not pair.other_factor(1.0, config.fit_scale_limit):
        return Check(what, State.MISFIT, f"no constant factor ({found} usually)")
    explained = explain_factor(factor / base, name == "speed")
    if explained is not None:
        lines = correction("odometer", {column: 1.0 / explained.exact})
        return Check(what, State.IMPOSSIBLE, found, f"the {name} is {explained.cause}", lines)
    if pair.constant >= _CLEARLY and max(factor, 1.0 / factor) > _UNEXPLAINED:
        lines = correction("odometer", {column: float(f"{1.0 / factor:.5g}")})
        return Check(what, State.IMPOSSIBLE, found, "pulses, or a unit that this program does not know", lines)
    return Check(what, State.MISFIT, found)


def _scale_lines(pair: PairFit, unit: float) -> str:
    sigma = max(2.0 * unit * pair.factor_sigma / pair.factor**2, 2e-4)
    return f"odometer_scale = {unit / abs(pair.factor):.4f}\nodometer_scale_sigma = {sigma:.4f}\n"


def _scale_check(
    pair: PairFit, by_reference: Callable[[], PairFit | None], vehicle: Vehicle, config: IngestConfig
) -> Check | None:
    """The file's odometer scale against what the run shows, in metres: a unit has a line of its own.

    Where there is a reference it has to contradict the file too: else it is the positions that drift.
    """
    if vehicle.odometer_scale is None:
        return None
    what, unit = "odometer scale of the vehicle file", 1.0
    if abs(abs(pair.factor) - 1.0) > config.fit_scale_limit:
        if (explained := explain_factor(abs(pair.factor), speed=False)) is None:
            return not_checked(what, "the unit of the odometer is not known")
        unit = explained.exact
    least = max(_FILE_SCALE, _FILE_SIGMAS * (vehicle.odometer_scale_sigma or 0.0))
    sigma = unit * pair.factor_sigma / pair.factor**2
    found = f"{vehicle.odometer_scale:.4f}, the run shows {unit / abs(pair.factor):.4f} (sigma {sigma:.4f})"
    factor = unit / vehicle.odometer_scale
    other = by_reference() if pair.other_factor(factor, least) else pair
    if other is not None and not other.other_factor(factor, least):
        return fits(what, found)
    no_train = abs(vehicle.odometer_scale - 1.0) > config.fit_scale_limit
    return _wrong_file(what, found, _scale_lines(pair, unit), State.IMPOSSIBLE if no_train else State.MISFIT)


def _latency_check(pair: PairFit, reference: Lag | None, vehicle: Vehicle, config: IngestConfig) -> Check | None:
    """The file's GNSS latency against what the run shows; a reference that agrees with it is believed."""
    if vehicle.gnss_latency_s is None or pair.shifted:
        return None
    if not pair.lag_told:
        return not_checked(LATENCY, "the speed changes too little")
    least_s = max(config.fit_lag_told_s / 2.0, _FILE_SIGMAS * (vehicle.gnss_latency_sigma_s or 0.0))
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
