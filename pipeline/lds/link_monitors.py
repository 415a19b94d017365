"""The linking monitors: order of balise identities, and GNSS against odometer distance."""

from __future__ import annotations

from math import sqrt

import numpy as np
import polars as pl

from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.crossings import Crossing
from pipeline.lds.journey import Bools, Floats, Journey
from pipeline.lds.recovery import Anchor
from schemas.config import LdsConfig
from schemas.enums import MonitorState, PassageStatus
from schemas.tables import Epochs

# Identities are counted: half a balise lies between none and one.
ORDER_THRESHOLD = 0.5
_STRETCH = 512

DISABLED = "disabled by configuration"
NO_ODOMETER = "no odometer"
NO_POSITION = "no position"
AMBIGUOUS = "match ambiguous or off track"
NO_REFERENCE = "no balise or validated position to measure from"
NO_SIGMA = "no standard deviation of the position"
FIRST_EPOCH = "no epoch before"


def disorder(offered: list[Crossing], overdue: int, journey: Journey, config: LdsConfig, limits: LdsLimits) -> int:
    """Number of balises of one step that were offered out of order (what finds 1A, DIAG Hazards).

    Two or more at once, or one against the direction of travel, are out of order where the
    odometer's step does not explain the position's; `overdue` ones, whose window has closed, always.
    """
    i, j = offered[0].before, offered[0].epoch
    odometer_step_m = journey.odometer_m[j] - journey.odometer_m[i]
    excess_m = abs(journey.path_m[j] - journey.path_m[i] - odometer_step_m)
    noise_m = limits.threshold_factor * sqrt(journey.sigma_m[i] ** 2 + journey.sigma_m[j] ** 2)
    unexplained = excess_m > noise_m + config.odometer_share * abs(odometer_step_m)
    backwards = offered[0].sense != journey.heading[j]
    return len(offered) if unexplained and (len(offered) > 1 or backwards) else overdue


class LinkOrder:
    """Order of balise identities, step by step."""

    def __init__(self, journey: Journey, limits: LdsLimits) -> None:
        self._reason = _order_reasons(journey, "link_order" in limits.disabled)
        self._value = np.array([0.0 if reason is None else np.nan for reason in self._reason])

    def is_evaluated(self, k: int) -> bool:
        return self._reason[k] is None

    def note(self, k: int, out_of_order: int) -> None:
        self._value[k] = out_of_order

    def columns(self) -> dict[str, pl.Series]:
        """`link_order_*` as in the contract of epochs."""
        threshold = np.where(np.isnan(self._value), np.nan, ORDER_THRESHOLD)
        return _columns("link_order", self._value, threshold, self._reason)


class LinkDistance:
    """GNSS against odometer distance since the LRVB, or since the TVB that began the chain.

    Bounds: the odometer's 5 m + 5 % (SUBSET-041 5.3.1.1), and the noise of the two positions at k_T.
    """

    def __init__(self, journey: Journey, config: LdsConfig, limits: LdsLimits) -> None:
        self._journey, self._config, self._limits = journey, config, limits
        self._reason = _distance_reasons(journey, "link_distance" in limits.disabled)
        self._possible = np.array([reason is None for reason in self._reason], dtype=bool)
        self._offset_m = journey.path_m - journey.odometer_m
        self._value = np.full(journey.t_ns.size, np.nan)
        self._threshold = np.full(journey.t_ns.size, np.nan)
        self._fails = [False] * journey.t_ns.size
        self._anchor: Anchor | None = None
        self._done = 0

    def measure_from(self, anchor: Anchor | None, k: int) -> None:
        """From epoch `k` on the distance counts from this anchor."""
        self._anchor, self._done = anchor, k

    def fails(self, k: int) -> bool:
        if self._anchor is None:
            return False
        if k >= self._done:
            self._evaluate(self._anchor, k)
        return self._fails[k]

    def _evaluate(self, anchor: Anchor, k: int) -> None:
        """A stretch ahead at once: elementwise, so every epoch still knows only its own past."""
        self._done = min(k + _STRETCH, len(self._fails))
        ahead = slice(k, self._done)
        way_m = np.abs(self._journey.travelled_m[ahead] - anchor.travelled_m)
        noise_m = self._limits.threshold_factor * np.hypot(self._journey.sigma_m[ahead], anchor.sigma_m)
        threshold_m = self._config.odometer_fixed_m + self._config.odometer_share * way_m + noise_m
        possible = self._possible[ahead]
        self._value[ahead] = np.where(possible, self._offset_m[ahead] - anchor.offset_m, np.nan)
        self._threshold[ahead] = np.where(possible, threshold_m, np.nan)
        self._fails[ahead] = (np.abs(self._value[ahead]) > self._threshold[ahead]).tolist()

    def forget(self, k: int) -> None:
        """From epoch `k` on there is nothing to measure from."""
        self.measure_from(None, k)
        self._value[k:] = self._threshold[k:] = np.nan

    def columns(self) -> dict[str, pl.Series]:
        """`link_distance_*` as in the contract of epochs."""
        unknown = np.isnan(self._value).tolist()
        reason = [why or (NO_REFERENCE if x else None) for why, x in zip(self._reason, unknown, strict=True)]
        return _columns("link_distance", self._value, self._threshold, reason)


