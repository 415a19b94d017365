"""Streams as the configuration corrects them (`[[ingest.correct]]`): exchanged columns, units, clocks, shifts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import polars as pl
from pydantic import TypeAdapter, ValidationError

from pipeline.read.ingest.conform import conform, refuse
from pipeline.read.ingest.wraps import unwrap
from pipeline.stages.track.geodesy import moved_deg
from schemas.arrays import NS_PER_S, floats
from schemas.config import IngestConfig, StreamCorrection, settings_from
from schemas.errors import BaliseError, ConfigError, InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, RunLog, Stream

RECORDED = "corrections"
"""In the metadata of a stream that was written: the corrections that it holds already."""

_DAMAGE = "damage"
_RAW_LOGS = "raw_logs"
_LISTING = TypeAdapter(tuple[tuple[str, int, str], ...])
_PLACE = ("latitude_deg", "longitude_deg")


def correct_run(run: RunLog, corrections: Sequence[StreamCorrection], later: bool = False) -> RunLog:
    """The run as the configuration corrects it, each correction once; `notes` lists them.

    A stream that was written with corrections holds them already: what the configuration begins with is left out.
    `later`: streams that the run does not have yet are corrected when they are added.

    Raises `ConfigError` for a stream or column that the run does not have, `InputError` for values that the contract
    does not allow afterwards, and for a stream that holds other corrections than these.
    """
    missing = [made for stream in STREAMS for made in _missing_corrections(run, stream, corrections)]
    return correct_further(run, [made for made in missing if not later or run.stream(made.stream) is not None])


def correct_further(run: RunLog, corrections: Sequence[StreamCorrection]) -> RunLog:
    """The run with these corrections in order, on top of those that it holds. Raises as `corrected`."""
    for correction in corrections:
        frame = run.stream(correction.stream)
        if frame is None:
            raise ConfigError(
                "the run has no such stream to correct",
                place=f"{run.run_id}: [[ingest.correct]] stream = {correction.stream!r}",
                remedy="Remove this correction, or replay this run with another configuration.",
            )
        run = run.with_streams(**{correction.stream: _correct_stream(frame, correction, run.run_id)})
        run = replace(run, notes=replace(run.notes, corrections=(*run.notes.corrections, correction)))
    return run


def _missing_corrections(
    run: RunLog, stream: Stream, corrections: Sequence[StreamCorrection]
) -> Sequence[StreamCorrection]:
    """The corrections of a stream that it does not hold yet.

    Where it holds others, nobody knows what would be made twice.
    """
    held = corrections_of(run, stream)
    wanted = [correction for correction in corrections if correction.stream == stream]
    both = min(len(held), len(wanted))
    if held[:both] != wanted[:both]:
        raise InputError(
            f"the {stream} was written with other corrections than these",
            place=f"{run.run_id}: {stream}",
            found="; ".join(correction.changes for correction in held),
            expected="; ".join(correction.changes for correction in wanted),
            remedy="Convert its logs again with this configuration, or take the one that they were converted with.",
        )
    return wanted[both:]


def corrections_of(run: RunLog, stream: Stream) -> list[StreamCorrection]:
    """The corrections that a stream holds already."""
    return [correction for correction in run.notes.corrections if correction.stream == stream]


def recorded_notes(run: RunLog, stream: Stream) -> dict[str, str]:
    """What a written stream says of its corrections and, of positions, of the logs of the run, for its metadata."""
    held = [correction.model_dump(mode="json", exclude_defaults=True) for correction in corrections_of(run, stream)]
    said = {RECORDED: json.dumps(held)} if held else {}
    if stream == "gnss" and run.notes.damage:
        said[_DAMAGE] = run.notes.damage
    if stream == "gnss" and run.notes.raw_logs:
        said[_RAW_LOGS] = json.dumps(run.notes.raw_logs)
    return said


def read_damage(metadata: Mapping[str, str]) -> str | None:
    """What the log lacked that a stream was written of."""
    return metadata.get(_DAMAGE)


def read_raw_logs(metadata: Mapping[str, str]) -> tuple[tuple[str, int, str], ...]:
    """The logs that a stream says its run was converted from; none where this program did not write that."""
    try:
        return _LISTING.validate_json(metadata.get(_RAW_LOGS, "[]"))
    except ValidationError:
        return ()


def read_corrections(metadata: Mapping[str, str], stream: Stream, place: str) -> tuple[StreamCorrection, ...]:
    """The corrections that a stream says it holds.

    Raises `InputError` where that cannot be understood, or is none that this program makes.
    """
    text = metadata.get(RECORDED)
    if text is None:
        return ()
    try:
        held = settings_from({"correct": json.loads(text)}, IngestConfig, place).correct
    except (ValueError, RecursionError, BaliseError):
        held = ()
    if not held or any(made.stream != stream or not made.changes or unknown_columns(made) for made in held):
        raise InputError(
            f"does not say clearly how its {stream} was corrected",
            place=place,
            found=text[:80],
            remedy="Convert its logs again.",
        )
    return held


def _correct_stream(frame: pl.DataFrame, correction: StreamCorrection, run_id: str) -> pl.DataFrame:
    """A stream with one correction made."""
    _refuse_unknown_columns(correction)
    mended = frame
    if correction.exchange is not None:
        first, second = correction.exchange
        mended = mended.with_columns(pl.col(second).alias(first), pl.col(first).alias(second))
    mended = _unwrap_distances(mended, correction.wrap) if correction.wrap is not None else mended
    mended = mended.with_columns(pl.col(name) * factor for name, factor in correction.factors.items())
    mended = _shift_times(mended, correction.shift_s) if correction.shift_s else mended
    if correction.moves:
        mended = _move_positions(mended, correction)
    if correction.solution is not None and "solution" in frame.columns:
        meant = pl.col("solution") == correction.solution
        mended = frame.with_columns(pl.when(meant).then(mended[name]).otherwise(pl.col(name)) for name in frame.columns)
    breaches: list[InputError] = []
    conformed = conform(mended, correction.stream, f"{run_id}: {correction.stream} after [[ingest.correct]]", breaches)
    refuse(breaches)
    return conformed


def _unwrap_distances(odometer: pl.DataFrame, size: float) -> pl.DataFrame:
    """Distances of counters that begin anew after so much, by sensor."""
    distance = floats(odometer, "distance_m").copy()
    for sensor in odometer["sensor"].unique():
        rows = np.flatnonzero((odometer["sensor"] == sensor).to_numpy())
        distance[rows] = unwrap(distance[rows], size)
    return odometer.with_columns(pl.Series("distance_m", distance).fill_nan(None))


def _shift_times(frame: pl.DataFrame, shift_s: float) -> pl.DataFrame:
    """Times shifted; null where 64 bits of nanoseconds cannot hold them."""
    shift_ns = round(shift_s * NS_PER_S)
    later = pl.col("t") + pl.duration(nanoseconds=shift_ns, time_unit="ns")
    # Beyond 64 bits polars wraps round without an error.
    return frame.with_columns(pl.when((later > pl.col("t")) == (shift_ns > 0)).then(later).alias("t"))


def _move_positions(frame: pl.DataFrame, correction: StreamCorrection) -> pl.DataFrame:
    """Positions moved by the shift; heights where there are any."""
    latitude, longitude = (floats(frame, name) for name in _PLACE)
    height = floats(frame, "height_m")
    count = np.ones(frame.height)
    moved = moved_deg(
        latitude, longitude, np.nan_to_num(height), correction.shift_east_m * count, correction.shift_north_m * count
    )
    columns = [pl.Series(name, values).fill_nan(None) for name, values in zip(_PLACE, moved, strict=True)]
    return frame.with_columns(*columns, pl.col("height_m") + correction.shift_up_m)


def unknown_columns(correction: StreamCorrection) -> list[str]:
    """The columns that it names and that cannot be corrected: only numbers can be multiplied, only places be moved."""
    names = [*correction.factors, *(correction.exchange or ()), *([*_PLACE, "height_m"] if correction.moves else [])]
    names += [] if correction.wrap is None else ["distance_m"]
    return sorted(set(names) - set(_number_columns(correction.stream)))


def _number_columns(stream: Stream) -> list[str]:
    """Columns of a stream that hold floats."""
    return [name for name, column in STREAM_SCHEMAS[stream].columns().items() if column.dtype == pl.Float64]


def _refuse_unknown_columns(correction: StreamCorrection) -> None:
    """Refuse a correction of columns that cannot be corrected."""
    if unknown := unknown_columns(correction):
        raise ConfigError(
            "names columns that cannot be corrected",
            place=f"[[ingest.correct]] stream = {correction.stream!r}",
            found=", ".join(unknown),
            expected="some of " + ", ".join(_number_columns(correction.stream)),
        )
