"""The epochs of a solution as the bank along the track watched them: what a fault could do there, and what not.

A fault f(t) is added to the position along growing path. From row to row the bank sees its change as a rate, on top of
the rate u that was recorded; y = u + g df/dt is what it would have observed. Its averages are linear in y, so every
threshold is a linear bound on y, and the fault is what y gathers beyond u. It began after the last independent fix.
"""

from __future__ import annotations

from dataclasses import fields, replace
from datetime import datetime
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.lds.link_monitors import Held
from pipeline.stages.monitors.axis import ewma_weight
from pipeline.stages.monitors.bank import AxisBank
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration, UndetectedConfig, Vehicle
from schemas.frozen import frozen
from schemas.run import RunLog
from schemas.stages import Crossings

NO_ROW = -1
_CURVE_COLUMNS = ("curvature_per_m", "cross_track_m")
_RELINKED = ("anchor", "low_m", "high_m", "held_low_m", "held_high_m", "free")


@frozen
class Watched:
    """One row per epoch that the bank used while the position was not negated, in order; all of the same length m.

    `epoch`: row among all epochs; `t_s`: seconds after the first epoch. `fastest_m`: by how much a fault may have
    changed since the row before, at its largest rate. `fresh`: nothing led here, so it may have done so unobserved.
    `free`: the averages are not known here, only that they were within their thresholds.
    `gain_s`: metres of fault per m/s that the bank sees over the increment (its time over g of the curve).
    `rate_mps`: u. `least_mps`, `most_mps`: bounds of y by the raw monitor and the largest rate of a fault.
    `weight`, `average_mps`, `threshold_mps` (m, averages): alpha(dt), what each average was, and its threshold.
    `low_m`, `high_m`: bounds of the fault itself by monitors without memory. `anchor`: row that a re-link held this one
    against, -1 where none, and `held_low_m`, `held_high_m`: the bounds of the difference. `learned_m`: by how much a
    learned scale can hide the fault on the way to this row (a sum), `learned_late_m`: a learned latency at this row.
    """

    epoch: Ints
    t_s: Floats
    fresh: Bools
    free: Bools
    fastest_m: Floats
    gain_s: Floats
    rate_mps: Floats
    least_mps: Floats
    most_mps: Floats
    weight: Floats
    average_mps: Floats
    threshold_mps: Floats
    low_m: Floats
    high_m: Floats
    anchor: Ints
    held_low_m: Floats
    held_high_m: Floats
    learned_m: Floats
    learned_late_m: Floats

    @property
    def count(self) -> int:
        """How many rows."""
        return self.epoch.size

    def in_other_direction(self) -> Watched:
        """What bounds errors in the other direction: what bounds them behind bounds these ahead."""
        return replace(
            self,
            rate_mps=-self.rate_mps,
            least_mps=-self.most_mps,
            most_mps=-self.least_mps,
            average_mps=-self.average_mps,
            low_m=-self.high_m,
            high_m=-self.low_m,
            held_low_m=-self.held_high_m,
            held_high_m=-self.held_low_m,
        )

    @property
    def longest_stretch(self) -> tuple[int, int]:
        """First and last row of the longest stretch that the bank saw."""
        edges = np.append(np.flatnonzero(self.fresh | (np.arange(self.count) == 0)), self.count)
        which = int(np.argmax(np.diff(edges)))
        return int(edges[which]), int(edges[which + 1]) - 1

    def rows_between(self, low: int, high: int) -> Watched:
        """Rows [low, high); anchors before them are lost."""
        part = {item.name: getattr(self, item.name)[low:high] for item in fields(self)}
        part["anchor"] = np.where(part["anchor"] >= low, part["anchor"] - low, NO_ROW)
        return Watched(**part)

    def after_fix(self, start: int, end: int, fix_s: float = -np.inf) -> Watched:
        """The rows from `start` to `end` for a fault that began after `fix_s`, an instant before the second of them.

        Of the first increment only the time after `fix_s` has a fault: |y - u| <= df / gain with that share of df.
        """
        window = self.rows_between(start, end + 1)
        if window.count < 2 or fix_s <= window.t_s[0]:
            return window
        fastest = window.fastest_m.copy()
        least = window.least_mps.copy()
        most = window.most_mps.copy()
        share_after_fix = (window.t_s[1] - fix_s) / (window.t_s[1] - window.t_s[0])
        fastest[1] *= share_after_fix
        change_mps = fastest[1] / window.gain_s[1]
        least[1] = max(least[1], window.rate_mps[1] - change_mps)
        most[1] = min(most[1], window.rate_mps[1] + change_mps)
        return replace(window, fastest_m=fastest, least_mps=least, most_mps=most)


