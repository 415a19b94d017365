"""A balise that was just detected is not detected again by position noise."""

from __future__ import annotations

from math import isnan

from pipeline.lds.crossings import Balise
from pipeline.lds.journey import Journey
from schemas.config import LdsConfig


class Latch:
    """Disarmed balises: re-armed once the odometer has moved max(10 m, 3 sigma) away (DOMAIN 4).

    Where the run has no odometer, the position's distance from the balise has to serve.
    """

    def __init__(self, journey: Journey, config: LdsConfig) -> None:
        self._journey, self._config = journey, config
        self._has_odometer = journey.has_odometer
        self._disarmed: dict[str, tuple[Balise, float]] = {}

    def __bool__(self) -> bool:
        return bool(self._disarmed)

    def holds(self, balise: Balise) -> bool:
        """A crossing of this balise is not an offer."""
        return balise.balise_id in self._disarmed

    def disarm(self, balise: Balise, odometer_m: float | None) -> None:
        self._disarmed[balise.balise_id] = (balise, float("nan") if odometer_m is None else odometer_m)

    def advance(self, k: int) -> None:
        """Re-arm what the train has left behind at epoch `k`."""
        away_m = max(self._config.rearm_m, 3.0 * float(self._journey.sigma_m[k]))
        for name, (balise, at_m) in list(self._disarmed.items()):
            if abs(self._moved_m(k, balise, at_m)) >= away_m:
                del self._disarmed[name]

    def _moved_m(self, k: int, balise: Balise, at_m: float) -> float:
        if not self._has_odometer:
            return float(self._journey.path_m[k]) - balise.path_m
        odometer_m = float(self._journey.odometer_m[k])
        if isnan(at_m):
            self._disarmed[balise.balise_id] = (balise, odometer_m)
        return odometer_m - at_m
