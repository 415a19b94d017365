"""Rare events with the noise of recorded runs: how rare a missed ramp becomes on this receiver, odometer and bank.

Assumed: positions are as noisy as the thresholds count with (stated sigma with the shares and correlation times of the
configuration, and the measured white noise), Gaussian, and alike throughout; nothing in the runs is at fault. A tail to
1e-9 is the model's, not the recording's: some hours hold no event so rare. `ratio` compares the recording with the
model: below 1 the monitors scatter less than counted.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from datasets.experiment.bank import BankSpec, LinearBank, bank_of_axis
from datasets.experiment.rare import HOUR_S, LONGEST_S, REPETITIONS, alarm_figures, miss_figures
from datasets.experiment.tables import Contents, Row, table
from pipeline.results.store import read_config, read_table
from pipeline.stages.monitors.axis import error_model
from schemas.config import Configuration, threshold_factor
from schemas.enums import MonitorState, RunStatus
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.tables import SCALES

__all__ = ["REPETITIONS", "RecordedNoise", "made", "recorded_noises"]

RATES_MPS: tuple[float, ...] = (0.01, 0.03, 0.1, 1.0)
# White noise of sigma w has the lasting part M = 1.5 w^2 in the thresholds (DOMAIN section 3: 4 M = 6 w^2).
_LASTING = 1.5
# Slower ramps are found by the averages, which see the same noise at 1 Hz and at 10 Hz.
_SLOWEST_AT_RECORDED_RATE_MPS = 0.1


@frozen
class RecordedNoise:
    """Noise along the track of one solution over all runs of a result: medians over epochs and runs."""

    solution: str
    runs: int
    hours: float
    rate_hz: float
    sigma_m: float
    white_m: float
    ratios: tuple[float | None, ...]

    def bank(self, config: Configuration, rate_hz: float) -> LinearBank:
        """The configured bank on this noise."""
        shares, taus_s = error_model(config.monitors)
        spec = BankSpec.of(config.monitors, "odometer", rate_hz)
        return bank_of_axis(spec, shares * self.sigma_m**2, taus_s, float(np.sqrt(_LASTING)) * self.white_m)


def made(result: Path, runs: int, seed: int, jobs: int, config: Configuration | None) -> Contents:
    """`noise` (what was taken from the recording), `missed`, `false_alarms`, of each solution of a replayed result."""
    noises = recorded_noises(result)
    settings = config or read_config(result) or Configuration()
    missed = [row for noise in noises for row in _missed(noise, settings, runs, seed, jobs)]
    alarms = [_alarms(noise, settings, runs, seed, jobs) for noise in noises]
    return {
        "noise": table([_noise_row(noise) for noise in noises]),
        "missed": table(missed),
        "false_alarms": table(alarms),
    }


def recorded_noises(result: Path) -> list[RecordedNoise]:
    """Of runs without injected faults. Raises `UsageError` where no run has a sigma and a measured white noise."""
    runs = (
        read_table(result, "runs").filter(pl.col("status") == RunStatus.OK.value, ~pl.col("faults_injected")).collect()
    )
    known = runs.filter(pl.col("white_noise_along_m").is_not_null(), pl.col("gnss_rate_hz").is_not_null())
    if known.is_empty():
        raise UsageError(
            "has no run whose noise along the track is known",
            place=str(result),
            expected="runs with an odometer, without injected faults, replayed to the end",
            found=f"{runs.height} fault-free runs, none with `white_noise_along_m`" if runs.height else "no such run",
            remedy="Replay fault-free runs of some minutes, with their odometer.",
        )
    return [_noise_of(result, solution, part) for (solution,), part in known.group_by("solution", maintain_order=True)]


def _noise_of(result: Path, solution: object, runs: pl.DataFrame) -> RecordedNoise:
    factor = threshold_factor((read_config(result) or Configuration()).monitors.false_alarm_probability)
    ratios = [factor * pl.col(f"along_{scale}_value") / pl.col(f"along_{scale}_threshold") for scale in SCALES]
    judged = [pl.col(f"along_{scale}_state") == MonitorState.PASS.value for scale in SCALES]
    rms = [r.filter(j).pow(2).mean().sqrt().alias(scale) for r, j, scale in zip(ratios, judged, SCALES, strict=True)]
    epochs = read_table(result, "epochs").filter(
        pl.col("run_id").is_in(runs["run_id"].to_list()), pl.col("solution") == solution, ~pl.col("alarm")
    )
    row = epochs.select(pl.col("sigma_along_m").median(), *rms).collect().row(0, named=True)
    return RecordedNoise(
        solution=str(solution),
        runs=runs.height,
        hours=float(runs["duration_s"].sum()) / HOUR_S,
        rate_hz=_median(runs["gnss_rate_hz"]),
        sigma_m=float(row["sigma_along_m"]),
        white_m=_median(runs["white_noise_along_m"]),
        ratios=tuple(row[scale] for scale in SCALES),
    )


def _median(values: pl.Series) -> float:
    middle = values.median()
    assert isinstance(middle, float)
    return middle


def _noise_row(noise: RecordedNoise) -> Row:
    return {
        "solution": noise.solution,
        "runs": noise.runs,
        "hours": noise.hours,
        "gnss_rate_hz": noise.rate_hz,
        "sigma_along_m": noise.sigma_m,
        "white_noise_along_m": noise.white_m,
        **{f"ratio_{scale}": ratio for scale, ratio in zip(SCALES, noise.ratios, strict=True)},
    }


def _missed(noise: RecordedNoise, config: Configuration, runs: int, seed: int, jobs: int) -> list[Row]:
    """Pmd of ramps along the track at the failure, and when it is as rare as the targets."""
    rows: list[Row] = []
    for rate_mps in RATES_MPS:
        rate_hz = noise.rate_hz if rate_mps >= _SLOWEST_AT_RECORDED_RATE_MPS else min(1.0, noise.rate_hz)
        bank = noise.bank(config, rate_hz)
        failure_s = config.hazards.limits.failure_m / rate_mps
        at_failure = int(min(failure_s, LONGEST_S) * rate_hz)
        for reason, epochs, found in miss_figures(bank, rate_mps, at_failure, 1.0 / rate_hz, runs, seed, jobs):
            of = {"solution": noise.solution, "rate_mps": rate_mps, "evaluated_hz": rate_hz, "chosen_for": reason}
            time_s = epochs / rate_hz
            rows.append(of | {"time_s": time_s, "time_since_failure_s": time_s - failure_s} | found)
    return rows


def _alarms(noise: RecordedNoise, config: Configuration, runs: int, seed: int, jobs: int) -> Row:
    found = alarm_figures(noise.bank(config, noise.rate_hz), int(HOUR_S * noise.rate_hz), runs, seed, jobs)
    return {"solution": noise.solution, "horizon_s": HOUR_S, "evaluated_hz": noise.rate_hz} | found
