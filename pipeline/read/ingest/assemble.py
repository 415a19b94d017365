"""Decoded fields to stream frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import polars as pl

from pipeline.read.ingest.conform import DEFAULTS, conform
from pipeline.read.ingest.plan import Source, is_world_frame, missing_field_error, world_frame_error
from pipeline.read.ingest.reader import ORDINAL
from pipeline.read.ingest.wraps import whole_stream, with_whole_counts, wrap_remarks
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream


@frozen
class DecodedRows:
    """Fields of all messages of a source, one row per message, with its times and place in the file.

    `speed_frames`: what its messages name as the frame of their speed.
    """

    source: Source
    solution: str | None
    frame: pl.DataFrame
    speed_frames: Sequence[str]


def stream_frames(
    decoded: Sequence[DecodedRows], breaches: list[InputError], config: IngestConfig, remarks: list[str]
) -> dict[str, pl.DataFrame]:
    """One frame per stream that has a source, rows in order of the file; `remarks` tells what was left out."""
    frames: dict[str, pl.DataFrame] = {}
    for stream in STREAMS:
        parts = [part for part in decoded if part.source.recipe.stream == stream]
        if parts:
            frames[stream] = _stream_frame(stream, parts, breaches, config, remarks)
    return frames


def _stream_frame(
    stream: Stream, parts: Sequence[DecodedRows], breaches: list[InputError], config: IngestConfig, remarks: list[str]
) -> pl.DataFrame:
    """One stream of all its sources, with what they lack among the breaches."""
    place = ", ".join(dict.fromkeys(part.source.channel.place for part in parts))
    breaches += [
        missing_field_error(part.source.channel, [], column, [path])
        for part in parts
        for column, path in part.source.doubtful.items()
        if part.frame[path].null_count() == part.frame.height
    ]
    supplements = [part for part in parts if part.source.recipe.supplement]
    rows = [_source_rows(part, supplements, config, remarks) for part in parts if not part.source.recipe.supplement]
    joined = pl.concat(rows, how="diagonal_relaxed")
    frame = joined if len(rows) == 1 else joined.sort(ORDINAL, maintain_order=True)
    conformed = conform(frame, stream, place, breaches)
    if stream != "odometer" or breaches or any(part.source.mapping is not None for part in parts):
        return conformed
    whole, wraps = whole_stream(conformed, config)
    topics = ", ".join(dict.fromkeys(part.source.channel.topic for part in parts))
    remarks += [f"{topics}: {said}" for said in wraps]
    return whole


def _with_supplements(frame: pl.DataFrame, part: DecodedRows, supplements: Sequence[DecodedRows]) -> pl.DataFrame:
    """The rows with the columns that other messages of the same receiver hold for the same epochs."""
    key = list(part.source.recipe.key)
    for supplement in supplements:
        if supplement.source.recipe.key != part.source.recipe.key or not _are_of_one_receiver(part, supplement):
            continue
        columns = [expression.alias(name) for name, expression in supplement.source.columns.items()]
        extra = supplement.frame.select(*key, *columns).unique(subset=key, keep="first", maintain_order=True)
        keys = part.frame.select(key)
        frame = frame.hstack(keys).join(extra, on=key, how="left", maintain_order="left").drop(key)
    return frame


def _are_of_one_receiver(part: DecodedRows, supplement: DecodedRows) -> bool:
    """Whether two topics are of one receiver: drivers publish its messages side by side."""
    return part.source.channel.topic.rpartition("/")[0] == supplement.source.channel.topic.rpartition("/")[0]


def _source_rows(
    part: DecodedRows, supplements: Sequence[DecodedRows], config: IngestConfig, remarks: list[str]
) -> pl.DataFrame:
    """Rows of one source, with its times and supplements."""
    source = part.source
    _refuse_world_frame(part)
    try:
        times = [time.instants(part.frame, name) for name, time in source.times.items()]
    except (ValueError, pl.exceptions.PolarsError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"has a time that cannot be read: {reason}", place=source.channel.place) from None
    part = replace(part, frame=_unwrap_counter(part, times, config, remarks))
    columns = _without_unset(part.frame.select(ORDINAL, **source.columns), source)
    frame = _with_supplements(_with_solution(columns.with_columns(times), part), part, supplements)
    if "t" not in source.times:
        return frame
    if frame["t"].null_count() and _may_be_left_out(part, frame["t"].is_null(), config.wrong_dates_share, remarks):
        frame = frame.drop_nulls("t")
    return _without_zero_stamps(frame, source, remarks)


def _refuse_world_frame(part: DecodedRows) -> None:
    """Raise `InputError` for a component of a velocity in a frame that does not turn with the train."""
    source = part.source
    for frame in filter(is_world_frame, part.speed_frames):
        (path,) = source.columns["speed_mps"].meta.root_names()
        raise world_frame_error(source.channel, path, frame)


def _unwrap_counter(
    part: DecodedRows, times: Sequence[pl.Series], config: IngestConfig, remarks: list[str]
) -> pl.DataFrame:
    """The fields with a mapped counter counted on where it begins anew."""
    mapping = part.source.mapping
    if mapping is None or part.source.recipe.stream != "odometer" or "distance_m" not in mapping.fields:
        return part.frame
    path = mapping.fields["distance_m"]
    if path not in part.frame.columns:
        return part.frame
    t_ns = times[0].to_physical().fill_null(0).to_numpy()
    sensors = part.frame[mapping.fields["sensor"]] if mapping.fields.get("sensor") in part.frame.columns else None
    whole, found = with_whole_counts(part.frame[path], t_ns, mapping.wrap, sensors, config.wraps)
    topic = part.source.channel.topic
    remarks += [f"{topic}: {times} x {said}" for said, times in wrap_remarks(found, path).items()]
    return part.frame.with_columns(whole) if found else part.frame


def _may_be_left_out(part: DecodedRows, unknown: pl.Series, few: float, remarks: list[str]) -> bool:
    """Whether messages without time may be left out, which is counted.

    They may where a receiver does not know the time yet, and where a few have a date that no trial can have.
    """
    source = part.source
    time = source.times["t"]
    if source.recipe.time is not None:
        remarks.append(f"{source.channel.topic}: {unknown.sum()} messages without a valid time")
        return True
    wrong = part.frame.select(~pl.any_horizontal(pl.col(*time.fields).is_null())).to_series() & unknown
    if wrong.sum() > few * wrong.len():
        row = int(wrong.arg_max() or 0)
        written = ", ".join(str(part.frame[name][row]) for name in time.fields)
        raise InputError(
            "has impossible time stamps",
            place=source.channel.place,
            found=f"{wrong.sum()} of {wrong.len()}, the first in message {row} of the topic: {written}",
            expected="times from 1970 to 2200",
            remedy='Check the unit of the stamps ([ingest] factors), or map the topic with time = "log".',
        )
    if wrong.any():
        remarks.append(f"{source.channel.topic}: {wrong.sum()} messages with a date before 1970 or after 2200")
    return bool((wrong == unknown).all())


_NEVER_ZERO = ("hpl_m", "vpl_m", "sbas_prn", "sigma_m", "sigma_speed_mps")


def _without_unset(frame: pl.DataFrame, source: Source) -> pl.DataFrame:
    """What a protobuf field without presence holds: a column that is 0 throughout was not recorded."""
    if not source.implicit:
        return frame
    contract = STREAM_SCHEMAS[source.recipe.stream].columns()
    names = [name for name in source.implicit if contract[name].nullable and frame[name].dtype.is_numeric()]
    zero_columns = [name for name in names if not (frame[name] != 0).any()]
    if "speed_mps" in zero_columns and not _gives_distance(frame, zero_columns):  # a train that stands says so
        zero_columns.remove("speed_mps")
    empty = [pl.lit(None, dtype=frame[name].dtype).alias(name) for name in zero_columns]
    zero = [
        pl.when(pl.col(name) != 0).then(name).alias(name)
        for name in names
        if name in _NEVER_ZERO and name not in zero_columns
    ]
    text = [pl.col(name).replace("", None) for name in (*DEFAULTS, "origin") if name in source.implicit]
    return frame.with_columns(*empty, *zero, *text)


def _gives_distance(frame: pl.DataFrame, zero_columns: Sequence[str]) -> bool:
    """Whether the odometer gives a distance, apart from the `zero_columns`."""
    return "distance_m" in set(frame.columns) - set(zero_columns) and frame["distance_m"].null_count() < frame.height


def _without_zero_stamps(frame: pl.DataFrame, source: Source, remarks: list[str]) -> pl.DataFrame:
    """The messages but for those whose stamp is 0, as of a driver that did not know the time yet."""
    if source.recipe.own:
        return frame
    t_ns = frame["t"].to_physical()
    if (t_ns.min() or 0) > 0:  # type: ignore[operator]
        return frame
    unset = t_ns == 0
    count = int(unset.sum())
    if count <= 1:  # a single 0 may be the start of a clock
        return frame
    if count == frame.height:
        raise InputError(
            "has no time of validity",
            place=source.channel.place,
            found="time stamp 0 in all messages",
            expected="the time at which the position was valid",
            remedy='If the time of recording is accurate enough, map the topic with time = "log".',
        )
    remarks.append(f"{source.channel.topic}: {count} messages with a stamp of 0")
    return frame.filter(~unset.fill_null(False))


def _with_solution(frame: pl.DataFrame, part: DecodedRows) -> pl.DataFrame:
    """The rows with the name of their solution: what the messages say, else the source's."""
    if part.solution is None:
        return frame
    name = pl.lit(part.solution, dtype=pl.String)
    if "solution" in part.source.columns:
        name = pl.coalesce(pl.col("solution"), name)
    return frame.with_columns(name.alias("solution"))
