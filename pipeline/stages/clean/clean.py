"""Streams in order of time, each stamp once, without strays and placeholders; refused where they are of no one journey.

Behind it no array that follows a stream's span is larger than the gate allows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import field, replace

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.track.geodesy import points_of
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, median, times_ns
from schemas.config import Configuration, IngestConfig
from schemas.enums import Fix
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import STREAMS, IngestNotes, RunLog, Stream

DAY_NS = 86_400 * NS_PER_S
_NS_PER_H = 3_600 * NS_PER_S


def require_two_times(stream: pl.DataFrame, place: str, of: str = "") -> None:
    """Refuse a stream (unique times) of fewer than two rows; `of`: words that say whose it is, for the message."""
    if stream.height < 2:
        raise InputError(
            f"all rows have the same time{of}" if stream.height else f"no row has a time after 1970{of}",
            place=f"{place}, column t",
            found=f"{stream.height} distinct time{'' if stream.height == 1 else 's'}",
            expected="at least two epochs at different times",
            remedy="Check the recorder's time stamps, or `time` in the [ingest] mapping.",
        )


def require_one_journey(fixes: pl.DataFrame, place: str, config: IngestConfig) -> None:
    """Refuse a solution with a gap of more than a day, or one that lasts longer than a journey."""
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
    """Refuse streams, other than the positions, that last longer than a journey; each solution is asked for itself."""
    odometers = [("odometer", odometer) for odometer in (run.odometer, *run.other_odometers)]
    satellites = [] if run.satellites is None else run.satellites.partition_by("solution", maintain_order=True)
    others = [(name, run.stream(name)) for name in _OF_POSITIONS if name != "satellites"]
    for name, frame in [*odometers, *(("satellites", part) for part in satellites), *others]:
        if frame is not None:
            require_span(frame["t"], f"{run.run_id}: {name}", config)


def require_span(t: pl.Series, place: str, config: IngestConfig) -> None:
    """Refuse times in order that last longer than a journey (`ingest.longest_journey_h`)."""
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


_KEYS: dict[Stream, list[str]] = {
    "gnss": ["solution", "t"],
    "odometer": ["sensor", "t"],
    "satellites": ["solution", "t", "sv"],
    "balise_reads": ["t", "balise_id"],
}
_SOURCES = ("solution", "sensor")
"""Columns that part a stream into sources, each with its own order of time."""
_PLACE = ("latitude_deg", "longitude_deg")
# Streams that say something only of positions: without them a run is replayed all the same.
_OF_POSITIONS = tuple(name for name in STREAMS if name not in ("gnss", "odometer", "faults"))
ClockAdvice = Callable[[RunLog], str]
"""What moves recorders of different times to one journey, in a sentence; empty where nothing does."""


def without_advice(run: RunLog) -> str:
    """No sentence of help, for recorders without a time in common."""
    return ""


@frozen
class StreamCounts:
    """Rows dropped because their key stands twice, and rows that came before an earlier one.

    `far_off`: dropped for a time of another day. Of GNSS also `contradicting`: doubles at another place than the one
    that stays; `placeholders`; and `held`: rows that repeat a position at a higher rate than the receiver's.
    """

    duplicates: int = 0
    out_of_order: int = 0
    contradicting: int = 0
    far_off: int = 0
    placeholders: int = 0
    held: int = 0


@frozen
class CleanCounts:
    """Per GNSS solution and per stream."""

    solutions: dict[str, StreamCounts] = field(default_factory=dict)
    streams: dict[str, StreamCounts] = field(default_factory=dict)


def clean(
    run: RunLog,
    config: Configuration = Configuration(),  # noqa: B008 - frozen
    clock_advice: ClockAdvice = without_advice,
) -> tuple[RunLog, CleanCounts]:
    """The run with every stream in order and each stamp once (the first recorded one stays).

    Left out are a few rows more than a day from the others (a receiver that did not know the date yet), all before
    1970, and reads, reference and satellites of another day than the positions; placeholders stay as epochs without a
    fix.

    Args:
        run: the run as recorded.
        config: the configuration; used are `ingest`, `lds.odometer_sensor` and `align.fastest_mps`.
        clock_advice: what would move recorders of different times to one journey, for the error's remedy.

    Returns:
        The run in order, and how many rows were left out and why.

    Raises:
        InputError: nothing can be replayed: no two times, none in common, longer than a journey.
    """
    dated = _part_strays(run, config.ingest.wrong_dates_share)
    streams: dict[str, pl.DataFrame] = {}
    counts: dict[str, StreamCounts] = {}
    for name, (kept, strays) in dated.items():
        streams[name], ordering = _sort_rows(kept, _KEYS.get(name, ["t"]))
        counts[name] = replace(ordering, far_off=strays.height)
    others: tuple[pl.DataFrame, ...] = ()
    if "odometer" in streams:
        streams["odometer"], others = _part_sensors(streams["odometer"], config.lds.odometer_sensor, run.run_id)
    streams["gnss"], placeholders = _without_placeholders(streams["gnss"], config)
    streams["gnss"], held = _without_held_positions(streams["gnss"])
    cleaned = replace(run, notes=_note_left_out(run.notes, counts), other_odometers=others or run.other_odometers)
    cleaned = cleaned.with_streams(**streams)
    require_spans(cleaned, config.ingest)
    _require_times(cleaned, clock_advice)
    return cleaned, CleanCounts(_solution_counts(*dated["gnss"], placeholders, held), counts)


def _part_strays(run: RunLog, few: float) -> dict[Stream, tuple[pl.DataFrame, pl.DataFrame]]:
    """Each stream without its strays, and the strays; positions decide for the others, so GNSS comes first.

    `few`: the largest share of rows that may be strays.
    """
    dated: dict[Stream, tuple[pl.DataFrame, pl.DataFrame]] = {}
    for name in STREAMS:
        frame = run.stream(name)
        if frame is None or name == "faults":
            continue
        stray = _are_strays(frame, few)
        if name in _OF_POSITIONS:
            elsewhere = _are_far_from_all(frame["t"], dated["gnss"][0]["t"])
            # Where no row is near, the clock of the whole recorder is wrong: the fit of the run names it.
            stray |= elsewhere & (not elsewhere.all())
        dated[name] = (frame.filter(~stray), frame.filter(stray)) if stray.any() else (frame, frame.clear())
    return dated


def _solution_counts(
    recorded: pl.DataFrame, far: pl.DataFrame, placeholders: Mapping[str, int], held: Mapping[str, int]
) -> dict[str, StreamCounts]:
    """Counts by solution; `placeholders` and `held` as they were found already."""
    counts: dict[str, StreamCounts] = {}
    for part in recorded.select("solution", "t", *_PLACE).partition_by("solution", maintain_order=True):
        name = part["solution"][0]
        marked = {"placeholders": placeholders.get(name, 0), "held": held.get(name, 0)}
        counts[name] = replace(_count_solution(part, far), **marked)
    return counts


def _require_times(run: RunLog, clock_advice: ClockAdvice) -> None:
    """Refuse a run without two times of a solution or of the odometer, or none in common."""
    if run.gnss["solution"].n_unique() == run.gnss.height:
        of = f" of solution {run.gnss['solution'][0]!r}" if run.gnss.height else ""
        require_two_times(run.gnss.head(1), f"{run.run_id}: gnss", of)
    if run.odometer is not None:
        require_two_times(run.odometer, f"{run.run_id}: odometer")
        _require_common_time(run, clock_advice)


def without_undated_streams(run: RunLog) -> RunLog:
    """The run without streams whose clock is wrong: no row lies within a day of a position; `notes` say so."""
    away = [
        name
        for name in _OF_POSITIONS
        if (frame := run.stream(name)) is not None
        and frame.height
        and _are_far_from_all(frame["t"], run.gnss["t"]).all()
    ]
    if not away:
        return run
    left_out = [f"{name}: left out, its times are all more than a day from the positions" for name in away]
    notes = replace(run.notes, skipped_topics=(*run.notes.skipped_topics, *left_out))
    return replace(run, notes=notes).with_streams(**dict.fromkeys(away))


def _part_sensors(odometer: pl.DataFrame, used: str, run_id: str) -> tuple[pl.DataFrame, tuple[pl.DataFrame, ...]]:
    """The odometer that the LDS uses, and the others in the order of their names."""
    if "sensor" not in odometer.columns:
        return odometer, ()
    if odometer.height and (odometer["sensor"] == used).all():
        return odometer, ()
    sensors = {str(key[0]): part for key, part in odometer.partition_by("sensor", as_dict=True).items()}
    if odometer.height and used not in sensors:
        raise InputError(
            "has no such sensor",
            place=f"{run_id}: odometer, column sensor",
            found=", ".join(sorted(sensors)),
            expected=used,
            remedy=f"Name the odometer that the LDS uses: [lds] odometer_sensor = {json.dumps(min(sensors))}",
        )
    return sensors.pop(used, odometer), tuple(sensors[name] for name in sorted(sensors))


def _without_placeholders(gnss: pl.DataFrame, config: Configuration) -> tuple[pl.DataFrame, dict[str, int]]:
    """Positions with placeholders marked as epochs without a fix, and how many these are, by solution."""
    if not {"fix", *_PLACE} <= set(gnss.columns):
        return gnss, {}
    counts: dict[str, int] = {}
    marked: list[pl.DataFrame] = []
    narrow = gnss.select("solution", "t", "fix", *_PLACE).with_row_index("_row")
    for part in narrow.partition_by("solution", maintain_order=True):
        part, count = mark_placeholders(part, config.ingest, config.align.fastest_mps)
        marked.append(part.select("_row", "fix"))
        counts[part["solution"][0]] = count
    return (gnss.with_columns(pl.concat(marked).sort("_row")["fix"]) if any(counts.values()) else gnss), counts


def _without_held_positions(gnss: pl.DataFrame) -> tuple[pl.DataFrame, dict[str, int]]:
    """Positions without rows that repeat them at a higher rate than the receiver's, and how many, by solution."""
    if not {"solution", *_PLACE} <= set(gnss.columns):
        return gnss, {}
    counts: dict[str, int] = {}
    left_out = np.zeros(gnss.height, dtype=np.bool_)
    narrow = gnss.select("solution", "t", *_PLACE).with_row_index("_row")
    for part in narrow.partition_by("solution", maintain_order=True):
        t_ns = times_ns(part)
        held = held_positions((t_ns - t_ns[:1]) / 1e9, *(floats(part, name) for name in _PLACE))
        left_out[part["_row"].to_numpy()] = held
        counts[part["solution"][0]] = int(held.sum())
    return (gnss.filter(~left_out) if left_out.any() else gnss), counts


