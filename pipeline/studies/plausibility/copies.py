"""Whether the reference is a copy of the solution under test: then every position would be judged by itself.

A copy has the solution's own errors. An independent record, however good, is off by the solution's errors, so it writes
the same digits as seldom as these errors are smaller than one of the digits.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import SEMI_MAJOR_AXIS_M
from pipeline.studies.plausibility.check import Cause, Check, FitState
from pipeline.studies.plausibility.pairs import LEAST
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.shifts import fit_survey
from schemas.arrays import Floats
from schemas.config import FixSigma
from schemas.enums import Fix, MisfitCause

_WHAT = "reference against the positions"
_ADVICE = "Leave the reference out of the run, or record one with another, better instrument."
# Fewer moving places in common show nothing.
_FEWEST = 3 * LEAST
# Degrees, minutes and seconds of an angle are written with so many decimals; finer is rounding of the computer [deg].
_DIGITS_DEG = sorted(unit / 10.0**decimals for unit in (1.0, 1 / 60.0, 1 / 3600.0) for decimals in range(2, 10))
_LEAST_DEG = 1e-9
# Positions as near to the track as this share of their sigma have no errors of their own; 0.67 is usual.
_WITHOUT_ERROR = 0.2


def copy_check(of: Recording) -> Check | None:
    """`impossible` where the reference has the places of the solution at its stamps, exact, thinned or rounded.

    None where it is no copy, or nobody can know. Positions that a program drew without errors equal a true reference:
    they lie on the survey far nearer than their sigma.
    """
    positions, references = _at_same_stamps(of)
    if len(positions) < _FEWEST:
        return None
    digit_deg = max(_digit_deg(positions), _digit_deg(references))
    equal = np.all(np.abs(positions - references) <= 1.001 * digit_deg, axis=1)
    if equal.mean() < of.config.copy_share:
        return None
    sigma_m = _sigma_m(of.fixes)
    digit_m = digit_deg * np.radians(SEMI_MAJOR_AXIS_M) * np.array([1.0, np.cos(np.radians(positions[0, 0]))])
    # Of a normal error, so much lies within a digit on either side.
    chance = float(np.prod(np.minimum(1.0, 2.0 * digit_m / (np.sqrt(2.0 * np.pi) * sigma_m))))
    if chance > of.config.copy_chance:
        return None
    if of.line is not None:
        aside_m = fit_survey(of.gnss, of.line, of.config.shift_told_m).aside_m
        if aside_m < _WITHOUT_ERROR * float(sigma_m.min()):
            return None
    found = (
        f"{equal.sum()} of {equal.size} places are those of the positions to the last digit ({digit_m[0]:.1g} m); an "
        f"independent one would be so near in {chance:.1g} of all cases"
    )
    causes = (Cause(MisfitCause.COPY),)
    return Check(_WHAT, FitState.IMPOSSIBLE, found, causes, advice=_ADVICE, of_evidence=True)


def _at_same_stamps(of: Recording) -> tuple[Floats, Floats]:
    """Positions, and the reference's places in motion, of the same 2 ms, (n, 2) each [deg]: recorders round stamps."""
    if of.run.reference is None or of.reference is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    stamp = pl.col("t").cast(pl.Datetime("ns", "UTC")).dt.round("2ms")
    fixes, reference = (
        frame.select(stamp, *_AXES).drop_nulls().unique("t", keep="first", maintain_order=True)
        for frame in (of.fixes, of.run.reference)
    )
    both = reference.join(fixes, on="t", how="inner", suffix="_gnss")
    both = both.filter(pl.Series(of.reference.moves(of.seconds(both)), dtype=pl.Boolean))
    return both.select(f"{axis}_gnss" for axis in _AXES).to_numpy(), both.select(_AXES).to_numpy()


def _digit_deg(degrees: Floats) -> float:
    """The coarsest last digit that all coordinates of a record have."""
    whole = (
        digit for digit in reversed(_DIGITS_DEG) if np.abs(degrees / digit - np.rint(degrees / digit)).max() < 1e-3
    )
    return max(next(whole, 0.0), _LEAST_DEG)


def _sigma_m(fixes: pl.DataFrame) -> Floats:
    """How far off the positions may be, north and east: as they state, else as their kind of fix usually is."""
    usual_m = pl.col("fix").cast(pl.String).replace_strict({kind.value: FixSigma().horizontal_m(kind) for kind in Fix})
    stated = (pl.when(pl.col(name) > 0.0).then(pl.col(name).sqrt()) for name in ("cov_nn_m2", "cov_ee_m2"))
    sigma_m = fixes.select(
        pl.coalesce(stated_m, usual_m).median().alias(name) for stated_m, name in zip(stated, "ne", strict=True)
    )
    return np.array(sigma_m.row(0), dtype=np.float64)