def _order_reasons(journey: Journey, disabled: bool) -> list[str | None]:
    """Per step, so both its ends must be good for it; a step ends at the epoch that it is noted at."""
    known = np.flatnonzero(journey.positioned)
    before = np.full(journey.t_ns.size, -1)
    before[known[1:]] = known[:-1]
    odometer, ambiguous, sigma = _odometer(journey), _ambiguous(journey), np.isfinite(journey.sigma_m)
    masks = (
        (np.full(odometer.size, disabled), DISABLED),
        (~odometer, NO_ODOMETER),
        (~journey.positioned, NO_POSITION),
        (before < 0, FIRST_EPOCH),
        (~odometer[before], NO_ODOMETER),
        (ambiguous | ambiguous[before], AMBIGUOUS),
        (~(sigma & sigma[before]), NO_SIGMA),
    )
    return _reasons(odometer.size, masks)


def _distance_reasons(journey: Journey, disabled: bool) -> list[str | None]:
    odometer = _odometer(journey)
    masks = (
        (np.full(odometer.size, disabled), DISABLED),
        (~odometer, NO_ODOMETER),
        (~journey.positioned, NO_POSITION),
        (_ambiguous(journey), AMBIGUOUS),
        (~np.isfinite(journey.sigma_m), NO_SIGMA),
    )
    return _reasons(odometer.size, masks)


def _odometer(journey: Journey) -> Bools:
    known: Bools = np.isfinite(journey.odometer_m)
    return known


def _ambiguous(journey: Journey) -> Bools:
    return np.array([refusal is PassageStatus.REJECTED_AMBIGUOUS for refusal in journey.refusal], dtype=bool)


def _reasons(size: int, masks: tuple[tuple[Bools, str], ...]) -> list[str | None]:
    reasons = np.full(size, None, dtype=object)
    for mask, reason in reversed(masks):
        reasons[mask] = reason
    found: list[str | None] = reasons.tolist()
    return found


def _columns(monitor: str, value: Floats, threshold: Floats, reasons: list[str | None]) -> dict[str, pl.Series]:
    state = np.where(np.abs(value) > threshold, MonitorState.FAIL.value, MonitorState.PASS.value)
    state = np.where(np.isnan(value), MonitorState.NOT_EVALUATED.value, state)
    kind = Epochs.columns()[f"{monitor}_state"].dtype
    return {
        f"{monitor}_value": _nullable(f"{monitor}_value", value),
        f"{monitor}_threshold": _nullable(f"{monitor}_threshold", threshold),
        f"{monitor}_state": pl.Series(f"{monitor}_state", state.tolist(), dtype=pl.String).cast(kind),
        f"{monitor}_reason": pl.Series(f"{monitor}_reason", reasons, dtype=pl.String),
    }


def _nullable(name: str, values: Floats) -> pl.Series:
    return pl.Series(name, values).fill_nan(None)
