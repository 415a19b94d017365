"""The gate before any computation: can a stream be of one journey, by its times alone?

Behind it no array that follows a stream's span is larger than the gate allows.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, times_ns
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import RunLog

DAY_NS = 86_400 * NS_PER_S
_NS_PER_H = 3_600 * NS_PER_S


def require_two_times(stream: pl.DataFrame, place: str, of: str = "") -> None:
    if stream.height < 2:
        raise InputError(
            f"all rows have the same time{of}" if stream.height else f"no row has a time after 1970{of}",
            place=f"{place}, column t",
            found=f"{stream.height} distinct time{'' if stream.height == 1 else 's'}",
            expected="at least two epochs at different times",
            remedy="Check the recorder's time stamps, or `time` in the [ingest] mapping.",
        )


def require_one_journey(fixes: pl.DataFrame, place: str, config: IngestConfig) -> None:
    """Refuse a solution with a gap of more than a day, or one that lasts too long."""
    gaps = np.diff(times_ns(fixes)) > DAY_NS
    if gaps.any():
        row = int(gaps.argmax())
        raise InputError(
            "holds positions more than a day apart",
            place=f"{place}, column t",
            found=f"{fixes['t'][row]} and {fixes['t'][row + 1]}",
            expected="the times of one journey",
            remedy="Split the recording, or correct its times.",
        )
    require_span(fixes["t"], place, config)


def require_spans(run: RunLog, config: IngestConfig) -> None:
    """Of the streams beside the positions; of these each solution is asked."""
    odometers = [("odometer", odometer) for odometer in (run.odometer, *run.other_odometers)]
    satellites = [] if run.satellites is None else run.satellites.partition_by("solution", maintain_order=True)
    others = [("reference", run.reference), ("balise_reads", run.balise_reads)]
    for name, frame in [*odometers, *(("satellites", part) for part in satellites), *others]:
        if frame is not None:
            require_span(frame["t"], f"{run.run_id}: {name}", config)


def require_span(t: pl.Series, place: str, config: IngestConfig) -> None:
    t_ns = t.cast(pl.Int64)
    if t.len() and int(t_ns[-1]) - int(t_ns[0]) > config.longest_journey_h * _NS_PER_H:
        raise InputError(
            "lasts longer than a journey",
            place=f"{place}, column t",
            found=f"{t[0]} to {t[-1]}",
            expected=f"at most {config.longest_journey_h:g} h",
            remedy="Split the recording, or correct its times; if it lasted so long, write a larger "
            "`longest_journey_h` under [ingest] in the configuration file.",
        )
