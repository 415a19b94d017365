"""Balise reads as places on the travelled path, with the odometer at the read."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.alignment.align import odometer_at
from pipeline.odometry import Odometry
from schemas.arrays import Floats, Ints
from schemas.enums import BaliseKind


def place_reads(
    reads: pl.DataFrame | None,
    aligned: pl.DataFrame,
    balises: pl.DataFrame,
    odometry: Odometry | None,
) -> pl.DataFrame | None:
    """Reads (`t, balise_id`) with `odometer_m, leg, path_m`; null where the balise is not on the path.

    A balise on an element that the run passes twice has several places: the one on the leg that the train is on,
    and there the one next to its position, is meant.
    """
    if reads is None:
        return None
    known = pl.Series("odometer_m", [None] * reads.height, dtype=pl.Float64)
    if odometry is not None:
        known = odometer_at(reads["t"], aligned, odometry)
    physical = balises.filter(pl.col("kind") == BaliseKind.PHYSICAL.value)
    places = physical.select("balise_id", "leg", "path_m").partition_by("balise_id", as_dict=True)
    near = places_near(reads["t"], aligned)
    here = [(0, float("nan"))] * reads.height if near is None else list(zip(*(x.tolist() for x in near), strict=True))
    chosen = [
        _nearest(places.get((name,)), leg, path_m) for name, (leg, path_m) in zip(reads["balise_id"], here, strict=True)
    ]
    legs, paths = [leg for leg, _ in chosen], [path_m for _, path_m in chosen]
    return reads.with_columns(
        known, pl.Series("leg", legs, dtype=pl.Int32), pl.Series("path_m", paths, dtype=pl.Float64)
    )


def places_near(times: pl.Series, aligned: pl.DataFrame) -> tuple[Ints, Floats] | None:
    """Leg and path position [m] of the epoch next in time to each instant; None in a run without a position."""
    placed = aligned.drop_nulls(["leg", "path_m"])
    if placed.is_empty():
        return None
    stamps, at = placed["t"].dt.timestamp("ns").to_numpy(), times.dt.timestamp("ns").to_numpy()
    after = np.searchsorted(stamps, at).clip(0, stamps.size - 1)
    before = np.maximum(after - 1, 0)
    rows = np.where(np.abs(stamps[before] - at) <= np.abs(stamps[after] - at), before, after)
    return placed["leg"].to_numpy().astype(np.int64)[rows], placed["path_m"].to_numpy()[rows]


def _nearest(places: pl.DataFrame | None, leg: int, path_m: float) -> tuple[int | None, float | None]:
    if places is None:
        return None, None
    options = list(zip(places["leg"], places["path_m"], strict=True))
    if np.isnan(path_m):
        return options[0]
    best: tuple[int, float] = min(options, key=lambda place: (place[0] != leg, abs(place[1] - path_m)))
    return best
