"""The fault catalogue: kinds by sizes, on the positions, the ranges, the odometer, the clocks, the map and balises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from datasets.experiment.catalogue_changes import (
    frozen,
    list_wrong,
    map_left,
    odometer_late,
    read_late,
    read_missing,
    stamps_ahead,
)
from schemas.run import RunLog, Site

Journey = Literal["short", "long", "physical"]
Change = Callable[[RunLog, Site, int, float], tuple[RunLog, Site]]

# The satellite at fault: in view all along, and its errors lie along the line.
SATELLITE = "G16"
HEALTHY = "healthy"


@dataclass(frozen=True)
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
    return (*_healthy(), *_ranges(), *_positions(), *_drifts(), *_receiver(), *_odometer(), *_surroundings())


def _healthy() -> list[CatalogueFault]:
    journeys: tuple[Journey, ...] = ("short", "long", "physical")
    return [CatalogueFault(f"{HEALTHY} {journey}", 0.0, "", journey=journey) for journey in journeys]


def _ranges() -> list[CatalogueFault]:
    ramps = [
        CatalogueFault(
            "range ramp", rate, "m/s", (_fault("ramp", SATELLITE, rate_mps=rate),), journey=_journey(rate, 0.1)
        )
        for rate in (0.01, 0.03, 0.1, 1.0, 5.0)
    ]
    steps = [
        CatalogueFault("range step", size, "m", (_fault("step", SATELLITE, size_m=size),))
        for size in (10.0, 30.0, 100.0)
    ]
    return ramps + steps


def _positions() -> list[CatalogueFault]:
    """Common-mode steps: all ranges in accord, as a spoofer makes them."""
    sizes = {"along": (5.0, 25.0, -25.0, 600.0, 1_200.0), "cross": (3.0, 10.0, 25.0), "up": (5.0, 15.0, 40.0)}
    return [
        CatalogueFault(f"step {axis}", size, "m", (_fault("step", axis, size_m=size),))
        for axis, chosen in sizes.items()
        for size in chosen
    ]


def _drifts() -> list[CatalogueFault]:
    return [
        CatalogueFault(
            f"drift {axis}", rate, "m/s", (_fault("ramp", axis, rate_mps=rate),), journey=_journey(abs(rate), 0.1)
        )
        for axis, rates in {"along": (0.01, 0.03, 0.1, 0.3, 1.0, -0.3, -1.0), "cross": (0.1, 1.0)}.items()
        for rate in rates
    ]


def _receiver() -> list[CatalogueFault]:
    gap = 90.0
    return [
        *(CatalogueFault("latency", s, "s", (_fault("latency", "position", latency_s=s),)) for s in (0.2, 1.0, 3.0)),
        *(CatalogueFault("clock ahead", s, "s", change=stamps_ahead) for s in (0.2, 1.0, 3.0)),
        *(CatalogueFault("frozen position", s, "s", change=frozen) for s in (2.0, 10.0)),
        *(CatalogueFault("outage", s, "s", (_fault("outage", "position", duration_s=s),)) for s in (5.0, 30.0, 90.0)),
        *(
            CatalogueFault(
                "outage of 90 s, then off by",
                size,
                "m",
                (
                    _fault("outage", "position", duration_s=gap),
                    _fault("step", "along", after_s=gap, size_m=size),
                ),
            )
            for size in (10.0, 30.0, 100.0, 300.0, -300.0)
        ),
        *(CatalogueFault("noise along", m, "m", (_fault("noise", "along", sigma_m=m),)) for m in (1.0, 3.0, 10.0)),
        *(
            CatalogueFault(
                "multipath below 40 deg", m, "m", (_fault("noise", "satellites", sigma_m=m, below_deg=40.0),)
            )
            for m in (3.0, 10.0)
        ),
        *(
            CatalogueFault(
                "one solution drifts along",
                rate,
                "m/s",
                (_fault("ramp", "along", rate_mps=rate, solution="primary"),),
                journey=_journey(rate, 0.1),
            )
            for rate in (0.01, 0.1, 1.0)
        ),
    ]


def _odometer() -> list[CatalogueFault]:
    speeds = [
        CatalogueFault(kind, rate, "m/s", (_fault(kind, "odometer", duration_s=20.0, rate_mps=rate),))
        for kind in ("slip", "slide")
        for rate in (0.3, 0.8, 3.0)
    ]
    scales = [
        CatalogueFault("odometer scale", scale, "", (_fault("scale", "odometer", scale=scale),))
        for scale in (1.001, 1.005, 1.02)
    ]
    return [
        *speeds,
        *scales,
        *(CatalogueFault("odometer late", s, "s", change=odometer_late) for s in (0.2, 1.0)),
        CatalogueFault("odometer outage", 20.0, "s", (_fault("outage", "odometer", duration_s=20.0),)),
    ]


def _surroundings() -> list[CatalogueFault]:
    """Track, map and balises."""
    missing = [
        CatalogueFault("physical balise missing", count, "", change=read_missing, journey="physical")
        for count in (1.0, 2.0)
    ]
    late = [
        CatalogueFault("physical balise late", s, "s", change=read_late, journey="physical") for s in (0.5, 3.0, 10.0)
    ]
    return [
        CatalogueFault("on the parallel track, left", 4.5, "m", (_fault("step", "cross", size_m=4.5),)),
        *(CatalogueFault("map off to the left", m, "m", change=map_left) for m in (1.0, 5.0, 20.0)),
        *(CatalogueFault("balise list wrong", m, "m", change=list_wrong) for m in (10.0, 30.0)),
        *missing,
        *late,
    ]


def _journey(rate_mps: float, short_from_mps: float) -> Journey:
    """Slow ramps need the long journey to come to their failure."""
    return "short" if rate_mps > short_from_mps else "long"


def _fault(kind: str, target: str, after_s: float = 0.0, **size: object) -> dict[str, object]:
    return {"kind": kind, "target": target, "start_s": after_s, **size}