def watch_rows(
    epochs: pl.DataFrame, bank: AxisBank, held: tuple[Held, ...], vehicle: Vehicle, config: Configuration
) -> Watched:
    """What the bank watched of a solution; `epochs`: aligned, with `negated`; `held`: the re-links that held.

    Rows under negation are left out: nobody uses the position there, and alarms add nothing. The row at which it
    returns is fresh.
    """
    series = bank.series
    kept = np.flatnonzero(~flags(epochs, "negated")[series.epoch])
    epoch = series.epoch[kept]
    t_ns = times_ns(epochs)
    t_s = (t_ns[epoch] - t_ns[0]) * 1e-9
    fresh = series.fresh[kept] | (np.diff(kept, prepend=-1) != 1)
    fastest_m = config.undetected.max_rate_mps * np.diff(t_s, prepend=t_s[:1])
    gain_s = series.dt_s[kept] / _least_share_observed(epochs, epoch, config.undetected.hidden_share)
    rate = series.rate_mps[kept]
    threshold = _thresholds(bank, epoch, config.undetected.max_rate_mps)
    alphas = np.array(config.monitors.ewma_alphas)[bank.enabled[1:]]
    learned_m, learned_late_m = _hidden_by_learning(epochs, epoch, vehicle, config)
    endless = np.full(epoch.size, np.inf)
    rows = Watched(
        epoch=epoch,
        t_s=t_s,
        fresh=fresh,
        free=np.zeros(epoch.size, dtype=np.bool_),
        fastest_m=fastest_m,
        gain_s=gain_s,
        rate_mps=rate,
        least_mps=np.maximum(-threshold[:, 0], rate - fastest_m / gain_s),
        most_mps=np.minimum(threshold[:, 0], rate + fastest_m / gain_s),
        weight=np.ascontiguousarray(ewma_weight(alphas, series.dt_s[kept])),
        average_mps=np.where(fresh[:, None], 0.0, bank.value[epoch][:, 1:][:, bank.enabled[1:]]),
        threshold_mps=threshold[:, 1:][:, bank.enabled[1:]],
        low_m=-endless,
        high_m=endless,
        anchor=np.full(epoch.size, NO_ROW),
        held_low_m=-endless,
        held_high_m=endless,
        learned_m=learned_m,
        learned_late_m=learned_late_m,
    )
    return _with_relinks(rows, held)


def _thresholds(bank: AxisBank, epoch: Ints, fastest_mps: float) -> Floats:
    """Thresholds of raw and averages [m/s] as they were; infinite where there is nothing to compare.

    While the noise is not known, or too large, there is a value and no threshold: what the fastest fault can make of it
    then passes.
    """
    threshold = np.where(np.isfinite(bank.threshold), bank.threshold, np.abs(bank.value) + fastest_mps)[epoch]
    return np.nan_to_num(threshold, nan=np.inf, posinf=np.inf, neginf=np.inf)


def _least_share_observed(epochs: pl.DataFrame, epoch: Ints, most: float) -> float:
    """How much of a fault the increments show, at least; one on straight track.

    `along_m` leaves out what a curve adds to the movement of a position y off the track
    (`alignment.align.curve_corrected_path_m`). A fault carries the position to where the track lies otherwise, and so
    hides y times the turn in between: at most y times the sharpest curvature times the fault.
    """
    curvature, offset = (np.abs(np.nan_to_num(floats(epochs, name)[epoch])) for name in _CURVE_COLUMNS)
    return 1.0 - min(float(curvature.max(initial=0.0) * offset.max(initial=0.0)), most)


