"""A first run: write a log and a site, replay the log, read the verdict.

python examples/first_run.py FOLDER

The train runs 8 km on a straight single track at 30 m/s. It records GNSS, a wheel odometer and a reference. In the
second log the position jumps 60 m ahead for ten seconds, over a virtual balise that the train has not reached yet.
"""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl

from pipeline import read_run, read_site, replay
from schemas.config import Vehicle
from schemas.run import RunTables

LATITUDE_DEG, LONGITUDE_DEG = 50.0, 14.0
M_PER_DEG = 111_229.0  # along a meridian at 50 degrees north, WGS 84
SPEED_MPS, LENGTH_M, BALISES_EVERY_M = 30.0, 8_000.0, 500.0
START = datetime(2026, 6, 1, 8, 0, tzinfo=UTC)
# The wheel counts right to one in ten thousand; without it the scale is learned in the run.
VEHICLE = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4)


def main(folder: Path) -> None:
    """Write one site and two logs, and print what a replay says of each."""
    write_site(folder / "site")
    write_log(folder / "healthy")
    write_log(folder / "jump", jump_m=60.0)
    site = read_site(folder / "site")
    for name in ("healthy", "jump"):
        tables = replay(read_run(folder / name), site, VEHICLE)
        print(f"{name}: {verdict_of(tables)}")
        print(tables.hazards.select("hazard", "size_m", "balise_ids", "accepted_ids", "detected", "hazardous_s"))


def write_site(folder: Path) -> None:
    """One net element to the north, surveyed every 25 m, and a virtual balise every 500 m."""
    folder.mkdir(parents=True, exist_ok=True)
    measure_m = np.arange(0.0, LENGTH_M + 1.0, 25.0)
    track = pl.DataFrame({"measure_m": measure_m, "latitude_deg": LATITUDE_DEG + measure_m / M_PER_DEG})
    track.with_columns(
        netelement_id=pl.lit("line"), longitude_deg=pl.lit(LONGITUDE_DEG), sigma_m=pl.lit(0.3)
    ).write_parquet(folder / "track.parquet")
    places_m = np.arange(BALISES_EVERY_M, LENGTH_M, BALISES_EVERY_M)
    pl.DataFrame(
        {"balise_id": [f"VB{place_m:.0f}" for place_m in places_m], "netelement_id": "line", "measure_m": places_m}
    ).with_columns(kind=pl.lit("virtual")).write_csv(folder / "balises.csv")


def write_log(folder: Path, jump_m: float = 0.0, drift_mps: float = 0.0, seed: int = 1) -> None:
    """One run as Parquet streams: 2 Hz, positions of 0.5 m, an odometer declared to be a wheel.

    `jump_m`: by how much the position lies ahead from 112 s to 122 s [m].
    `drift_mps`: the rate at which it drifts ahead from 100 s on [m/s].
    """
    folder.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed)
    seconds = np.arange(0.0, LENGTH_M / SPEED_MPS - 10.0, 0.5)
    place_m = 100.0 + SPEED_MPS * seconds
    jumped_m = np.where((seconds >= 112.0) & (seconds < 122.0), jump_m, 0.0)
    fault_m = jumped_m + drift_mps * np.maximum(seconds - 100.0, 0.0)
    t = pl.lit(START, pl.Datetime("ns", "UTC")) + pl.Series(seconds * 1e9).cast(pl.Duration("ns"))

    def positions(error_m: float, added_m: np.ndarray | float = 0.0) -> pl.DataFrame:
        north_m = place_m + added_m + noise.normal(0.0, error_m, seconds.size)
        east_m = noise.normal(0.0, error_m, seconds.size)
        east_deg = east_m / (M_PER_DEG * np.cos(np.radians(LATITUDE_DEG)))
        places = {"latitude_deg": LATITUDE_DEG + north_m / M_PER_DEG, "longitude_deg": LONGITUDE_DEG + east_deg}
        return pl.DataFrame(places).with_columns(t=t)

    gnss = positions(0.3, fault_m).with_columns(fix=pl.lit("sbas"), cov_ee_m2=pl.lit(0.25), cov_nn_m2=pl.lit(0.25))
    gnss.with_columns(cov_en_m2=pl.lit(0.0)).write_parquet(folder / "gnss.parquet")
    positions(0.02).with_columns(sigma_m=pl.lit(0.05)).write_parquet(folder / "reference.parquet")
    counted_m = place_m + noise.normal(0.0, 0.01, seconds.size)
    odometer = pl.DataFrame({"distance_m": counted_m, "origin": "wheel"}).with_columns(t=t)
    odometer.write_parquet(folder / "odometer.parquet")


def verdict_of(tables: RunTables) -> str:
    """The verdict of a run with its reasons, and the balises accepted of those on the path."""
    row = tables.runs.row(0, named=True)
    because = f" ({', '.join(row['reasons'])})" if row["reasons"] else ""
    return f"{row['verdict']}{because}, {row['balises_accepted']} of {row['balises_on_path']} balises accepted"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
