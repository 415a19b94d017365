"""What every question about one solution needs: its positions, the evidence, and the instants that they are held at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.epochs.clock import met, unambiguous
from pipeline.epochs.timeline import crossing_gap_ns
from pipeline.evidence import Evidence as AllEvidence
from pipeline.evidence.carrying import carried_forward
from pipeline.evidence.evidence import KINDS
from pipeline.evidence.routes import Route, routes_of_path
from pipeline.judge.judgement import Judgements, Positions, judge_positions, margins_m, with_own_anchors
from pipeline.judge.states import odometer_beyond_confidence, stood_spans
from pipeline.odometry import Odometry
from pipeline.track.path import TravelledPath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import Configuration, Vehicle
from schemas.enums import BaliseKind, Evidence, PassageStatus


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
class Bench:
    """One solution before the judge; `odometry` grows with its path."""

    solution: Solution
    evidence: AllEvidence
    odometry: Odometry | None
    vehicle: Vehicle
    config: Configuration

    @property
    def epochs(self) -> pl.DataFrame:
        return self.solution.epochs

    @cached_property
    def t_ns(self) -> Ints:
        return times_ns(self.epochs)

    def instants(self, t_ns: Ints) -> Ints:
        """When positions of these stamps were true: less the latency of the vehicle file, 0 without one."""
        return t_ns - round((self.vehicle.gnss_latency_s or 0.0) * NS_PER_S)

    @cached_property
    def at_ns(self) -> Ints:
        return self.instants(self.t_ns)

    @cached_property
    def legs(self) -> list[Route]:
        return routes_of_path(self.solution.path, self.evidence.network.track.index)

    @cached_property
    def path_m(self) -> Floats:
        """Path positions, NaN without a valid fix."""
        return floats(self.epochs, "path_m")

    @cached_property
    def odometer_moves(self) -> Bools:
        """Per epoch whether the odometer says that the train moved to the next one."""
        if self.odometry is None:
            return np.zeros(self.t_ns.size, dtype=np.bool_)
        moves = self.odometry.moved(self.at_ns)
        return np.append(moves, moves[-1:])[: self.t_ns.size]

    @cached_property
    def odometer_told(self) -> Bools:
        """Per epoch whether the odometer counted from it to the next one."""
        if self.odometry is None:
            return np.zeros(self.t_ns.size, dtype=np.bool_)
        told = np.isfinite(self.odometry.between(self.at_ns[:-1], self.at_ns[1:]).distance_m)
        return np.append(told, told[-1:])[: self.t_ns.size]

    @cached_property
    def stood(self) -> list[tuple[int, int]]:
        limit_m = self.config.hazards.failure_limit_m
        return stood_spans(self.at_ns, self.path_m, self.odometer_moves, self.odometer_told, limit_m)

    @cached_property
    def positions(self) -> Positions:
        """The positions of all epochs.

        Without an odometer the direction of travel is that of the train's own place, where the evidence tells it: a
        position that jumps back does not turn the train.
        """
        told = self._positions(ints(self.epochs["direction"], 1))
        if self.odometry is not None:
            return told
        found = judge_positions(told, self.evidence.at(self.at_ns), self.legs, self.config.hazards)
        train_m = self.path_m - found.known_m(self.config.hazards.known_error_m) * told.direction
        ahead = np.searchsorted(self.t_ns, self.t_ns + round(self.config.hazards.turn_s * NS_PER_S)).clip(
            0, self.t_ns.size - 1
        )
        with np.errstate(invalid="ignore"):
            came_m = train_m[ahead] - train_m
            sure = np.flatnonzero(np.abs(came_m) > found.half_m + found.half_m[ahead])
        if sure.size == 0:
            return told
        last = np.maximum(np.searchsorted(sure, np.arange(self.t_ns.size), side="right") - 1, 0)
        return self._positions(np.sign(came_m[sure]).astype(np.int64)[last])

    def _positions(self, direction: Ints) -> Positions:
        epochs, index = self.epochs, self.evidence.network.track.index
        element = epochs["netelement_id"].replace_strict(index, default=-1, return_dtype=pl.Int64).fill_null(-1)
        return Positions(
            element=np.where(np.isfinite(self.path_m), element.to_numpy(), -1),
            measure_m=floats(epochs, "measure_m"),
            leg=ints(epochs["leg"]),
            path_m=self.path_m,
            direction=direction,
            unambiguous=met(epochs, unambiguous(self.config)),
        )

    @cached_property
    def judged(self) -> Judgements:
        """What the evidence says of every epoch."""
        return self._judge(self.positions, self.at_ns)

    @cached_property
    def offers(self) -> pl.DataFrame:
        """Crossings of virtual balises and telegrams, those of a balise not re-armed yet (not `offered`) among them.

        `virtual`, and `accepted` (of a virtual one by the LDS), stand beside the columns of the LDS.
        """
        status, kind = (pl.col(name).cast(pl.String) for name in ("status", "kind"))
        virtual = kind == BaliseKind.VIRTUAL.value
        accepted = (virtual & (status == PassageStatus.ACCEPTED.value)).fill_null(value=False)
        crossings = self.solution.crossings.filter(pl.col("offered") | pl.col("status").is_null())
        return crossings.with_columns(virtual=virtual, accepted=accepted)

    @cached_property
    def accepted(self) -> pl.DataFrame:
        """The virtual balises that the LDS accepted, in order of time."""
        return self.offers.filter("accepted").sort("t")

    @cached_property
    def offers_judged(self) -> Judgements:
        """What the evidence says of every offer: the balise against where the train was."""
        offers = self.offers
        index = self.evidence.network.track.index
        sure = self.positions.unambiguous
        positions = Positions(
            element=offers["netelement_id"].replace_strict(index, default=-1, return_dtype=pl.Int64).to_numpy(),
            measure_m=floats(offers, "measure_m"),
            leg=ints(offers["leg"]),
            path_m=floats(offers, "path_m"),
            direction=self.positions.direction[ints(offers["before"])],
            unambiguous=sure[ints(offers["before"])] & sure[ints(offers["epoch"])],
        )
        t_ns = times_ns(offers)
        return self._judge(positions, np.where(flags(offers, "virtual"), self.instants(t_ns), t_ns))

    def _judge(self, positions: Positions, at_ns: Ints) -> Judgements:
        hazards = self.config.hazards
        found = judge_positions(positions, self.evidence.at(at_ns, self.stood), self.legs, hazards)
        if self.odometry is None:
            return found
        since_ns, path_m = self.instants(times_ns(self.accepted)), floats(self.accepted, "path_m")
        carried = carried_forward(since_ns, path_m, at_ns, self.odometry, self.stood, self.config)
        return with_own_anchors(found, positions, carried, hazards)

    @cached_property
    def train_m(self) -> Floats:
        """Path position of the train where reference or reads tell it closely enough [m], NaN elsewhere."""
        known = self.judged.known_m(self.config.hazards.known_error_m)
        return self.path_m - known * self.positions.direction

    @cached_property
    def by_reference_m(self) -> Floats:
        """The same where the reference tells it."""
        return np.where(self.judged.kind == KINDS.index(Evidence.REFERENCE), self.train_m, np.nan)

    @cached_property
    def margin_m(self) -> Floats:
        """Errors below it are those of a healthy position."""
        return margins_m(floats(self.epochs, "sigma_along_m"), self.config.hazards)

    @cached_property
    def odometer_wrong(self) -> Bools:
        """Epochs at which the distance since the last accepted VB is beyond 5 m + 5 % by the evidence."""
        half = np.where(np.isfinite(self.train_m), self.judged.half_m, np.nan)
        odometer_m, since_ns = floats(self.epochs, "odometer_m"), times_ns(self.accepted)
        return odometer_beyond_confidence(self.t_ns, odometer_m, self.train_m, half, since_ns, self.config.lds)

    def speed_at(self, t_ns: Ints) -> Floats:
        """Speed [m/s] by the epochs around each instant; NaN where no epoch knows it."""
        speed = np.abs(floats(self.epochs, "speed_mps"))
        known = np.isfinite(speed)
        if not known.any():
            return np.full(t_ns.size, np.nan)
        at_s, stamps_s = ((values - self.t_ns[0]) / NS_PER_S for values in (t_ns, self.t_ns[known]))
        found: Floats = np.interp(at_s, stamps_s, speed[known])
        return found

    @cached_property
    def gap_ns(self) -> int:
        """Longest time between epochs over which a movement is interpolated."""
        return crossing_gap_ns(self.t_ns, self.config.lds)
