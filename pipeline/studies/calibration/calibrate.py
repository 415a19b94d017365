"""Vehicle, fast noise and monitor sigmas measured on recorded fault-free runs (`balise calibrate`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

import numpy as np
import polars as pl
import tomli_w

from pipeline.one_run import replay
from pipeline.results.workers import with_progress
from pipeline.stages.alignment.align import align
from pipeline.stages.matching import Match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.monitors.single import doppler_monitor
from pipeline.stages.odometry import Odometry
from pipeline.stages.prepare import prepare, require_independent_odometer
from pipeline.studies.calibration.sigmas import (
    COMPARED,
    SigmaFit,
    monitors_beyond_noise,
    regress_sigmas,
    sigma_table,
    velocity_sigma_mps,
    worst_fit,
)
from pipeline.studies.calibration.vehicle import RunEstimate, estimate_run, pool_runs
from pipeline.studies.plausibility.fit import clock_advice, required_fit
from schemas.config import Configuration, Vehicle
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.monitors import AXES
from schemas.run import RunLog, Site

_AS_STATED = {"sigma_intercept_m": 0.0, "sigma_slope": 1.0}
_NO_NOISE = {f"noise_{axis}_m": (0.0, 0.0, 0.0, 0.0) for axis in AXES}


@frozen
class Calibration:
    """The vehicle has no latency where the runs show none. `monitors`: the keys of `[monitors]` that were measured.

    `alarms`: by run the monitors that failed beyond its noise: such a run is hardly without fault.
    """

    vehicle: Vehicle
    runs: pl.DataFrame
    sigmas: pl.DataFrame
    monitors: Mapping[str, float | tuple[float, ...]]
    alarms: Mapping[str, tuple[str, ...]]

    def monitors_toml(self) -> str:
        """The part of a configuration file that was measured."""
        return tomli_w.dumps({"monitors": self.monitors}) if self.monitors else ""


@frozen
class ObservedRun:
    """What one run shows of its vehicle; `estimate` is None where GNSS and odometer could not be compared.

    `noise_m`: fast noise by key of `[monitors]`. `epochs`: the columns that sigmas are regressed on.
    """

    run_id: str
    estimate: RunEstimate | None
    noise_m: dict[str, tuple[float, ...]]
    epochs: pl.DataFrame | None
    alarms: tuple[str, ...]


def calibrate(
    logs: Sequence[RunLog],
    site: Site,
    vehicle: Vehicle | None = None,
    config: Configuration | None = None,
    solution: str = "primary",
) -> Calibration:
    """Measure vehicle, fast noise and monitor sigmas on recorded runs.

    Args:
        logs: recorded fault-free runs.
        site: their site.
        vehicle: lever arms and heights [m]; its scale and latency are measured anew.
        config: the configuration; None: the defaults.
        solution: the solution to calibrate.

    Returns:
        Vehicle, monitor sigmas and fast noise, and what each run shows.

    Raises:
        InputError: no run has the solution, or can be compared with an odometer.
    """
    known = sorted({name for log in logs for name in log.solutions()})
    if solution not in known:
        remedy = "Name one of these with --solution."
        raise InputError("no run has this solution", place=solution, found=", ".join(known), remedy=remedy)
    config = config or Configuration()
    base = vehicle or Vehicle()
    return combine_runs([observe_run(log, site, base, config, solution) for log in with_progress(logs)], base, config)


def observe_run(log: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str) -> ObservedRun:
    """What a fault-free run shows; `InputError` where its streams do not fit, or no odometer is independent of them."""
    prepared = prepare(log, site, vehicle, config, clock_advice)
    if solution not in prepared.run.solutions():
        return ObservedRun(log.run_id, None, {}, None, ())
    require_independent_odometer(prepared)
    # A run with a wrong unit or clock would teach its error to every other run.
    required_fit(prepared, solution, Vehicle(antenna_height_m=vehicle.antenna_height_m))
    match = prepared.match(solution)
    odometry = None if prepared.odometry is None else prepared.odometry.growing_along_path(match.odometer_sign)
    estimate = None if odometry is None else _estimate_vehicle(match, odometry)
    measured = (
        vehicle if estimate is None else _calibrated_vehicle(vehicle, [estimate], config.align.latency_prior_sigma_s)
    )
    noise_m, epochs = _monitor_noise(match, odometry, measured, config)
    return ObservedRun(
        log.run_id, estimate, noise_m, epochs, _alarms_without_noise(log, site, measured, config, solution)
    )


def _estimate_vehicle(match: Match, odometry: Odometry) -> RunEstimate | None:
    """Scale and latency by the epochs with a position on the track."""
    rows = match.epochs.fix_valid & match.epochs.on_track
    return estimate_run(odometry.seconds(match.epochs.t_ns[rows]), match.epochs.path_m[rows], odometry)


def _monitor_noise(
    match: Match, odometry: Odometry | None, vehicle: Vehicle, config: Configuration
) -> tuple[dict[str, tuple[float, ...]], pl.DataFrame]:
    """The fast noise that the bank measures, and the monitors with this noise given."""
    # Without the margin of a single run: the loudest of several counts.
    stated = _with_monitors(config, {**_AS_STATED, **dict.fromkeys(_NO_NOISE), "noise_doubt": 0.0})
    aligned = align(match.epochs, odometry, vehicle, stated)
    noise_m = MonitorBank(aligned, {}, stated).median_noise_m()
    as_stated = _with_monitors(stated, noise_m)
    bank = MonitorBank(aligned, {"along_doppler": doppler_monitor(aligned, as_stated)}, as_stated)
    return noise_m, pl.concat([aligned.table, pl.DataFrame(bank.columns())], how="horizontal").select(COMPARED)


def _alarms_without_noise(
    log: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str
) -> tuple[str, ...]:
    """Alarms of a replay without any noise given or measured: a fault must not pass for noise."""
    replayed = replay(log, site, vehicle, _with_monitors(config, {**_AS_STATED, **_NO_NOISE}))
    return monitors_beyond_noise(
        replayed.epochs.filter(pl.col("solution") == solution), config.monitors.threshold_factor
    )


def combine_runs(runs: Sequence[ObservedRun], vehicle: Vehicle, config: Configuration) -> Calibration:
    """All runs together, with the `vehicle` and `config` that they were observed with."""
    place = ", ".join(run.run_id for run in runs)
    estimates = [run.estimate for run in runs if run.estimate is not None]
    if not estimates:
        raise InputError(
            "no run gives odometer scale and latency",
            place=place,
            expected="GNSS of the solution on the track, and an odometer, while the speed changes",
            remedy="Calibrate on longer runs that stop and start.",
        )
    fitted = _calibrated_vehicle(vehicle, estimates, config.align.latency_prior_sigma_s)
    _require_plausible(fitted, place, config)
    epochs = [run.epochs for run in runs if run.epochs is not None]
    sigmas = regress_sigmas(epochs, config.monitors.threshold_factor, config.calibration)
    noise_m = _largest_noise_m(runs)
    noisy = any(any(figures) for figures in noise_m.values())
    velocity_mps = velocity_sigma_mps(epochs, config)
    velocity = {} if velocity_mps is None else {"doppler_sigma_mps": velocity_mps}
    return Calibration(
        vehicle=fitted,
        runs=_run_table(runs),
        sigmas=sigma_table(sigmas),
        monitors={**noise_m, **sigma_settings(sigmas, noisy=noisy), **velocity},
        alarms={run.run_id: run.alarms for run in runs if run.alarms},
    )


def _largest_noise_m(runs: Sequence[ObservedRun]) -> dict[str, tuple[float, ...]]:
    """Largest noise of all runs by key of `[monitors]` [m]."""
    names = sorted({name for run in runs for name in run.noise_m})
    shown = {name: [run.noise_m[name] for run in runs if name in run.noise_m] for name in names}
    return {name: tuple(np.max(noises_m, axis=0).tolist()) for name, noises_m in shown.items()}


def sigma_settings(sigmas: Sequence[SigmaFit], *, noisy: bool) -> dict[str, float]:
    """Sigma of positions by the loudest monitor; noise has a margin: where all are quieter the stated sigma stands."""
    worst = worst_fit(sigmas)
    if worst is None:
        return {}
    if noisy and worst.ratio < 1.0:
        return _AS_STATED
    return {"sigma_intercept_m": worst.intercept_m, "sigma_slope": worst.slope}


def _with_monitors(config: Configuration, keys: Mapping[str, object]) -> Configuration:
    """The configuration with some keys of `[monitors]` changed."""
    return config.model_copy(update={"monitors": config.monitors.model_copy(update=dict(keys))})


def _calibrated_vehicle(base: Vehicle, runs: Sequence[RunEstimate], latency_unknown_s: float) -> Vehicle:
    """The vehicle with what was measured.

    A latency more than half as uncertain as `latency_unknown_s`, with which learning in a run begins, is no
    measurement: at constant speed nothing shows it.
    """
    scale = pool_runs(*np.array([(run.scale, run.scale_sigma) for run in runs]).T)
    measured = {"odometer_scale": scale.value, "odometer_scale_sigma": scale.sigma}
    latencies = [(run.latency_s, run.latency_sigma_s) for run in runs if run.latency_s is not None]
    latency = pool_runs(*np.array(latencies, dtype=np.float64).T) if latencies else None
    if latency is not None and latency.sigma <= 0.5 * latency_unknown_s:
        measured |= {"gnss_latency_s": latency.value, "gnss_latency_sigma_s": latency.sigma}
    return base.model_copy(update=measured)


def _require_plausible(vehicle: Vehicle, place: str, config: Configuration) -> None:
    """Figures that no wheel or receiver has are another error, and a vehicle file would hide it."""
    scale = vehicle.odometer_scale or 1.0
    latency_s = vehicle.gnss_latency_s or 0.0
    most = config.plausibility.scale_limit
    most_s = config.plausibility.lag_limit_s
    if abs(scale - 1.0) <= most and abs(latency_s) <= most_s:
        return
    raise InputError(
        "the runs give impossible figures",
        place=place,
        found=f"odometer_scale {scale:.4g}, gnss_latency_s {latency_s:.3g}",
        expected=f"a scale within {most:g} of 1, and a latency within {most_s:g} s",
        remedy="`balise inspect RUN --site SITE` says what does not fit; calibrate on fault-free runs.",
    )


def _run_table(runs: Sequence[ObservedRun]) -> pl.DataFrame:
    """One row per run: scale and latency, null where they could not be estimated."""
    kinds: dict[str, type[pl.DataType]] = {field.name: pl.Float64 for field in fields(RunEstimate)}
    rows = [{"run_id": run.run_id} | ({} if run.estimate is None else asdict(run.estimate)) for run in runs]
    return pl.DataFrame(rows, schema={"run_id": pl.String} | kinds | {"points": pl.Int64})
