"""What is at fault: the position, the odometer, the map or the track (DOMAIN section 5, Suspect)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns, truths
from schemas.config import Configuration
from schemas.enums import Evidence, Suspect, Verdict

# How far back an alarm's cause may lie: a raw monitor answers at once, the slowest EWMA after minutes.
_LOOKBACKS_S = (1.0, 30.0, 300.0)
# What an alarm is about shows when it comes; a long one sees other things too.
_COMING_S = 30.0
# Longest step between epochs over which the mean of two velocities stands for the way.
_JOINED_S = 2.0
_ACROSS = ("cross_", "up_")
# A reference is steadier than this over the seconds before an alarm, a map need not be.
_MAP_ERROR_M = 0.5


@dataclass(frozen=True)
class Witnesses:
    """Per epoch, all epochs: truth, position, odometer and GNSS velocity, NaN where not known.

    `tolerated_m`: errors along the track below this are a healthy position's, max(5 m, 3 sigma) (DOMAIN section 5);
    `healthy_m`: the part of it that does not depend on sigma; beyond `failure_limit_m` a position is wrong; `slip_m`:
    size of what two reads around say that the odometer counted wrong; `void`: the evidence is an odometer that lost way
    or may have lost it.
    """

    t_ns: Ints
    path_m: Floats
    error_m: Floats
    noise_m: Floats
    tolerated_m: Floats
    bound_m: Floats
    slip_m: Floats
    error_cross_m: Floats
    noise_cross_m: Floats
    error_up_m: Floats
    noise_up_m: Floats
    truth_m: Floats
    truth_cross_m: Floats
    truth_up_m: Floats
    truth_sigma_m: Floats
    odometer_m: Floats
    stretch: Ints
    scale_sigma: Floats
    white_m2_per_s: Floats
    reading_m2: Floats
    velocity_mps: Floats
    by_reference: Bools
    by_odometer: Bools
    void: Bools
    doubtful_track: Bools
    healthy_m: float
    failure_limit_m: float

    def epoch_before(self, epoch: int, lookback_s: float) -> int:
        """The first epoch no more than this time before another."""
        return int(np.searchsorted(self.t_ns, self.t_ns[epoch] - round(lookback_s * NS_PER_S)))


def witnesses_of(
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    errors: dict[str, Floats],
    config: Configuration,
    void: Bools | None = None,
) -> Witnesses:
    """Everything that can speak for or against the position."""
    truth_sigma = floats(truth, "truth_sigma_m")
    gate = floats(epochs, "gate_probability")
    has_path = np.isfinite(floats(epochs, "path_m"))
    off_track = flags(epochs, "fix_valid") & ~flags(epochs, "on_track") & has_path
    noise_m = 3.0 * np.hypot(floats(epochs, "sigma_along_m"), truth_sigma)
    return Witnesses(
        t_ns=times_ns(epochs),
        path_m=np.where(flags(epochs, "fix_valid"), floats(epochs, "path_m"), np.nan),
        error_m=errors["along"],
        noise_m=noise_m,
        tolerated_m=np.fmax(config.hazards.false_alarm_margin_m, noise_m),
        bound_m=floats(truth, "truth_bound_m"),
        slip_m=np.abs(floats(truth, "truth_slip_m")),
        error_cross_m=errors["cross"],
        noise_cross_m=3.0 * np.hypot(floats(epochs, "sigma_cross_m"), truth_sigma),
        error_up_m=errors["up"],
        noise_up_m=3.0 * np.hypot(floats(epochs, "sigma_up_m"), truth_sigma),
        truth_m=floats(truth, "truth_path_m"),
        truth_cross_m=floats(truth, "truth_cross_m"),
        truth_up_m=floats(truth, "truth_up_m"),
        truth_sigma_m=np.nan_to_num(truth_sigma),
        odometer_m=floats(epochs, "odometer_m"),
        stretch=ints(epochs["odometer_segment"]),
        scale_sigma=np.nan_to_num(floats(epochs, "scale_sigma")),
        white_m2_per_s=np.nan_to_num(floats(epochs, "odometer_white_m2_per_s")),
        reading_m2=np.nan_to_num(floats(epochs, "odometer_rows_m")) ** 2,
        velocity_mps=floats(epochs, "velocity_along_mps"),
        by_reference=truths(truth["evidence"] == Evidence.REFERENCE.value),
        by_odometer=truths(truth["evidence"] == Evidence.ODOMETER.value),
        void=np.zeros(epochs.height, dtype=np.bool_) if void is None else void,
        doubtful_track=(gate < config.matching.ambiguity_probability) | off_track,
        healthy_m=config.hazards.false_alarm_margin_m,
        failure_limit_m=config.hazards.failure_limit_m,
    )


def suspect_of_alarm(w: Witnesses, first: int, last: int, monitors: tuple[str, ...], verdict: Verdict) -> Suspect:
    """Who caused the alarm over epochs `first..last`, in the order in which the evidence speaks."""
    across = all(name.startswith(_ACROSS) for name in monitors)
    if verdict is Verdict.TRUE:
        # The position was wrong at some other time; whoever left the truth when the alarm came made it.
        came = min(int(np.searchsorted(w.t_ns, w.t_ns[first] + round(_COMING_S * NS_PER_S))), last)
        healthy = by_reference_healthy(w, first, came) or doppler_vote(w, first, came) is Suspect.ODOMETER
        if not across and healthy and odometer_left_truth(w, first, came):
            return Suspect.ODOMETER
        return suspect_of_error(w, first, last, monitors)
    # What fails across the track or in height has not looked at the odometer.
    vote = None if across else doppler_vote(w, first, last)
    if not across and (odometer_left_truth(w, first, last) or vote is Suspect.ODOMETER):
        return Suspect.ODOMETER
    if vote is Suspect.GNSS and verdict is Verdict.UNKNOWN:
        return Suspect.GNSS
    if w.doubtful_track[first : last + 1].any():
        return Suspect.TRACK
    cross = "cross_", w.error_cross_m, w.noise_cross_m
    up = "up_", w.error_up_m, w.noise_up_m
    for axis, error, noise in (cross, up):
        if any(name.startswith(axis) for name in monitors) and _beyond(error, noise, first, last):
            return Suspect.GNSS
    return Suspect.MAP if across and reference_left_map(w, first, last, monitors) else Suspect.UNKNOWN


def reference_left_map(w: Witnesses, first: int, last: int, monitors: tuple[str, ...]) -> bool:
    """The reference itself moved against the map around an alarm across the track: one run is then enough.

    Else a map error shows over several runs only (`map_errors`): one alarm may be chance.
    """
    for axis, place in (("cross_", w.truth_cross_m), ("up_", w.truth_up_m)):
        if not any(name.startswith(axis) for name in monitors):
            continue
        for lookback_s in _LOOKBACKS_S[:2]:
            begin = w.epoch_before(first, lookback_s)
            moved = place[begin : last + 1]
            moved = moved[np.isfinite(moved)]
            if moved.size > 1 and float(np.ptp(moved)) > max(_MAP_ERROR_M, 6.0 * float(w.truth_sigma_m[first])):
                return True
    return False


def suspect_of_error(w: Witnesses, first: int, last: int, monitors: tuple[str, ...] = ()) -> Suspect:
    """Who is behind a difference between position and truth over epochs `first..last`.

    Against a reference it is the position. Where the odometer carries the truth, the Doppler velocity
    decides between the two; without it monitors across the track speak against the position.
    """
    part = slice(first, last + 1)
    known = np.isfinite(w.error_m[part])
    if known.any() and w.by_reference[part][known].all():
        return Suspect.GNSS
    sides = doppler_vote(w, first, last)
    if sides is not None:
        return sides
    if w.doubtful_track[part].any():
        return Suspect.TRACK
    return Suspect.GNSS if any(name.startswith(_ACROSS) for name in monitors) else Suspect.UNKNOWN


def by_reference_healthy(w: Witnesses, first: int, last: int) -> bool:
    """The reference has the position's error along the track within what is tolerated over epochs `first..last`."""
    part = slice(first, last + 1)
    known = np.isfinite(w.error_m[part]) & w.by_reference[part]
    within: Bools = np.abs(w.error_m[part][known]) < w.tolerated_m[part][known]
    return bool(known.any() and within.all())


