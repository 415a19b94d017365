"""Streams as the configuration corrects them (`[[ingest.correct]]`): exchanged columns, units, clocks, shifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import moved_deg
from schemas.arrays import NS_PER_S, floats
from schemas.config import StreamCorrection
from schemas.errors import ConfigError, InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import RunLog

_PLACE = ("latitude_deg", "longitude_deg")


def corrected(run: RunLog, corrections: Sequence[StreamCorrection]) -> RunLog:
    """The run with these corrections applied in order; `notes` tells of each.

    Raises `ConfigError` for a stream or column that the run does not have, `InputError` for places that are none on
    earth afterwards.
    """
    for correction in corrections:
        frame = run.stream(correction.stream)
        if frame is None:
            raise ConfigError(
                "the run has no such stream to correct",
                place=f"{run.run_id}: [[ingest.correct]] stream = {correction.stream!r}",
                remedy="Remove this correction, or replay this run with another configuration.",
            )
        run = run.with_streams(**{correction.stream: _corrected(frame, correction, run.run_id)})
        notes = replace(run.notes, corrections=(*run.notes.corrections, _told(correction)))
        run = replace(run, notes=notes)
    return run


def _corrected(frame: pl.DataFrame, correction: StreamCorrection, run_id: str) -> pl.DataFrame:
    _refuse_unknown(correction)
    mended = frame
    if correction.exchange is not None:
        one, other = correction.exchange
        mended = mended.with_columns(pl.col(other).alias(one), pl.col(one).alias(other))
    mended = mended.with_columns(pl.col(name) * factor for name, factor in correction.factors.items())
    shift = pl.duration(nanoseconds=round(correction.shift_s * NS_PER_S), time_unit="ns")
    mended = mended.with_columns(pl.col("t") + shift) if correction.shift_s else mended
    if correction.shift_east_m or correction.shift_north_m or correction.shift_up_m:
        mended = _moved(mended, correction)
    _refuse_no_place(mended, correction, run_id)
    if correction.solution is None or "solution" not in frame.columns:
        return mended
    kept = pl.col("solution") == correction.solution
    one_solution = [pl.when(kept).then(mended[name]).otherwise(pl.col(name)).alias(name) for name in frame.columns]
    return frame.with_columns(one_solution)


def _moved(frame: pl.DataFrame, correction: StreamCorrection) -> pl.DataFrame:
    """Positions moved by the shift; heights where there are any."""
    latitude, longitude = (floats(frame, name) for name in _PLACE)
    height = floats(frame, "height_m")
    count = np.ones(frame.height)
    moved = moved_deg(
        latitude, longitude, np.nan_to_num(height), correction.shift_east_m * count, correction.shift_north_m * count
    )
    columns = [pl.Series(name, values).fill_nan(None) for name, values in zip(_PLACE, moved, strict=True)]
    return frame.with_columns(*columns, pl.col("height_m") + correction.shift_up_m)


def _refuse_unknown(correction: StreamCorrection) -> None:
    """Only numbers can be multiplied, and only places be moved."""
    contract = STREAM_SCHEMAS[correction.stream].columns()
    numbers = [name for name, column in contract.items() if column.dtype == pl.Float64]
    named = [*correction.factors, *(correction.exchange or ())]
    moves = correction.shift_east_m or correction.shift_north_m or correction.shift_up_m
    named += [*_PLACE, "height_m"] if moves else []
    if unknown := sorted(set(named) - set(numbers)):
        raise ConfigError(
            "names columns that cannot be corrected",
            place=f"[[ingest.correct]] stream = {correction.stream!r}",
            found=", ".join(unknown),
            expected="some of " + ", ".join(numbers),
        )


def _refuse_no_place(frame: pl.DataFrame, correction: StreamCorrection, run_id: str) -> None:
    if not set(_PLACE) <= set(frame.columns):
        return
    beyond = frame.filter((pl.col(_PLACE[0]).abs() > 90.0) | (pl.col(_PLACE[1]).abs() > 180.0))
    if beyond.height:
        raise InputError(
            "has latitudes or longitudes out of range after correction",
            place=f"{run_id}: {correction.stream}",
            found=f"latitude {beyond[_PLACE[0]][0]:g}, longitude {beyond[_PLACE[1]][0]:g}",
            remedy="Check [[ingest.correct]] in the configuration.",
        )


def _told(correction: StreamCorrection) -> str:
    changed = correction.model_dump(exclude_defaults=True)
    changed.pop("stream")
    return f"{correction.stream} corrected by configuration: " + ", ".join(
        f"{name} {value}" for name, value in changed.items()
    )
