"""What is judged, and by what: one solution as it was replayed, with the evidence of its run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.evidence import Evidence
from pipeline.stages.odometry import Odometry
from pipeline.stages.track.path import Route, TravelledPath
from schemas.arrays import NS_PER_S, Ints, times_ns
from schemas.config import Configuration, Vehicle


@dataclass(frozen=True)
class Solution:
    """One solution as it was recorded and replayed.

    `fixes`: its positions as recorded; `epochs`: matched, aligned and monitored, with the LDS columns; `crossings` and
    `passages`: of the LDS; `balises`: those on the path.
    """

    name: str
    fixes: pl.DataFrame
    epochs: pl.DataFrame
    crossings: pl.DataFrame
    passages: pl.DataFrame
    balises: pl.DataFrame
    path: TravelledPath


@dataclass(frozen=True)
class Case:
    """One solution before the judge; `odometry` grows with its path; `faults`: what was injected, if anything was."""

    solution: Solution
    evidence: Evidence
    odometry: Odometry | None
    vehicle: Vehicle
    config: Configuration
    reference: pl.DataFrame | None = None
    faults: pl.DataFrame | None = None

    def instants(self, t_ns: Ints) -> Ints:
        """When positions of these stamps were true: less the latency of the vehicle file, 0 without one."""
        return t_ns - round((self.vehicle.gnss_latency_s or 0.0) * NS_PER_S)

    def instants_of_epochs(self) -> Ints:
        return self.instants(times_ns(self.solution.epochs))

    def legs(self) -> list[Route]:
        return self.solution.path.routes(self.evidence.network.track.index)

    def element_numbers(self, names: pl.Series) -> Ints:
        """Net elements by their numbers in the survey, -1 for none."""
        index = self.evidence.network.track.index
        return names.replace_strict(index, default=-1, return_dtype=pl.Int64).fill_null(-1).to_numpy()


def between_far_epochs(at_ns: Ints, step_s: float) -> Ints:
    """The instants of the positions, and others between those that are far apart."""
    step_ns = round(step_s * NS_PER_S)
    far = np.flatnonzero(np.diff(at_ns) > 1.5 * step_ns)
    between = [
        np.arange(begin, end, step_ns, dtype=np.int64)[1:]
        for begin, end in zip(at_ns[far].tolist(), at_ns[far + 1].tolist(), strict=True)
    ]
    return np.unique(np.concatenate([at_ns, *between]))