def odometer_left_truth(w: Witnesses, first: int, last: int) -> bool:
    """Odometer minus truth moved by more than 3 of its sigma around the alarm (needs the reference)."""
    for lookback_s in _LOOKBACKS_S:
        begin = w.epoch_before(first, lookback_s)
        rows = np.arange(begin, last + 1)
        rows = rows[w.by_reference[rows] & np.isfinite(w.odometer_m[rows]) & (w.stretch[rows] == w.stretch[first])]
        if rows.size < 2:
            continue
        drift = (w.odometer_m[rows] - w.truth_m[rows]) - (w.odometer_m[rows[0]] - w.truth_m[rows[0]])
        variance = _odometer_variance(w, rows) + 2.0 * _truth_variance(w, rows)
        if (np.abs(drift) > 3.0 * np.sqrt(variance))[1:].any():
            return True
    return False


def _odometer_variance(w: Witnesses, rows: Ints) -> Floats:
    """Variance of the odometer's distance from the first of the rows on [m2]."""
    elapsed_s = (w.t_ns[rows] - w.t_ns[rows[0]]) / NS_PER_S
    moved = w.odometer_m[rows] - w.odometer_m[rows[0]]
    readings_m2 = w.reading_m2[rows] + w.reading_m2[rows[0]]
    variance: Floats = w.white_m2_per_s[rows] * elapsed_s + (w.scale_sigma[rows] * moved) ** 2 + readings_m2
    return variance


