"""The one fit of a run: every check of units, clocks, axes and shifts, for `inspect`, `replay`, `calibrate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.plausibility.axes import velocity_checks
from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, fits, not_checked
from pipeline.plausibility.corrections import correction, inline
from pipeline.plausibility.counter import sign_check, turn_check
from pipeline.plausibility.course import Course, Places, distance_course, places_of, speed_course
from pipeline.plausibility.pairs import PairFit, fit_pair
from pipeline.plausibility.places import reads_lag, reference_lag, survey_checks
from pipeline.plausibility.witnesses import Lag, lag_checks
from schemas.arrays import times_ns
from schemas.config import IngestConfig, Vehicle
from schemas.errors import InputError
from schemas.run import RunLog, Site

_POSITIONS = "positions"
_LATENCY = "GNSS latency of the vehicle file"
# So many windows agree on a factor that is a unit's; a factor that no unit explains has to be clearer, and far from 1.
_CONSTANT, _CLEARLY, _UNEXPLAINED = 0.6, 0.8, 1.5
# The vehicle file may differ from the run by so many of its own sigmas, and by this much at least.
_FILE_SIGMAS, _FILE_SCALE, _FILE_LATENCY_S = 4.0, 0.005, 0.15


@dataclass(frozen=True)
class Fit:
    """All checks of one solution."""

    checks: tuple[Check, ...]

    @property
    def impossible(self) -> tuple[Check, ...]:
        """What no train can have, and a known cause explains."""
        return tuple(check for check in self.checks if check.state is State.IMPOSSIBLE)

    @property
    def misfits(self) -> tuple[Check, ...]:
        """What does not fit, the impossible first."""
        return (*self.impossible, *(check for check in self.checks if check.state is State.MISFIT))


def fit_run(run: RunLog, solution: str, vehicle: Vehicle, config: IngestConfig, site: Site | None = None) -> Fit:
    """Compare the streams of a cleaned run with one solution, the site and the vehicle file where there are any."""
    fixes = run.gnss.filter(pl.col("solution") == solution)
    if fixes.is_empty():
        return Fit((not_checked(_POSITIONS, "none"),))
    epoch_ns = int(times_ns(fixes)[0])
    gnss = places_of(fixes, epoch_ns)
    if gnss is None:
        return Fit((not_checked(_POSITIONS, "hardly any is valid"),))
    # Positions that lie on another continent fit nothing else.
    surveyed = survey_checks(gnss, site, vehicle, config) if site is not None else []
    if any(check.state is State.IMPOSSIBLE for check in surveyed):
        return Fit(tuple(surveyed))
    several = solution if len(run.solutions()) > 1 else None
    streams = [name for name in ("gnss", "satellites", "odometer", "reference") if run.stream(name) is not None]
    lag: Lag | None = None
    of_reference: list[Check] = []
    if run.reference is not None and run.reference.height:
        lag, of_reference = reference_lag(gnss, run.reference, epoch_ns, config)
    checks, lags = _odometer(run, gnss, epoch_ns, vehicle, config, lag)
    lags += [] if lag is None else [lag]
    checks += of_reference
    if run.balise_reads is not None and run.balise_reads.height and site is not None:
        lags.append(reads_lag(gnss, run.balise_reads, site, epoch_ns))
    checks += velocity_checks(fixes, gnss, epoch_ns)
    checks += lag_checks(lags, streams, several, epoch_ns, config)
    return Fit((*surveyed, *checks))


def _odometer(
    run: RunLog, gnss: Places, epoch_ns: int, vehicle: Vehicle, config: IngestConfig, reference: Lag | None
) -> tuple[list[Check], list[Lag]]:
    """Units, direction and clock of the odometer, and what the vehicle file says of it."""
    if run.odometer is None or run.odometer.height < 2:
        return [], []
    distance, speed = distance_course(run.odometer, epoch_ns), speed_course(run.odometer, epoch_ns)
    if distance is None and speed is None:
        return [not_checked("odometer against the GNSS", "hardly any row")], []
    fitted = {name: fit_pair(gnss, one) for name, one in (("distance", distance), ("speed", speed)) if one is not None}
    checks = [_factor_check(name, pair, _base(name, fitted, config), config) for name, pair in fitted.items()]
    usable = [(name, pair) for name, pair in fitted.items() if pair.told]
    main = usable[0][1] if usable else next(iter(fitted.values()))
    counter = distance if distance is not None and (not usable or usable[0][0] == "distance") else speed
    checks += sign_check(distance, speed)
    if usable and counter is not None:
        checks.append(turn_check(gnss, counter, main.factor, main.lag_s))
        checks += _vehicle_checks(main, lambda: _by_reference(run, counter, reference, epoch_ns), reference, vehicle)
    if any(check.what == _LATENCY and check.state is State.MISFIT for check in checks):
        return checks, [Lag("odometer", reason="the latency of the vehicle file does not fit")]
    lag = _odometer_lag(main, vehicle, config)
    small = lag.sure and abs(lag.lag_s) <= config.fit_lag_limit_s
    other = _by_reference(run, counter, reference, epoch_ns) if small and counter is not None else None
    if other is not None and other.lag_told and not other.other_lag(0.0, config.fit_lag_told_s):
        return checks, [Lag("odometer", reason=f"{lag.lag_s:+.2f} s, but none against the reference")]
    return checks, [lag]


def _odometer_lag(pair: PairFit, vehicle: Vehicle, config: IngestConfig) -> Lag:
    """The clock of the odometer, beyond the latency that the vehicle file tells."""
    if not pair.told:
        return Lag("odometer", reason=pair.reason)
    if pair.shifted:
        return Lag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_told:
        return Lag("odometer", reason=pair.clock_reason or "the speed changes too little")
    from_file_s = -(vehicle.gnss_latency_s or 0.0)
    rest_s = pair.lag_s - from_file_s
    sure = pair.other_lag(from_file_s, config.fit_lag_told_s) and abs(rest_s) <= config.fit_lag_limit_s
    return Lag("odometer", rest_s, pair.lag_sigma_s, sure, latency_known=vehicle.gnss_latency_s is not None)


def _base(name: str, fitted: Mapping[str, PairFit], config: IngestConfig) -> float:
    """The wheel's own factor as the odometer's other column shows it, if that is one; else 1."""
    others = [abs(pair.factor) for other, pair in fitted.items() if other != name and pair.told]
    return others[0] if others and abs(others[0] - 1.0) <= config.fit_scale_limit else 1.0


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
        lines = f"odometer_scale = {1.0 / factor:.4f}\nodometer_scale_sigma = {_scale_sigma(pair):.4f}\n"
        return Check(what, State.MISFIT, found, "a wheel diameter that is set wrongly", "the vehicle file", lines)
    if pair.constant < _CONSTANT:
        return Check(what, State.MISFIT, f"no constant factor ({found} usually)")
    explained = explain_factor(factor / base, name == "speed")
    if explained is not None:
        lines = correction("odometer", {column: 1.0 / explained.exact})
        return Check(what, State.IMPOSSIBLE, found, f"the {name} is {explained.cause}", "the configuration", lines)
    if pair.constant >= _CLEARLY and max(factor, 1.0 / factor) > _UNEXPLAINED:
        lines = correction("odometer", {column: float(f"{1.0 / factor:.5g}")})
        cause = "pulses, or a unit that this program does not know"
        return Check(what, State.IMPOSSIBLE, found, cause, "the configuration", lines)
    return Check(what, State.MISFIT, found)


def _scale_sigma(pair: PairFit) -> float:
    return max(2.0 * pair.factor_sigma / pair.factor**2, 2e-4)


def _by_reference(run: RunLog, counter: Course, lag: Lag | None, epoch_ns: int) -> PairFit | None:
    """The odometer against the reference, which no GNSS drift is in; None where it has none in its own time."""
    if run.reference is None or lag is None or lag.reason:
        return None
    places = places_of(run.reference, epoch_ns)
    found = None if places is None else fit_pair(places, counter)
    return found if found is not None and found.told else None


def _vehicle_checks(
    pair: PairFit, by_reference: Callable[[], PairFit | None], reference: Lag | None, vehicle: Vehicle
) -> list[Check]:
    """Scale and latency of the vehicle file against what the run shows.

    Where there is a reference it has to contradict the file too: else it is the positions that drift.
    """
    checks: list[Check] = []
    if vehicle.odometer_scale is not None:
        what, scale = "odometer scale of the vehicle file", 1.0 / abs(pair.factor)
        least = max(_FILE_SCALE, _FILE_SIGMAS * (vehicle.odometer_scale_sigma or 0.0))
        found = f"{vehicle.odometer_scale:.4f}, the run shows {scale:.4f} (sigma {_scale_sigma(pair) / 2:.4f})"
        factor = 1.0 / vehicle.odometer_scale
        other = by_reference() if pair.other_factor(factor, least) else pair
        if other is None or other.other_factor(factor, least):
            lines = f"odometer_scale = {scale:.4f}\nodometer_scale_sigma = {_scale_sigma(pair):.4f}\n"
            checks.append(_wrong_file(what, found, lines))
        else:
            checks.append(fits(what, found))
    if vehicle.gnss_latency_s is not None and not pair.shifted:
        if not pair.lag_told:
            return [*checks, not_checked(_LATENCY, "the speed changes too little")]
        least_s = max(_FILE_LATENCY_S, _FILE_SIGMAS * (vehicle.gnss_latency_sigma_s or 0.0))
        found = f"{vehicle.gnss_latency_s:.2f} s, the run shows {-pair.lag_s:.2f} s (sigma {pair.lag_sigma_s:.2f} s)"
        known = reference is not None and not reference.reason and abs(reference.lag_s) < 10.0
        agrees = known and reference is not None and abs(reference.lag_s + vehicle.gnss_latency_s) < least_s
        if pair.other_lag(-vehicle.gnss_latency_s, least_s) and not agrees:
            sigma_s = max(2 * pair.lag_sigma_s, 0.02)
            lines = f"gnss_latency_s = {-pair.lag_s:.2f}\ngnss_latency_sigma_s = {sigma_s:.2f}\n"
            checks.append(_wrong_file(_LATENCY, found, lines))
        elif agrees and reference is not None:
            checks.append(fits(_LATENCY, f"{vehicle.gnss_latency_s:.2f} s, by the reference {-reference.lag_s:.2f} s"))
        else:
            checks.append(fits(_LATENCY, found))
    return checks


def _wrong_file(what: str, found: str, lines: str) -> Check:
    cause = "the vehicle file is of another vehicle or out of date, or the GNSS drifts over the whole run"
    return Check(what, State.MISFIT, found, cause, "the vehicle file", lines)


def refuse_impossible(fit: Fit, place: str, config: IngestConfig) -> None:
    """One error for a run that cannot be as recorded, unless the configuration lets it pass."""
    found = fit.impossible
    if not found or config.plausibility == "warn":
        return
    raise InputError(
        "does not fit: " + "; ".join(check.sentence for check in found),
        place=place,
        expected="streams of one journey, in the units and times of the contract",
        remedy='To replay it all the same: [ingest] plausibility = "warn". ' + remedy_of(found),
    )


def remedy_of(checks: Sequence[Check]) -> str:
    """What mends all of these: advice, then for each file its lines, which can be appended as they are."""
    advice = list(dict.fromkeys(check.advice for check in checks if check.advice))
    return " ".join([*advice, *(f"In {into}: {inline(lines)}." for into, lines in lines_of(checks).items())])


def lines_of(checks: Sequence[Check]) -> dict[str, str]:
    """The lines that mend these, by the file they belong into."""
    files = dict.fromkeys(check.into for check in checks if check.lines)
    return {into: "\n".join(dict.fromkeys(one.lines for one in checks if one.into == into)) for into in files}
