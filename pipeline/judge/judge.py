"""The judge: one solution of a run against the evidence, in the order in which an assessor asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import failure_log
from pipeline.evidence import true_places
from pipeline.evidence.evidence import KINDS, NOTHING, within_spans
from pipeline.judge.alarms import alarms_table
from pipeline.judge.bench import Bench
from pipeline.judge.episodes import find_episodes
from pipeline.judge.hazards import drafts_of, failures_table, hazards_table
from pipeline.judge.judgement import evidence_words, judgement_words
from pipeline.judge.passages import passages_table
from pipeline.judge.passings import Passing, train_passings
from pipeline.judge.states import lds_states
from pipeline.track.geodesy import points_of
from pipeline.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.enums import Evidence


@dataclass(frozen=True)
class Judged:
    """Tables of one solution by the contract; `epochs_columns`: those of the judge, row for row with the epochs.

    `used_s`: for how long each epoch stands for a position in use; `failures`: as in `schemas.stages`;
    `distance_m`: way driven; `evidence`: what most epochs rest on.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    failures: pl.DataFrame
    epochs_columns: pl.DataFrame
    used_s: Floats
    distance_m: float | None
    evidence: Evidence | None


def judge(bench: Bench, reference: pl.DataFrame | None, faults: pl.DataFrame | None) -> Judged:
    """Judge one solution; `reference`: as recorded, for errors across the track; `faults`: what was injected."""
    log = failure_log(bench.epochs, bench.config.lds.recovery_s)
    episodes = find_episodes(bench, log, faults)
    drafts = drafts_of(episodes, bench)
    heading_deg, hazards = floats(bench.epochs, "heading_deg"), bench.config.hazards
    limits = hazards.reference_gap_s, hazards.failure_limit_m
    across = errors_across(bench.solution.fixes, heading_deg, bench.at_ns, reference, *limits)
    spans = [one.undetected_ns(bench.series) for one in episodes]
    return Judged(
        hazards=hazards_table(drafts, bench),
        alarms=alarms_table(bench, log, healthy_across(bench, across), drafts),
        passages=passages_table(bench, drafts, *_train_passings(bench), spans),
        failures=failures_table(episodes, drafts, bench),
        epochs_columns=_epochs(bench, spans, across),
        used_s=bench.used_s,
        distance_m=_distance_m(bench),
        evidence=_evidence(bench),
    )


def _train_passings(bench: Bench) -> tuple[dict[str, list[Passing]], dict[str, int]]:
    """When the train passed each balise of the path, in a direction in which it is valid; how the path runs there."""
    index, balises = bench.evidence.network.track.index, bench.solution.balises.unique("balise_id", keep="first")
    rows = balises.select("balise_id", "netelement_id", "measure_m", "sense", "valid_direction").rows()
    places = {name: Place(index[element], measure) for name, element, measure, _, _ in rows}
    forward = {name: sense for name, _, _, sense, _ in rows}
    # Along the measure, as the passings are.
    valid = {name: direction * sense for name, _, _, sense, direction in rows}
    at_ns = _look_at(bench)
    evidence = bench.evidence.at(at_ns, bench.stood)
    hazards = bench.config.hazards
    passed = train_passings(at_ns, evidence, places, hazards.known_error_m, bench.config.lds.rearm_m)
    return {name: [one for one in found if valid[name] in (0, one.sense)] for name, found in passed.items()}, forward


def _look_at(bench: Bench) -> Ints:
    """The instants of the positions, and others between those that are far apart."""
    at_ns, step_ns = bench.at_ns, round(bench.config.align.speed_window_s * NS_PER_S)
    long = np.flatnonzero(np.diff(at_ns) > 1.5 * step_ns)
    between = [
        np.arange(begin, end, step_ns, dtype=np.int64)[1:]
        for begin, end in zip(at_ns[long].tolist(), at_ns[long + 1].tolist(), strict=True)
    ]
    return np.unique(np.concatenate([at_ns, *between]))


