"""Trains that stand where a recording ends: they stand on for a second (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.stages.odometry import Odometry
from pipeline.stages.reference import ReferenceStretch
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import Configuration

# DOMAIN section 5.1: a train that stood for so long at the last row stands for up to so much more [s].
_STOOD_S = 2.0
_STANDS_S = 1.0


class Stand(NamedTuple):
    """The last instant of a recording at which the train stood [ns]."""

    last_ns: int


def final_stands(
    reference: Sequence[ReferenceStretch], odometers: Sequence[Odometry], config: Configuration
) -> tuple[Stand, ...]:
    """The ends of independent odometers and of the reference at which the train had stood for two seconds.

    Of several recordings the one that ends last counts: the others may have lost a train that drove on.
    """
    ends: list[tuple[int, bool]] = []
    for odometer in odometers:
        end_ns = np.array([odometer.epoch_ns + round(float(odometer.t_s[-1]) * 1e9)])
        ends.append((int(end_ns[0]), bool(odometer.stood(end_ns - round(_STOOD_S * NS_PER_S), end_ns)[0])))
    for stretch in reference:
        last_ns = int(stretch.t_ns[-1])
        path = stretch.paths[0]
        rows = slice(int(np.searchsorted(stretch.t_ns, last_ns - round(_STOOD_S * NS_PER_S))), None)
        spread_m = float(np.ptp(path.at_m[rows]))
        noise_m = 2.0 * config.hazards.evidence_factor * float(stretch.sigma_m[-1])
        ends.append((last_ns, spread_m <= config.matching.deadband_mps * _STOOD_S + noise_m))
    if not ends:
        return ()
    last_ns, stood = max(ends)
    return (Stand(last_ns),) if stood else ()


def still_standing(t_ns: Ints, stands: Sequence[Stand], config: Configuration) -> tuple[Ints, Floats]:
    """The instants, those within a second after a stand put at its end, and how far the train may have come [m]."""
    held_ns = t_ns.copy()
    slack_m = np.zeros(t_ns.size)
    for stand in stands:
        since_s = (t_ns - stand.last_ns) / NS_PER_S
        rows = (since_s > 0.0) & (since_s <= _STANDS_S)
        held_ns[rows] = stand.last_ns
        slack_m[rows] = 0.5 * config.align.braking_mps2 * since_s[rows] ** 2
    return held_ns, slack_m