def _note_left_out(notes: IngestNotes, counts: Mapping[str, StreamCounts]) -> IngestNotes:
    """The notes with how many rows each stream lost; for GNSS the `runs` row has that count."""
    left_out = [
        f"{name}: {count.far_off} rows left out: their time is more than a day from the others or the positions"
        for name, count in counts.items()
        if count.far_off and name != "gnss"
    ]
    return replace(notes, skipped_topics=(*notes.skipped_topics, *left_out))


def _are_strays(frame: pl.DataFrame, few: float) -> Bools:
    """Rows before 1970, and rows more than a day away from most of their solution, if at most the share `few`."""
    t_ns = times_ns(frame)
    stray: Bools = t_ns < 0
    if not t_ns.size or int(t_ns.max()) - int(t_ns.min()) <= DAY_NS:
        return stray
    solutions = frame["solution"].to_numpy() if "solution" in frame.columns else np.zeros(t_ns.size)
    for name in np.unique(solutions[~stray]):
        rows = np.flatnonzero((solutions == name) & ~stray)
        far = _are_far_from_most(t_ns[rows])
        stray[rows] = far & (far.sum() <= few * rows.size)
    return stray


def _are_far_from_most(t_ns: npt.NDArray[np.int64]) -> Bools:
    """Times outside the largest group without a gap of more than a day."""
    order = np.argsort(t_ns, kind="stable")
    group = np.concatenate(([0], np.cumsum(np.diff(t_ns[order]) > DAY_NS)))
    far = np.zeros(t_ns.size, dtype=np.bool_)
    far[order] = group != np.bincount(group).argmax()
    return far


