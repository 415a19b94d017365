"""Sigmas of the monitors on fault-free runs, by regression (DIAG: thresholds vary with sigma of the position).

Each by the sigma of its own axis (DIAG: all by the along-track one). Where the position's true sigma is
a + b sigma_axis, measured over predicted is b + a / sigma_axis; a = 0, b = 1 says that receiver and model are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields

import numpy as np
import polars as pl
from scipy.optimize import nnls

from schemas.arrays import Floats
from schemas.config import CalibrationConfig, Configuration
from schemas.enums import MonitorState
from schemas.frozen import frozen
from schemas.monitors import ALL_MONITORS, AXES, SCALES

# Numerics of the regression: bins of the same number of epochs. Half or twice as many change a simulated fit by less
# than a fifth of its standard error.
_BINS = 12
_LINKING = ("link_order", "link_distance")
_AXIS_OF_BANK = {monitor.name: str(monitor.axis) for monitor in ALL_MONITORS if monitor.scale is not None}

_READ = ("state", "value", "threshold")
COMPARED = (
    *(f"sigma_{axis}_m" for axis in AXES),
    *(f"{monitor}_{part}" for monitor in _AXIS_OF_BANK for part in _READ),
    *("along_doppler_value", "along_doppler_threshold"),
)
"""Columns of epochs that sigmas are regressed on."""


@frozen
class SigmaFit:
    """Position sigma = `intercept_m` + `slope` * stated sigma, as a monitor shows it; standard errors next to each."""

    monitor: str
    epochs: int
    ratio: float
    ratio_error: float
    intercept_m: float
    intercept_error_m: float
    slope: float
    slope_error: float


def regress_sigmas(runs: Sequence[pl.DataFrame], factor: float, config: CalibrationConfig) -> list[SigmaFit]:
    """One fit per monitor of the bank that was evaluated often enough; `runs`: epochs tables; `factor`: k_T.

    Errors are jackknifed over runs, or over stretches of a few runs, as epochs are correlated.
    """
    fits = []
    least = -(-config.left_out_pieces // max(len(runs), 1))
    for monitor, axis in _AXIS_OF_BANK.items():
        pieces = [piece for run in runs for piece in _pieces(run, monitor, axis, factor, least)]
        samples = np.concatenate(pieces) if pieces else np.zeros((0, 2))
        if len(samples) >= config.least_epochs:
            fits.append(_fit_with_errors(monitor, pieces, config))
    return fits


def _pieces(run: pl.DataFrame, monitor: str, axis: str, factor: float, count: int) -> list[Floats]:
    """Rows (sigma of the axis, value over predicted sigma), in so many pieces for the jackknife."""
    sigma = f"sigma_{axis}_m"
    chosen = run.filter(pl.col(f"{monitor}_state") != "not_evaluated").select(
        pl.col(sigma), (factor * pl.col(f"{monitor}_value") / pl.col(f"{monitor}_threshold")).alias("ratio")
    )
    rows = chosen.drop_nulls().filter(pl.col(sigma) > 0).to_numpy()
    return [piece for piece in np.array_split(rows, count) if len(piece)]


def _fit_with_errors(monitor: str, pieces: list[Floats], config: CalibrationConfig) -> SigmaFit:
    """The fit of one monitor, with errors by leaving out each piece in turn (jackknife)."""
    count = len(pieces)
    whole = _fit(np.concatenate(pieces), config)
    errors = np.full(3, np.nan)
    if count > 1:
        without = np.array([_fit(np.concatenate(pieces[:left] + pieces[left + 1 :]), config) for left in range(count)])
        errors = np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    figures = [figure for pair in zip(whole.tolist(), errors.tolist(), strict=True) for figure in pair]
    return SigmaFit(monitor, sum(len(piece) for piece in pieces), *figures)


def overall_ratio(ratios: Floats) -> float:
    """Measured over predicted sigma, from values over predicted sigmas."""
    return float(np.sqrt(np.mean(np.square(ratios))))


def _fit(samples: Floats, config: CalibrationConfig) -> Floats:
    """Overall ratio, intercept [m] and slope from rows (sigma, ratio): weighted least squares over bins of sigma."""
    sigma = samples[:, 0]
    squares = samples[:, 1] ** 2
    overall = overall_ratio(samples[:, 1])
    if sigma.std() < config.sigma_spread_share * sigma.mean():
        return np.array([overall, 0.0, overall])
    edges = np.unique(np.quantile(sigma, np.linspace(0.0, 1.0, _BINS + 1)))
    place = np.clip(np.searchsorted(edges, sigma, side="right") - 1, 0, edges.size - 2)
    count = np.bincount(place, minlength=edges.size - 1).astype(np.float64)
    filled = count > 0
    measured = np.sqrt(np.bincount(place, squares, count.size)[filled] / count[filled])
    inverse = np.bincount(place, 1.0 / sigma, count.size)[filled] / count[filled]
    weight = np.sqrt(count[filled])
    # ratio = b + a / sigma: linear in (a, b), both not negative; a bin of n samples has a weight of sqrt(n).
    design = np.column_stack([inverse, np.ones(inverse.size)])
    (intercept, slope), _ = nnls(design * weight[:, None], measured * weight)
    return np.array([overall, intercept, slope])


def velocity_sigma_mps(runs: Sequence[pl.DataFrame], config: Configuration) -> float | None:
    """Standard deviation of the GNSS velocity along the track [m/s] as monitor `along_doppler` shows it.

    What the odometer is assumed to account for is taken off. None where the monitor was hardly evaluated, or where
    less than a tenth of what was assumed is left, which no such difference shows.
    """
    value = pl.col("along_doppler_value")
    threshold = pl.col("along_doppler_threshold")
    looks = [run.select(value, threshold).drop_nulls() for run in runs]
    if sum(look.height for look in looks) < config.calibration.least_epochs:
        return None
    assumed_mps = config.monitors.doppler_sigma_mps
    of_others = (threshold / config.monitors.threshold_factor) ** 2 - assumed_mps**2
    variance = pl.concat(looks).select((value**2 - of_others).mean()).item()
    return float(np.sqrt(variance)) if variance > (0.1 * assumed_mps) ** 2 else None


def sigma_table(fits: Sequence[SigmaFit]) -> pl.DataFrame:
    """Errors are null where one piece of data gives none."""
    kinds: dict[str, type[pl.DataType]] = {field.name: pl.Float64 for field in fields(SigmaFit)}
    table = pl.DataFrame([asdict(fit) for fit in fits], schema=kinds | {"monitor": pl.String, "epochs": pl.Int64})
    return table.with_columns(pl.selectors.float().fill_nan(None))


def worst_fit(fits: Sequence[SigmaFit]) -> SigmaFit | None:
    """The monitor that is proven to be the loudest: one that is quieter than predicted costs detection only.

    Proven is what remains of the ratio after two standard errors: among twelve one always looks loud by chance.
    """
    return max(fits, key=lambda fit: fit.ratio - 2.0 * float(np.nan_to_num(fit.ratio_error)), default=None)


def beyond_noise(epochs: pl.DataFrame, factor: float) -> tuple[str, ...]:
    """Monitors of a run, replayed without any noise, that fail by more than its noise; `factor` is k_T.

    The raw monitor of an axis shows its noise and hardly a drift or step. So every monitor of the axis is held against
    its threshold, widened by the raw one's ratio: its own would be widened by the very fault that it sees.
    """
    failing: list[str] = []
    for axis in AXES:
        shown = _ratios(epochs, f"{axis}_raw")
        widened = max(1.0, overall_ratio((factor * shown).to_numpy())) if len(shown) else 1.0
        failing += [name for scale in SCALES if (_ratios(epochs, name := f"{axis}_{scale}").abs() > widened).any()]
    return (*failing, *(name for name in _LINKING if (epochs[f"{name}_state"] == MonitorState.FAIL.value).any()))


def _ratios(epochs: pl.DataFrame, monitor: str) -> pl.Series:
    """Value over threshold where the monitor was evaluated."""
    return (epochs[f"{monitor}_value"] / epochs[f"{monitor}_threshold"]).drop_nulls()
