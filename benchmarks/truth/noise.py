"""Does the bank live with the noise of real receivers, and what does measuring it cost in detection.

    python -m benchmarks.truth.noise quiet [--runs N] [--hours H] [--seed S]
    python -m benchmarks.truth.noise ramps [--runs N] [--seed S]

Own simulation on a straight track with known scale and latency, which shares nothing with the program's generator:
Gauss-Markov errors of any correlation time, white noise, heavy tails, bursts, digits, an odometer that walks at random;
gaps, uneven steps, a stated sigma that varies. The product's bank runs on it. Printed: the receivers with an alarm
after the first minute, and by which monitor; how much later ramps are found than by a bank that was given the noise.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.monitors.bank import MonitorBank
from schemas.config import Configuration
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table

Floats = npt.NDArray[np.float64]
_AXES = ("along", "cross", "up")
_SCALES = ("raw", "ewma_0p1", "ewma_0p01", "ewma_0p001")
_SPEED_MPS = 30.0


@dataclass(frozen=True)
class Receiver:
    """What a receiver does, and what it says of itself.

    `true_over_stated`: its smooth errors over the stated sigma, `tau_s`: their correlation time (None: DIAG's four);
    `white_m`: noise without memory; `digits_m`: step in which positions are written; `tails`: degrees of freedom of
    Student's t for the white noise; `burst`: (factor, length [s], mean time between [s]) of noisier stretches.
    """

    rate_hz: float = 1.0
    sigma_m: float = 1.0
    true_over_stated: float = 1.0
    tau_s: float | None = None
    white_m: float = 0.0
    digits_m: float = 0.0
    tails: int | None = None
    burst: tuple[float, float, float] | None = None
    uneven: bool = False
    gaps: bool = False
    sigma_varies: bool = False


def _stamps(receiver: Receiver, hours: float, rng: np.random.Generator) -> Floats:
    """Times of epochs [s]: regular, or with uneven steps, single epochs missing, and outages of 5 to 90 s."""
    t_s = np.arange(0.0, 3600.0 * hours, 1.0 / receiver.rate_hz)
    if receiver.uneven:
        t_s = t_s[rng.random(t_s.size) > 0.03]
    if receiver.gaps:
        for begin_s in rng.uniform(300.0, t_s[-1], max(1, round(2 * hours))):
            t_s = t_s[(t_s < begin_s) | (t_s > begin_s + rng.uniform(5.0, 90.0))]
    return t_s


def _gauss_markov(t_s: Floats, tau_s: float, rng: np.random.Generator) -> Floats:
    """Unit variance; on the regular grid of the rate, then read at the stamps."""
    from scipy.signal import lfilter  # takes long to load

    step_s = float(np.min(np.diff(t_s)))
    grid = np.round(t_s / step_s).astype(np.int64)
    phi = np.exp(-step_s / tau_s)
    drive = rng.standard_normal(int(grid[-1]) + 1)
    drive[1:] *= np.sqrt(1.0 - phi**2)
    return np.asarray(lfilter([1.0], [1.0, -phi], drive)[grid])


def _factor(t_s: Floats, burst: tuple[float, float, float] | None, rng: np.random.Generator) -> Floats:
    factor = np.ones(t_s.size)
    if burst is None:
        return factor
    times, length_s, between_s = burst
    begin_s = 0.0
    while (begin_s := begin_s + rng.exponential(between_s)) < t_s[-1]:
        factor[(t_s >= begin_s) & (t_s < begin_s + length_s)] = times
    return factor


def _errors(receiver: Receiver, t_s: Floats, stated_m: Floats, rng: np.random.Generator) -> Floats:
    shares = (
        {360.0: 0.083, 1800.0: 0.014, 3600.0: 0.150, 100.0: 0.752} if receiver.tau_s is None else {receiver.tau_s: 1.0}
    )
    smooth = sum(np.sqrt(share) * _gauss_markov(t_s, tau_s, rng) for tau_s, share in shares.items())
    white = rng.standard_normal(t_s.size) if receiver.tails is None else rng.standard_t(receiver.tails, t_s.size)
    factor = _factor(t_s, receiver.burst, rng)
    return np.asarray(receiver.true_over_stated * stated_m * smooth + factor * receiver.white_m * white)


def _written(position_m: Floats, digits_m: float) -> Floats:
    return np.round(position_m / digits_m) * digits_m if digits_m else position_m


def epochs_of(
    receiver: Receiver, hours: float, rng: np.random.Generator, fault_m: Floats | None = None
) -> pl.DataFrame:
    """Aligned epochs of a run, as the bank reads them; `fault_m` is added along the track, epoch by epoch."""
    t_s = _stamps(receiver, hours, rng)
    count = t_s.size
    stated_m = np.full(count, receiver.sigma_m)
    if receiver.sigma_varies:
        stated_m = receiver.sigma_m * np.exp(0.35 * np.sin(2.0 * np.pi * t_s / 700.0) + 0.05 * np.sin(t_s / 9.0))
    steps_m = _SPEED_MPS * np.diff(t_s, prepend=0.0)
    odometer_m = np.cumsum(steps_m + 0.05 * np.sqrt(np.diff(t_s, prepend=0.0)) * rng.standard_normal(count))
    along_m = np.cumsum(steps_m) + _errors(receiver, t_s, stated_m, rng)
    if fault_m is not None:
        along_m = along_m + np.interp(t_s, np.arange(fault_m.size) * 0.1, fault_m)
    along_m = _written(along_m, receiver.digits_m)
    nothing = pl.lit(None, pl.Float64)
    frame = pl.DataFrame(
        {
            "t": pl.Series(np.round(t_s * 1e9).astype(np.int64)).cast(pl.Datetime("ns", "UTC")),
            "path_m": along_m,
            "along_m": along_m,
            "cross_track_m": _written(_errors(receiver, t_s, stated_m, rng), receiver.digits_m),
            "vertical_m": _written(1.5 * _errors(receiver, t_s, stated_m, rng), receiver.digits_m),
            "odometer_m": odometer_m,
            "travelled_m": odometer_m,
            "sigma_along_m": stated_m,
            "calibrated_up_m": 1.5 * stated_m,
        }
    )
    digits_m = receiver.digits_m / np.sqrt(12.0)
    return frame.with_columns(
        **{name: pl.col("sigma_along_m") for name in ("sigma_cross_m", "calibrated_along_m", "calibrated_cross_m")},
        **dict.fromkeys((f"digits_{axis}_m" for axis in _AXES), pl.lit(digits_m)),
        **dict.fromkeys(("fix_valid", "near_track"), pl.lit(True)),
        **dict.fromkeys(("odometer_white_m2_per_s",), pl.lit(0.05**2)),
        **dict.fromkeys(("interpolation_error_m", "curvature_per_m", "stamp_jitter_s", "scale_sigma"), pl.lit(0.0)),
        **dict.fromkeys(("latency_sigma_s", "odometer_rows_m", "odometer_period_s"), pl.lit(0.0)),
        survey_sigma_m=pl.lit(0.1),
        netelement_id=pl.lit("line"),
        odometer_doubt_m=pl.lit(0.0),
        speed_mps=pl.lit(_SPEED_MPS),
        odometer_reason=pl.lit(None, pl.String),
        velocity_along_mps=nothing,
    )


def first_alarm(epochs: pl.DataFrame, config: Configuration, after_s: float = 60.0) -> tuple[str, float] | None:
    """Monitor and time of the first fail after so long, None where there is none."""
    columns = pl.DataFrame(MonitorBank(arrays_of_table(AlignedEpochs, epochs), {}, config).columns())
    t_s = epochs["t"].dt.timestamp("ns").to_numpy() * 1e-9
    found = []
    for name in (f"{axis}_{scale}" for axis in _AXES for scale in _SCALES):
        at = np.flatnonzero((columns[f"{name}_state"] == "fail").to_numpy() & (t_s > after_s))
        found += [(name, float(t_s[at[0]]))] if at.size else []
    return min(found, key=lambda one: one[1]) if found else None


RAMPED = (
    Receiver(white_m=0.05),
    Receiver(rate_hz=10.0, white_m=0.05),
    Receiver(rate_hz=10.0, sigma_m=0.02, white_m=0.005),
    Receiver(tau_s=20.0),
    Receiver(rate_hz=5.0, sigma_m=2.0, white_m=0.3, sigma_varies=True),
)
RATES_MPS = (0.03, 0.1, 0.3, 1.0, 5.0)
_ONSET_S = 1500.0


def ramps(count: int, seed: int) -> None:
    """Time to the first alarm of a ramp, noise measured against noise given; `count` runs per receiver and rate."""
    rng = np.random.default_rng(seed)
    ratios: list[float] = []
    for receiver in RAMPED:
        given = _given_noise(receiver, rng)
        for rate_mps in RATES_MPS:
            hours = (_ONSET_S + min(1000.0, 60.0 / rate_mps)) / 3600.0
            fault_m = rate_mps * np.maximum(np.arange(0.0, 3600.0 * hours, 0.1) - _ONSET_S, 0.0)
            runs = [epochs_of(receiver, hours, rng, fault_m) for _ in range(count)]
            delays_s = np.array([[_delay_s(run, config) for config in (Configuration(), given)] for run in runs])
            delays_s = delays_s[np.isfinite(delays_s[:, 1]) & ~np.isnan(delays_s[:, 0])]
            found = delays_s[:, 0] / delays_s[:, 1]
            ratios += found.tolist()
            undetected = (delays_s * rate_mps > 20.0).sum(axis=0).tolist()
            print(
                f"{rate_mps:g} m/s: {np.median(found):.2f} times later, at most {found.max():.2f}; beyond 20 m"
                f" undetected {undetected[0]}, with noise given {undetected[1]} of {found.size}: {receiver}",
                flush=True,
            )
    print(f"all: median {np.median(ratios):.2f}, 95 % {np.quantile(ratios, 0.95):.2f}")


def _given_noise(receiver: Receiver, rng: np.random.Generator) -> Configuration:
    """As calibration measures it, on another run of the receiver."""
    unhedged = Configuration.model_validate({"monitors": {"noise_doubt": 0.0}})
    shown = MonitorBank(arrays_of_table(AlignedEpochs, epochs_of(receiver, 2.0, rng)), {}, unhedged).median_noise_m()
    return Configuration.model_validate({"monitors": shown})


def _delay_s(epochs: pl.DataFrame, config: Configuration) -> float:
    """From the onset to the first alarm; NaN where noise too large kept the position out of use."""
    found = first_alarm(epochs, config, _ONSET_S)
    if found is not None:
        return found[1] - _ONSET_S
    bank = MonitorBank(arrays_of_table(AlignedEpochs, epochs), {}, config)
    return np.inf if bank.noise_known_at(epochs.height - 1) else np.nan


def random_receivers(count: int, rng: np.random.Generator) -> Iterator[Receiver]:
    """Combinations as issue 35 names them."""
    for _ in range(count):
        yield Receiver(
            rate_hz=float(rng.choice([1.0, 5.0, 10.0])),
            sigma_m=float(rng.choice([0.02, 0.5, 1.0, 2.0])),
            true_over_stated=float(rng.choice([0.5, 1.0, 2.0])),
            tau_s=(None, 10.0, 20.0, 50.0, 100.0, 300.0)[rng.integers(6)],
            white_m=float(rng.choice([0.0, 0.005, 0.05, 0.15, 0.3])),
            digits_m=float(rng.choice([0.0, 0.01, 0.011, 0.11])),
            uneven=bool(rng.random() < 0.25),
            gaps=bool(rng.random() < 0.25),
            sigma_varies=bool(rng.random() < 0.25),
        )


def quiet_runs(count: int, hours: float, seed: int, config: Configuration) -> None:
    rng = np.random.default_rng(seed)
    alarms = 0
    begin = time.process_time()
    for receiver in random_receivers(count, rng):
        found = first_alarm(epochs_of(receiver, hours, rng), config)
        alarms += found is not None
        if found is not None:
            print(f"{found[0]} at {found[1]:.0f} s: {receiver}", flush=True)
    print(f"{count - alarms} of {count} without an alarm in {hours:g} h ({time.process_time() - begin:.0f} s)")


if __name__ == "__main__":
    what, options = sys.argv[1], dict(zip(sys.argv[2::2], sys.argv[3::2], strict=False))
    chosen_seed = int(options.get("--seed", 1))
    if what == "ramps":
        ramps(int(options.get("--runs", 7)), chosen_seed)
    else:
        quiet_runs(int(options.get("--runs", 40)), float(options.get("--hours", 2)), chosen_seed, Configuration())
