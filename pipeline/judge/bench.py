"""What every question about one solution needs: its positions, the evidence, and the instants that they are held at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.epochs.clock import crossing_gap_ns, met, position_ns, unambiguous
from pipeline.evidence import Evidence as AllEvidence
from pipeline.evidence.carrying import carried_forward
from pipeline.evidence.evidence import KINDS, within_spans
from pipeline.judge.judgement import Judgements, Positions, judge_positions, margins_m, with_own_anchors
from pipeline.judge.jumps import Jump, find_jumps, steps_of
from pipeline.judge.states import held_on, in_use_s, odometer_beyond_confidence, stood_spans
from pipeline.odometry import Odometry
from pipeline.track.path import Route, TravelledPath
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
class Series:
    """Valid positions of one solution in order of time, judged; `row`: their epochs.

    `path_m`, `train_m`: path positions of position and train (NaN where not known), `direction` of travel along it;
    `used_s`: for how long each was in use; `sigma_m`: of the position; `jumps` in order of time.
    """

    row: Ints
    t_ns: Ints
    path_m: Floats
    train_m: Floats
    direction: Ints
    judged: Judgements
    used_s: Floats
    sigma_m: Floats
    jumps: list[Jump]

    @property
    def size(self) -> int:
        return self.t_ns.size


@dataclass(frozen=True)
class Offers:
    """Crossings and telegrams, judged; arrays in order of time.

    `number`: the valid position that completes the crossing (`Series`); `beyond_window`: offered after its window
    closed; `accepted`: a virtual one by the LDS; not `offered`: crossed again before it was re-armed, which only a jump
    does.
    """

    crossing_id: Ints
    balise_id: list[str]
    t_ns: Ints
    number: Ints
    path_m: Floats
    judged: Judgements
    virtual: Bools
    offered: Bools
    accepted: Bools
    beyond_window: Bools


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

    @cached_property
    def position_ns(self) -> Ints:
        """Times of the epochs with a position."""
        return position_ns(self.epochs)

    def instants(self, t_ns: Ints) -> Ints:
        """When positions of these stamps were true: less the latency of the vehicle file, 0 without one."""
        return t_ns - round((self.vehicle.gnss_latency_s or 0.0) * NS_PER_S)

    @cached_property
    def at_ns(self) -> Ints:
        return self.instants(self.t_ns)

    @cached_property
    def legs(self) -> list[Route]:
        return self.solution.path.routes(self.evidence.network.track.index)

    @cached_property
    def path_m(self) -> Floats:
        """Path positions, NaN without a valid fix."""
        return floats(self.epochs, "path_m")

    @cached_property
    def odometer_moves(self) -> Bools:
        """Per epoch whether the odometer says that the train moved to the next one."""
        nothing = np.zeros(self.t_ns.size - 1, dtype=np.bool_)
        return held_on(nothing if self.odometry is None else self.odometry.moved(self.at_ns), self.t_ns.size)

    @cached_property
    def odometer_told(self) -> Bools:
        """Per epoch whether the odometer counted from it to the next one."""
        nothing = np.full(self.t_ns.size - 1, np.nan)
        steps = self.at_ns[:-1], self.at_ns[1:]
        counted_m = nothing if self.odometry is None else self.odometry.between(*steps).distance_m
        return held_on(np.isfinite(counted_m), self.t_ns.size)

    @cached_property
    def stood(self) -> list[tuple[int, int]]:
        limit_m = self.config.hazards.failure_limit_m
        return stood_spans(self.at_ns, self.path_m, self.odometer_moves, self.odometer_told, limit_m)

    @cached_property
    def positions(self) -> Positions:
        """The positions of all epochs.

        Without an odometer the direction of travel is that of the train's own place, where the evidence tells it: a
        position that jumps back does not turn the train. With one it is the odometer's, but for an odometer that counts
        up while the train reverses, where the reference tells.
        """
        told = self._positions(ints(self.epochs["direction"], 1))
        found = judge_positions(told, self.evidence.at(self.at_ns), self.legs, self.config.hazards)
        train_m = self.path_m - found.known_m(self.config.hazards.known_error_m) * told.direction
        came_m, noise_m, _ = self._came(train_m, found.half_m, self.config.hazards.turn_s)
        with np.errstate(invalid="ignore"):
            sure = np.abs(came_m) > noise_m
        sense = np.sign(came_m)
        by_reference = found.kind == KINDS.index(Evidence.REFERENCE)
        if self.odometry is not None:
            # Not over a turn: the odometer knows best when that was.
            turned = self._came(told.direction.astype(np.float64), found.half_m, self.config.hazards.turn_s)[0]
            sure &= by_reference & (turned == 0.0)
            sense *= told.direction
        rows = np.flatnonzero(sure)
        if rows.size == 0:
            return told
        last = np.maximum(np.searchsorted(rows, np.arange(self.t_ns.size), side="right") - 1, 0)
        sense = sense[rows].astype(np.int64)[last]
        if self.odometry is None:
            return self._positions(sense)
        return self._positions(told.direction * np.where(by_reference, sense, 1))

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
    def used_s(self) -> Floats:
        """For how long each epoch stands for a position in use [s]."""
        return in_use_s(self.epochs, self.config)

    @cached_property
    def series(self) -> Series:
        """The valid positions with their jumps."""
        row = np.flatnonzero(self.positions.known)
        at_ns, t_ns, path_m = self.at_ns[row], self.t_ns[row], self.path_m[row]
        counted_m = np.full(max(row.size - 1, 0), np.nan)
        if self.odometry is not None:
            counted_m = self.odometry.between(at_ns[:-1], at_ns[1:]).distance_m
        steps, direction = (
            steps_of(t_ns, path_m, self.by_reference_m[row], counted_m, self.gap_ns),
            self.positions.direction[row],
        )
        return Series(
            row=row,
            t_ns=t_ns,
            path_m=path_m,
            train_m=self.train_m[row],
            direction=direction,
            judged=self.judged.take(row),
            used_s=self.used_s[row],
            sigma_m=floats(self.epochs, "sigma_along_m")[row],
            jumps=find_jumps(steps, direction, self.config.hazards),
        )

    @cached_property
    def _offered(self) -> pl.DataFrame:
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
        return self._offered.filter("accepted").sort("t")

    @cached_property
    def offers(self) -> Offers:
        """What was offered, the balise judged against where the train was."""
        offered, passages, valid = self._offered, self.solution.passages, self.series.row
        late = passages.filter(pl.col("odometer_distance_m") > pl.col("window_close_m"))["crossing_id"]
        index, sure = self.evidence.network.track.index, self.positions.unambiguous
        t_ns, virtual = times_ns(offered), flags(offered, "virtual")
        before, epoch = ints(offered["before"]), ints(offered["epoch"])
        positions = Positions(
            element=offered["netelement_id"].replace_strict(index, default=-1, return_dtype=pl.Int64).to_numpy(),
            measure_m=floats(offered, "measure_m"),
            leg=ints(offered["leg"]),
            path_m=floats(offered, "path_m"),
            direction=self.positions.direction[before],
            unambiguous=sure[before] & sure[epoch],
        )
        return Offers(
            crossing_id=ints(offered["crossing_id"]),
            balise_id=offered["balise_id"].to_list(),
            t_ns=t_ns,
            number=np.searchsorted(valid, epoch).clip(0, max(valid.size - 1, 0)),
            path_m=positions.path_m,
            judged=self._judge(positions, np.where(virtual, self.instants(t_ns), t_ns)),
            virtual=virtual,
            offered=virtual & flags(offered, "offered"),
            accepted=flags(offered, "accepted"),
            beyond_window=offered["crossing_id"].is_in(late.drop_nulls().implode()).to_numpy(),
        )

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
        """Longest time between positions over which a movement is interpolated."""
        return crossing_gap_ns(self.position_ns, self.config.lds)

    @cached_property
    def moving(self) -> tuple[Bools, Bools]:
        """Per epoch whether the train moved to the next one, and whether that is known: by reference or odometer.

        By the reference it moved where it came farther over a second than the dead band and the noise of both places
        allow. It also tells where the odometer stands or is silent.
        """
        window_s = self.config.align.speed_window_s
        came_m, noise_m, elapsed_s = self._came(self.by_reference_m, self.judged.half_m, window_s)
        with np.errstate(invalid="ignore"):
            by_reference = np.abs(came_m) > self.config.matching.deadband_mps * elapsed_s + noise_m
        told = np.isfinite(came_m)
        moves, sure = by_reference | (self.odometer_moves & self.odometer_told), told | self.odometer_told
        sure &= told | ~within_spans(self.at_ns, self.stood)
        return held_on(moves[:-1], moves.size), held_on(sure[:-1], sure.size)

    def _came(self, place_m: Floats, half_m: Floats, window_s: float) -> tuple[Floats, Floats, Floats]:
        """How far from each epoch to the one `window_s` later [m], what both places may be off by [m], and the time."""
        t_ns = self.at_ns
        ahead = np.searchsorted(t_ns, t_ns + round(window_s * NS_PER_S)).clip(0, t_ns.size - 1)
        return place_m[ahead] - place_m, half_m + half_m[ahead], (t_ns[ahead] - t_ns) / NS_PER_S
