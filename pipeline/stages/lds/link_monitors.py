"""Monitors of linking: the re-link after time out of use, the order of balises, and the linking distance.

A re-link asks whether GNSS minus odometer is what it was at the anchor (DOMAIN section 4). What the odometer may have
miscounted widens its bound, up to half the failure limit; if that is more, only a telegram re-links.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np

from pipeline.stages.epochs.verdicts import (
    DISABLED,
    NO_ODOMETER,
    NO_POSITION,
    NO_SIGMA,
    NUMBER,
    Verdicts,
    fill_reasons,
    first_reason,
    verdicts,
)
from pipeline.stages.lds.crossings import Crossing, Journey
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry.bound import RecoveryRule, is_lost
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration
from schemas.enums import BaliseKind, NotEvaluated
from schemas.stages import NO_REASON


@dataclass(frozen=True, slots=True)
class Anchor:
    """GNSS minus odometer [m] where it was trusted: at a TVB, or a telegram. `sigma_m`: of the position or the read."""

    epoch: int
    t_ns: int
    offset_m: float
    sigma_m: float
    travelled_m: float
    is_read: bool = False

    @classmethod
    def at_epoch(cls, journey: Journey, epoch: int) -> Anchor:
        """The anchor at the position of an epoch."""
        offset_m = float(journey.path_m[epoch] - journey.odometer_m[epoch])
        return cls(
            epoch, int(journey.t_ns[epoch]), offset_m, float(journey.sigma_m[epoch]), float(journey.travelled_m[epoch])
        )

    @classmethod
    def at_crossing(cls, journey: Journey, crossing: Crossing, sigma_m: float) -> Anchor | None:
        """The anchor at the place of a balise; None where the odometer is not known there."""
        whole = journey.doubt_m[crossing.epoch] == journey.doubt_m[crossing.before]
        if crossing.odometer_m is None or not whole or not isfinite(crossing.travelled_m):
            return None
        offset_m = crossing.balise.path_m - crossing.odometer_m
        is_read = crossing.balise.kind is BaliseKind.PHYSICAL
        return cls(crossing.epoch, crossing.t_ns, offset_m, sigma_m, crossing.travelled_m, is_read)


@dataclass(frozen=True, slots=True)
class Comparison:
    """How far GNSS minus odometer moved since the anchor, and may have; else why nothing can be said."""

    moved_m: float = np.nan
    bound_m: float = np.nan
    reason: NotEvaluated | None = None

    @property
    def holds(self) -> bool:
        """Whether the position moved no farther than the bound."""
        return self.reason is None and abs(self.moved_m) <= self.bound_m


class Held(NamedTuple):
    """A re-link that held: at which epoch, against the position of which one (None: a telegram)."""

    epoch: int
    anchor_epoch: int | None
    moved_m: float
    bound_m: float


class Relink:
    """The return into use: what the position is compared with, and how. `tvb`: flags of the epochs so far.

    The anchor is fixed where the position is withheld. After an alarm, or slip that the odometer reports, it is the
    last telegram, else the first TVB of the mission: a slow drift has moved every later one. After time that nothing
    watched it is the last TVB before. A later return does not move it: from a return on the position is held to it
    until the slowest average of the restarted bank is full.
    """

    def __init__(self, journey: Journey, tvb: list[bool], config: Configuration) -> None:
        self._journey = journey
        self._tvb = tvb
        self._config = config
        self._rule = RecoveryRule(config)
        self._memory_ns = round(NS_PER_S / min(config.monitors.ewma_alphas))
        self.held: list[Held] = []
        self.begin_mission(0)

    def begin_mission(self, epoch: int) -> None:
        """Forget telegram and anchor: TVBs count from this epoch on."""
        self._mission_from = epoch
        self._read: Anchor | None = None
        self._anchor: Anchor | None = None
        self._suspected = False
        self._hold_to_ns: int | None = None

    def note_read(self, read: Crossing) -> None:
        """A telegram becomes the anchor, where the odometer is known at it."""
        anchor = Anchor.at_crossing(self._journey, read, self._config.hazards.balise_read_sigma_m)
        if anchor is not None:
            self._read = self._anchor = anchor

    def withhold(self, epoch: int, suspected: bool) -> None:
        """Fix the anchor; `suspected`: by an alarm or slip, else nothing watched the position."""
        waits = self._hold_to_ns is None
        if suspected or not (self._suspected and (waits or self.is_held(epoch))):
            tvb = self._first_tvb(epoch) if suspected else self._last_tvb(epoch)
            kept = self._read is not None and (suspected or tvb is None or self._read.t_ns >= tvb.t_ns)
            self._anchor = self._read if kept else tvb
            self._suspected = suspected
        self._hold_to_ns = None

    def hold(self, epoch: int) -> None:
        """The position returns: from here on it is held to the anchor."""
        self._hold_to_ns = int(self._journey.t_ns[epoch]) + self._memory_ns

    def is_held(self, epoch: int) -> bool:
        """Whether the position is still held to the anchor at this epoch."""
        return self._hold_to_ns is not None and int(self._journey.t_ns[epoch]) <= self._hold_to_ns

    def movement_in_hold_m(self, epoch: int) -> tuple[Floats, Floats]:
        """How far the position moved since the anchor, and may have [m], at each epoch of the hold from this one on."""
        assert self._hold_to_ns is not None
        assert self._anchor is not None
        end = int(np.searchsorted(self._journey.t_ns, self._hold_to_ns, side="right"))
        return self._movement_since_m(self._anchor, epoch, max(end, epoch))

    def compare(self, epoch: int) -> Comparison:
        """Compare GNSS minus odometer at this epoch with what it was at the anchor, and note a re-link that holds."""
        anchor = self._anchor
        if not self._config.lds.relink:
            return Comparison(reason=NotEvaluated.RELINK_OFF)
        if anchor is None:
            return Comparison(reason=NotEvaluated.RELINK_NO_ANCHOR)
        doubt_m = float(self._journey.doubt_m[epoch] - self._journey.doubt_m[anchor.epoch])
        if is_lost(np.array(doubt_m)):
            return Comparison(reason=NotEvaluated.RELINK_DISTANCE_LOST)
        if self._journey.scale_sigma is None and not (anchor.is_read and anchor.epoch == epoch):
            return Comparison(reason=NotEvaluated.RELINK_NO_VEHICLE)
        if doubt_m > self._rule.most_m:
            # Slip at each start counts too much each time, and would soon explain any fault.
            return Comparison(reason=NotEvaluated.RELINK_SLIPPED)
        moved_m, bound_m = (float(values[0]) for values in self._movement_since_m(anchor, epoch, epoch + 1))
        comparison = Comparison(moved_m, bound_m)
        if comparison.holds:
            self.held.append(Held(epoch, None if anchor.is_read else anchor.epoch, moved_m, bound_m + doubt_m))
        return comparison

    def _movement_since_m(self, anchor: Anchor, epoch: int, end: int) -> tuple[Floats, Floats]:
        """How far GNSS minus odometer moved since the anchor at these epochs, and how far it may have [m].

        NaN where the odometer lost its distance, or may have miscounted too much through slip.
        """
        journey = self._journey
        at = slice(epoch, end)
        moved_m = journey.path_m[at] - journey.odometer_m[at] - anchor.offset_m
        waited_s = (journey.t_ns[at] - anchor.t_ns) / NS_PER_S
        driven_m = journey.travelled_m[at] - anchor.travelled_m
        positions_m2 = anchor.sigma_m**2 + journey.sigma_m[at] ** 2
        bound_m = self._rule.bound_m(
            self._rule.variance_m2(positions_m2, waited_s, driven_m, journey.scale_sigma or 0.0)
        )
        doubt_m = journey.doubt_m[at] - journey.doubt_m[anchor.epoch]
        known = doubt_m <= self._rule.most_m
        return np.where(known, moved_m, np.nan), np.minimum(self._rule.most_m, bound_m + doubt_m)

    def _first_tvb(self, epoch: int) -> Anchor | None:
        """The anchor at the first TVB of the mission before an epoch."""
        return self._anchor_at_first(range(self._mission_from, epoch))

    def _last_tvb(self, epoch: int) -> Anchor | None:
        """The anchor at the last TVB of the mission before an epoch."""
        return self._anchor_at_first(range(epoch - 1, self._mission_from - 1, -1))

    def _anchor_at_first(self, epochs: Iterable[int]) -> Anchor | None:
        """The anchor at the first of these epochs that is a TVB, where the odometer is known."""
        found = next((k for k in epochs if self._tvb[k] and self._journey.comparable[k]), None)
        return None if found is None else Anchor.at_epoch(self._journey, found)


class Recovery:
    """While the position is negated: for how long no fast monitor has failed."""

    def __init__(self, journey: Journey, bank: MonitorBank, config: Configuration) -> None:
        self._journey = journey
        self._bank = bank
        self._rule = RecoveryRule(config)
        self._failed_at_ns = self._observed_at_ns = 0

    def begin(self, epoch: int) -> None:
        """The position is negated from this epoch on."""
        self._failed_at_ns = self._observed_at_ns = int(self._journey.t_ns[epoch])

    def is_over(self, epoch: int, evaluated: bool, failing: bool) -> bool:
        """Whether raw and fastest monitors were silent for `recovery_s`, observed without a gap; usable now.

        Observed is an epoch with a verdict of `along_raw` (`evaluated`); without an odometer, with a usable position.
        """
        t_ns = int(self._journey.t_ns[epoch])
        usable = bool(self._journey.usable[epoch])
        observed = evaluated if self._journey.has_odometer else usable
        if observed:
            if t_ns - self._observed_at_ns > self._journey.gap_ns[epoch]:
                self._failed_at_ns = t_ns
            self._observed_at_ns = t_ns
        if failing or self._bank.fast_failed(epoch):
            self._failed_at_ns = t_ns
        quiet = bool(self._rule.recovery_is_over((t_ns - self._failed_at_ns) / NS_PER_S))
        return observed and usable and quiet


# Identities are counted: half a balise lies between none and one.
ORDER_THRESHOLD = 0.5
# Numerics: epochs evaluated at once, at first and at the most; between balises near each other few are needed.
_FIRST_BLOCK, _BLOCK = 64, 4096


def count_out_of_order(offered: list[Crossing], overdue: int, journey: Journey, config: Configuration) -> int:
    """Number of balises of one step that were offered out of order (what finds 1A, DIAG Hazards).

    Two at once, or one against the direction of travel, where the odometer's step does not explain the position's;
    `overdue` ones, whose window has closed, always.
    """
    before = offered[0].before
    after = offered[0].epoch
    odometer_step_m = journey.odometer_m[after] - journey.odometer_m[before]
    excess_m = abs(journey.path_m[after] - journey.path_m[before] - odometer_step_m)
    ends = [before, after]
    noise_m = config.monitors.threshold_factor * sqrt((journey.sigma_m[ends] ** 2 + journey.rows_m[ends] ** 2).sum())
    unexplained = excess_m > noise_m + config.lds.odometer_share * abs(odometer_step_m)
    backwards = offered[0].sense != journey.direction[after]
    return len(offered) if unexplained and (len(offered) > 1 or backwards) else overdue


class LinkOrder:
    """The monitor `link_order`: the order of identities, step by step."""

    def __init__(self, journey: Journey, config: Configuration) -> None:
        self._reason = _order_reasons(journey, "link_order" in config.monitors.disabled, config)
        self._evaluated: Bools = self._reason == NO_REASON
        self._value = np.zeros(journey.t_ns.size)

    def is_evaluated(self, epoch: int) -> bool:
        """Whether the monitor has a verdict at this epoch."""
        return bool(self._evaluated[epoch])

    def note(self, epoch: int, out_of_order: int) -> None:
        """Note how many balises were offered out of order in the step to this epoch."""
        self._value[epoch] = out_of_order

    def verdicts(self) -> Verdicts:
        """Verdicts of all epochs."""
        return verdicts(self._value, np.full(self._value.size, ORDER_THRESHOLD), self._reason)


class LinkDistance:
    """GNSS against odometer distance since the LRVB, or since the TVB that began the chain.

    Bounds: 5 m + 5 % (SUBSET-041 5.3.1.1), and the noise of both positions and of the odometer's rows at k_T. After an
    outage and for a while after a return it is the distance since the re-link anchor, within the bound of a re-link.
    """

    def __init__(self, journey: Journey, config: Configuration) -> None:
        self._journey = journey
        self._config = config.lds
        self._factor = config.monitors.threshold_factor
        self._reason = _distance_reasons(journey, "link_distance" in config.monitors.disabled, config)
        self._possible: Bools = self._reason == NO_REASON
        self._offset_m = journey.path_m - journey.odometer_m
        self._value = np.full(journey.t_ns.size, np.nan)
        self._threshold = np.full(journey.t_ns.size, np.nan)
        self._fails = np.zeros(journey.t_ns.size, dtype=bool)
        self._anchor: Anchor | None = None
        self._done = 0
        self._begun = False  # evaluated at all since what it is measured from changed
        self._block = _FIRST_BLOCK
        self._since_return = np.full((2, journey.t_ns.size), np.nan)  # moved since the re-link anchor, its bound

    def measure_from(self, anchor: Anchor | None, epoch: int) -> None:
        """After this epoch the distance is measured from another anchor; None: from nowhere."""
        self._evaluate_before_change(epoch)
        self._anchor = anchor

    def hold_to_relink_anchor(self, epoch: int, moved_m: Floats, bound_m: Floats) -> None:
        """From `epoch` on the distance since the re-link anchor counts, for as long as it is given [m]."""
        self._evaluate_before_change(epoch)
        self._since_return[:, epoch:] = np.nan
        self._since_return[:, epoch : epoch + moved_m.size] = moved_m, bound_m

    @property
    def has_anchor(self) -> bool:
        """Whether there is something to measure from."""
        return self._anchor is not None

    def can_measure(self, epoch: int) -> bool:
        """Whether nothing of the odometer's distance since the anchor is in doubt."""
        doubt_m = self._journey.doubt_m
        return self._anchor is not None and bool(doubt_m[self._anchor.epoch] == doubt_m[epoch])

    def fails(self, epoch: int) -> bool:
        """Whether the monitor fails at this epoch."""
        if self._anchor is None:
            return False
        self._evaluate_up_to(self._anchor, epoch)
        return bool(self._fails[epoch])

    def first_alarm_from(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on that fails or is not evaluated yet; at most `end`."""
        if self._anchor is None:
            return end
        self._evaluate_up_to(self._anchor, epoch)
        ahead = self._fails[epoch : min(self._done, end)]
        first = int(ahead.argmax())
        return epoch + (first if ahead[first] else ahead.size)

    def _evaluate_up_to(self, anchor: Anchor, epoch: int) -> None:
        """Evaluate up to this epoch and a block ahead, and whatever nobody asked for before."""
        if epoch >= self._done:
            begin = self._done if self._begun else epoch
            self._done = min(epoch + self._block, self._fails.size)
            self._block = min(2 * self._block, _BLOCK)
            self._begun = True
            self._evaluate_block(anchor, slice(begin, self._done))

    def _evaluate_before_change(self, epoch: int) -> None:
        """What it is measured from changes: epochs up to this one are evaluated, those after it anew."""
        if self._anchor is not None and self._begun and epoch >= self._done:
            self._evaluate_block(self._anchor, slice(self._done, epoch + 1))
        self._done = epoch
        self._begun = False
        self._block = _FIRST_BLOCK

    def _evaluate_block(self, anchor: Anchor, ahead: slice) -> None:
        """Write value, threshold and reason of some epochs.

        Elementwise, so every epoch still knows only its own past.
        """
        driven_m = np.abs(self._journey.travelled_m[ahead] - anchor.travelled_m)
        rows_m2 = self._journey.rows_m[ahead] ** 2 + self._journey.rows_m[anchor.epoch] ** 2
        noise_m = self._factor * np.sqrt(self._journey.sigma_m[ahead] ** 2 + anchor.sigma_m**2 + rows_m2)
        threshold_m = self._config.odometer_fixed_m + self._config.odometer_share * driven_m + noise_m
        lost = self._possible[ahead] & (self._journey.doubt_m[ahead] != self._journey.doubt_m[anchor.epoch])
        known = self._possible[ahead] & ~lost
        moved_m, bound_m = self._since_return[:, ahead]
        held = known & np.isfinite(moved_m)
        self._reason[ahead][self._possible[ahead]] = NO_REASON
        self._reason[ahead][lost] = NUMBER[NotEvaluated.DISTANCE_LOST]
        since_m = np.where(held, moved_m, self._offset_m[ahead] - anchor.offset_m)
        self._value[ahead] = np.where(known, since_m, np.nan)
        self._threshold[ahead] = np.where(known, np.where(held, bound_m, threshold_m), np.nan)
        self._fails[ahead] = np.abs(self._value[ahead]) > self._threshold[ahead]

    def note_comparison(self, comparison: Comparison, epoch: int) -> None:
        """The verdict of a re-link joins that of the bounds at `epoch`, whose fail remains."""
        if not self._possible[epoch] or self.fails(epoch):
            return
        self._value[epoch] = comparison.moved_m
        self._threshold[epoch] = comparison.bound_m
        self._fails[epoch] = comparison.reason is None and not comparison.holds
        self._reason[epoch] = NO_REASON if comparison.reason is None else NUMBER[comparison.reason]

    def forget(self, epoch: int) -> None:
        """A new mission begins: nothing to measure from, no verdict from this epoch on."""
        self.measure_from(None, epoch)
        self._since_return[:, epoch:] = np.nan
        self._value[epoch:] = self._threshold[epoch:] = np.nan
        self._reason[epoch:][self._possible[epoch:]] = NO_REASON

    def verdicts(self) -> Verdicts:
        """Verdicts of all epochs."""
        self._evaluate_before_change(self._fails.size - 1)
        never = first_reason((np.isnan(self._value), NotEvaluated.NEVER_VALIDATED))
        return verdicts(self._value, self._threshold, fill_reasons(self._reason, never))


def _order_reasons(journey: Journey, disabled: bool, config: Configuration) -> Ints:
    """Why `link_order` has no verdict of the step to each epoch; both its ends must be good for it."""
    known = np.flatnonzero(journey.positioned)
    before = np.full(journey.t_ns.size, -1)
    before[known[1:]] = known[:-1]
    odometer = np.isfinite(journey.odometer_m)
    sigma = np.isfinite(journey.sigma_m)
    return first_reason(
        (np.full(before.size, disabled), DISABLED),
        (~odometer, NO_ODOMETER),
        (~journey.positioned, NO_POSITION),
        (before < 0, NotEvaluated.NO_EPOCH_BEFORE),
        (~odometer[before], NO_ODOMETER),
        (journey.ambiguous | journey.ambiguous[before], NotEvaluated.AMBIGUOUS_OR_OFF),
        (~(sigma & sigma[before]), NO_SIGMA),
        (_are_coarse(journey, config), NotEvaluated.NOISE_TOO_LARGE),
    )


def _distance_reasons(journey: Journey, disabled: bool, config: Configuration) -> Ints:
    """Why `link_distance` has no verdict at each epoch."""
    return first_reason(
        (np.full(journey.t_ns.size, disabled), DISABLED),
        (~np.isfinite(journey.odometer_m), NO_ODOMETER),
        (~journey.positioned, NO_POSITION),
        (journey.ambiguous, NotEvaluated.AMBIGUOUS_OR_OFF),
        (~np.isfinite(journey.sigma_m), NO_SIGMA),
        (_are_coarse(journey, config), NotEvaluated.NOISE_TOO_LARGE),
    )


def _are_coarse(journey: Journey, config: Configuration) -> Bools:
    """Epochs at which rows of the odometer scatter by as much as thresholds allow for: no threshold would hold."""
    coarse: Bools = journey.rows_m >= config.scatter_limit_m
    return coarse
