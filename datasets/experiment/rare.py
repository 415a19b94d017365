"""Rare events of a bank and of the pseudorange monitor, which is alone on its ranges.

When a missed detection has become as rare as railways ask, and how often healthy monitors alarm: on the noise of the
published experiment, or on that of recorded runs. For the latter it is assumed that positions are as noisy as the
thresholds count with (stated sigma with the shares and correlation times of the configuration, and the measured white
noise), Gaussian, and alike throughout; nothing in the runs is at fault. A tail to 1e-9 is the model's, not the
recording's: some hours hold no event so rare.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from datasets.experiment.bank import READINGS, SENSORS, BankSpec, LinearBank, bank_of_axis, linear_bank
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.range_system import RangePlan, miss_at_one_epoch, range_system
from datasets.experiment.sampling import (
    SMALLEST,
    System,
    false_alarm_probability,
    first_below,
    missed_detection_probability,
    probability_figures,
)
from datasets.experiment.tables import Contents, Row, table_of_rows
from pipeline.results.store import read_config, read_table
from pipeline.stages.monitors.axis import error_model
from schemas.config import Configuration, threshold_factor
from schemas.enums import MonitorState, RunStatus
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.monitors import SCALES

REPETITIONS = 20_000
TARGETS: tuple[float, ...] = (1e-4, 1e-9)
_RATES_MPS = (0.01, 0.03, 0.1, 1.0)
_TRANSIENT_RATES_MPS = (0.1, 1.0)
# Ramps in a range, and how often residuals are recorded for them; the first time that a period comes alarms are asked.
_RANGES_ASKED: tuple[tuple[float, float], ...] = ((0.01, 10.0), (0.01, 30.0), (0.1, 1.0), (0.1, 10.0))
_SEARCH_RUNS = 500
_FAILURE_LIMIT_M = 20.0
_LONGEST_S = 10_000
HOUR_S = 3_600.0
_FAST_HZ, _SLOWEST_AT_FAST_MPS = 10.0, 0.1
_ALARM_SHARE = 20
# Seconds since the restart at the onset of a fault; none: long ago.
AGES_S: tuple[float | None, ...] = (0.0, 10.0, 60.0, 300.0, None)
# White noise of sigma w has the lasting part M = 1.5 w^2 in the thresholds (DOMAIN section 3: 4 M = 6 w^2).
_LASTING = 1.5

_Bank = tuple[Constellation, LinearBank]


def run(
    repetitions: int, seed: int, jobs: int, config: Configuration | None = None, recorded: Path | None = None
) -> Contents:
    """`missed`, `transients`, `false_alarms`, `pseudorange`; `repetitions` are the sampled runs.

    With `recorded`, a replayed result: `noise` (what was taken from it), `missed`, `false_alarms` of each solution.
    """
    if recorded is not None:
        return _tables_on_recorded_noise(recorded, repetitions, seed, jobs, config)
    return {
        "missed": missed_table(repetitions, seed, jobs, config),
        "transients": transient_table(repetitions, seed, jobs, config),
        "false_alarms": alarm_table(repetitions, seed, jobs, config),
        "pseudorange": range_table(repetitions, seed, jobs, config),
    }


def banks(config: Configuration | None, rate_hz: float = 1.0) -> Iterator[_Bank]:
    """Both constellations and sensor sets, heading 0: the configured bank, or those of both readings."""
    for constellation in CONSTELLATIONS:
        for sensors in SENSORS:
            specs = [BankSpec(reading=reading, sensors=sensors, rate_hz=rate_hz) for reading in READINGS]
            if config is not None:
                specs = [BankSpec.from_configuration(config.monitors, sensors, rate_hz)]
            for spec in specs:
                yield constellation, linear_bank(default_geometry(constellation), 0.0, spec)


def failure_epoch(bank: LinearBank, rate_mps: float) -> int:
    """Epochs until the mean along-track error of a range ramp passes the limit, at most the published span."""
    slope = abs(float(bank.along_error[0])) * rate_mps
    seconds = _FAILURE_LIMIT_M / slope if slope > 0 else float(_LONGEST_S)
    return int(min(seconds, _LONGEST_S) * bank.spec.rate_hz)


def epochs_until(
    system: System, rate_mps: float, targets: Sequence[float], seed: int, jobs: int, period_s: float
) -> list[int | None]:
    """Epochs after which the missed-detection probability is below each target; None if not within the span."""
    return first_below(
        lambda epochs: missed_detection_probability(system, epochs, rate_mps, _SEARCH_RUNS, seed, jobs).value,
        targets,
        int(_LONGEST_S / period_s),
    )


def miss_figures(
    system: System, rate_mps: float, at_failure: int, period_s: float, runs: int, seed: int, jobs: int
) -> Iterator[tuple[str, int, Row]]:
    """What is asked of a ramp of `rate_mps`: why, after how many epochs of `period_s`, and the figures of a miss.

    At the failure, after `at_failure` epochs, and when a miss is as rare as the targets.
    """
    found = epochs_until(system, rate_mps, TARGETS, seed, jobs, period_s)
    targets = [f"{target:g}" for target in TARGETS]
    for reason, epochs in [("failure", at_failure), *zip(targets, found, strict=True)]:
        if epochs is not None:
            yield (
                reason,
                epochs,
                probability_figures(missed_detection_probability(system, epochs, rate_mps, runs, seed, jobs)),
            )


def missed_table(runs: int, seed: int, jobs: int, config: Configuration | None) -> pl.DataFrame:
    """Pmd at the mean failure, and the time that makes it as rare as each target, with the error of the estimate."""
    asked = [(one, rate) for one in banks(config) for rate in _RATES_MPS]
    # At 10 Hz the faster ramps of GPS, since slow ones differ little from 1 Hz.
    asked += [(one, rate) for one in _fast_banks(config) for rate in _RATES_MPS if rate >= _SLOWEST_AT_FAST_MPS]
    rows: list[Row] = []
    for (constellation, bank), rate in asked:
        period_s = 1.0 / bank.spec.rate_hz
        for reason, epochs, found in miss_figures(bank, rate, failure_epoch(bank, rate), period_s, runs, seed, jobs):
            rows.append(_question_row(constellation, bank, rate, epochs, reason) | found)
    return table_of_rows(rows)


def _fast_banks(config: Configuration | None) -> list[_Bank]:
    """Banks of GPS alone at the fast rate."""
    return [one for one in banks(config, _FAST_HZ) if one[0] == "gps"]


def _question_row(constellation: Constellation, bank: LinearBank, rate: float, epochs: int, reason: str) -> Row:
    """The columns of a row that say what is asked: a ramp of `rate` [m/s] on a bank, so many epochs after its onset."""
    return {
        **_bank_row(constellation, bank.spec),
        "rate_mps": rate,
        "chosen_for": reason,
        "time_s": epochs / bank.spec.rate_hz,
        "mean_failure_s": failure_epoch(bank, rate) / bank.spec.rate_hz,
    }


def _bank_row(constellation: Constellation, spec: BankSpec) -> Row:
    """What names a bank in a table."""
    return {
        "constellation": constellation,
        "reading": spec.reading,
        "alphas": spec.weights_text,
        "sensors": spec.sensors,
        "rate_hz": spec.rate_hz,
    }


def transient_table(runs: int, seed: int, jobs: int, config: Configuration | None) -> pl.DataFrame:
    """Pmd of a fault that begins soon after a restart, and of one long after, at the time that makes the latter 1e-4.

    Thresholds are exact at every age (DOMAIN section 3), so false alarms do not depend on it; misses do.
    """
    rows: list[Row] = []
    for constellation, bank in banks(config):
        for rate in _TRANSIENT_RATES_MPS if constellation == "gps" else ():
            (epochs,) = epochs_until(bank, rate, (max(TARGETS),), seed, jobs, 1.0 / bank.spec.rate_hz)
            for age_s in AGES_S if epochs is not None else ():
                young = linear_bank(default_geometry(constellation), 0.0, replace(bank.spec, age_s=age_s))
                missed = missed_detection_probability(young, epochs or 0, rate, runs, seed, jobs)
                row = _question_row(constellation, young, rate, epochs or 0, "transient")
                rows.append({"age_s": age_s, **row, **probability_figures(missed)})
    return table_of_rows(rows)


def alarm_table(runs: int, seed: int, jobs: int, config: Configuration | None) -> pl.DataFrame:
    """Probability that a healthy bank alarms at least once within an hour."""
    rows: list[Row] = []
    for constellation, bank in [*banks(config), *_fast_banks(config)]:
        asked = {"false_alarm_probability": bank.spec.false_alarm_probability, "horizon_s": HOUR_S}
        found = alarm_figures(bank, int(HOUR_S * bank.spec.rate_hz), runs, seed, jobs)
        rows.append(_bank_row(constellation, bank.spec) | asked | found)
    return table_of_rows(rows)


def alarm_figures(system: System, epochs: int, runs: int, seed: int, jobs: int) -> Row:
    """Figures of at least one alarm in so many epochs; a share of the `runs` suffices."""
    return probability_figures(false_alarm_probability(system, epochs, max(runs // _ALARM_SHARE, 20), seed, jobs))


def range_table(runs: int, seed: int, jobs: int, config: Configuration | None) -> pl.DataFrame:
    """Misses of the pseudorange monitor, heading 0, and its alarms within an hour."""
    rows: list[Row] = []
    for constellation in CONSTELLATIONS:
        periods = []
        for rate, period_s in _RANGES_ASKED:
            plan = RangePlan(default_geometry(constellation), period_s=period_s)
            if config is not None:
                plan = replace(plan, false_alarm_probability=config.monitors.false_alarm_probability)
            system = range_system(plan, 0.0)
            labels = {"constellation": constellation, "period_s": period_s}
            failure_s = min(plan.mean_failure_s(0.0, rate), float(_LONGEST_S))
            at_failure = int(failure_s / period_s)
            for reason, epochs, found in miss_figures(system, rate, at_failure, period_s, runs, seed, jobs):
                time_s = epochs * period_s
                at_most = max(miss_at_one_epoch(system, rate * time_s), SMALLEST)
                asked = {"event": "missed_detection", "rate_mps": rate, "chosen_for": reason, "time_s": time_s}
                rows.append(labels | asked | {"mean_failure_s": failure_s, "at_most": at_most} | found)
            if period_s not in periods:
                alarm = {"event": "false_alarm", "time_s": HOUR_S}
                rows.append(labels | alarm | alarm_figures(system, int(HOUR_S / period_s), runs, seed, jobs))
            periods.append(period_s)
    return table_of_rows(rows)


@frozen
class RecordedNoise:
    """Noise along the track of one solution over all runs of a result: medians over epochs and runs.

    `ratios`: by scale, scatter of the monitors over what the thresholds count with; below 1 they scatter less.
    """

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
        spec = BankSpec.from_configuration(config.monitors, "odometer", rate_hz)
        return bank_of_axis(spec, shares * self.sigma_m**2, taus_s, float(np.sqrt(_LASTING)) * self.white_m)

    @property
    def row(self) -> Row:
        """The noise as a row of the table `noise`."""
        return {
            "solution": self.solution,
            "runs": self.runs,
            "hours": self.hours,
            "gnss_rate_hz": self.rate_hz,
            "sigma_along_m": self.sigma_m,
            "white_noise_along_m": self.white_m,
            **{f"ratio_{scale}": ratio for scale, ratio in zip(SCALES, self.ratios, strict=True)},
        }


def _tables_on_recorded_noise(result: Path, runs: int, seed: int, jobs: int, config: Configuration | None) -> Contents:
    """`noise`, `missed` and `false_alarms` of each solution of a replayed result."""
    noises = recorded_noises(result)
    settings = config or read_config(result) or Configuration()
    missed = [row for noise in noises for row in _missed_rows(noise, settings, runs, seed, jobs)]
    false_alarms = []
    for noise in noises:
        labels = {"solution": noise.solution, "horizon_s": HOUR_S, "evaluated_hz": noise.rate_hz}
        bank = noise.bank(settings, noise.rate_hz)
        false_alarms.append(labels | alarm_figures(bank, int(HOUR_S * noise.rate_hz), runs, seed, jobs))
    return {
        "noise": table_of_rows([noise.row for noise in noises]),
        "missed": table_of_rows(missed),
        "false_alarms": table_of_rows(false_alarms),
    }


def recorded_noises(result: Path) -> list[RecordedNoise]:
    """Noise measured in runs without injected faults.

    Raises `UsageError` where no run has a sigma and a measured white noise.
    """
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
    return [
        _noise_of_solution(result, solution, part)
        for (solution,), part in known.group_by("solution", maintain_order=True)
    ]


def _noise_of_solution(result: Path, solution: object, runs: pl.DataFrame) -> RecordedNoise:
    """Noise of one solution over the runs of a result."""
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
        rate_hz=float(np.median(runs["gnss_rate_hz"])),
        sigma_m=float(row["sigma_along_m"]),
        white_m=float(np.median(runs["white_noise_along_m"])),
        ratios=tuple(row[scale] for scale in SCALES),
    )


def _missed_rows(noise: RecordedNoise, config: Configuration, runs: int, seed: int, jobs: int) -> Iterator[Row]:
    """Pmd of ramps along the track at the failure, and when it is as rare as the targets."""
    for rate_mps in _RATES_MPS:
        # Slower ramps are found by the averages, which see the same noise at 1 Hz and at 10 Hz.
        rate_hz = noise.rate_hz if rate_mps >= _SLOWEST_AT_FAST_MPS else min(1.0, noise.rate_hz)
        bank = noise.bank(config, rate_hz)
        failure_s = config.hazards.limits.failure_m / rate_mps
        at_failure = int(min(failure_s, _LONGEST_S) * rate_hz)
        for reason, epochs, found in miss_figures(bank, rate_mps, at_failure, 1.0 / rate_hz, runs, seed, jobs):
            of = {"solution": noise.solution, "rate_mps": rate_mps, "evaluated_hz": rate_hz, "chosen_for": reason}
            time_s = epochs / rate_hz
            yield of | {"time_s": time_s, "time_since_failure_s": time_s - failure_s} | found
