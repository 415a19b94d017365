"""Axes, signs and unit of the GNSS velocity, by the displacement of the same positions."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pipeline.studies.plausibility.causes import explain_factor
from pipeline.studies.plausibility.check import Cause, Check, FitState, correction, fits, misfit, not_checked
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.records import SPEED_S
from pipeline.studies.plausibility.robust import LEAST, sampled
from schemas.arrays import Floats, floats
from schemas.enums import MisfitCause

_WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"
_COLUMNS = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
# Slower, scatter turns displacements.
_FAST_MPS = 3.0
# Velocities differ from displacements by less than this share of them: noise of positions over 4 s.
_VELOCITY_SHARE = 0.3
# Exchanged axes or signs explain velocities that are off by this share at least, if they leave at most this part.
_TURNED = 0.1
_EXPLAINED = 0.35
# Up and down differ by this correlation, where the slope changes by so much over the run: 1 % at 10 m/s.
_CLIMB_AGREES = 0.6
_CLIMB_MPS = 0.1
# The mean over a step by the trapezium rule.
_MEAN = np.array([0.125, 0.25, 0.25, 0.25, 0.125])


class Arrangement(NamedTuple):
    """How recorded velocities become east and north: exchanged first, then these signs."""

    exchanged: bool
    east: float
    north: float

    def turned(self, velocity: Floats) -> Floats:
        ordered = velocity[:, ::-1] if self.exchanged else velocity
        turned: Floats = ordered * np.array([self.east, self.north])
        return turned

    def correction(self, factor: float) -> str:
        """The lines of configuration that undo this arrangement and scale all axes."""
        axes = (self.east * factor, self.north * factor, factor)
        changed = {name: value for name, value in zip(_COLUMNS, axes, strict=True) if value != 1.0}
        return correction("gnss", changed, exchange=_COLUMNS[:2] if self.exchanged else None)

    @property
    def causes(self) -> tuple[Cause, ...]:
        signs = [name for name, sign in (("east", self.east), ("north", self.north)) if sign < 0]
        exchanged = (Cause(MisfitCause.VELOCITY_EXCHANGED),) if self.exchanged else ()
        return exchanged + ((Cause(MisfitCause.VELOCITY_SIGN, (" and ".join(signs),)),) if signs else ())


_AS_RECORDED, *_OTHERS = (Arrangement(*parts) for parts in product((False, True), (1.0, -1.0), (1.0, -1.0)))


def velocity_checks(of: Recording) -> list[Check]:
    """The recorded velocity, as mean over steps, against the displacement of the positions."""
    rows = np.column_stack([floats(of.fixes, name) for name in _COLUMNS])
    known = np.isfinite(rows[:, :2]).all(axis=1)
    if not known.any():
        return []
    gnss = of.gnss
    begin_s = gnss.instants(SPEED_S)
    begin_s = begin_s[sampled(gnss.known(begin_s) & gnss.known(begin_s + SPEED_S))]
    near = np.clip(np.searchsorted(gnss.t_s, begin_s), 0, gnss.t_s.size - 1)
    axes = np.stack([gnss.points.east[near], gnss.points.north[near]], axis=1)
    moved = np.einsum("ijk,ik->ij", axes, gnss.gained(begin_s, begin_s + SPEED_S)) / SPEED_S
    fast = np.linalg.norm(moved, axis=1) > _FAST_MPS
    if known.sum() < LEAST or fast.sum() < 2 * LEAST or not rows[known, :2].any():
        return [not_checked(_WHAT, "hardly any movement with a velocity")]
    instants = begin_s[fast, None] + np.linspace(0.0, SPEED_S, _MEAN.size)
    t_s = of.seconds(of.fixes)[known]
    recorded = np.column_stack([np.interp(instants, t_s, axis) @ _MEAN for axis in rows[known].T])
    return [_horizontal(recorded[:, :2], moved[fast], of), *_vertical(recorded[:, 2], begin_s[fast], of)]


def _horizontal(recorded: Floats, moved: Floats, of: Recording) -> Check:
    """Axes and signs first, by the arrangement that leaves least; then the unit, by the ratio of the speeds."""
    speed = np.linalg.norm(moved, axis=1)
    ratio = float(np.median(np.linalg.norm(recorded, axis=1) / speed))

    def misses(arrangement: Arrangement) -> float:
        """What it leaves usually, as a share of the speed."""
        left = arrangement.turned(recorded) / max(ratio, 1e-9) - moved
        return float(np.median(np.linalg.norm(left, axis=1) / speed))

    best = min(_OTHERS, key=misses)
    off = misses(_AS_RECORDED)
    turned = off > _TURNED and misses(best) <= min(_EXPLAINED * off, _VELOCITY_SHARE)
    elsewhere = f"they point elsewhere, by {off:.0%} of the speed"
    if off > _VELOCITY_SHARE and not turned:
        return misfit(_WHAT, elsewhere, MisfitCause.VELOCITY_FRAME)
    if turned and off <= _VELOCITY_SHARE:
        return Check(_WHAT, FitState.MISFIT, elsewhere, best.causes)
    return _magnitude(ratio, best if turned else _AS_RECORDED, of.config.scale_limit)


def _magnitude(ratio: float, arrangement: Arrangement, limit: float) -> Check:
    """The recorded speed over that of the positions: it fits, or a known unit explains it."""
    words = f"the recorded speed is {ratio:.4g} times that of the positions"
    explained = explain_factor(ratio, True) if abs(ratio - 1.0) > limit else None
    if explained is None and arrangement == _AS_RECORDED:
        return fits(_WHAT, words) if abs(ratio - 1.0) <= 1.5 * limit else misfit(_WHAT, words)
    if explained is None:
        return Check(_WHAT, FitState.IMPOSSIBLE, words, arrangement.causes, arrangement.correction(1.0))
    cause, unit = explained
    causes = (cause, *arrangement.causes)
    return Check(_WHAT, FitState.IMPOSSIBLE, words, causes, arrangement.correction(1.0 / unit))


def _vertical(up_mps: Floats, begin_s: Floats, of: Recording) -> list[Check]:
    """Up against down."""
    gnss = of.gnss
    known = np.isfinite(gnss.height_m)
    if not np.isfinite(up_mps).all() or known.sum() < 2 * LEAST:
        return []
    ends = np.interp([begin_s, begin_s + SPEED_S], gnss.t_s[known], gnss.height_m[known])
    climbed = (ends[1] - ends[0]) / SPEED_S
    # Jumps of the height are no climbing.
    kept = np.abs(climbed) < 4.0 * np.median(np.abs(climbed)) + _CLIMB_MPS
    climbed = climbed[kept]
    up_mps = up_mps[kept]
    agreement = 0.0
    if climbed.size >= 2 * LEAST and np.std(climbed) >= _CLIMB_MPS and np.ptp(up_mps):
        agreement = float(np.corrcoef(climbed, up_mps)[0, 1])
    if abs(agreement) <= _CLIMB_AGREES:
        return [not_checked(_UP, "the run hardly climbs")]
    words = f"correlation {agreement:.2f}"
    if agreement > 0.0:
        return [fits(_UP, words)]
    causes = (Cause(MisfitCause.VELOCITY_DOWN),)
    return [Check(_UP, FitState.IMPOSSIBLE, words, causes, correction("gnss", {"vel_u_mps": -1.0}))]
