"""Whose clock is wrong: lags of several recorders against the GNSS, and the lines that mend them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.read.ingest.timescale import leap_seconds
from pipeline.studies.plausibility.check import (
    IN_VEHICLE_FILE,
    VEHICLE_FILE,
    Cause,
    Check,
    FitState,
    correction,
    explain_lag,
    fits,
    misfit,
    not_checked,
)
from pipeline.studies.plausibility.pairs import SIGNIFICANT_SIGMAS
from pipeline.studies.plausibility.recording import Recording
from schemas.enums import MisfitCause, MisfitPlace
from schemas.frozen import frozen
from schemas.run import Stream

# Two lags so near to each other are of one clock.
_SAME_CLOCK_S = 1.5
# A clock with an old count of leap seconds (16 or 17 in place of 18, or none of the last three) is off by these; lags
# of reads and odometers are known to so much beyond their noise [s].
_LEAPS_S = (2, 3)
_WHOLE_NEAR_S = 0.3
_LEAP_NEAR_S = 0.12


@frozen
class StreamLag:
    """Of one stream against the GNSS [s]: its stamp of a moment minus the GNSS's; `reason`: why it is not known.

    `sure`: its noise is far below it, and no part of the run contradicts it.
    """

    stream: Stream
    lag_s: float = 0.0
    sigma_s: float = float("inf")
    sure: bool = False
    reason: str = ""

    @property
    def name(self) -> str:
        """The stream as people write it."""
        return self.stream.replace("_", " ")


def clock_checks(of: Recording, lags: list[StreamLag]) -> list[Check]:
    """One check per stream, of what is beyond the GNSS latency of the vehicle file. What two recorders say against the
    GNSS is the GNSS's own.
    """
    latency_s = of.vehicle.gnss_latency_s or 0.0
    lags = [replace(lag, lag_s=lag.lag_s + latency_s) for lag in lags]
    wrong = [lag for lag in lags if lag.sure and abs(lag.lag_s) > of.config.lag_limit_s]
    others = [lag for lag in lags if not lag.reason and abs(lag.lag_s) <= of.config.lag_limit_s]
    alike = all(abs(lag.lag_s - wrong[0].lag_s) < _SAME_CLOCK_S for lag in wrong)
    # One clock has one lag, and one line that mends it.
    of_gnss = min(wrong, key=lambda lag: lag.sigma_s) if len(wrong) >= 2 and alike and not others else None
    leap = _leap_of_gnss(of, lags)
    if leap is not None:
        return [_of_leap(of, lag, leap) if not lag.reason else _check(of, lag, None, known=True) for lag in lags]
    checks = [_check(of, lag, of_gnss, known=bool(others) or len(wrong) >= 2) for lag in lags]
    leaps = [0 if _is_own_clock(lag, lags) else leap_of(lag, of.epoch_ns) for lag in lags]
    checks = [_with_leap(check, leap_s) for check, leap_s in zip(checks, leaps, strict=True)]
    return [
        replace(check, in_time=None if lag.reason or abs(lag.lag_s) > _WHOLE_NEAR_S else lag.stream)
        for check, lag in zip(checks, lags, strict=True)
    ]


def _is_own_clock(lag: StreamLag, lags: Sequence[StreamLag]) -> bool:
    """The clock of an odometer alone is off where a recorder of places agrees with that of the positions."""
    places = [other for other in lags if other.stream != "odometer" and not other.reason]
    return lag.stream == "odometer" and any(abs(other.lag_s) <= _WHOLE_NEAR_S for other in places)


def _with_leap(check: Check, leap_s: int) -> Check:
    """A lag of whole seconds that nobody puts down to one of the clocks may be of leap seconds all the same."""
    if not leap_s or check.state is not FitState.MISFIT:
        return replace(check, leap_s=leap_s)
    return replace(check, leap_s=leap_s, found=f"{check.found}, as an old count of leap seconds would make them")


def leap_of(lag: StreamLag, t_ns: int) -> int:
    """The whole leap seconds that a sure lag is, 0 where it is none: positions late by chance are not, to a tenth.

    2 or 3 s of an old count, or all of GPS - UTC by one. Positions that are exactly so old look alike: nobody knows.
    One second is the age of positions as often.
    """
    whole = round(lag.lag_s)
    if lag.reason or not lag.sure or not whole:
        return 0
    leap_s = leap_seconds(t_ns)
    if leap_s - max(_LEAPS_S) <= abs(whole) <= leap_s and abs(lag.lag_s - whole) <= _WHOLE_NEAR_S:
        return whole
    old = abs(whole) in _LEAPS_S and abs(lag.lag_s - whole) <= _LEAP_NEAR_S
    return whole if old else 0


def _leap_of_gnss(of: Recording, lags: list[StreamLag]) -> int | None:
    """The whole seconds by which two recorders and more say that the clock of the GNSS is off; none where they do not.

    One second may be the age of positions. A misfit, not an impossibility: a slow fault of the GNSS can look like it.
    """
    known = [lag for lag in lags if not lag.reason]
    sure = [lag for lag in known if lag.sure]
    if len(known) < 2 or not sure:
        return None
    whole = round(sure[0].lag_s)
    exact = abs(sure[0].lag_s - whole) <= _LEAP_NEAR_S
    alike = exact and all(
        abs(lag.lag_s - whole) <= _WHOLE_NEAR_S + SIGNIFICANT_SIGMAS * min(lag.sigma_s, 0.1) for lag in known
    )
    return whole if alike and abs(whole) in _LEAPS_S else None


def _of_leap(of: Recording, lag: StreamLag, leap_s: int) -> Check:
    """The check of a stream that is off by the leap seconds."""
    later = "later" if lag.lag_s > 0 else "earlier"
    found = f"{lag.lag_s:+.2f} s, stamps of the {lag.name} are {later}"
    causes = (Cause(MisfitCause.LEAP_SECONDS, (f"{abs(leap_s)}",)), Cause(MisfitPlace.IN_STREAM, ("GNSS", lag.name)))
    what = f"clock of the {lag.name} against the GNSS"
    return Check(what, FitState.MISFIT, found, causes, _lines_of_gnss(of, float(leap_s)), leap_s=leap_s)


def _check(of: Recording, lag: StreamLag, of_gnss: StreamLag | None, known: bool) -> Check:
    """Whether the clock of a stream agrees with that of the GNSS."""
    config = of.config
    what = f"clock of the {lag.name} against the GNSS"
    size_s = abs(lag.lag_s)
    if lag.reason:
        return not_checked(what, lag.reason)
    if not lag.sure and size_s > max(config.reported_lag_s, SIGNIFICANT_SIGMAS * lag.sigma_s):
        return not_checked(what, f"{lag.lag_s:+.2f} s, but not in all of the run: a lag, a slip or a drift")
    if not lag.sure or size_s <= config.reported_lag_s:
        return fits(what, f"{lag.lag_s:+.2f} s")
    later = "later" if lag.lag_s > 0 else "earlier"
    found = f"{lag.lag_s:+.{1 if size_s > 5 else 2}f} s, stamps of the {lag.name} are {later}"
    if size_s > config.lag_limit_s:
        return _large(what, found, of, lag, of_gnss, known)
    return _small(what, found, lag, of.vehicle.gnss_latency_s)


def _large(what: str, found: str, of: Recording, lag: StreamLag, of_gnss: StreamLag | None, known: bool) -> Check:
    """A lag that no train can have; `known`: other recorders show whose it is."""
    clock = of_gnss or lag
    constant = Cause(MisfitCause.CONSTANT_LAG), round(clock.lag_s, 2)
    cause, exact_s = explain_lag(clock.lag_s, of.epoch_ns, min(3.0 * clock.sigma_s, 3.0)) or constant
    # GPS time is ahead of UTC, so where nobody else knows the stream with the later stamps holds it.
    leaps = abs(abs(lag.lag_s) - leap_seconds(of.epoch_ns)) < _SAME_CLOCK_S
    # A counter of weeks that begins anew shows an earlier date.
    weeks = cause.code is MisfitCause.GPS_WEEK and lag.lag_s > 0
    at_gnss = of_gnss is not None or (not known and ((leaps and lag.lag_s < 0) or weeks))
    pair = ("GNSS", lag.name) if at_gnss else (lag.name, "GNSS")
    whose = Cause(MisfitPlace.IN_STREAM if known else MisfitPlace.RATHER_IN_STREAM, pair)
    lines = correction(lag.stream, shift_s=-exact_s)
    if at_gnss:
        lines = _lines_of_gnss(of, exact_s)
    return Check(what, FitState.IMPOSSIBLE, found, (cause, whose), lines)


def _lines_of_gnss(of: Recording, shift_s: float) -> str:
    """What moves the stamps of the positions, and of their satellites."""
    streams = ("gnss",) if of.run.satellites is None else ("gnss", "satellites")
    only = of.solution if len(of.run.solutions()) > 1 else None
    return "".join(correction(stream, shift_s=shift_s, solution=only) for stream in streams)


def _small(what: str, found: str, lag: StreamLag, file_s: float | None) -> Check:
    """A lag that a train can have, and that costs availability all the same; `file_s`: latency of the vehicle file."""
    latency_s = round((file_s or 0.0) - lag.lag_s, 2)
    if lag.stream == "odometer" and latency_s >= 0.0:
        code = MisfitCause.LATENCY if file_s is None else MisfitCause.LATENCY_OF_FILE
        into = VEHICLE_FILE if file_s is None else IN_VEHICLE_FILE
        lines = f"gnss_latency_s = {latency_s}\ngnss_latency_sigma_s = {max(round(lag.sigma_s, 3), 0.02)}\n"
        return misfit(what, found, code, lines=lines, into=into)
    # Nobody should shift a recorder, least of all one that the judge believes, to where the positions want it.
    return misfit(
        what, found, MisfitCause.CONSTANT_LAG, advice="Find out which clock is wrong before one is corrected."
    )
