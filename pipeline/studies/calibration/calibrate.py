"""What recorded fault-free runs tell of a vehicle and of its monitors (`balise calibrate`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
import tomli_w

from pipeline.one_run import replay
from pipeline.stages.monitors.axis import error_model
from pipeline.stages.prepare import PreparedRun, prepare
from pipeline.studies.calibration.noise import beyond_noise
from pipeline.studies.calibration.sigmas import COMPARED, regress_sigmas, sigma_table, velocity_sigma_mps, worst_fit
from pipeline.studies.calibration.vehicle import Observations, RunEstimate, estimate_run, pooled
from pipeline.studies.plausibility.fit import clock_advice, fit_run, refuse_impossible
from schemas.arrays import floats, times_ns
from schemas.config import Configuration, Vehicle
from schemas.errors import InputError
from schemas.run import RunLog, Site
from schemas.tables import AXES

NO_NOISE = {f"noise_{axis}_m": (0.0, 0.0, 0.0, 0.0) for axis in AXES}
"""For `[monitors]`: the fitted sigma stands for the fast noise too, so that the run itself measures none."""


@dataclass(frozen=True)
class Calibration:
    """`vehicle`: the vehicle file; `runs`: scale and latency run by run; `sigmas`: regression by monitor.

    The vehicle has no latency where the runs tell none.

    `sigma_intercept_m`, `sigma_slope`, from the loudest monitor, and `doppler_sigma_mps` are for `[monitors]` of the
    configuration; None where the monitors were not evaluated.
    """

    vehicle: Vehicle
    runs: pl.DataFrame
    sigmas: pl.DataFrame
    sigma_intercept_m: float | None
    sigma_slope: float | None
    doppler_sigma_mps: float | None

    def monitors(self) -> dict[str, float]:
        """What was measured for `[monitors]` of the configuration, by key."""
        names = ("sigma_intercept_m", "sigma_slope", "doppler_sigma_mps")
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def monitors_toml(self) -> str:
        """The part of a configuration file that was measured."""
        measured = self.monitors()
        return tomli_w.dumps({"monitors": measured}) if measured else ""


@dataclass(frozen=True)
class Observed:
    """What one run tells of its vehicle; `estimate` is None where GNSS and odometer could not be compared.

    `epochs`: the columns that sigmas are regressed on. `alarms`: monitors that failed beyond noise (`beyond_noise`).
    """

    run_id: str
    estimate: RunEstimate | None
    epochs: pl.DataFrame
    alarms: tuple[str, ...]


def calibrate(
    logs: Sequence[RunLog],
    site: Site,
    vehicle: Vehicle | None = None,
    config: Configuration | None = None,
    solution: str = "primary",
) -> Calibration:
    """Vehicle and monitor sigmas from fault-free runs over one site.

    `vehicle` brings lever arms and heights; what it says of scale and latency is measured anew, and so are the sigmas
    of `config`. Raises `InputError` where no run can be compared with an odometer.
    """
    config, base = config or Configuration(), vehicle or Vehicle()
    _check_solution(logs, solution)
    return calibration_of([observe(log, site, base, config, solution) for log in logs], base, config)


def observe(log: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str) -> Observed:
    """What a fault-free run tells: its scale and latency, and what the monitors show when it is replayed with these.

    Raises `InputError` where its streams do not fit each other.
    """
    config = _uncalibrated(config)
    prepared = prepare(log, site, vehicle, config, clock_advice)
    _refuse_what_does_not_fit(prepared, solution)
    estimate = _estimate(prepared, solution)
    own = vehicle if estimate is None else _vehicle(vehicle, [estimate], config.align.latency_prior_sigma_s)
    epochs = replay(log, site, own, config).epochs.filter(pl.col("solution") == solution)
    alarms = beyond_noise(epochs, config.monitors.threshold_factor)
    return Observed(log.run_id, estimate, epochs.select(COMPARED), alarms)


def calibration_of(runs: Sequence[Observed], vehicle: Vehicle, config: Configuration) -> Calibration:
    """Vehicle and monitor sigmas that runs tell together.

    `vehicle` and `config` as the runs were observed with. Raises `InputError` as `calibrate` does.
    """
    place = ", ".join(run.run_id for run in runs)
    found = [run.estimate for run in runs if run.estimate is not None]
    if not found:
        raise InputError(
            "no run gives odometer scale and latency",
            place=place,
            expected="GNSS of the solution on the track, and an odometer, while the speed changes",
            remedy="Calibrate on longer runs that stop and start.",
        )
    fitted = _vehicle(vehicle, found, config.align.latency_prior_sigma_s)
    _refuse_figures_of_no_train(fitted, place, config)
    epochs = [run.epochs for run in runs]
    factor = config.monitors.threshold_factor
    fits = regress_sigmas(epochs, factor, config.calibration)
    worst = worst_fit(fits)
    return Calibration(
        vehicle=fitted,
        runs=_run_table([(run.run_id, run.estimate) for run in runs]),
        sigmas=sigma_table(fits),
        sigma_intercept_m=None if worst is None else worst.intercept_m,
        sigma_slope=None if worst is None else worst.slope,
        doppler_sigma_mps=velocity_sigma_mps(epochs, factor, config.monitors.doppler_sigma_mps, config.calibration),
    )


def _uncalibrated(config: Configuration) -> Configuration:
    """Without the figures of an earlier calibration, or of the run: the regression is on what the receiver states."""
    stated = {"sigma_intercept_m": 0.0, "sigma_slope": 1.0, **NO_NOISE}
    return config.model_copy(update={"monitors": config.monitors.model_copy(update=stated)})


def _check_solution(logs: Sequence[RunLog], solution: str) -> None:
    known = sorted({name for log in logs for name in log.solutions()})
    if solution not in known:
        raise InputError(
            "no run has this solution",
            place=solution,
            found=", ".join(known),
            remedy="Name one of these with --solution.",
        )


def _estimate(prepared: PreparedRun, solution: str) -> RunEstimate | None:
    config, odometry = prepared.config, prepared.odometry
    if odometry is None or solution not in prepared.run.solutions():
        return None
    match = prepared.match(solution)
    epochs = match.epochs.filter("fix_valid", "on_track")
    t_s = odometry.seconds(times_ns(epochs))
    seen = Observations(t_s, floats(epochs, "path_m"), floats(epochs, "sigma_along_m"))
    return estimate_run(seen, odometry.oriented(match.odometer_sign), *error_model(config.monitors), config.calibration)


def _vehicle(base: Vehicle, found: Sequence[RunEstimate], latency_unknown_s: float) -> Vehicle:
    """The vehicle with what was measured.

    A latency that the runs leave more than half as uncertain as `latency_unknown_s`, with which a replay without a
    vehicle file begins to learn it, is no measurement: at constant speed nothing tells it. What `base` says stays.
    """
    scale = pooled(np.array([one.scale for one in found]), np.array([one.scale_sigma for one in found]))
    latency = pooled(np.array([one.latency_s for one in found]), np.array([one.latency_sigma_s for one in found]))
    measured = {"odometer_scale": scale.value, "odometer_scale_sigma": scale.sigma}
    if latency.sigma <= 0.5 * latency_unknown_s:
        measured |= {"gnss_latency_s": latency.value, "gnss_latency_sigma_s": latency.sigma}
    return base.model_copy(update=measured)


def _refuse_what_does_not_fit(prepared: PreparedRun, solution: str) -> None:
    """A run with a wrong unit or clock would teach its error to every other run."""
    run, config = prepared.recorded, prepared.config
    if solution in run.solutions():
        mounted = Vehicle(antenna_height_m=prepared.vehicle.antenna_height_m)
        refuse_impossible(
            fit_run(run, solution, mounted, config.plausibility, prepared.site), run.run_id, config.ingest
        )


def _refuse_figures_of_no_train(vehicle: Vehicle, place: str, config: Configuration) -> None:
    """Figures beyond what wheels and receivers can be off are another error, and a vehicle file would hide it."""
    scale, latency_s = vehicle.odometer_scale or 1.0, vehicle.gnss_latency_s or 0.0
    most, most_s = config.plausibility.scale_limit, config.plausibility.lag_limit_s
    if abs(scale - 1.0) <= most and abs(latency_s) <= most_s:
        return
    raise InputError(
        "the runs give impossible figures",
        place=place,
        found=f"odometer_scale {scale:.4g}, gnss_latency_s {latency_s:.3g}",
        expected=f"a scale within {most:g} of 1, and a latency within {most_s:g} s",
        remedy="`balise inspect RUN --site SITE` says what does not fit; calibrate on fault-free runs.",
    )


def _run_table(estimates: Sequence[tuple[str, RunEstimate | None]]) -> pl.DataFrame:
    names = ("scale", "scale_sigma", "latency_s", "latency_sigma_s", "misfit", "points")
    rows = [(run_id, *(None if one is None else getattr(one, name) for name in names)) for run_id, one in estimates]
    schema = {"run_id": pl.String} | dict.fromkeys(names, pl.Float64) | {"points": pl.Int64}
    return pl.DataFrame(rows, schema=schema, orient="row")
