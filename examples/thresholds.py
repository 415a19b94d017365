"""A study of thresholds: what does a lower false-alarm probability cost in time to detect?

python examples/thresholds.py FOLDER

The threshold of every monitor is k_T sigma, and k_T follows from `monitors.false_alarm_probability` (DIAG eq. 17). The
study replays one healthy run and drifts of several rates at several probabilities, on the line of `first_run.py`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import polars as pl
from first_run import VEHICLE, write_log, write_site

from pipeline import read_run, read_site, replay
from schemas.config import Configuration

PROBABILITIES = (1e-3, 1e-7, 1e-11)
DRIFTS_MPS = (0.2, 0.5, 1.0)


def main(folder: Path) -> pl.DataFrame:
    """Print and return one row per probability and drift."""
    write_site(folder / "site")
    site = read_site(folder / "site")
    for drift_mps in (0.0, *DRIFTS_MPS):
        write_log(folder / f"drift_{drift_mps}", drift_mps=drift_mps)
    rows = []
    for probability in PROBABILITIES:
        config = Configuration.model_validate({"monitors": {"false_alarm_probability": probability}})
        healthy = replay(read_run(folder / "drift_0.0"), site, VEHICLE, config)
        for drift_mps in DRIFTS_MPS:
            tables = replay(read_run(folder / f"drift_{drift_mps}"), site, VEHICLE, config)
            rows.append(
                {
                    "false_alarm_probability": probability,
                    "k_T": round(config.monitors.threshold_factor, 2),
                    "alarms_when_healthy": healthy.runs["alarms"].item(),
                    "drift_mps": drift_mps,
                    **first_alarm(tables.alarms, tables.epochs),
                }
            )
    table = pl.DataFrame(rows)
    with pl.Config(tbl_rows=-1, tbl_cols=-1, tbl_width_chars=120):
        print(table)
    return table


def first_alarm(alarms: pl.DataFrame, epochs: pl.DataFrame) -> dict[str, float | None]:
    """Seconds from the begin of the drift, 100 s into the run, to the first alarm behind it, and the error then [m]."""
    onset = epochs["t"].min() + pl.duration(seconds=100)
    after = alarms.filter(pl.col("t_start") >= onset).sort("t_start").head(1)
    found = after.join(epochs, left_on="t_start", right_on="t").select(
        alarm_after_s=(pl.col("t_start") - onset).dt.total_milliseconds() / 1000,
        error_m=pl.col("error_along_m").round(1),
    )
    return found.row(0, named=True) if found.height else {"alarm_after_s": None, "error_m": None}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
