"""When the train moved, how far and how fast, after the fact: by the odometer, unless the positions contradict it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.epochs.timeline import moved
from pipeline.motion.contradicted import Contradiction, contradictions
from pipeline.motion.position_rate import PositionRate
from pipeline.motion.witness import Witness
from pipeline.odometry.driven import evenly_driven, hysteresis_m, way_m
from schemas.arrays import NS_PER_S, Bools, Floats, floats, times_ns
from schemas.config import Configuration

# Time over which the speed of an odometer is taken whose rows scatter.
_WINDOW_S = 1.0


@dataclass(frozen=True)
class Motion:
    """Per epoch, from it to the next (the last: as before): whether the train moved, and whether that is known.

    `speed_mps`: along growing path, NaN where nobody knows. `distance_m`: way driven, None without a way to tell.
    `contradicted`: stretches in which the odometer stood and the positions moved on.
    """

    moving: Bools
    known: Bools
    speed_mps: Floats
    distance_m: float | None
    contradicted: tuple[Contradiction, ...] = ()

    def columns(self) -> list[pl.Series]:
        moving = pl.select(pl.when(pl.Series(self.known)).then(pl.Series(self.moving)).alias("moving")).to_series()
        return [moving, pl.Series("speed_mps", self.speed_mps, nan_to_null=True)]


def motion_by_odometer(epochs: pl.DataFrame, deadband_mps: float) -> Motion:
    """What the odometer says, and the GNSS speed where the run has none; nothing is held against it.

    `epochs`: `t, path_m, odometer_m, speed_mps, direction`, and `odometer_rows_m` where rows may scatter.
    """
    t_ns, distance, speed = times_ns(epochs), floats(epochs, "odometer_m"), floats(epochs, "speed_mps")
    counted = np.flatnonzero(np.isfinite(distance))
    width = np.zeros(0)
    if "odometer_rows_m" in epochs.columns and counted.size:
        width = hysteresis_m(np.nan_to_num(floats(epochs, "odometer_rows_m")))[counted]
    if not width.any():
        moving = _held(moved(t_ns, distance, speed, deadband_mps))
        return Motion(moving, np.ones(t_ns.size, dtype=np.bool_), speed, _distance_m(epochs))
    t_s = (t_ns - t_ns[0]) / NS_PER_S
    moving = _held(_moved_with_play(t_s, distance, width, speed, deadband_mps))
    return Motion(moving, np.ones(t_ns.size, dtype=np.bool_), speed, way_m(distance[counted], width))


def motion_of(epochs: pl.DataFrame, truth: pl.DataFrame, config: Configuration) -> Motion:
    """What the odometer says, held against the positions and whatever else was recorded (`contradictions`).

    Where the odometer tells nothing, the positions do. `epochs`: matched and aligned; `truth`: from `establish_truth`.
    """
    deadband_mps = config.matching.deadband_mps
    plain = motion_by_odometer(epochs, deadband_mps)
    if epochs.height < 2:
        return plain
    positions = PositionRate.of(epochs, ~plain.moving)
    motion = _by_positions(plain, epochs, positions, deadband_mps)
    witness = Witness.of(epochs, truth, positions, plain.moving)
    found = contradictions(witness, config)
    moving, known, speed = motion.moving.copy(), motion.known.copy(), motion.speed_mps.copy()
    distance_m = plain.distance_m
    for one in found:
        part = slice(one.first, one.last + 1)
        stood = ~plain.moving[part]
        known[part] &= ~stood if one.moved is None else True
        moving[part] |= stood
        speed[part] = np.where(stood, np.nan if one.moved is None else positions.at_mps[part], speed[part])
        if one.moved and distance_m is not None:
            distance_m += abs(one.way_m)
    return replace(motion, moving=moving, known=known, speed_mps=speed, distance_m=distance_m, contradicted=found)


def _by_positions(motion: Motion, epochs: pl.DataFrame, positions: PositionRate, deadband_mps: float) -> Motion:
    """Where neither distance nor speed of the odometer is known: by how fast positions moved on."""
    counted = np.isfinite(floats(epochs, "odometer_m"))
    silent = _held(~(counted[:-1] & counted[1:]) & ~np.isfinite(motion.speed_mps[:-1]), append=False)
    by_positions = np.abs(positions.step_mps) > deadband_mps
    moving = np.where(silent, by_positions, motion.moving)
    return replace(motion, moving=moving, known=motion.known & ~(silent & ~np.isfinite(positions.step_mps)))


def _held(moving: Bools, *, append: bool = True) -> Bools:
    """From each epoch to the next; nothing follows upon the last one, which stays as it was before."""
    steps = moving[:-1] if append else moving
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last]) if moving.size else moving


def _moved_with_play(t_s: Floats, distance_m: Floats, width_m: Floats, speed_mps: Floats, deadband_mps: float) -> Bools:
    """As `timeline.moved`, of a distance that scatters: over a second around each step, or over longer ones."""
    counted = np.flatnonzero(np.isfinite(distance_m))
    at_s, at_m = evenly_driven(t_s[counted], distance_m[counted], width_m, deadband_mps)
    begin, end = t_s, np.append(t_s[1:], t_s[-1:])
    half_s, centre = 0.5 * np.maximum(end - begin, _WINDOW_S), 0.5 * (begin + end)
    way = np.interp(centre + half_s, at_s, at_m) - np.interp(centre - half_s, at_s, at_m)
    by_way = way / (2.0 * half_s)
    both = np.isfinite(distance_m) & np.isfinite(np.append(distance_m[1:], np.nan))
    speed = np.where(both, np.abs(by_way), np.abs(speed_mps))
    return np.asarray((speed > deadband_mps) & (end > begin))


def _distance_m(epochs: pl.DataFrame) -> float | None:
    """Distance travelled [m]: by the odometer; without one by the positions while they moved.

    Positions count from first to last of each stretch in one direction, so that noise adds nothing.
    """
    odometer = epochs["odometer_m"].drop_nulls()
    if odometer.len() > 1:
        return float(odometer.diff().abs().sum())
    moving = epochs.filter(pl.col("path_m").is_not_null() & (pl.col("direction").fill_null(0) != 0))
    if moving.height < 2:
        return None
    stretches = moving.group_by(pl.col("direction").rle_id(), maintain_order=True).agg(
        (pl.col("path_m").last() - pl.col("path_m").first()).abs()
    )
    return float(stretches["path_m"].sum())
