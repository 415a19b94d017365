"""Axes, signs and unit of the GNSS velocity, by the displacement of the same positions."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.studies.plausibility.causes import explain_factor
from pipeline.studies.plausibility.check import Check, FitState, KnownCause, correction, fits, misfit, not_checked
from pipeline.studies.plausibility.records import SPEED_S, Places, seconds_since
from pipeline.studies.plausibility.robust import LEAST, sampled
from schemas.arrays import Floats, floats
from schemas.config import PlausibilityConfig
from schemas.enums import MisfitCause

_WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"
# Slower, scatter turns displacements.
_FAST_MPS = 3.0
# Velocities differ from displacements by less than this share of them: noise of positions over 4 s.
VELOCITY_SHARE = 0.3
# Exchanged axes or signs explain velocities that are off by this share at least, if they leave at most this part.
_TURNED = 0.1
_EXPLAINED = 0.35
# Up and down differ by this correlation, where the slope changes by so much over the run: 1 % at 10 m/s.
_CLIMB_AGREES = 0.6
_CLIMB_MPS = 0.1


class Arrangement(NamedTuple):
    """How recorded velocities become east and north: exchanged first, then these signs."""

    exchanged: bool
    east: float
    north: float

    def turned(self, velocity: Floats) -> Floats:
        ordered = velocity[:, ::-1] if self.exchanged else velocity
        turned: Floats = ordered * np.array([self.east, self.north])
        return turned

    @property
    def causes(self) -> tuple[KnownCause, ...]:
        signs = [name for name, sign in (("east", self.east), ("north", self.north)) if sign < 0]
        exchanged = (KnownCause(MisfitCause.VELOCITY_EXCHANGED),) if self.exchanged else ()
        return exchanged + ((KnownCause(MisfitCause.VELOCITY_SIGN, (" and ".join(signs),)),) if signs else ())


ARRANGEMENTS = tuple(Arrangement(*parts) for parts in product((False, True), (1.0, -1.0), (1.0, -1.0)))


class VelocityFit(NamedTuple):
    """`ratio`: recorded speed over that of the positions; `misfits`: what each arrangement leaves, as share of it;
    `best`: the arrangement that explains the velocities, the recorded one (0) unless another does so far better;
    `begin_s`, `recorded`: the steps compared and the mean velocity recorded over each.
    """

    ratio: float
    misfits: Floats
    best: int
    begin_s: Floats
    recorded: Floats


def fit_velocity(fixes: pl.DataFrame, gnss: Places, epoch_ns: int) -> VelocityFit | None:
    """Recorded velocities against the displacement over fast steps; None where there are too few of them."""
    t_s = seconds_since(epoch_ns, fixes)
    velocity = np.column_stack([floats(fixes, f"vel_{axis}_mps") for axis in "enu"])
    rows = np.isfinite(velocity[:, :2]).all(axis=1)
    if rows.sum() < LEAST or not np.any(velocity[rows, :2]):
        return None
    begin_s = gnss.instants(SPEED_S, end_s=gnss.t_s[-1] - SPEED_S)
    begin_s = begin_s[sampled(gnss.known(begin_s) & gnss.known(begin_s + SPEED_S))]
    step = gnss.gained(begin_s, begin_s + SPEED_S) / SPEED_S
    near = np.clip(np.searchsorted(gnss.t_s, begin_s), 0, gnss.t_s.size - 1)
    moved = np.column_stack([(step * vectors[near]).sum(axis=1) for vectors in (gnss.points.east, gnss.points.north)])
    # By the trapezium rule.
    instants = begin_s[:, None] + np.linspace(0.0, SPEED_S, 5)
    weights = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    recorded = np.column_stack([np.interp(instants, t_s[rows], axis) @ weights for axis in velocity[rows].T])
    size = np.linalg.norm(moved, axis=1)
    fast = size > _FAST_MPS
    if fast.sum() < 2 * LEAST:
        return None
    moved = moved[fast]
    recorded = recorded[fast]
    size = size[fast]
    flat = recorded[:, :2]
    ratio = float(np.median(np.linalg.norm(flat, axis=1) / size))
    left = [np.linalg.norm(way.turned(flat) / max(ratio, 1e-9) - moved, axis=1) / size for way in ARRANGEMENTS]
    misfits = np.median(left, axis=1)
    best = int(np.argmin(misfits))
    far_better = misfits[0] > _TURNED and misfits[best] <= min(_EXPLAINED * misfits[0], VELOCITY_SHARE)
    return VelocityFit(ratio, misfits, best if far_better else 0, begin_s[fast], recorded)


def velocity_checks(fit: VelocityFit | None, gnss: Places, config: PlausibilityConfig) -> list[Check]:
    """Checks of the recorded velocity."""
    if fit is None:
        return [not_checked(_WHAT, "hardly any movement with a velocity")]
    return [_horizontal(fit, config), *_vertical(gnss, fit)]


def _horizontal(fit: VelocityFit, config: PlausibilityConfig) -> Check:
    arrangement = ARRANGEMENTS[fit.best]
    as_recorded = f"they point elsewhere, by {fit.misfits[0]:.0%} of the speed"
    if fit.best and fit.misfits[0] <= VELOCITY_SHARE:
        advice = "Look at a run with curves before the velocity is corrected."
        return Check(_WHAT, FitState.MISFIT, as_recorded, arrangement.causes, advice=advice)
    if not fit.best and fit.misfits[0] > VELOCITY_SHARE:
        return misfit(_WHAT, as_recorded, MisfitCause.VELOCITY_FRAME)
    words = f"the recorded speed is {fit.ratio:.4g} times that of the positions"
    off = abs(fit.ratio - 1.0)
    explained = explain_factor(fit.ratio, True) if off > config.scale_limit else None
    if explained is None and not fit.best:
        return fits(_WHAT, words) if off <= 1.5 * config.scale_limit else misfit(_WHAT, words)
    if fit.best and (fit.misfits <= VELOCITY_SHARE).sum() > 1:
        words += "; the run has one heading only, so others fit too"
    factor = 1.0 if explained is None else 1.0 / explained.exact
    factors = {"vel_e_mps": arrangement.east * factor, "vel_n_mps": arrangement.north * factor, "vel_u_mps": factor}
    exchange = ("vel_e_mps", "vel_n_mps") if arrangement.exchanged else None
    lines = correction("gnss", {name: value for name, value in factors.items() if value != 1.0}, exchange=exchange)
    causes = (explained.causes if explained else ()) + arrangement.causes
    return Check(_WHAT, FitState.IMPOSSIBLE, words, causes, lines)


def _vertical(gnss: Places, fit: VelocityFit) -> list[Check]:
    """Up against down."""
    known = np.isfinite(gnss.height_m)
    up_mps = fit.recorded[:, 2]
    if not np.isfinite(up_mps).all() or known.sum() < 2 * LEAST:
        return []
    ends = np.interp([fit.begin_s, fit.begin_s + SPEED_S], gnss.t_s[known], gnss.height_m[known])
    climbed = (ends[1] - ends[0]) / SPEED_S
    # Jumps of the height are no climbing.
    kept = np.abs(climbed) < 4.0 * np.median(np.abs(climbed)) + _CLIMB_MPS
    climbed = climbed[kept]
    up_mps = up_mps[kept]
    agreement = 0.0
    if kept.sum() >= 2 * LEAST and np.std(climbed) >= _CLIMB_MPS and np.any(up_mps != up_mps[0]):
        agreement = float(np.corrcoef(climbed, up_mps)[0, 1])
    if abs(agreement) <= _CLIMB_AGREES:
        return [not_checked(_UP, "the run hardly climbs")]
    words = f"correlation {agreement:.2f}"
    if agreement > 0.0:
        return [fits(_UP, words)]
    lines = correction("gnss", {"vel_u_mps": -1.0})
    return [Check(_UP, FitState.IMPOSSIBLE, words, (KnownCause(MisfitCause.VELOCITY_DOWN),), lines)]
