"""The statistic V: how well the steps of an odometer are predicted by those of the positions (DOMAIN section 5.0).

An odometer of its own has errors of its own: however much the positions know, what it writes next cannot be told better
than by what it wrote before and after. One that is made of the positions has their noise, which they predict.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.follows.stands import correlated_at_stands
from pipeline.stages.follows.steps import Steps, common_steps
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, EvidenceConfig
from schemas.frozen import frozen

# Steps on either side that predict one: of the series itself, and of the positions.
_OWN = 4
_OTHERS = 32
# Absolute values of a standard normal variable lie below these in such a part of all cases. The lowest is ours: without
# it RTK positions on winding tracks, whose steps across are curves, not noise, accuse 2 of 500 odometers at 1 Hz.
_QUANTILES = ((0.2, 0.253347), (0.5, 0.674490), (0.9, 1.644854))
# Heights of GNSS are noisier than what lies across by about so much (DIAG Table 1: 1.5 in sigma).
_HEIGHT_OVER_CROSS = 1.5
# What is predicted to a tenth of a millimetre is predicted by rounding [m].
_LEAST_M = 1e-4


@frozen
class Follows:
    """`ratio`: V, None where too few steps could be looked at; `at_stands`: odometer and positions err as one there."""

    ratio: float | None = None
    at_stands: bool = False

    def found(self, config: EvidenceConfig) -> bool:
        return self.at_stands or (self.ratio is not None and self.ratio < config.follows_limit)


NOT_TESTED = Follows()


def follows_positions(odometer: pl.DataFrame, fixes: pl.DataFrame, config: Configuration) -> Follows:
    """Whether an odometer (one sensor) is made of these positions (one solution), both cleaned, with their times.

    At most `follows_steps_most` steps spread over the run are looked at, so that an hour at 10 Hz takes milliseconds.
    """
    steps = common_steps(odometer, fixes, config)
    if steps is None:
        return NOT_TESTED
    return Follows(_ratio(steps, config.evidence), correlated_at_stands(steps, config.evidence))


def _ratio(steps: Steps, config: EvidenceConfig) -> float | None:
    """V: what the positions leave unexplained of an odometer's step, over the least that a series leaves alone."""
    rows = _spread(_in_motion(steps), config.follows_steps_most)
    if rows.size < config.follows_steps_least:
        return None
    own = _neighbours(steps.odometer_m, rows, _OWN)
    both = np.column_stack([own, _around(steps.along_m, rows, _OTHERS)])
    left_m = _unexplained(steps.odometer_m[rows], both)
    alone_m = [_unexplained(steps.odometer_m[rows], own)]
    alone_m.append(_unexplained(steps.across_m[rows], _neighbours(steps.across_m, rows, _OWN)))
    if np.isfinite(steps.up_m[rows]).mean() > 0.5:
        up_m = np.nan_to_num(steps.up_m)
        if np.ptp(up_m[rows]) > _LEAST_M:
            alone_m.append(_unexplained(up_m[rows], _neighbours(up_m, rows, _OWN)) / _HEIGHT_OVER_CROSS)
    return max(
        max(_sigma_m(left_m, *quantile), _LEAST_M) / max(min(_sigma_m(m, *quantile) for m in alone_m), 1e-9)
        for quantile in _QUANTILES
    )


def _in_motion(steps: Steps) -> Ints:
    """Steps around which both recorders went on without a break, and the train moved, as far as predictors reach."""
    good = steps.moving & steps.unbroken
    count = np.concatenate([[0], np.cumsum(good)])
    rows = np.arange(_OTHERS, good.size - _OTHERS)
    whole = count[rows + _OTHERS + 1] - count[rows - _OTHERS] == 2 * _OTHERS + 1
    return np.asarray(rows[whole])


def _spread(rows: Ints, most: int) -> Ints:
    return rows if rows.size <= most else rows[np.linspace(0, rows.size - 1, most).astype(np.int64)]


def _around(steps_m: Floats, rows: Ints, reach: int) -> Floats:
    """The steps from `reach` before to `reach` after each row, shape (rows, 2 reach + 1)."""
    return np.asarray(steps_m[rows[:, None] + np.arange(-reach, reach + 1)])


def _neighbours(steps_m: Floats, rows: Ints, reach: int) -> Floats:
    return np.delete(_around(steps_m, rows, reach), reach, axis=1)


def _unexplained(wanted_m: Floats, by_m: Floats) -> Floats:
    """Absolute residuals of a linear prediction [m], larger by what fitting so many numbers takes off."""
    columns = by_m - by_m.mean(axis=0)
    wanted = wanted_m - wanted_m.mean()
    count, fitted = columns.shape
    # Ridge of rounding: steps of one speed are all alike.
    normal = columns.T @ columns + count * _LEAST_M**2 * np.eye(fitted)
    weights = np.linalg.solve(normal, columns.T @ wanted)
    return np.asarray(np.abs(wanted - columns @ weights) * np.sqrt(count / (count - fitted - 1.0)))


def _sigma_m(residuals_m: Floats, part: float, of_normal: float) -> float:
    return float(np.quantile(residuals_m, part)) / of_normal