def _epochs(bench: Bench, spans: Sequence[tuple[int, int]], across: tuple[Floats, Floats]) -> pl.DataFrame:
    config, judged, (moving, sure) = bench.config, bench.judged, bench.moving
    suspect = within_spans(bench.t_ns, spans) & bench.epochs["tvb"].fill_null(value=False).to_numpy()
    known = np.isfinite(bench.path_m)
    errors = {
        "error_along_m": judged.known_m(config.hazards.known_error_m),
        "error_low_m": np.where(known, judged.low_m, np.nan),
        "error_high_m": np.where(known, judged.high_m, np.nan),
        "error_cross_m": across[0],
        "error_up_m": across[1],
    }
    return (
        pl.DataFrame(errors)
        .fill_nan(None)
        .with_columns(
            judgement_words(judged.code),
            evidence_words(judged.kind),
            *true_places(bench.evidence.at(bench.at_ns, bench.stood), bench.evidence.network.track),
            pl.Series("in_use", bench.used_s > 0.0),
            pl.Series("direction", bench.positions.direction, dtype=pl.Int8),
            lds_states(bench.epochs, judged, bench.odometer_wrong),
            pl.Series("suspect_after_the_fact", suspect),
            moving=pl.when(pl.Series(sure)).then(pl.Series(moving)),
        )
    )


def _distance_m(bench: Bench) -> float | None:
    """Way driven: by the odometer, else by the reference, else by the positions; None where none of them tells."""
    if bench.odometry is not None:
        begin_m, end_m = bench.odometry.travelled_at(bench.at_ns[[0, -1]]).tolist()
        return float(end_m - begin_m) * (bench.odometry.scale or 1.0)
    train = bench.train_m[np.isfinite(bench.train_m)]
    place = train if train.size > 1 else bench.path_m[np.isfinite(bench.path_m)]
    return float(np.abs(np.diff(place)).sum()) if place.size > 1 else None


def _evidence(bench: Bench) -> Evidence | None:
    """What most epochs rest on."""
    kinds = bench.judged.kind[bench.judged.kind != NOTHING]
    return KINDS[int(np.bincount(kinds).argmax())] if kinds.size else None


def errors_across(
    fixes: pl.DataFrame,
    heading_deg: Floats,
    at_ns: Ints,
    reference: pl.DataFrame | None,
    gap_s: float,
    along_limit_m: float,
) -> tuple[Floats, Floats]:
    """Position minus reference, left of growing path and upwards [m]; NaN where the reference is silent.

    `fixes`: those of the solution; `at_ns`: the instants that they are judged at. NaN too where the position is more
    than `along_limit_m` ahead or behind: a curve goes aside by metres over such a way, and a slope up.
    """
    nothing = np.full(at_ns.size, np.nan)
    if reference is None or reference.height < 2:
        return nothing, nothing
    stamps = times_ns(reference)
    x, at = (stamps - stamps[0]) / NS_PER_S, (at_ns - stamps[0]) / NS_PER_S
    after = np.searchsorted(x, at).clip(1, x.size - 1)
    silent = (at < x[0]) | (at > x[-1]) | (x[after] - x[after - 1] > gap_s)
    latitude, longitude, height = (
        np.where(silent, np.nan, np.interp(at, x, floats(reference, name)))
        for name in ("latitude_deg", "longitude_deg", "height_m")
    )
    known = np.flatnonzero(~silent & np.isfinite(floats(fixes, "latitude_deg")))
    own = points_of(floats(fixes, "latitude_deg")[known], floats(fixes, "longitude_deg")[known])
    there = points_of(latitude[known], longitude[known])
    away = own.surface - there.surface
    east, north = np.einsum("ij,ij->i", away, own.east), np.einsum("ij,ij->i", away, own.north)
    heading = np.radians(heading_deg[known])
    comparable = np.abs(east * np.sin(heading) + north * np.cos(heading)) <= along_limit_m
    across, up = nothing.copy(), nothing.copy()
    across[known] = np.where(comparable, north * np.sin(heading) - east * np.cos(heading), np.nan)
    up[known] = np.where(comparable, (floats(fixes, "height_m") - height)[known], np.nan)
    return across, up


def healthy_across(bench: Bench, errors_m: tuple[Floats, Floats]) -> dict[str, Bools]:
    """Per axis of the monitors, epochs whose error by the reference is within the noise of both."""
    factor, healthy = bench.config.hazards.evidence_factor, {}
    reference_m = np.nan_to_num(bench.judged.half_m / factor)
    for axis, error_m in zip(("cross", "up"), errors_m, strict=True):
        noise_m = np.hypot(np.nan_to_num(floats(bench.epochs, f"sigma_{axis}_m")), reference_m)
        with np.errstate(invalid="ignore"):
            healthy[f"{axis}_"] = np.abs(error_m) <= factor * noise_m
    return healthy