def _truth_variance(w: Witnesses, rows: Ints) -> float:
    """Noise of the reference between epochs, from its own second differences [m2]: its stated sigma
    also holds what is constant over an alarm.
    """
    if rows.size < 4:
        return 0.0
    rough = np.diff(w.truth_m[rows], 2)
    return float((1.4826 * np.median(np.abs(rough - np.median(rough)))) ** 2 / 6.0)


def doppler_vote(w: Witnesses, first: int, last: int) -> Suspect | None:
    """Position, Doppler velocity and odometer over the alarm: the one that stands against the other two.

    None where one of them is missing or no two of them part by more than their noise.
    """
    for lookback_s in _LOOKBACKS_S:
        begin = w.epoch_before(first, lookback_s)
        rows = np.arange(begin, last + 1)
        known = np.isfinite(w.path_m[rows]) & np.isfinite(w.velocity_mps[rows]) & np.isfinite(w.odometer_m[rows])
        rows = rows[known & (w.stretch[rows] == w.stretch[first])]
        vote = _vote(w, rows) if rows.size > 1 else None
        if vote is not None:
            return vote
    return None


def _vote(w: Witnesses, rows: Ints) -> Suspect | None:
    """The epoch of the largest difference between position and odometer decides.

    A position that left Doppler's way before it by as much was not with Doppler: the velocity along a track that heads
    elsewhere comes by any sum (see `slip`).
    """
    dt_s = np.diff(w.t_ns[rows]) / NS_PER_S
    velocity = w.velocity_mps[rows]
    by_doppler = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * dt_s)))
    by_position = w.path_m[rows] - w.path_m[rows[0]]
    by_odometer = w.odometer_m[rows] - w.odometer_m[rows[0]]
    at = int(np.argmax(np.abs(by_position - by_odometer)))
    noise_m = float(np.nan_to_num(w.noise_m[rows[at]], nan=0.0))
    odometer_m = 3.0 * float(np.sqrt(_odometer_variance(w, rows)[at]))
    apart = abs(by_position[at] - by_odometer[at])
    if apart <= noise_m + odometer_m:
        return None
    to_position, to_odometer = abs(by_doppler[at] - by_position[at]), abs(by_doppler[at] - by_odometer[at])
    if to_position < 0.5 * apart and to_odometer > to_position:
        strayed_m = float(np.ptp((by_position - by_doppler)[: at + 1]))
        return Suspect.ODOMETER if strayed_m <= max(w.healthy_m, 0.5 * apart) else Suspect.GNSS
    return Suspect.GNSS if to_odometer < 0.5 * apart else None


def left_doppler(w: Witnesses, first: int, last: int) -> bool:
    """The position left Doppler's way by more than the failure limit over epochs `first..last` or just before them.

    Then it was wrong, whatever the odometer did. What a gap of the position or of Doppler hides counts for nothing.
    """
    rows = np.arange(w.epoch_before(first, _LOOKBACKS_S[1]), last + 1)
    rows = rows[np.isfinite(w.path_m[rows]) & np.isfinite(w.velocity_mps[rows])]
    dt_s, velocity = np.diff(w.t_ns[rows]) / NS_PER_S, w.velocity_mps[rows]
    apart = np.diff(w.path_m[rows]) - 0.5 * (velocity[1:] + velocity[:-1]) * dt_s
    strayed = np.concatenate(([0.0], np.cumsum(np.where(dt_s <= _JOINED_S, apart, 0.0))))
    return float(np.ptp(strayed)) > w.failure_limit_m


def _beyond(error: Floats, noise: Floats, first: int, last: int) -> bool:
    part = slice(first, last + 1)
    with np.errstate(invalid="ignore"):
        return bool((np.abs(error[part]) > noise[part]).any())