def _hidden_by_learning(
    epochs: pl.DataFrame, epoch: Ints, vehicle: Vehicle, config: Configuration
) -> tuple[Floats, Floats]:
    """How much of a fault a learned scale hides on the way to each row, and a learned latency at it [m].

    Both learn from the positions that the fault moves. They are taken to stay within the threshold factor times their
    prior deviation, whatever the fault; nothing holds them there.
    """
    factor = config.monitors.threshold_factor
    scale = late_s = np.zeros(epoch.size)
    if vehicle.odometer_scale is None:
        scale = factor * config.align.scale_prior_sigma + np.abs(floats(epochs, "odometer_scale")[epoch] - 1.0)
    if vehicle.gnss_latency_s is None:
        late_s = factor * config.align.latency_prior_sigma_s + np.abs(floats(epochs, "latency_s")[epoch])
    odometer_m = floats(epochs, "odometer_m")[epoch]
    speed_mps = np.abs(floats(epochs, "speed_mps")[epoch])
    return scale * np.abs(np.diff(odometer_m, prepend=odometer_m[:1])), late_s * speed_mps


def _with_relinks(rows: Watched, held: tuple[Held, ...]) -> Watched:
    """Re-links that held: fault here minus fault at the anchor (none at a telegram) within the bound as recorded."""
    bounds = {name: getattr(rows, name).copy() for name in _RELINKED}
    for relink in held:
        row = int(np.searchsorted(rows.epoch, relink.epoch))
        if row >= rows.count or rows.epoch[row] != relink.epoch:
            continue
        room_m = relink.bound_m + rows.learned_late_m[row]
        if relink.anchor_epoch is None:
            bounds["low_m"][row] = max(bounds["low_m"][row], -relink.moved_m - room_m)
            bounds["high_m"][row] = min(bounds["high_m"][row], room_m - relink.moved_m)
        else:
            anchor = int(np.searchsorted(rows.epoch, relink.anchor_epoch))
            room_m += rows.learned_late_m[anchor]
            bounds["anchor"][row] = anchor
            bounds["held_low_m"][row] = -relink.moved_m - room_m
            bounds["held_high_m"][row] = room_m - relink.moved_m
        bounds["free"][row] = not rows.fresh[row]
    return replace(rows, **bounds)


def fixes_ns(run: RunLog, crossings: Crossings, missions: tuple[datetime, ...], config: UndetectedConfig) -> Ints:
    """Instants at which something else than GNSS said where the train was, in order [ns].

    Physical balises read on the path, the reference by configuration, and configured starts of mission. The run's
    first row is a start of mission in any case.
    """
    times: list[Ints] = [np.array([round(t.timestamp() * 1e9) for t in missions], dtype=np.int64)]
    if "read" in config.fixes:
        times.append(crossings.t_ns[~crossings.virtual])
    if "reference" in config.fixes and run.reference is not None:
        times.append(times_ns(run.reference))
    return np.unique(np.concatenate(times))


class FaultWindow(NamedTuple):
    """Rows over which a fault may grow: none at `start`, the last row at or before the fix, and free up to `end`.

    `since_ns`: the fix, or the first row where the run begins without one; `since_s`: seconds after the first epoch.
    """

    start: int
    end: int
    since_ns: int
    since_s: float


def windows_between_fixes(rows: Watched, t_ns: Ints, fixes: Ints) -> list[FaultWindow]:
    """The windows of a run, in order; `t_ns`: stamps of all epochs."""
    if not rows.count:
        return []
    stamps = t_ns[rows.epoch]
    last = np.searchsorted(stamps, fixes, side="right") - 1
    # Of several fixes between two rows the last one counts.
    began = {0: int(stamps[0])} | dict(zip(last[last >= 0].tolist(), fixes[last >= 0].tolist(), strict=True))
    ends = [*sorted(began)[1:], rows.count - 1]
    return [
        FaultWindow(start, end, began[start], (began[start] - int(t_ns[0])) / NS_PER_S)
        for start, end in zip(sorted(began), ends, strict=True)
        if end > start
    ]
