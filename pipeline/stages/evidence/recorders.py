"""Streams of the witnesses before they are evidence: declared latencies, samples that stand still."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.odometry import Odometry
from schemas.arrays import floats, times_ns
from schemas.config import HazardConfig


def on_time(stream: pl.DataFrame | None, latency_s: float) -> pl.DataFrame | None:
    """The stream with its declared lag taken off (vehicle file, `reference_latency_s`, `reads_latency_s`)."""
    if stream is None or latency_s == 0.0:
        return stream
    return stream.with_columns(pl.col("t") - pl.duration(nanoseconds=round(latency_s * 1e9)))


def without_frozen(
    reference: pl.DataFrame | None, odometers: Sequence[Odometry], config: HazardConfig
) -> pl.DataFrame | None:
    """The reference without samples that repeat the one before while an odometer moves on: any, or any independent one.

    A recorder that stands still says nothing of where the train is (DOMAIN section 5.0): after so long the stretch
    ends. A train that stands repeats too: there the odometer shows no way beyond its dead band and the sample's noise.
    """
    witnesses = [odometer for odometer in odometers if odometer.independent] or list(odometers)
    if reference is None or reference.height < 2 or not witnesses:
        return reference
    t_ns = times_ns(reference)
    places = np.column_stack([floats(reference, "latitude_deg"), floats(reference, "longitude_deg")])
    repeats = np.concatenate([[False], (np.diff(places, axis=0) == 0.0).all(axis=1)])
    if not repeats.any():
        return reference
    held = np.arange(t_ns.size)[~repeats][np.cumsum(~repeats) - 1]
    noise_m = config.evidence_factor * reference["sigma_m"].fill_null(config.reference_sigma_m).to_numpy()
    frozen = np.zeros(t_ns.size, dtype=np.bool_)
    for odometer in witnesses:
        frozen |= repeats & odometer.drove(t_ns[held], t_ns, noise_m)
    return reference.filter(~pl.Series(frozen))
