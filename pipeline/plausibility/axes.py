"""Axes, signs and unit of the GNSS velocity, by the displacement of the same positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, fits, not_checked
from pipeline.plausibility.corrections import correction
from pipeline.plausibility.course import Places, seconds_since
from schemas.arrays import Bools, Floats, floats

WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"
_SPAN_S = 4.0
_LEAST_MPS = 3.0
_LEAST_WINDOWS = 15
_MOST_WINDOWS = 800
# Velocities fit if they differ from the displacement by a smaller share of it; another arrangement explains them if
# it leaves so much less.
_FITS, _EXPLAINS = 0.3, 0.35
# On a run of one heading exchanged axes turn the velocity by less; beyond this share of it that is told, and no more.
_TURNED = 0.1
# Reflections and latency never change the unit by so much.
_UNIT_LIMIT = 0.12
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


def velocity_checks(fixes: pl.DataFrame, gnss: Places, epoch_ns: int) -> list[Check]:
    """Checks of the recorded velocity; none where nothing was recorded."""
    t_s = seconds_since(epoch_ns, fixes)
    velocity = np.column_stack([floats(fixes, f"vel_{axis}_mps") for axis in "enu"])
    rows = np.isfinite(velocity[:, :2]).all(axis=1)
    if rows.sum() < 2:
        return []
    begin_s, moved, recorded = _windows(gnss, t_s[rows], velocity[rows])
    fast = np.hypot(moved[:, 0], moved[:, 1]) > _LEAST_MPS
    if fast.sum() < _LEAST_WINDOWS or not np.any(recorded[:, :2]):
        return [not_checked(WHAT, "hardly any movement with a velocity")]
    return [_horizontal(moved[fast], recorded[fast]), *_vertical(gnss, begin_s, recorded[:, 2], fast)]


def _windows(gnss: Places, t_s: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
    """Begin of windows, mean velocity east and north by displacement, and mean recorded velocity."""
    begin_s = np.arange(gnss.t_s[0], gnss.t_s[-1] - _SPAN_S, _SPAN_S)
    begin_s = begin_s[:: max(1, begin_s.size // _MOST_WINDOWS)]
    known = gnss.known(begin_s) & gnss.known(begin_s + _SPAN_S)
    begin_s = begin_s[known]
    near = np.searchsorted(gnss.t_s, begin_s).clip(0, gnss.t_s.size - 1)
    step = (gnss.at(begin_s + _SPAN_S) - gnss.at(begin_s)) / _SPAN_S
    moved = np.column_stack(
        [np.einsum("ij,ij->i", step, vectors[near]) for vectors in (gnss.points.east, gnss.points.north)]
    )
    instants = begin_s[:, None] + np.linspace(0.0, _SPAN_S, 5)
    weights = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    recorded = np.column_stack([np.interp(instants, t_s, velocity[:, axis]) @ weights for axis in range(3)])
    return begin_s, moved, recorded


def _horizontal(moved: Floats, recorded: Floats) -> Check:
    size = np.hypot(moved[:, 0], moved[:, 1])
    ratio = float(np.median(np.hypot(recorded[:, 0], recorded[:, 1]) / size))
    if ratio < 1e-6:
        return Check(WHAT, State.MISFIT, "the velocity is 0 while the positions move")
    misfits = [
        float(np.median(np.linalg.norm(one.turned(recorded[:, :2]) / ratio - moved, axis=1) / size))
        for one in ARRANGEMENTS
    ]
    best = int(np.argmin(misfits))
    if misfits[0] > _FITS and misfits[best] > _FITS:
        middle = size.size // 2
        halves = [
            np.median(np.linalg.norm(recorded[part, :2] / ratio - moved[part], axis=1) / size[part])
            for part in (slice(middle), slice(middle, None))
        ]
        if min(halves) <= _FITS:
            return fits(WHAT, "they agree in one half of the run")
        found = f"they point elsewhere, by {misfits[0]:.0%} of the speed"
        return Check(WHAT, State.MISFIT, found, "latitude and longitude may be exchanged, or the axes are of the train")
    if _TURNED < misfits[0] <= _FITS and misfits[best] <= _EXPLAINS * misfits[0]:
        found = f"they point elsewhere, by {misfits[0]:.0%} of the speed; the run has hardly more than one heading"
        advice = "Look at a run with curves before the velocity is corrected."
        return Check(WHAT, State.MISFIT, found, f"{ARRANGEMENTS[best].words}, it seems", advice=advice)
    arrangement = (
        ARRANGEMENTS[0] if misfits[0] <= _FITS or misfits[best] > _EXPLAINS * misfits[0] else ARRANGEMENTS[best]
    )
    return _told(ratio, arrangement, misfits)


def _told(ratio: float, arrangement: Arrangement, misfits: list[float]) -> Check:
    explained = explain_factor(ratio, speed=True) if abs(ratio - 1.0) > _UNIT_LIMIT else None
    factor = 1.0 if explained is None else 1.0 / explained.exact
    found = f"the recorded speed is {ratio:.4g} times that of the positions"
    if arrangement == ARRANGEMENTS[0]:
        if abs(ratio - 1.0) <= _UNIT_LIMIT:
            return fits(WHAT, found)
        if explained is None:
            return Check(WHAT, State.MISFIT, found)
    rivals = sum(misfit <= _FITS for misfit in misfits)
    doubt = "" if rivals == 1 or arrangement == ARRANGEMENTS[0] else "; the run has one heading only, so others fit too"
    causes = [explained.cause] if explained else []
    causes += [arrangement.words] if arrangement.words else []
    factors = {"vel_e_mps": arrangement.east * factor, "vel_n_mps": arrangement.north * factor}
    factors |= {"vel_u_mps": factor} if factor != 1.0 else {}
    exchange = ("vel_e_mps", "vel_n_mps") if arrangement.exchanged else None
    lines = correction("gnss", {name: value for name, value in factors.items() if value != 1.0}, exchange=exchange)
    return Check(WHAT, State.IMPOSSIBLE, found + doubt, " and ".join(causes), "the configuration", lines)


def _vertical(gnss: Places, begin_s: Floats, up_mps: Floats, fast: Bools) -> list[Check]:
    """Up against down."""
    known = np.isfinite(gnss.height_m)
    if not np.isfinite(up_mps).all() or known.sum() < 10:
        return []
    ends = [np.interp(at_s, gnss.t_s[known], gnss.height_m[known]) for at_s in (begin_s, begin_s + _SPAN_S)]
    climbed = ((ends[1] - ends[0]) / _SPAN_S)[fast]
    up_mps = up_mps[fast]
    bound = 4.0 * np.median(np.abs(climbed)) + 0.05
    kept = (np.abs(climbed) < bound) & (np.abs(up_mps) < 20 * bound)
    if kept.sum() < _LEAST_WINDOWS or np.std(climbed[kept]) < _LEAST_CLIMB_MPS or np.std(up_mps[kept]) < 1e-3:
        return [not_checked(_UP, "the run hardly climbs")]
    agreement = float(np.corrcoef(climbed[kept], up_mps[kept])[0, 1])
    found = f"correlation {agreement:.2f}"
    if agreement > -_CLIMBS:
        return [fits(_UP, found) if agreement > _CLIMBS else not_checked(_UP, "the run hardly climbs")]
    lines = correction("gnss", {"vel_u_mps": -1.0})
    return [Check(_UP, State.IMPOSSIBLE, found, "the vertical velocity counts down", "the configuration", lines)]