def _are_far_from_all(t: pl.Series, positions: pl.Series) -> Bools:
    """Times more than a day from every position, in 64 bits without overflow."""
    t_ns, known = (series.cast(pl.Datetime("ns")).cast(pl.Int64).to_numpy() for series in (t, positions))
    if not known.size:
        return np.zeros(t.len(), dtype=np.bool_)
    known = np.sort(known)
    at = np.searchsorted(np.minimum(known, np.iinfo(np.int64).max - DAY_NS) + DAY_NS, t_ns)
    far: Bools = (at == known.size) | (t_ns < known[np.minimum(at, known.size - 1)] - DAY_NS)
    return far


def _count_solution(part: pl.DataFrame, far: pl.DataFrame) -> StreamCounts:
    """Counts of one solution; `far`: rows of all solutions that were left out for a time of another day."""
    counts = _sort_rows(part, ["t"])[1]
    contradicting = 0
    if counts.duplicates:
        elsewhere = [(pl.col(name) != pl.col(name).first().over("t")).fill_null(False) for name in _PLACE]
        contradicting = int(part.select(pl.any_horizontal(elsewhere).sum()).item())
    far_off = far.filter(pl.col("solution") == part["solution"][0]).height if far.height else 0
    return replace(counts, contradicting=contradicting, far_off=far_off)


