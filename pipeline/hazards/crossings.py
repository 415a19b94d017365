"""Virtual balises that a movement along the path crosses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.hazards.series import Series
from schemas.arrays import Bools, Floats, Ints, floats
from schemas.enums import BaliseKind


@dataclass(frozen=True)
class Beacons:
    """Balises on one leg of the path, in order of path position."""

    leg: int
    path_m: Floats
    balise_id: tuple[str, ...]

    def between(self, a_m: float, b_m: float) -> set[int]:
        """Those that a movement from a to b passes: the end counts, the begin does not."""
        first, last = np.searchsorted(self.path_m, (a_m, b_m), side="right")
        return set(range(min(first, last), max(first, last)))


@dataclass(frozen=True)
class Crossing:
    """A balise crossed by the raw matched position between usable epochs `epoch - 1` and `epoch`."""

    epoch: int
    fraction: float
    t_ns: int
    balise_id: str
    path_m: float
    error_m: float


def beacons_by_leg(balises: pl.DataFrame) -> tuple[Beacons, ...]:
    """Virtual balises on the path, by leg."""
    virtual = balises.filter(pl.col("kind") == BaliseKind.VIRTUAL.value).sort("leg", "path_m", "balise_id")
    return tuple(
        Beacons(int(part["leg"][0]), floats(part, "path_m"), tuple(part["balise_id"].to_list()))
        for part in virtual.partition_by("leg", maintain_order=True)
    )


def crossings_with_error(series: Series, beacons: tuple[Beacons, ...], limit_m: float) -> list[Crossing]:
    """Offered crossings whose interpolated error exceeds `limit_m` and what the evidence can resolve, in time."""
    if series.size < 2:
        return []
    large: Bools = np.zeros(series.size, dtype=np.bool_)
    reach = np.abs(series.error_m) > limit_m
    large[1:] = series.linked[1:] & (reach[1:] | reach[:-1])
    epochs = np.flatnonzero(large)
    found = [crossing for part in beacons for crossing in _on_leg(series, part, epochs)]
    beyond = [c for c in found if abs(c.error_m) > max(limit_m, float(series.bound_m[c.epoch]))]
    return sorted(beyond, key=lambda c: (c.t_ns, c.balise_id))


def _on_leg(series: Series, beacons: Beacons, epochs: Ints) -> Iterator[Crossing]:
    here = epochs[series.leg[epochs] == beacons.leg]
    passed = np.searchsorted(beacons.path_m, series.path_m[here], side="right")
    passed_before = np.searchsorted(beacons.path_m, series.path_m[here - 1], side="right")
    for epoch in here[passed != passed_before].tolist():
        a, b = float(series.path_m[epoch - 1]), float(series.path_m[epoch])
        for index in sorted(beacons.between(a, b)):
            yield crossing_at(series, beacons, index, epoch)


def crossing_at(series: Series, beacons: Beacons, index: int, epoch: int) -> Crossing:
    """The crossing of one balise in the movement that leads to `epoch`, linearly interpolated."""
    a, b = float(series.path_m[epoch - 1]), float(series.path_m[epoch])
    place = float(beacons.path_m[index])
    fraction = (place - a) / (b - a) if b != a else 1.0
    t0, t1 = int(series.t_ns[epoch - 1]), int(series.t_ns[epoch])
    e0, e1 = float(series.error_m[epoch - 1]), float(series.error_m[epoch])
    return Crossing(
        epoch=epoch,
        fraction=fraction,
        t_ns=t0 + round(fraction * (t1 - t0)),
        balise_id=beacons.balise_id[index],
        path_m=place,
        error_m=e0 + fraction * (e1 - e0),
    )
