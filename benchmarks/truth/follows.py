"""Does the statistic V of an odometer accuse no independent one, and find those that are made of the positions.

    python -m benchmarks.truth.follows [--runs N] [--seed S]

Own simulation, which shares nothing with the program's generator: journeys with stops over curves and grades; receivers
with RTK, SBAS, canyon and heavy-tailed errors, digits and gaps; independent odometers (tacho pulses of 0.02 to 1 m,
speeds in digits of 0.1 and 1 km/h, radar with noise of 1 to 30 s, smoothing, slip, latency, stamps of the positions or
their own); and odometers that are differences of the positions or their chainage. Printed: how many of each family are
found, and the least V of those that are independent. Ends with 1 where one is accused, or fewer than 95 % are found.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from scipy.ndimage import uniform_filter1d

from benchmarks.results import Figure, processor_s
from pipeline.stages.follows import Follows, follows_positions
from schemas.config import Configuration

Floats = npt.NDArray[np.float64]
Rng = np.random.Generator
RECEIVERS = ("rtk", "sbas", "canyon", "student")
INDEPENDENT = ("pulses", "digits", "radar", "wheel")
COPIES = ("differences", "chainage")
_RADIUS_M = 6_371_000.0
_FINE_S = 0.05
_LATITUDE_DEG = 50.0


@dataclass(frozen=True)
class Journey:
    """The truth each `_FINE_S`: way [m], and places east, north, up [m]."""

    t_s: Floats
    travelled_m: Floats
    places_m: Floats


def journey(rng: Rng, length_s: float) -> Journey:
    """Speeds between stops by random walks of acceleration; direction and grade by random walks along the way."""
    t_s = np.arange(0.0, length_s, _FINE_S)
    speed = np.zeros(t_s.size)
    at = 0
    while at < t_s.size:
        at += int(rng.uniform(5.0, 60.0) / _FINE_S)
        ride = int(rng.uniform(60.0, 600.0) / _FINE_S)
        top = rng.uniform(8.0, 55.0)
        shape = np.minimum(
            1.0, np.minimum(np.arange(ride), np.arange(ride)[::-1]) * _FINE_S * rng.uniform(0.3, 1.0) / top
        )
        wander = _correlated(rng, ride, rng.uniform(10.0, 60.0), _FINE_S) * rng.uniform(0.0, 0.08)
        room = speed[at : at + ride]
        room[:] = (top * shape * (1.0 + wander * shape))[: room.size]
        at += ride
    speed = uniform_filter1d(np.maximum(speed, 0.0), int(1.0 / _FINE_S))
    travelled_m = np.cumsum(speed) * _FINE_S
    along = np.arange(0.0, travelled_m[-1] + 20.0, 10.0)
    turn = np.cumsum(_correlated(rng, along.size, 300.0, 10.0)) * 10.0 * rng.uniform(0.0, 1.0 / 600.0)
    grade = _correlated(rng, along.size, 800.0, 10.0) * rng.uniform(0.0, 0.012)
    course = turn + rng.uniform(0.0, 2 * np.pi)
    axes = (np.cumsum(part) * 10.0 for part in (np.sin(course), np.cos(course), grade))
    return Journey(t_s, travelled_m, np.column_stack([np.interp(travelled_m, along, axis) for axis in axes]))


def _correlated(rng: Rng, size: int, tau: float, step: float) -> Floats:
    """First-order Gauss-Markov noise of unit variance."""
    from scipy.signal import lfilter  # takes long to load

    phi = np.exp(-step / tau)
    drive = rng.standard_normal(size)
    drive[1:] *= np.sqrt(1.0 - phi**2)
    return np.asarray(lfilter([1.0], [1.0, -phi], drive))


def errors(rng: Rng, kind: str, size: int, step_s: float) -> Floats:
    """Errors east, north, up [m], shape (size, 3)."""
    smooth = np.column_stack([_correlated(rng, size, rng.uniform(20.0, 300.0), step_s) for _ in range(3)])
    white = rng.standard_normal((size, 3))
    up = np.array([1.0, 1.0, rng.uniform(1.2, 2.0)])
    if kind == "rtk":
        return np.asarray((rng.uniform(0.005, 0.02) * smooth + rng.uniform(0.001, 0.006) * white) * up)
    if kind == "sbas":
        return np.asarray((rng.uniform(0.3, 1.0) * smooth + rng.uniform(0.01, 0.1) * white) * up)
    if kind == "student":
        tails = rng.standard_t(3, (size, 3))
        return np.asarray((rng.uniform(0.3, 1.0) * smooth + rng.uniform(0.02, 0.1) * tails) * up)
    burst = np.repeat(rng.random(size // 50 + 1) < 0.15, 50)[:size, None]
    fast = np.column_stack([_correlated(rng, size, rng.uniform(3.0, 15.0), step_s) for _ in range(3)])
    bursts = np.where(burst, 4.0, 0.5) * fast
    return np.asarray((rng.uniform(1.0, 3.0) * smooth + bursts + rng.uniform(0.05, 0.3) * white) * up)


def fixes_of(rng: Rng, truth: Journey, kind: str, rate_hz: float) -> tuple[pl.DataFrame, Floats, Floats]:
    """The gnss stream; its times [s] and places [m] as the receiver computed them."""
    t_s = np.arange(1.0, truth.t_s[-1] - 1.0, 1.0 / rate_hz)
    places = np.column_stack([np.interp(t_s, truth.t_s, axis) for axis in truth.places_m.T])
    places = places + errors(rng, kind, t_s.size, 1.0 / rate_hz)
    kept = rng.random(t_s.size) > rng.choice([0.0, 0.0, 0.002])
    t_s, places = t_s[kept], places[kept]
    digits = rng.choice([9, 8, 7])
    latitude = np.round(_LATITUDE_DEG + np.degrees(places[:, 1] / _RADIUS_M), digits)
    longitude = np.round(14.0 + np.degrees(places[:, 0] / (_RADIUS_M * np.cos(np.radians(_LATITUDE_DEG)))), digits)
    height = np.round(300.0 + places[:, 2], rng.choice([3, 2, 1]))
    columns = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    frame = pl.DataFrame({"t": stamps(t_s), **columns, "fix": ["sbas"] * t_s.size})
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC"))), t_s, places


def stamps(t_s: Floats) -> npt.NDArray[np.int64]:
    return np.round(t_s * 1e9).astype(np.int64) + 1_764_000_000_000_000_000


def odometer_frame(t_s: Floats, distance_m: Floats | None, speed_mps: Floats | None) -> pl.DataFrame:
    nothing = np.full(t_s.size, np.nan)
    columns = {"distance_m": distance_m, "speed_mps": speed_mps}
    values = {name: pl.Series(nothing if v is None else v).fill_nan(None) for name, v in columns.items()}
    return pl.DataFrame({"t": stamps(t_s), **values}).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def independent(rng: Rng, truth: Journey, kind: str, fixes_s: Floats) -> pl.DataFrame:
    """What a sensor free of the GNSS writes: from the way alone."""
    step_s = 1.0 / rng.choice([1.0, 2.0, 5.0, 10.0, 20.0, 50.0])
    own = np.arange(0.5, truth.t_s[-1] - 0.5, step_s)
    t_s = fixes_s if rng.random() < 0.5 else own + rng.uniform(0.0, 0.5) + 0.1 * step_s * rng.uniform(-1, 1, own.size)
    sampled_s = t_s - rng.uniform(0.0, 0.5)
    way = np.interp(sampled_s, truth.t_s, truth.travelled_m) * rng.uniform(0.98, 1.02)
    speed = np.gradient(np.interp(truth.t_s, truth.t_s, truth.travelled_m), _FINE_S)
    if rng.random() < 0.3:  # slip now and then
        begin = rng.uniform(0.0, truth.t_s[-1], 6)
        slip = np.any([(truth.t_s > b) & (truth.t_s < b + rng.uniform(2.0, 10.0)) for b in begin], axis=0)
        speed = speed * np.where(slip & (speed > 1.0), rng.uniform(1.02, 1.3), 1.0)
        way = np.interp(sampled_s, truth.t_s, np.cumsum(speed) * _FINE_S)
    if kind == "pulses":
        pulse = rng.choice([0.02, 0.05, 0.1, 0.3, 0.5, 1.0])
        return odometer_frame(t_s, np.floor(way / pulse) * pulse, None)
    if kind == "wheel":
        walk = np.cumsum(rng.standard_normal(t_s.size)) * rng.uniform(0.0005, 0.05) * np.sqrt(np.median(np.diff(t_s)))
        return odometer_frame(t_s, way + walk, None)
    if kind == "digits":
        digit = rng.choice([0.1, 1.0]) / 3.6
        return odometer_frame(t_s, None, np.round(_smooth(rng, speed, sampled_s, truth) / digit) * digit)
    noise = rng.uniform(0.02, 0.5) * _correlated(rng, t_s.size, rng.uniform(1.0, 30.0), float(np.median(np.diff(t_s))))
    return odometer_frame(t_s, None, _smooth(rng, speed, sampled_s, truth) + noise)


def _smooth(rng: Rng, speed: Floats, sampled_s: Floats, truth: Journey) -> Floats:
    window = int(rng.choice([0.1, 0.5, 1.0, 2.0]) / _FINE_S)
    return np.asarray(np.interp(sampled_s, truth.t_s, uniform_filter1d(speed, window)))


def copied(rng: Rng, truth: Journey, kind: str, t_s: Floats, places: Floats) -> pl.DataFrame:
    """An odometer that somebody made of the positions: speeds of their steps, smoothed, or their chainage in cm."""
    if kind == "differences":
        speed = np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1) / np.diff(t_s)
        window = max(1, round(rng.choice([0.0, 0.5, 1.0, 2.0]) / float(np.median(np.diff(t_s)))))
        speed = uniform_filter1d(speed, window)
        if rng.random() < 0.5:
            return odometer_frame(t_s[1:], None, speed)
        return odometer_frame(t_s, np.concatenate([[0.0], np.cumsum(speed * np.diff(t_s))]), None)
    true = np.column_stack([np.interp(t_s, truth.t_s, axis) for axis in truth.places_m.T])[:, :2]
    ahead = np.gradient(true, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-6)[:, None]
    off_m = np.einsum("ij,ij->i", places[:, :2] - true, ahead)
    return odometer_frame(t_s, np.round(np.interp(t_s, truth.t_s, truth.travelled_m) + off_m, 2), None)


def tried(seed: int, receiver: str, kind: str, minutes: float | None = None) -> Follows:
    """One journey with one receiver and one odometer."""
    rng = np.random.default_rng(seed)
    rate_hz = float(rng.choice([1.0, 2.0, 5.0, 10.0]))
    length_s = 60.0 * (minutes or rng.uniform(10.0, 40.0) * (3.0 if rate_hz == 1.0 else 1.0))
    truth = journey(rng, length_s)
    fixes, t_s, places = fixes_of(rng, truth, receiver, rate_hz)
    odometer = copied(rng, truth, kind, t_s, places) if kind in COPIES else independent(rng, truth, kind, t_s)
    return follows_positions(odometer, fixes, Configuration())


def cost_s(seed: int = 0) -> float:
    """An hour at 10 Hz of both, processor time."""
    rng = np.random.default_rng(seed)
    truth = journey(rng, 3600.0)
    fixes, t_s, _ = fixes_of(rng, truth, "sbas", 10.0)
    odometer = independent(rng, truth, "pulses", t_s)
    return processor_s(5, lambda: follows_positions(odometer, fixes, Configuration()))


def measure(out: Path | None = None, runs: int = 2000, seed: int = 1) -> list[Figure]:
    """Independent odometers accused, copies found, and the cost; `out` is not needed."""
    per_family = -(-runs // (len(RECEIVERS) * len(INDEPENDENT)))
    accused = sum(
        said(receiver, kind, family(seed, receiver, kind, per_family)) for receiver in RECEIVERS for kind in INDEPENDENT
    )
    shares = []
    for kind in COPIES:
        found = [one for one in family(seed, "sbas", kind, max(per_family, 40)) if one.ratio is not None]
        shares.append(said("sbas", kind, found) / len(found))
    return [
        Figure("independent odometers accused", accused, "odometers", 0),
        Figure("copies of positions found at SBAS noise", min(shares), "1", 0.95, "above"),
        Figure("an hour at 10 Hz", cost_s(), "s", 0.03),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2000, help="independent odometers")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(arguments)
    figures = measure(None, given.runs, given.seed)
    print("\n".join(f"{figure.name}: {figure.value:.3g} {figure.unit}" for figure in figures))
    return int(any(figure.met is False for figure in figures))


def family(seed: int, receiver: str, kind: str, runs: int) -> list[Follows]:
    first = 1_000_003 * seed + 17 * RECEIVERS.index(receiver) + 31 * (*INDEPENDENT, *COPIES).index(kind)
    return [tried(first + 97 * number, receiver, kind) for number in range(runs)]


def said(receiver: str, kind: str, found: Sequence[Follows]) -> int:
    """Prints one family; how many of it are found."""
    copies = sum(one.found(Configuration().evidence) for one in found)
    ratios = [one.ratio for one in found if one.ratio is not None]
    least, median = (float(np.quantile(ratios, part)) if ratios else float("nan") for part in (0.0, 0.5))
    stands = sum(one.at_stands for one in found)
    words = f"{copies} of {len(found)} found ({stands} at stands), {len(ratios)} with a V, least {least:.2f}"
    print(f"{receiver:8} {kind:12} {words}, median {median:.2f}", flush=True)
    return copies


if __name__ == "__main__":
    sys.exit(main())