def count_stamps(stream: Stream, frame: pl.DataFrame) -> StreamCounts:
    """What `clean` would count in one stream, of GNSS in one solution."""
    return _sort_rows(frame.drop_nulls("t"), _KEYS.get(stream, ["t"]))[1]


def _sort_rows(frame: pl.DataFrame, keys: list[str]) -> tuple[pl.DataFrame, StreamCounts]:
    """Rows in order of time, the first of each `keys`; counts of the duplicates and of those recorded too late."""
    if frame["t"].dtype != pl.Datetime("ns", "UTC"):
        frame = frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    if (np.diff(times_ns(frame)) > 0).all():
        return frame, StreamCounts()
    latest = pl.col("t").cum_max()  # of the rows recorded so far
    keys = [key for key in keys if key in frame.columns]
    sources = [key for key in keys if key in _SOURCES]
    late = frame.select((pl.col("t") < (latest.over(sources) if sources else latest)).sum()).item()
    ordered = frame if late == 0 and frame["t"].is_sorted() else frame.sort("t", maintain_order=True)
    first = ordered.select(pl.struct(keys).is_first_distinct()).to_series()
    # Where each key stands once the rows are not copied: of a day of several solutions they are most of the log.
    unique = ordered if first.all() else ordered.filter(first)
    return unique, StreamCounts(frame.height - unique.height, late)


def _require_common_time(run: RunLog, clock_advice: ClockAdvice) -> None:
    """Refuse a run whose odometer overlaps the GNSS at no time: not one position could be held against it."""
    gnss = run.gnss
    odometer = run.odometer
    if gnss.is_empty() or odometer is None:
        return
    begin, end = times_ns(gnss)[[0, -1]]
    odometer_begin, odometer_end = times_ns(odometer)[[0, -1]]
    if odometer_begin > end or odometer_end < begin:
        remedy = "Check date and time scale (UTC or GPS) of both recorders, or leave the odometer out."
        advice = clock_advice(run) if {"fix", *_PLACE} <= set(gnss.columns) else ""
        raise InputError(
            "does not overlap the GNSS in time",
            place=f"{run.run_id}: odometer, column t",
            found=f"{odometer['t'][0]} to {odometer['t'][-1]}",
            expected=f"times within {gnss['t'][0]} to {gnss['t'][-1]}",
            remedy=f"{remedy} {advice}".rstrip(),
        )


# Numerics of the reading: with fewer updates no period is known; a regular one is kept, to a logged step, by so many of
# the updates. Digits that repeat at low speed are not: their time changes with the speed.
_FEWEST = 20
_REGULAR_SHARE = 0.8
_LEAST_RATIO = 1.5
_STEP_NOISE = 1.2


