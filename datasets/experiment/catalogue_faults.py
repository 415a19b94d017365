"""The fault catalogue: kinds by sizes, on the positions, the ranges, the odometer, the clocks, the map and balises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

from datasets.experiment.catalogue_changes import (
    list_wrong,
    map_left,
    odometer_late,
    position_frozen,
    read_late,
    read_missing,
    stamps_ahead,
)
from schemas.frozen import frozen
from schemas.run import RunLog, Site

Journey = Literal["short", "long", "physical"]
Change = Callable[[RunLog, Site, int, float], tuple[RunLog, Site]]

# The satellite at fault: in view all along, and its errors lie along the line.
SATELLITE = "G16"
HEALTHY = "healthy"
_SLOW_MPS = 0.1


@frozen
class CatalogueFault:
    """One fault from the onset on. `injected`: faults of a scenario (times from the onset); `change`: the rest.

    `journey`: short suffices for all but slow drifts; `physical` has balises that are read beside virtual ones.
    """

    kind: str
    size: float
    unit: str
    injected: tuple[dict[str, object], ...] = ()
    change: Change | None = None
    journey: Journey = "short"

    @property
    def name(self) -> str:
        return self.kind if self.is_healthy else f"{self.kind} {self.size:g} {self.unit}".strip()

    @property
    def is_healthy(self) -> bool:
        return self.kind.startswith(HEALTHY)


def catalogue() -> tuple[CatalogueFault, ...]:
    """All faults; the first ones are none, to show what is no detection."""
    journeys: tuple[Journey, ...] = ("short", "long", "physical")
    healthy = [CatalogueFault(f"{HEALTHY} {journey}", 0.0, "", journey=journey) for journey in journeys]
    return (*healthy, *_ranges(), *_positions(), *_receiver(), *_odometer(), *_surroundings())


def _injected(
    label: str, unit: str, sizes: Sequence[float], kind: str, target: str, quantity: str, **fixed: object
) -> list[CatalogueFault]:
    """Faults of a scenario from the onset on, one of each size; slow ramps need the long journey to their failure."""
    return [
        CatalogueFault(
            label,
            size,
            unit,
            ({"kind": kind, "target": target, "start_s": 0.0, quantity: size, **fixed},),
            journey="long" if kind == "ramp" and abs(size) <= _SLOW_MPS else "short",
        )
        for size in sizes
    ]


def _changed(
    label: str, unit: str, sizes: Sequence[float], change: Change, journey: Journey = "short"
) -> list[CatalogueFault]:
    return [CatalogueFault(label, size, unit, change=change, journey=journey) for size in sizes]


def _ranges() -> list[CatalogueFault]:
    return [
        *_injected("range ramp", "m/s", (0.01, 0.03, 0.1, 1.0, 5.0), "ramp", SATELLITE, "rate_mps"),
        *_injected("range step", "m", (10.0, 30.0, 100.0), "step", SATELLITE, "size_m"),
    ]


def _positions() -> list[CatalogueFault]:
    """Common-mode steps and drifts: all ranges in accord, as a spoofer makes them."""
    return [
        *_injected("step along", "m", (5.0, 25.0, -25.0, 600.0, 1_200.0), "step", "along", "size_m"),
        *_injected("step cross", "m", (3.0, 10.0, 25.0), "step", "cross", "size_m"),
        *_injected("step up", "m", (5.0, 15.0, 40.0), "step", "up", "size_m"),
        *_injected("drift along", "m/s", (0.01, 0.03, 0.1, 0.3, 1.0, -0.3, -1.0), "ramp", "along", "rate_mps"),
        *_injected("drift cross", "m/s", (0.1, 1.0), "ramp", "cross", "rate_mps"),
    ]


def _receiver() -> list[CatalogueFault]:
    gap: dict[str, object] = {"kind": "outage", "target": "position", "start_s": 0.0, "duration_s": 90.0}
    off = _injected(
        "outage of 90 s, then off by", "m", (10.0, 30.0, 100.0, 300.0, -300.0), "step", "along", "size_m", start_s=90.0
    )
    return [
        *_injected("latency", "s", (0.2, 1.0, 3.0), "latency", "position", "latency_s"),
        *_changed("clock ahead", "s", (0.2, 1.0, 3.0), stamps_ahead),
        *_changed("frozen position", "s", (2.0, 10.0), position_frozen),
        *_injected("outage", "s", (5.0, 30.0, 90.0), "outage", "position", "duration_s"),
        *(replace(one, injected=(gap, *one.injected)) for one in off),
        *_injected("noise along", "m", (1.0, 3.0, 10.0), "noise", "along", "sigma_m"),
        *_injected("multipath below 40 deg", "m", (3.0, 10.0), "noise", "satellites", "sigma_m", below_deg=40.0),
        *_injected(
            "one solution drifts along", "m/s", (0.01, 0.1, 1.0), "ramp", "along", "rate_mps", solution="primary"
        ),
    ]


def _odometer() -> list[CatalogueFault]:
    return [
        *_injected("slip", "m/s", (0.3, 0.8, 3.0), "slip", "odometer", "rate_mps", duration_s=20.0),
        *_injected("slide", "m/s", (0.3, 0.8, 3.0), "slide", "odometer", "rate_mps", duration_s=20.0),
        *_injected("odometer scale", "", (1.001, 1.005, 1.02), "scale", "odometer", "scale"),
        *_changed("odometer late", "s", (0.2, 1.0), odometer_late),
        *_injected("odometer outage", "s", (20.0,), "outage", "odometer", "duration_s"),
    ]


def _surroundings() -> list[CatalogueFault]:
    """Track, map and balises."""
    return [
        *_injected("on the parallel track, left", "m", (4.5,), "step", "cross", "size_m"),
        *_changed("map off to the left", "m", (1.0, 5.0, 20.0), map_left),
        *_changed("balise list wrong", "m", (10.0, 30.0), list_wrong),
        *_changed("physical balise missing", "", (1.0, 2.0), read_missing, "physical"),
        *_changed("physical balise late", "s", (0.5, 3.0, 10.0), read_late, "physical"),
    ]
