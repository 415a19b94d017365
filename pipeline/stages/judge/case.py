"""What is judged, and by what: one solution as it was replayed, with the evidence of its run."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import polars as pl

from pipeline.stages.evidence import EvidenceSet, TrainEvidence, either
from pipeline.stages.odometry import Odometry
from pipeline.stages.track.path import RoutePath, TravelledPath
from schemas.arrays import NS_PER_S, Ints, times_ns
from schemas.config import Configuration, Vehicle
from schemas.enums import BaliseKind, PassageStatus
from schemas.frozen import frozen


@frozen
class Solution:
    """One solution: `fixes` as recorded, `epochs` with all columns up to the LDS, `balises` on its path."""

    name: str
    fixes: pl.DataFrame
    epochs: pl.DataFrame
    crossings: pl.DataFrame
    passages: pl.DataFrame
    balises: pl.DataFrame
    path: TravelledPath

    @cached_property
    def offers(self) -> pl.DataFrame:
        """Crossings and telegrams, with `virtual` and `accepted`; also crossings before the balise was re-armed."""
        virtual = pl.col("kind").cast(pl.String) == BaliseKind.VIRTUAL.value
        accepted = virtual & (pl.col("status").cast(pl.String) == PassageStatus.ACCEPTED.value)
        crossings = self.crossings.filter(pl.col("offered") | pl.col("status").is_null())
        return crossings.with_columns(virtual=virtual, accepted=accepted.fill_null(value=False))

    @cached_property
    def accepted(self) -> pl.DataFrame:
        """The virtual balises that the LDS accepted, in order of time."""
        return self.offers.filter("accepted").sort("t")


@frozen
class Case:
    """One solution with the evidence of its run; `odometry` grows with its path, `faults` were injected.

    `leaps_s`: whole leap seconds that may have to be added to the stamps of the positions, beside none; nobody knows.
    """

    solution: Solution
    evidence: TrainEvidence
    odometry: Odometry | None
    vehicle: Vehicle
    config: Configuration
    reference: pl.DataFrame | None = None
    faults: pl.DataFrame | None = None
    leaps_s: tuple[int, ...] = ()

    def evidence_at(self, at_ns: Ints) -> EvidenceSet:
        """Where the train was at instants of the positions' clock: by either clock, where that may be off by leaps."""
        return either([self.evidence.at(clock_ns) for clock_ns in self.clocks_ns(at_ns)])

    def clocks_ns(self, at_ns: Ints) -> list[Ints]:
        """The same instants of the positions' clock by each clock of the evidence that they may have."""
        return [at_ns, *(at_ns + leap_s * NS_PER_S for leap_s in self.leaps_s)]

    def instants(self, t_ns: Ints) -> Ints:
        """When positions of these stamps were true: less the latency of the vehicle file, 0 without one."""
        return t_ns - round((self.vehicle.gnss_latency_s or 0.0) * NS_PER_S)

    def instants_of_epochs(self) -> Ints:
        return self.instants(times_ns(self.solution.epochs))

    def legs(self) -> list[RoutePath]:
        return self.solution.path.routes(self.evidence.network.track.index)

    def element_numbers(self, names: pl.Series) -> Ints:
        """Net elements by their numbers in the survey, -1 for none."""
        index = self.evidence.network.track.index
        # A train is on a net element for many epochs: each name is looked up once for all of them.
        visit = names.rle_id().to_numpy()
        first = names[np.flatnonzero(np.diff(visit, prepend=-1))]
        numbers = np.array([-1 if name is None else index.get(name, -1) for name in first], dtype=np.int64)
        return np.asarray(numbers[visit])
