"""The bank of monitors with memory, as the LDS asks it: what each says of an epoch, from the last restart on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import (
    DISABLED,
    FAIL,
    NOT_EVALUATED,
    NUMBER,
    PASS,
    Verdicts,
    fill_reasons,
    first_reason,
    no_verdicts,
    states_of,
    verdicts,
)
from pipeline.stages.monitors.axes import Axis, axes_of
from pipeline.stages.monitors.axis import BLOCK, FIRST_BLOCK, AxisSeries, AxisState, run_axis
from pipeline.stages.monitors.noise import OF_WALK, OF_WHITE_NOISE
from schemas.arrays import Bools, Floats, Ints, rows_of
from schemas.config import Configuration
from schemas.enums import NotEvaluated
from schemas.monitors import SCALES
from schemas.stages import AlignedEpochs

FIRST_EPOCH = NotEvaluated.FIRST_EPOCH


NOISE_UNKNOWN = NotEvaluated.NOISE_UNKNOWN
NOISE_TOO_LARGE = NotEvaluated.NOISE_TOO_LARGE
WHITE_PART = float(np.sqrt(OF_WALK / OF_WHITE_NOISE))
"""White noise over what is measured, which is taken for a random walk."""


class AxisBank:
    """One axis of the bank over all epochs of a solution; rows are evaluated up to `_done`.

    `series`: its increments, `fresh` where a restart was too. `value`, `threshold`, `noise_m` (fast noise in the
    thresholds): per epoch and monitor (raw, then the EWMAs), NaN where there is none. `noise_known`: no failure can
    hide in it; true where the axis has no row. `enabled`: which of the monitors are. `blind`: why none of them can say
    that all is well, None where they can.

    Rows are evaluated in blocks ahead of the LDS, which then may take back what lies ahead. An example, with a row at
    each epoch:

    1. Asked for epoch 0, the axis evaluates rows 0 to 8191, and its noise is known at row 5000.
    2. A monitor fails there and the LDS negates: `freeze(5000)`. Rows from 5000 on are under alarm and no longer enter
       the noise, so the thresholds behind 5000, made with them, are void. The state of the recursions is kept at the
       begin of a block alone, here row 0: evaluated anew are 0 to 2047 and 2048 to 6143, as far as the LDS asks. Rows
       before 5000 come out as they were.
    3. The position returns: `restart(5300)`. Row 5300 becomes `fresh`, and 5300 to 7347 are evaluated without what the
       averages held before it. What stands at 5299 and before stays. The noise keeps its samples of before 5000, and
       those whose three rows lie at 5300 or behind it count again.
    """

    def __init__(self, axis: Axis, epochs: int, config: Configuration, blind: NotEvaluated | None = None) -> None:
        self.axis = axis
        self._blind = blind
        self.series = axis.series
        self._config = config
        self._alphas = np.array(config.monitors.ewma_alphas)
        self.enabled = np.array([f"{axis.name}_{scale}" not in config.monitors.disabled for scale in SCALES])
        shape = epochs, len(SCALES)
        self.value = np.full(shape, np.nan, order="F")
        self.threshold = np.full(shape, np.nan, order="F")
        self.noise_m = np.full(shape, np.nan, order="F")
        self.state = np.full(shape, NOT_EVALUATED, dtype=np.int8, order="F")
        self.window_begins = np.zeros(epochs, dtype=np.bool_)
        # Rows of the odometer scatter by nobody knows how much yet.
        self.noise_known: Bools = axis.reasons != NUMBER[NOISE_UNKNOWN]
        given_m: tuple[float, ...] | None = getattr(config.monitors, f"noise_{axis.name}_m")
        self._meter = axis.noise_meter(given_m)
        self._begin_at(0, None, BLOCK)

    def _begin_at(self, row: int, state: AxisState | None, block: int) -> None:
        """Evaluate from this row on, at first so many at once; state None: a restart."""
        self._done = row
        self._state = state
        self._block = block
        self._last_block = row, state

    def advance(self, epoch: int) -> int:
        """Evaluate up to this epoch; returns the last one that is evaluated now."""
        rows = self.series.epoch
        while self._done < rows.size and rows[self._done] <= epoch:
            end = min(self._done + self._block, rows.size)
            self._last_block = self._done, self._state
            part = self.series.rows_between(self._done, end)
            noise_m2 = self._meter.variance_m2(self._done, end)
            value, sigma, self._state = run_axis(part, self._alphas, self._state, noise_m2)
            self._store(part, value, self._config.monitors.threshold_factor * sigma, np.sqrt(noise_m2))
            self._done, self._block = end, min(2 * self._block, BLOCK)
        return int(rows[self._done]) - 1 if self._done < rows.size else self.value.shape[0] - 1

    def _store(self, part: AxisSeries, value: Floats, threshold: Floats, noise_m: Floats) -> None:
        """Write what was evaluated of some rows into the arrays by epoch."""
        present = (self.enabled[:, None] & ~part.fresh).T
        # One noise too large, and the axis has a blind spot: none of its monitors says that all is well.
        known: Bools = np.all((noise_m <= self._config.noise_limit_m) | ~self.enabled.any(), axis=1)
        judged = present & known[:, None]
        state = states_of(value, threshold, judged)
        if self._blind is not None:
            state[state == PASS] = NOT_EVALUATED
            judged &= state == FAIL
        epochs = rows_of(part.epoch)
        self.state[epochs] = state
        self.value[epochs] = np.where(present, value, np.nan)
        self.threshold[epochs] = np.where(judged, threshold, np.nan)
        self.noise_m[epochs] = noise_m
        self.window_begins[epochs] = part.fresh
        self.noise_known[epochs] = known

    def freeze(self, epoch: int) -> None:
        """No row from this epoch on enters the noise, until a restart; evaluated anew from the last block on.

        Noise that is not known yet, or too large, goes on being measured: it would never be known, or smaller.
        """
        row = int(np.searchsorted(self.series.epoch, epoch))
        before = int(np.searchsorted(self.series.epoch, epoch, side="right")) - 1
        if before >= 0 and np.all(self.noise_m[self.series.epoch[before]] <= self._config.noise_limit_m):
            self._meter.freeze(row)
            self._begin_at(*self._last_block, FIRST_BLOCK)

    def restart(self, epoch: int) -> None:
        """Forget all but the noise; the first increment is from the first usable epoch on."""
        row = int(np.searchsorted(self.series.epoch, epoch))
        self.series = replace(self.series, fresh=self.series.fresh | (np.arange(self.series.fresh.size) == row))
        self._meter.restart(row)
        self._begin_at(row, None, FIRST_BLOCK)

    def white_noise_m(self) -> float | None:
        """sqrt(4 M / 6) of one epoch at the end; None where never known (DOMAIN section 3)."""
        known = self.noise_m[:, 0][np.isfinite(self.noise_m[:, 0])]
        return float(known[-1]) * WHITE_PART if known.size else None

    def median_noise_m(self) -> tuple[float, ...]:
        """Median noise in the thresholds of each monitor [m]; empty where it never was known."""
        known = self.noise_m[np.isfinite(self.noise_m).all(axis=1)]
        return tuple(np.median(known, axis=0).tolist()) if known.size else ()

    def verdicts(self) -> dict[str, Verdicts]:
        """Verdicts of the monitors of this axis by name, as far as they are evaluated."""
        unknown = np.zeros(self.value.shape[0], dtype=np.bool_)
        epochs = rows_of(self.series.epoch)
        unknown[epochs] = np.isnan(self.noise_m[epochs]).any(axis=1)
        too_large: Bools = np.any(self.noise_m > self._config.noise_limit_m, axis=1)
        of_noise = first_reason((unknown, NOISE_UNKNOWN), (too_large, NOISE_TOO_LARGE))
        reasons = fill_reasons(self.axis.reasons, of_noise)
        if self._blind is not None:
            reasons = fill_reasons(reasons, first_reason((np.isfinite(self.value).any(axis=1), self._blind)))
        reasons = fill_reasons(reasons, FIRST_EPOCH)
        disabled = fill_reasons(self.axis.reasons, DISABLED)
        return {
            f"{self.axis.name}_{scale}": verdicts(
                self.value[:, index],
                self.threshold[:, index],
                reasons if self.enabled[index] else disabled,
                self.state[:, index],
            )
            for index, scale in enumerate(SCALES)
        }


class MonitorBank:
    """The bank as the location determination system sees it: monitors of one solution, from the last restart on.

    Epochs are rows of the solution's epochs. Answers for an epoch may change with `freeze` or `restart` at or before
    it, never through later ones. `watched`: epochs with a row along the track. A fail of any monitor is an alarm.

    Args:
        epochs: aligned epochs of the solution, arrays of shape (n,).
        single: verdicts of the monitors without memory, by name, each of n rows.
        config: the configuration.
        blind_along: why those along the track cannot say that all is well, None where they can: an odometer made of the
            positions agrees with them whatever they say (DOMAIN section 5.0).
        along_axis: the axis along the track, where the alignment made it already.

    Source:
        DIAG eq. 1-17; DOMAIN section 3.
    """

    def __init__(
        self,
        epochs: AlignedEpochs,
        single: Mapping[str, Verdicts],
        config: Configuration,
        blind_along: NotEvaluated | None = None,
        along_axis: Axis | None = None,
    ):
        self._count = epochs.height
        disabled = config.monitors.disabled
        self._axes = tuple(
            AxisBank(axis, self._count, config, blind_along if axis.name == "along" else None)
            for axis in axes_of(epochs, config, along_axis)
        )
        along, across, _ = self._axes
        # In a run without an odometer the axis across the track has to say where the bank begins.
        self._begins = (along if along.series.epoch.size else across).window_begins
        self._noise_known = along.noise_known
        self.watched: Ints = along.series.epoch
        self._single = {
            name: no_verdicts(self._count, DISABLED) if name in disabled else found for name, found in single.items()
        }
        fails = [found.fails for found in self._single.values()]
        self._single_fails = np.logical_or.reduce([np.zeros(self._count, dtype=np.bool_), *fails])
        self._any, self._stops, self._fast, self._along = (np.zeros(self._count, dtype=np.bool_) for _ in range(4))
        self._known_to = -1

    def _look(self, epoch: int) -> None:
        """Evaluate all axes up to this epoch at least, and note what the LDS asks for."""
        if epoch <= self._known_to:
            return
        begin = self._known_to + 1
        self._known_to = min(axis.advance(epoch) for axis in self._axes)
        part = slice(begin, self._known_to + 1)
        fails = np.logical_or.reduce([axis.state[part] == FAIL for axis in self._axes])
        self._any[part] = fails.any(axis=1) | self._single_fails[part]
        self._fast[part] = fails[:, :2].any(axis=1) | self._single_fails[part]
        self._stops[part] = self._any[part] | self._begins[part] | ~self._noise_known[part]
        self._along[part] = self._axes[0].state[part, 0] != NOT_EVALUATED

    def _look_to_the_end(self) -> None:
        """Look at all epochs given so far."""
        self._look(self._count - 1)

    def failed(self, epoch: int) -> bool:
        """A monitor of the bank fails at this epoch."""
        self._look(epoch)
        return bool(self._any[epoch])

    def fast_failed(self, epoch: int) -> bool:
        """A monitor fails that does not ring: raw, fastest EWMA, or without memory. Only these hold back recovery.

        One without memory does not outlive its fault; a return while it fails would restart the bank every `recovery_s`
        and so blind its slow averages.
        """
        self._look(epoch)
        return bool(self._fast[epoch])

    def along_evaluated(self, epoch: int) -> bool:
        """`along_raw` has a verdict; an average alone says nothing of a step."""
        self._look(epoch)
        return bool(self._along[epoch])

    def first_alarm_from(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on, at most `end`, at which something fails, begins or is not known yet."""
        self._look(epoch)
        ahead = self._stops[epoch : min(self._known_to + 1, end)]
        first = int(ahead.argmax())
        return epoch + (first if ahead[first] else ahead.size)

    def hidden_until(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on, at most `end`, at which the fast noise is known or something fails."""
        self._look(epoch)
        part = slice(epoch, min(self._known_to + 1, end))
        shown = self._noise_known[part] | self._any[part]
        first = int(shown.argmax())
        return epoch + (first if shown[first] else shown.size)

    def along_evaluated_between(self, epoch: int, end: int) -> Bools:
        """Whether the axis along is evaluated at epochs for which `first_alarm_from` answered."""
        return self._along[epoch:end]

    def noise_known_at(self, epoch: int) -> bool:
        """The fast noise along the track is known, and no failure can hide in it."""
        self._look(epoch)
        return bool(self._noise_known[epoch])

    def begins_at(self, epoch: int) -> bool:
        """Nothing leads here: start, gap, lost distance, restart."""
        self._look(epoch)
        return bool(self._begins[epoch])

    def freeze(self, epoch: int) -> None:
        """Negated from this epoch on: until a restart nothing enters the measured noise."""
        for axis in self._axes:
            axis.freeze(epoch)
        self._known_to = min(self._known_to, epoch)

    def restart(self, epoch: int) -> None:
        """Begin anew at this epoch, as after a gap: nothing but the measured noise is kept."""
        for axis in self._axes:
            axis.restart(epoch)
        self._known_to = epoch - 1

    def along(self) -> AxisBank:
        """What the monitors along the track saw, after the walk."""
        self._look_to_the_end()
        return self._axes[0]

    def white_noise(self) -> dict[str, float | None]:
        """`white_noise_*_m` of the run [m]."""
        return {f"white_noise_{axis.axis.name}_m": axis.white_noise_m() for axis in self._axes}

    def median_noise_m(self) -> dict[str, tuple[float, ...]]:
        """`noise_*_m` of the configuration, as this run shows them."""
        self._look_to_the_end()
        shown = {f"noise_{axis.axis.name}_m": axis.median_noise_m() for axis in self._axes}
        return {name: noise_m for name, noise_m in shown.items() if noise_m}

    def verdicts(self) -> dict[str, Verdicts]:
        """Verdicts of each monitor of the bank by name."""
        self._look_to_the_end()
        return {name: found for axis in self._axes for name, found in axis.verdicts().items()} | self._single

    def columns(self) -> list[pl.Series]:
        """The same as columns of `epochs`."""
        return [column for name, found in self.verdicts().items() for column in found.columns(name)]
