"""Axes, signs and unit of the GNSS velocity, by the displacement of the same positions."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.studies.plausibility.causes import explain_factor
from pipeline.studies.plausibility.check import Cause, Check, State, correction, fits, not_checked
from pipeline.studies.plausibility.records import Places, seconds_since
from pipeline.studies.plausibility.robust import LEAST, sampled
from schemas.arrays import Floats, floats
from schemas.config import PlausibilityConfig
from schemas.enums import MisfitCause

_WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"


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
    def causes(self) -> tuple[Cause, ...]:
        signs = [name for name, sign in (("east", self.east), ("north", self.north)) if sign < 0]
        exchanged = (Cause(MisfitCause.VELOCITY_EXCHANGED),) if self.exchanged else ()
        return exchanged + ((Cause(MisfitCause.VELOCITY_SIGN, (" and ".join(signs),)),) if signs else ())


ARRANGEMENTS = tuple(Arrangement(*one) for one in product((False, True), (1.0, -1.0), (1.0, -1.0)))


class VelocityFit(NamedTuple):
    """`ratio`: recorded speed over that of the positions; `misfits`: what each arrangement leaves, as share of it;
    `best`: the arrangement that explains the velocities, the recorded one (0) unless another does so far better.

    Of the steps compared `begin_s`, the mean velocity east and north by displacement, and the recorded one.
    """

    ratio: float
    misfits: Floats
    best: int
    begin_s: Floats
    recorded: Floats


def fit_velocity(fixes: pl.DataFrame, gnss: Places, epoch_ns: int) -> VelocityFit | None:
    """Recorded velocities against the displacement over fast steps; None where nothing tells."""
    config, over_s, t_s = gnss.config, gnss.config.speed_s, seconds_since(epoch_ns, fixes)
    velocity = np.column_stack([floats(fixes, f"vel_{axis}_mps") for axis in "enu"])
    rows = np.isfinite(velocity[:, :2]).all(axis=1)
    if rows.sum() < LEAST or not np.any(velocity[rows, :2]):
        return None
    begin_s = np.arange(gnss.t_s[0], gnss.t_s[-1] - over_s, over_s)
    begin_s = begin_s[sampled(gnss.known(begin_s) & gnss.known(begin_s + over_s))]
    step = gnss.gained(begin_s, begin_s + over_s) / over_s
    near = np.clip(np.searchsorted(gnss.t_s, begin_s), 0, gnss.t_s.size - 1)
    moved = np.column_stack([(step * vectors[near]).sum(axis=1) for vectors in (gnss.points.east, gnss.points.north)])
    # By the trapezium rule.
    instants, weights = begin_s[:, None] + np.linspace(0.0, over_s, 5), np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    recorded = np.column_stack([np.interp(instants, t_s[rows], axis) @ weights for axis in velocity[rows].T])
    size = np.linalg.norm(moved, axis=1)
    fast = size > config.velocity_mps
    if fast.sum() < 2 * LEAST:
        return None
    begin_s, moved, recorded, size = begin_s[fast], moved[fast], recorded[fast], size[fast]
    flat = recorded[:, :2]
    ratio = float(np.median(np.linalg.norm(flat, axis=1) / size))
    left = [np.linalg.norm(one.turned(flat) / max(ratio, 1e-9) - moved, axis=1) / size for one in ARRANGEMENTS]
    misfits = np.median(left, axis=1)
    other = int(np.argmin(misfits))
    far_better = misfits[0] > config.velocity_turned and misfits[other] <= min(
        config.velocity_explained * misfits[0], config.velocity_share
    )
    return VelocityFit(ratio, misfits, other if far_better else 0, begin_s, recorded)


def velocity_checks(fit: VelocityFit | None, gnss: Places) -> list[Check]:
    """Checks of the recorded velocity."""
    if fit is None:
        return [not_checked(_WHAT, "hardly any movement with a velocity")]
    return [_horizontal(fit, gnss.config), *_vertical(gnss, fit)]


def _horizontal(fit: VelocityFit, config: PlausibilityConfig) -> Check:
    arrangement, most = ARRANGEMENTS[fit.best], config.velocity_share
    as_recorded = f"they point elsewhere, by {fit.misfits[0]:.0%} of the speed"
    if fit.best and fit.misfits[0] <= most:
        advice = "Look at a run with curves before the velocity is corrected."
        return Check(_WHAT, State.MISFIT, as_recorded, arrangement.causes, advice=advice)
    if not fit.best and fit.misfits[0] > most:
        return Check(_WHAT, State.MISFIT, as_recorded, (Cause(MisfitCause.VELOCITY_FRAME),))
    found = f"the recorded speed is {fit.ratio:.4g} times that of the positions"
    off = abs(fit.ratio - 1.0)
    explained = explain_factor(fit.ratio, True, config) if off > config.scale_limit else None
    if explained is None and not fit.best:
        return fits(_WHAT, found) if off <= 1.5 * config.scale_limit else Check(_WHAT, State.MISFIT, found)
    doubt = "; the run has one heading only, so others fit too" if fit.best and (fit.misfits <= most).sum() > 1 else ""
    factor = 1.0 if explained is None else 1.0 / explained.exact
    factors = {"vel_e_mps": arrangement.east * factor, "vel_n_mps": arrangement.north * factor, "vel_u_mps": factor}
    exchange = ("vel_e_mps", "vel_n_mps") if arrangement.exchanged else None
    lines = correction("gnss", {name: value for name, value in factors.items() if value != 1.0}, exchange=exchange)
    causes = (explained.causes if explained else ()) + arrangement.causes
    return Check(_WHAT, State.IMPOSSIBLE, found + doubt, causes, lines)


def _vertical(gnss: Places, fit: VelocityFit) -> list[Check]:
    """Up against down."""
    config, over_s = gnss.config, gnss.config.speed_s
    known, up_mps = np.isfinite(gnss.height_m), fit.recorded[:, 2]
    if not np.isfinite(up_mps).all() or known.sum() < 2 * LEAST:
        return []
    ends = np.interp([fit.begin_s, fit.begin_s + over_s], gnss.t_s[known], gnss.height_m[known])
    climbed = (ends[1] - ends[0]) / over_s
    # Jumps of the height are no climbing.
    kept = np.abs(climbed) < 4.0 * np.median(np.abs(climbed)) + config.climb_mps
    climbed, up_mps = climbed[kept], up_mps[kept]
    agreement = 0.0
    if kept.sum() >= 2 * LEAST and np.std(climbed) >= config.climb_mps and np.any(up_mps != up_mps[0]):
        agreement = float(np.corrcoef(climbed, up_mps)[0, 1])
    if abs(agreement) <= config.climb_agrees:
        return [not_checked(_UP, "the run hardly climbs")]
    found = f"correlation {agreement:.2f}"
    if agreement > 0.0:
        return [fits(_UP, found)]
    lines = correction("gnss", {"vel_u_mps": -1.0})
    return [Check(_UP, State.IMPOSSIBLE, found, (Cause(MisfitCause.VELOCITY_DOWN),), lines)]
