"""Axes, signs and unit of the GNSS velocity, by the displacement of the same positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, correction, fits, not_checked
from pipeline.plausibility.course import SPEED_S, Places, seconds_since
from pipeline.plausibility.robust import LEAST, sampled
from schemas.arrays import Floats, floats

WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"
# Slower, the scatter of the positions turns the displacement.
_LEAST_MPS = 3.0
# Velocities fit if they differ from the displacement by a smaller share of it; another arrangement explains them if
# it leaves so much less. On a run of one heading exchanged axes turn them by less: from the third on that is told.
_FITS, _EXPLAINS, _TURNED = 0.3, 0.35, 0.1
# Enough climbing to tell up from down: correlation, and the way climbed in the windows [m/s].
_CLIMBS, _LEAST_CLIMB_MPS = 0.6, 0.1


@dataclass(frozen=True)
class Arrangement:
    """How recorded velocities become east and north: exchanged first, then these signs."""

    exchanged: bool
    east: float
    north: float

    def turned(self, velocity: Floats) -> Floats:
        ordered = velocity[:, ::-1] if self.exchanged else velocity
        turned: Floats = ordered * np.array([self.east, self.north])
        return turned

    @property
    def words(self) -> str:
        signs = [name for name, sign in (("east", self.east), ("north", self.north)) if sign < 0]
        exchanged = ["east and north are exchanged"] if self.exchanged else []
        return " and ".join(exchanged + ([f"{' and '.join(signs)} of the wrong sign"] if signs else []))


ARRANGEMENTS = tuple(
    Arrangement(exchanged, east, north) for exchanged in (False, True) for east in (1.0, -1.0) for north in (1.0, -1.0)
)


@dataclass(frozen=True)
class VelocityFit:
    """`ratio`: recorded speed over that of the positions; `misfits`: what each arrangement leaves, as share of it."""

    ratio: float
    misfits: tuple[float, ...]
    one_half_agrees: bool

    @property
    def best(self) -> int:
        """The arrangement that explains the velocities; the recorded one unless another does so far better."""
        other = int(np.argmin(self.misfits))
        recorded = self.misfits[0] <= _TURNED or self.misfits[other] > _EXPLAINS * self.misfits[0]
        return 0 if recorded or self.misfits[other] > _FITS else other


@dataclass(frozen=True)
class _Steps:
    """Begin of steps [s], mean velocity east and north by displacement, and mean recorded velocity."""

    begin_s: Floats
    moved: Floats
    recorded: Floats


def fit_velocity(fixes: pl.DataFrame, gnss: Places, epoch_ns: int) -> VelocityFit | None:
    """None where nothing tells."""
    steps = _fast_steps(fixes, gnss, epoch_ns)
    return None if steps is None else _fitted(steps)


def velocity_checks(fixes: pl.DataFrame, gnss: Places, epoch_ns: int, most: float) -> list[Check]:
    """Checks of the recorded velocity, none where nothing was recorded; `most`: share that no unit is off 1."""
    if fixes["vel_e_mps"].null_count() == fixes.height:
        return []
    steps = _fast_steps(fixes, gnss, epoch_ns)
    if steps is None:
        return [not_checked(WHAT, "hardly any movement with a velocity")]
    return [_horizontal(_fitted(steps), most), *_vertical(gnss, steps)]


def _fast_steps(fixes: pl.DataFrame, gnss: Places, epoch_ns: int) -> _Steps | None:
    t_s = seconds_since(epoch_ns, fixes)
    velocity = np.column_stack([floats(fixes, f"vel_{axis}_mps") for axis in "enu"])
    rows = np.isfinite(velocity[:, :2]).all(axis=1)
    if rows.sum() < LEAST or not np.any(velocity[rows, :2]):
        return None
    begin_s = np.arange(gnss.t_s[0], gnss.t_s[-1] - SPEED_S, SPEED_S)
    begin_s = begin_s[sampled(gnss.known(begin_s) & gnss.known(begin_s + SPEED_S))]
    near = np.searchsorted(gnss.t_s, begin_s).clip(0, gnss.t_s.size - 1)
    step = (gnss.at(begin_s + SPEED_S) - gnss.at(begin_s)) / SPEED_S
    moved = np.column_stack([(step * vectors[near]).sum(axis=1) for vectors in (gnss.points.east, gnss.points.north)])
    # By the trapezium rule.
    instants, weights = begin_s[:, None] + np.linspace(0.0, SPEED_S, 5), np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    recorded = np.column_stack([np.interp(instants, t_s[rows], axis) @ weights for axis in velocity[rows].T])
    fast = np.linalg.norm(moved, axis=1) > _LEAST_MPS
    return _Steps(begin_s[fast], moved[fast], recorded[fast]) if fast.sum() >= 2 * LEAST else None


def _fitted(steps: _Steps) -> VelocityFit:
    moved, recorded = steps.moved, steps.recorded[:, :2]
    size = np.linalg.norm(moved, axis=1)
    ratio = float(np.median(np.linalg.norm(recorded, axis=1) / size))

    def left(one: Arrangement) -> Floats:
        return np.asarray(np.linalg.norm(one.turned(recorded) / max(ratio, 1e-9) - moved, axis=1) / size)

    halves = np.array_split(left(ARRANGEMENTS[0]), 2)
    misfits = tuple(float(np.median(left(one))) for one in ARRANGEMENTS)
    return VelocityFit(ratio, misfits, min(float(np.median(half)) for half in halves) <= _FITS)


def _horizontal(fit: VelocityFit, most: float) -> Check:
    if fit.ratio < 1e-6:
        return Check(WHAT, State.MISFIT, "the velocity is 0 while the positions move")
    arrangement = ARRANGEMENTS[fit.best]
    apart = f"they point elsewhere, by {fit.misfits[0]:.0%} of the speed"
    if fit.best and fit.misfits[0] <= _FITS:
        advice = "Look at a run with curves before the velocity is corrected."
        found = f"{apart}; the run has hardly more than one heading"
        return Check(WHAT, State.MISFIT, found, f"{arrangement.words}, it seems", advice=advice)
    if not fit.best and fit.misfits[0] > _FITS:
        if fit.one_half_agrees:
            return fits(WHAT, "they agree in one half of the run")
        return Check(WHAT, State.MISFIT, apart, "latitude and longitude may be exchanged, or the axes are of the train")
    found = f"the recorded speed is {fit.ratio:.4g} times that of the positions"
    explained = explain_factor(fit.ratio, speed=True) if abs(fit.ratio - 1.0) > most else None
    if explained is None and not fit.best:
        within = abs(fit.ratio - 1.0) <= 1.5 * most
        return fits(WHAT, found) if within else Check(WHAT, State.MISFIT, found)
    doubt = "; the run has one heading only, so others fit too" if sum(one <= _FITS for one in fit.misfits) > 1 else ""
    factor = 1.0 if explained is None else 1.0 / explained.exact
    factors = {"vel_e_mps": arrangement.east * factor, "vel_n_mps": arrangement.north * factor, "vel_u_mps": factor}
    exchange = ("vel_e_mps", "vel_n_mps") if arrangement.exchanged else None
    lines = correction("gnss", {name: value for name, value in factors.items() if value != 1.0}, exchange=exchange)
    causes = " and ".join(filter(None, (explained.cause if explained else "", arrangement.words)))
    return Check(WHAT, State.IMPOSSIBLE, found + (doubt if fit.best else ""), causes, lines)


def _vertical(gnss: Places, steps: _Steps) -> list[Check]:
    """Up against down."""
    known, up_mps = np.isfinite(gnss.height_m), steps.recorded[:, 2]
    if not np.isfinite(up_mps).all() or known.sum() < 2 * LEAST:
        return []
    begin, end = (
        np.interp(at_s, gnss.t_s[known], gnss.height_m[known]) for at_s in (steps.begin_s, steps.begin_s + SPEED_S)
    )
    climbed = (end - begin) / SPEED_S
    # Jumps of the height are no climbing.
    kept = np.abs(climbed) < 4.0 * np.median(np.abs(climbed)) + _LEAST_CLIMB_MPS
    climbed, up_mps = climbed[kept], up_mps[kept]
    if kept.sum() < 2 * LEAST or np.std(climbed) < _LEAST_CLIMB_MPS or not np.any(up_mps != up_mps[0]):
        return [not_checked(_UP, "the run hardly climbs")]
    agreement = float(np.corrcoef(climbed, up_mps)[0, 1])
    found = f"correlation {agreement:.2f}"
    if agreement > -_CLIMBS:
        return [fits(_UP, found) if agreement > _CLIMBS else not_checked(_UP, "the run hardly climbs")]
    lines = correction("gnss", {"vel_u_mps": -1.0})
    return [Check(_UP, State.IMPOSSIBLE, found, "the vertical velocity counts down", lines)]
