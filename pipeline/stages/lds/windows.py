"""Expectation windows of ETCS linking, and the spacing of balises that keeps them disjoint."""

from __future__ import annotations

from typing import NamedTuple

from schemas.config import LdsConfig

DEFAULTS = LdsConfig()


class Window(NamedTuple):
    """Expectation window in odometer distance from the LRVB [m]."""

    open_m: float
    close_m: float

    def holds(self, distance_m: float) -> bool:
        return self.open_m <= distance_m <= self.close_m


def window_m(distance_m: float, accuracy_m: float, reference_accuracy_m: float, config: LdsConfig = DEFAULTS) -> Window:
    """Window of a balise announced `distance_m` beyond the reference (SUBSET-026 3.4.4.4.3, 3.6.4.1).

    The odometer's reading d is true to 5 m + 5 % of d (SUBSET-041 5.3.1.1), so the window is
    d + (5 + 0.05 d) >= D - Q - Q_r and d - (5 + 0.05 d) <= D + Q + Q_r: not symmetric about D.
    """
    margin_m = accuracy_m + reference_accuracy_m + config.odometer_fixed_m
    return Window(
        (distance_m - margin_m) / (1.0 + config.odometer_share),
        (distance_m + margin_m) / (1.0 - config.odometer_share),
    )


def window_after_turn_m(distance_m: float, travelled_m: float, margin_m: float, config: LdsConfig = DEFAULTS) -> Window:
    """Where the train turned round since the reference: 5 % of the whole way run, not of the net distance.

    `margin_m` is Q + Q_r + 5 m. The clauses know no such case.
    """
    half_m = (margin_m + config.odometer_share * travelled_m) / (1.0 - config.odometer_share)
    return Window(distance_m - half_m, distance_m + half_m)


def minimal_spacing_m(
    distance_m: float, accuracy_m: float, next_accuracy_m: float, reference_accuracy_m: float, config: LdsConfig
) -> float:
    """Smallest distance to the next balise whose window does not overlap its own (LOC section III)."""
    margin_m = next_accuracy_m + reference_accuracy_m + config.odometer_fixed_m
    close_m = window_m(distance_m, accuracy_m, reference_accuracy_m, config).close_m
    return close_m * (1.0 + config.odometer_share) + margin_m - distance_m