def held_positions(t_s: Floats, latitude_deg: Floats, longitude_deg: Floats) -> Bools:
    """Rows (times [s], places [deg]) that repeat the place of the row before within one period of the receiver."""
    none: Bools = np.zeros(t_s.size, dtype=np.bool_)
    same = np.append(False, (np.diff(latitude_deg) == 0.0) & (np.diff(longitude_deg) == 0.0))
    updates = t_s[~same & np.isfinite(latitude_deg)]
    if not same.any() or updates.size < _FEWEST:
        return none
    step_s = median(np.diff(t_s))
    apart_s = np.diff(updates)
    period_s = median(apart_s)
    regular = np.mean(np.abs(apart_s - period_s) <= _STEP_NOISE * step_s)
    if period_s < _LEAST_RATIO * step_s or regular < _REGULAR_SHARE:
        return none
    kept_s = -np.inf
    for row in range(t_s.size):
        none[row] = same[row] and t_s[row] - kept_s < period_s - step_s / 2.0
        kept_s = kept_s if none[row] else t_s[row]
    return none


def mark_placeholders(fixes: pl.DataFrame, config: IngestConfig, fastest_mps: float) -> tuple[pl.DataFrame, int]:
    """One solution in order of time, its placeholders marked as without a fix, and how many they are.

    Placeholders are: 0/0; places repeated to the last digit and farther than `placeholder_far_m` from the rest; and
    what comes before the first fix, where the run goes on so far away that no train can have gone there.
    """
    latitude = floats(fixes, "latitude_deg")
    longitude = floats(fixes, "longitude_deg")
    valid = np.isfinite(latitude) & np.isfinite(longitude)
    valid &= (fixes["fix"].cast(pl.String) != Fix.NONE.value).fill_null(False).to_numpy()
    origin = valid & (np.maximum(np.abs(latitude), np.abs(longitude)) < config.placeholder_origin_deg)
    rows = np.flatnonzero(valid & ~origin)
    placeholder = origin
    if rows.size > 2:
        places = points_of(latitude[rows], longitude[rows]).surface
        placeholder = origin.copy()
        placeholder[rows] = _are_far_placeholders(times_ns(fixes)[rows], places, config, fastest_mps)
    count = int(placeholder.sum())
    if not count:
        return fixes, 0
    none = pl.lit(Fix.NONE.value).cast(fixes["fix"].dtype)
    marked = pl.when(pl.Series(placeholder)).then(none).otherwise(pl.col("fix")).alias("fix")
    return fixes.with_columns(marked), count


def _are_far_placeholders(t_ns: Ints, places: Floats, config: IngestConfig, fastest_mps: float) -> Bools:
    """Placeholders among valid positions: far pieces of the run, between leaps that no train can make.

    A far piece counts if it is one place repeated exactly, or the brief begin of the run (search for a first fix).
    """
    step_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    step_s = np.diff(t_ns) / NS_PER_S
    leap = step_m > config.placeholder_far_m + fastest_mps * step_s
    piece = np.concatenate([[0], np.cumsum(leap)])
    placeholder = np.zeros(t_ns.size, dtype=np.bool_)
    if not leap.any():
        return placeholder
    sizes = np.bincount(piece)
    main = int(np.argmax(sizes))
    home = np.median(places[piece == main], axis=0)
    for number in range(sizes.size):
        if number == main:
            continue
        rows = np.flatnonzero(piece == number)
        # Several epochs of exactly one place are a default: a fix never repeats to the last digit far away.
        same = rows.size > 1 and np.ptp(places[rows], axis=0).max() == 0.0
        first = rows[0] == 0 and number < main and _is_brief(t_ns, rows[-1] + 1, config)
        far = np.linalg.norm(np.median(places[rows], axis=0) - home) > config.placeholder_far_m
        placeholder[rows] = far and (same or first)
    return placeholder


def _is_brief(t_ns: Ints, until: int, config: IngestConfig) -> bool:
    """Whether the rows before `until` take no longer than the search for a first fix."""
    spent_s = (t_ns[until - 1] - t_ns[0]) / NS_PER_S
    whole_s = (t_ns[-1] - t_ns[0]) / NS_PER_S
    return bool(
        spent_s <= config.first_fix_share * whole_s or (spent_s <= config.first_fix_s and spent_s < 0.5 * whole_s)
    )
