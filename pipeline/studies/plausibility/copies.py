"""Whether the reference is a copy of the solution under test: then every position would be judged by itself.

A copy has the solution's own errors. An independent record, however good, is off by the solution's errors, so it writes
the same digits as seldom as these errors are smaller than one of the digits. No place is fitted for this, only the one
difference of the stamps at which most places come back.

Positions without errors (drawn by a program, to test the replay) equal a true reference. Only the survey tells: they
lie on the track far nearer than their sigma. There a copy and the truth are the same, and nothing is said.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import SEMI_MAJOR_AXIS_M, points_of
from pipeline.studies.plausibility.check import Check, FitState, KnownCause
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.robust import LEAST
from pipeline.studies.plausibility.shifts import fit_survey
from schemas.arrays import Bools, Floats, floats
from schemas.config import FixSigma
from schemas.enums import Fix, MisfitCause

_WHAT = "reference against the positions"
# Fewer moving places in common tell nothing.
_FEWEST = 3 * LEAST
# Degrees, minutes and seconds of an angle are written with so many decimals; finer is rounding of the computer [deg].
_UNITS_DEG = (1.0, 1.0 / 60.0, 1.0 / 3600.0)
_DECIMALS = range(2, 10)
_LEAST_DEG = 1e-9
# Rows of the reference that are looked at.
_ROWS = 4_000
# Stamps are equal within this: recorders round them to milliseconds.
_SAME_STAMP_S = 0.002
# Positions as near to the track as this share of their sigma have no errors of their own; 0.67 is usual.
_WITHOUT_ERROR = 0.2


class _StampedTrack(NamedTuple):
    """Stamps [s], and latitude and longitude [deg] in rows."""

    t_s: Floats
    degrees: Floats

    def take(self, rows: Bools) -> _StampedTrack:
        return _StampedTrack(self.t_s[rows], self.degrees[rows])


def copy_check(of: Recording) -> Check | None:
    """`impossible` where the reference is a copy of the solution; None where it is none, or nobody can know.

    An exact, a rounded or a thinned copy is seen, and one with other stamps.
    """
    config = of.config
    fixes = of.fixes
    reference = of.run.reference
    if reference is None or of.reference is None:
        return None
    positions = _track(fixes, of.seconds(fixes))
    references = _track(reference, of.seconds(reference))
    references = references.take(of.reference.moves(references.t_s))
    references = references.take(np.arange(references.t_s.size) % max(1, references.t_s.size // _ROWS) == 0)
    if min(positions.t_s.size, references.t_s.size) < _FEWEST:
        return None
    digit_deg = max(_digit_deg(positions.degrees), _digit_deg(references.degrees), _LEAST_DEG)
    to_m = np.radians(1.0) * SEMI_MAJOR_AXIS_M * np.array([1.0, np.cos(np.radians(positions.degrees[0, 0]))])
    digit_m = digit_deg * to_m
    sigma_m = _sigma_m(fixes)
    # Of a normal error, so much lies within a digit on either side.
    chance = float(np.prod(np.minimum(1.0, 2.0 * digit_m / (np.sqrt(2.0 * np.pi) * sigma_m))))
    lag_s = _lag_s(positions, references, 2.0 * float(digit_m[0])) if chance <= config.copy_chance else None
    if lag_s is None:
        return None
    row = np.clip(np.searchsorted(positions.t_s, references.t_s - lag_s), 1, positions.t_s.size - 1)
    row -= references.t_s - lag_s - positions.t_s[row - 1] < positions.t_s[row] - (references.t_s - lag_s)
    common = np.abs(positions.t_s[row] - (references.t_s - lag_s)) <= _SAME_STAMP_S
    equal = np.all(np.abs(positions.degrees[row] - references.degrees) <= 1.001 * digit_deg, axis=1)[common]
    if equal.size < _FEWEST or equal.mean() < config.copy_share:
        return None
    exact_m = _WITHOUT_ERROR * float(sigma_m.min())
    if of.line is not None and fit_survey(of.gnss, of.line, of.config.shift_told_m).aside_m < exact_m:
        return None
    stamps = f", at stamps {lag_s:+.2f} s from them" if abs(lag_s) > _SAME_STAMP_S else ""
    finding = (
        f"{equal.sum()} of {equal.size} places are those of the positions to the last digit ({digit_m[0]:.1g} m)"
        f"{stamps}; an independent one would be so near in {chance:.1g} of all cases, for the positions have sigma "
        f"{sigma_m.max():.2g} m"
    )
    advice = "Leave the reference out of the run, or record one with another, better instrument."
    return Check(_WHAT, FitState.IMPOSSIBLE, finding, (KnownCause(MisfitCause.COPY),), advice=advice, of_evidence=True)


def _track(frame: pl.DataFrame, t_s: Floats) -> _StampedTrack:
    degrees = np.column_stack([floats(frame, name) for name in ("latitude_deg", "longitude_deg")])
    return _StampedTrack(t_s, degrees).take(np.all(np.isfinite(degrees), axis=1))


def _lag_s(positions: _StampedTrack, references: _StampedTrack, reach_m: float) -> float | None:
    """The difference of stamps that most places of the other record have which are in the own one too."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points_of(*positions.degrees.T).surface)
    away_m, row = tree.query(points_of(*references.degrees.T).surface, distance_upper_bound=reach_m)
    near = np.isfinite(away_m)
    if near.sum() < _FEWEST:
        return None
    lags_s = np.sort(references.t_s[near] - positions.t_s[row[near]])
    alike = np.searchsorted(lags_s, lags_s + _SAME_STAMP_S, "right") - np.arange(lags_s.size)
    first = int(alike.argmax())
    return float(np.median(lags_s[first : first + alike[first]]))


def _digit_deg(degrees: Floats) -> float:
    """The coarsest last digit that all coordinates of a record have; 0 where they have none."""
    digits = sorted((unit / 10.0**decimals for unit in _UNITS_DEG for decimals in _DECIMALS), reverse=True)
    return next((digit for digit in digits if np.abs(degrees / digit - np.rint(degrees / digit)).max() < 1e-3), 0.0)


def _sigma_m(fixes: pl.DataFrame) -> Floats:
    """How far off the positions may be, north and east: as they state, else as their kind of fix usually is."""
    usual_m = pl.col("fix").cast(pl.String).replace_strict({kind.value: FixSigma().horizontal_m(kind) for kind in Fix})
    stated = (pl.when(pl.col(name) > 0.0).then(pl.col(name).sqrt()) for name in ("cov_nn_m2", "cov_ee_m2"))
    sigma_m = fixes.select(
        pl.coalesce(stated_m, usual_m).median().alias(name) for stated_m, name in zip(stated, "ne", strict=True)
    )
    return np.array(sigma_m.row(0), dtype=np.float64)
