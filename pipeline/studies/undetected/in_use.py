"""The largest error of a fault still in use at each epoch, alarms or not: noticed is not stopped.

A fault that raises an alarm is negated, and returns where the re-link holds: GNSS minus odometer moved by no more than
its bound since the anchor. With the anchor's own error that bounds the error at the return, and while the position is
held to the anchor; from there on it grows by what the restarted bank lets pass, its averages within their thresholds:

    unnoticed            f(k) <= U(k)
    held to anchor A     f(k) <= U(A) + b(A, k) - (x(k) - x(A))          x: GNSS minus odometer as recorded
    after, since h       f(k) <= f(h) + sum over (h, k] of gain_s (y - u), |averages| <= thresholds

The anchor is the fix (a telegram; the first TVB is taken to be no worse than that), or after an outage beyond
`gap_reset_s` a TVB before it; which one, and when the alarm came, is open: the largest counts. Before anything was
validated there is no anchor: the LDS forgets a fault that is noticed there and initialises anew with it. So nothing is
bounded from a start of mission to the first fix after the first TVB.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.odometry.bound import RecoveryRule, is_lost
from pipeline.studies.undetected.watched import FaultWindow, Watched
from schemas.arrays import NS_PER_S, Bools, Floats, floats
from schemas.config import Configuration
from schemas.frozen import frozen

# The hold ends after the memory of the slowest average; growth counts from a row in its last tenth, where there is one.
_LAST_TENTH = 0.9


@frozen
class Returns:
    """What decides whether a negated position returns, at the rows of `Watched`.

    `offset_m`: GNSS minus odometer. The others as in the aligned epochs.
    """

    offset_m: Floats
    sigma_m: Floats
    travelled_m: Floats
    doubt_m: Floats
    scale_sigma: float

    @classmethod
    def of_epochs(cls, rows: Watched, epochs: pl.DataFrame, scale_sigma: float) -> Returns:
        """The rows of the aligned epochs of the solution; `scale_sigma`: of the vehicle file [1]."""
        path_m, odometer_m, sigma_m, travelled_m, doubt_m = (
            floats(epochs, name)[rows.epoch]
            for name in ("path_m", "odometer_m", "position_sigma_m", "travelled_m", "odometer_doubt_m")
        )
        return cls(path_m - odometer_m, sigma_m, travelled_m, doubt_m, scale_sigma)

    def some_rows(self, part: slice) -> Returns:
        """The returns at some of the rows."""
        return Returns(
            self.offset_m[part],
            self.sigma_m[part],
            self.travelled_m[part],
            self.doubt_m[part],
            self.scale_sigma,
        )


def in_use_errors(
    rows: Watched,
    windows: list[FaultWindow],
    unnoticed_m: Floats,
    validated: Bools,
    returns: Returns | None,
    config: Configuration,
) -> Floats:
    """The largest error along growing path and against it [m], shape (2, rows); NaN where nothing bounds it.

    `unnoticed_m`: the same of errors that no monitor noticed; `validated`: TVBs. Without `returns` no alarm is ever
    taken back once a position was validated.
    """
    errors = np.full_like(unnoticed_m, np.nan)
    for window in windows:
        part = slice(window.start, window.end + 1)
        grown = slice(window.start + 1, window.end + 1)
        if not validated[_before_mission_fix(rows, window, config) & (np.arange(rows.count) < window.start)].any():
            continue
        if returns is None:
            errors[:, grown] = unnoticed_m[:, grown]
            continue
        within = rows.rows_between(part.start, part.stop)
        for side, sign, travel in ((0, 1.0, within), (1, -1.0, within.in_other_direction())):
            largest_m = np.concatenate([[0.0], unnoticed_m[side, grown]])
            found = _InUseWindow(travel, returns.some_rows(part), validated[part], sign, config)
            errors[side, grown] = found.largest_errors_m(largest_m)[1:]
    return errors


def _before_mission_fix(rows: Watched, window: FaultWindow, config: Configuration) -> Bools:
    """The rows since the last start of mission up to the fix of a window: what was validated before is forgotten."""
    missions_ns = [round(start.timestamp() * NS_PER_S) for start in config.lds.starts_of_mission]
    since_s = [window.since_s - (window.since_ns - t_ns) / NS_PER_S for t_ns in missions_ns if t_ns <= window.since_ns]
    return rows.t_s >= max(since_s, default=-np.inf)


@frozen
class _InUseWindow:
    """One window, which begins with a fix, in one direction."""

    watched: Watched
    returns: Returns
    validated: Bools
    sign: float
    config: Configuration

    def largest_errors_m(self, unnoticed_m: Floats) -> Floats:
        """The largest error at each row; NaN once the distance was lost."""
        held_m = self._held_errors_m(unnoticed_m, 0.0)
        hold_s = _LAST_TENTH / min(self.config.monitors.ewma_alphas)
        if "link_distance" in self.config.monitors.disabled:
            hold_s = 0.0
        ended_m = self._held_errors_m(unnoticed_m, hold_s)
        most_m = np.maximum(unnoticed_m, np.maximum(held_m, self._errors_after_hold_m(ended_m)))
        unknown = is_lost(self.returns.doubt_m - self.returns.doubt_m[0])
        return np.where(unknown | np.isinf(most_m), np.nan, most_m)

    def _held_errors_m(self, unnoticed_m: Floats, since_s: float) -> Floats:
        """The largest error at each row while it is held to an anchor, for so long since its return."""
        reach_m = unnoticed_m + self.sign * self.returns.offset_m + self.watched.learned_late_m
        anchors_m = self._largest_anchors_m(reach_m, since_s)
        held_m: Floats = (
            anchors_m + self._relink_bounds_m() - self.sign * self.returns.offset_m + self.watched.learned_late_m
        )
        return held_m

    def _largest_anchors_m(self, reach_m: Floats, since_s: float) -> Floats:
        """The largest U(A) + x(A) of these anchors at each row."""
        t_s = self.watched.t_s
        of_tvb = np.where(self.validated, reach_m, -np.inf)
        old = np.searchsorted(t_s, t_s - self.config.align.gap_reset_s - since_s, side="right") - 1
        before_m = np.where(old >= 0, np.fmax.accumulate(of_tvb)[old], -np.inf)
        # The position's own error at the fix is not known.
        read_m = self.config.hazards.balise_read_sigma_m
        spread_m = self.config.monitors.threshold_factor * float(np.hypot(self.returns.sigma_m[0], read_m))
        fix_m = float(reach_m[0]) + spread_m
        delay_s = self.config.lds.recovery_s + since_s
        return np.maximum(before_m, np.where(t_s - t_s[0] >= delay_s, fix_m, -np.inf))

    def _relink_bounds_m(self) -> Floats:
        """The widest bound of a re-link at each row: with the anchor at the first row, and the largest sigma since."""
        returns = self.returns
        rule = RecoveryRule(self.config)
        sigma_m2 = np.fmax.accumulate(returns.sigma_m) ** 2 + returns.sigma_m**2
        waited_s = np.maximum(self.watched.t_s - self.watched.t_s[0], 0.0)
        driven_m = returns.travelled_m - returns.travelled_m[0]
        bound_m = rule.bound_m(rule.variance_m2(sigma_m2, waited_s, driven_m, returns.scale_sigma))
        doubt_m = np.maximum(returns.doubt_m - returns.doubt_m[0], 0.0)
        widest_m: Floats = np.minimum(self.config.hazards.limits.relink_m, bound_m + doubt_m)
        return widest_m

    def _errors_after_hold_m(self, ended_m: Floats) -> Floats:
        """The error at each row after a hold that ended at some row before with at most `ended_m`."""
        averages = range(self.watched.weight.shape[1])
        least: Floats = np.min(
            [self._growth_by_average_m(ended_m, average) for average in averages], axis=0, initial=np.inf
        )
        return least

    def _growth_by_average_m(self, ended_m: Floats, average: int) -> Floats:
        """Growth by one average alone: gain_s y = gain_s / w (A_i - (1 - w) A_(i-1)), and each |A| within its
        threshold.
        """
        watched = self.watched
        led = ~watched.fresh
        # A restarted average is zero.
        threshold = np.where(led, watched.threshold_mps[:, average], 0.0)
        known = np.isfinite(threshold)
        threshold = np.where(known, threshold, 0.0)
        part = np.where(led, watched.gain_s / watched.weight[:, average], 0.0)
        carried = np.append((part * (1.0 - watched.weight[:, average]))[1:], 0.0)
        inner_m = np.cumsum(np.abs(part - carried) * threshold)
        unobserved_m = np.cumsum(np.where(led, watched.learned_m, watched.fastest_m))
        recorded_m = np.cumsum(np.where(led, watched.gain_s * watched.rate_mps, 0.0))
        at_row = np.concatenate([[0.0], inner_m[:-1]]) + part * threshold + unobserved_m - recorded_m
        from_row = ended_m + carried * threshold - inner_m - unobserved_m + recorded_m
        grown = at_row + np.concatenate([[-np.inf], np.fmax.accumulate(from_row)[:-1]])
        # Where a threshold is not known any more, neither is this bound.
        lost = np.logical_or.accumulate(~known & np.isfinite(np.fmax.accumulate(ended_m)))
        largest: Floats = np.where(lost, np.inf, grown)
        return largest
