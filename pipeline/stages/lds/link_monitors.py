"""The linking monitors: order of balise identities, and GNSS against odometer distance."""

from __future__ import annotations

from math import sqrt

import numpy as np

from pipeline.stages.epochs.verdicts import (
    DISABLED,
    NO_ODOMETER,
    NO_POSITION,
    NO_SIGMA,
    NUMBER,
    Verdicts,
    first_reason,
    otherwise,
    verdicts,
)
from pipeline.stages.lds.crossings import Crossing
from pipeline.stages.lds.journey import Journey
from pipeline.stages.lds.relink import Anchor, Comparison
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration
from schemas.enums import NotEvaluated
from schemas.stages import NO_REASON

# Identities are counted: half a balise lies between none and one.
ORDER_THRESHOLD = 0.5
# Numerics: epochs evaluated at once, at first and at the most; between balises near each other few are needed.
_FIRST_BLOCK, _BLOCK = 64, 4096


def disorder(offered: list[Crossing], overdue: int, journey: Journey, config: Configuration) -> int:
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
    """Order of identities, step by step."""

    def __init__(self, journey: Journey, config: Configuration) -> None:
        self._reason = _order_reasons(journey, "link_order" in config.monitors.disabled, config)
        self._evaluated: Bools = self._reason == NO_REASON
        self._value = np.zeros(journey.t_ns.size)

    def is_evaluated(self, epoch: int) -> bool:
        return bool(self._evaluated[epoch])

    def note(self, epoch: int, out_of_order: int) -> None:
        self._value[epoch] = out_of_order

    def verdicts(self) -> Verdicts:
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
        self._end_at(epoch)
        self._anchor = anchor

    def hold_to(self, epoch: int, moved_m: Floats, bound_m: Floats) -> None:
        """From `epoch` on the distance since the re-link anchor counts, for as long as it is given."""
        self._end_at(epoch)
        self._since_return[:, epoch:] = np.nan
        self._since_return[:, epoch : epoch + moved_m.size] = moved_m, bound_m

    def can_measure(self, epoch: int) -> bool:
        """Nothing of the odometer's distance since the anchor is in doubt."""
        doubt_m = self._journey.doubt_m
        return self._anchor is not None and bool(doubt_m[self._anchor.epoch] == doubt_m[epoch])

    def fails(self, epoch: int) -> bool:
        if self._anchor is None:
            return False
        self._look(self._anchor, epoch)
        return bool(self._fails[epoch])

    def quiet_until(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on that fails or is not evaluated yet; at most `end`."""
        if self._anchor is None:
            return end
        self._look(self._anchor, epoch)
        ahead = self._fails[epoch : min(self._done, end)]
        first = int(ahead.argmax())
        return epoch + (first if ahead[first] else ahead.size)

    def _look(self, anchor: Anchor, epoch: int) -> None:
        """A block ahead at once, and whatever nobody asked for before it: a failing bank is alarm enough."""
        if epoch >= self._done:
            begin = self._done if self._begun else epoch
            self._done = min(epoch + self._block, self._fails.size)
            self._block = min(2 * self._block, _BLOCK)
            self._begun = True
            self._evaluate(anchor, slice(begin, self._done))

    def _end_at(self, epoch: int) -> None:
        """What it is measured from changes: epochs up to this one are evaluated, those after it anew."""
        if self._anchor is not None and self._begun and epoch >= self._done:
            self._evaluate(self._anchor, slice(self._done, epoch + 1))
        self._done = epoch
        self._begun = False
        self._block = _FIRST_BLOCK

    def _evaluate(self, anchor: Anchor, ahead: slice) -> None:
        """Elementwise, so every epoch still knows only its own past."""
        way_m = np.abs(self._journey.travelled_m[ahead] - anchor.travelled_m)
        rows_m2 = self._journey.rows_m[ahead] ** 2 + self._journey.rows_m[anchor.epoch] ** 2
        noise_m = self._factor * np.sqrt(self._journey.sigma_m[ahead] ** 2 + anchor.sigma_m**2 + rows_m2)
        threshold_m = self._config.odometer_fixed_m + self._config.odometer_share * way_m + noise_m
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

    def hold_against(self, comparison: Comparison, epoch: int) -> None:
        """The verdict of a re-link joins that of the bounds at `epoch`, whose fail remains."""
        if not self._possible[epoch] or self.fails(epoch):
            return
        self._value[epoch] = comparison.moved_m
        self._threshold[epoch] = comparison.bound_m
        self._fails[epoch] = comparison.reason is None and not comparison.holds
        self._reason[epoch] = NO_REASON if comparison.reason is None else NUMBER[comparison.reason]

    def forget(self, epoch: int) -> None:
        self.measure_from(None, epoch)
        self._since_return[:, epoch:] = np.nan
        self._value[epoch:] = self._threshold[epoch:] = np.nan
        self._reason[epoch:][self._possible[epoch:]] = NO_REASON

    def verdicts(self) -> Verdicts:
        self._end_at(self._fails.size - 1)
        never = first_reason((np.isnan(self._value), NotEvaluated.NEVER_VALIDATED))
        return verdicts(self._value, self._threshold, otherwise(self._reason, never))


def _order_reasons(journey: Journey, disabled: bool, config: Configuration) -> Ints:
    """Per step: both its ends must be good for it."""
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
        (_is_coarse(journey, config), NotEvaluated.NOISE_TOO_LARGE),
    )


def _distance_reasons(journey: Journey, disabled: bool, config: Configuration) -> Ints:
    return first_reason(
        (np.full(journey.t_ns.size, disabled), DISABLED),
        (~np.isfinite(journey.odometer_m), NO_ODOMETER),
        (~journey.positioned, NO_POSITION),
        (journey.ambiguous, NotEvaluated.AMBIGUOUS_OR_OFF),
        (~np.isfinite(journey.sigma_m), NO_SIGMA),
        (_is_coarse(journey, config), NotEvaluated.NOISE_TOO_LARGE),
    )


def _is_coarse(journey: Journey, config: Configuration) -> Bools:
    """Rows of the odometer scatter by as much as thresholds allow for, or more: no threshold would hold."""
    coarse: Bools = journey.rows_m >= config.scatter_limit_m
    return coarse
