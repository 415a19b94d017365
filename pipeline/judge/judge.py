"""The judge: one solution of a run against the evidence, in the order in which an assessor asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import failure_log
from pipeline.evidence.evidence import KINDS, NOTHING, within_spans
from pipeline.evidence.routes import Place
from pipeline.judge.across import errors_across, healthy_across
from pipeline.judge.alarms import alarms_table
from pipeline.judge.bench import Bench
from pipeline.judge.episodes import Episode, Series, find_episodes
from pipeline.judge.hazards import Draft, drafts_of
from pipeline.judge.judgement import WRONG, judgement_words
from pipeline.judge.jumps import find_jumps, steps_of
from pipeline.judge.offers import Offers
from pipeline.judge.passages import Found, passages_table
from pipeline.judge.passings import Passing, train_passings
from pipeline.judge.rows import failures_table, hazards_table
from pipeline.judge.states import in_use_s, lds_states, moving_by_evidence
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats
from schemas.enums import Evidence


@dataclass(frozen=True)
class Judged:
    """Tables of one solution by the contract; `epochs_columns`: those of the judge, row for row with the epochs.

    `failures`: as in `schemas.stages`; `distance_m`: way driven; `evidence`: what most epochs rest on.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    failures: pl.DataFrame
    epochs_columns: pl.DataFrame
    distance_m: float | None
    evidence: Evidence | None


def judge(bench: Bench, reference: pl.DataFrame | None, faults: pl.DataFrame | None) -> Judged:
    """Judge one solution; `reference`: as recorded, for errors across the track; `faults`: what was injected."""
    used_s = in_use_s(bench.epochs, bench.config)
    log = failure_log(bench.epochs, bench.config.lds.recovery_s)
    series = _series(bench, used_s)
    offers = Offers.of(bench, series.row)
    episodes = find_episodes(series, _marked(series, offers), log, faults, bench.config.hazards)
    drafts = drafts_of(episodes, series, offers, bench.config.hazards)
    across = _across(bench, reference)
    spans = [undetected_ns(one, series) for one in episodes]
    return Judged(
        hazards=hazards_table(drafts, series, offers, bench),
        alarms=alarms_table(bench, log, _healthy(bench, across), drafts),
        passages=passages_table(bench, offers, _found(bench, drafts, offers), *_train_passings(bench), spans),
        failures=failures_table(episodes, drafts, series, offers, bench),
        epochs_columns=_epochs(bench, used_s, spans, across),
        distance_m=_distance_m(bench),
        evidence=_evidence(bench),
    )


def undetected_ns(episode: Episode, series: Series) -> tuple[int, int]:
    """From onset to detection, or to the end; what a step offers on its way lies before its first position."""
    begin_ns = episode.onset_ns
    if episode.step is not None:
        begin_ns = min(begin_ns, int(series.t_ns[episode.step.first - 1]) + 1)
    return begin_ns, episode.end_ns if episode.detected_ns is None else episode.detected_ns


def _series(bench: Bench, used_s: Floats) -> Series:
    """Valid positions with their jumps."""
    row = np.flatnonzero(bench.positions.known)
    at_ns, odometry = bench.at_ns[row], bench.odometry
    counted_m = np.full(max(row.size - 1, 0), np.nan)
    if odometry is not None:
        counted_m = odometry.between(at_ns[:-1], at_ns[1:]).distance_m
    t_ns, path_m = bench.t_ns[row], bench.path_m[row]
    steps = steps_of(t_ns, path_m, bench.by_reference_m[row], counted_m, bench.gap_ns)
    jumps = find_jumps(steps, bench.positions.direction[row], bench.config.hazards)
    sigma_m = floats(bench.epochs, "sigma_along_m")[row]
    direction = bench.positions.direction[row]
    return Series(row, t_ns, path_m, bench.train_m[row], direction, bench.judged.take(row), used_s[row], sigma_m, jumps)


def _marked(series: Series, offers: Offers) -> Bools:
    """Valid positions that complete an offer judged wrong; what a jump offers on its way is the jump's."""
    marked = np.zeros(series.size, dtype=np.bool_)
    marked[offers.number[offers.offered & (offers.judged.code == WRONG)]] = True
    for jump in series.jumps:
        marked[jump.first : jump.last + 1] = False
    return marked


def _across(bench: Bench, reference: pl.DataFrame | None) -> tuple[Floats, Floats]:
    """Errors across the track and of height [m]."""
    heading, hazards = floats(bench.epochs, "heading_deg"), bench.config.hazards
    limits = hazards.reference_gap_s, hazards.failure_limit_m
    return errors_across(bench.solution.fixes, heading, bench.at_ns, reference, *limits)


def _found(bench: Bench, drafts: Sequence[Draft], offers: Offers) -> Found:
    """What the hazards say of each offer; inserted: by a jump, on another track, or early and wrong."""
    hazard = np.full(offers.t_ns.size, NOTHING)
    jumped = np.zeros(offers.t_ns.size, dtype=np.bool_)
    for number, draft in reversed(list(enumerate(drafts))):
        hazard[draft.hits] = number
        jumped[draft.crossed] = True
    judged = offers.judged
    early = (judged.code == WRONG) & ((judged.low_m > 0.0) | judged.wrong_track)
    return Found(judged.known_m(bench.config.hazards.known_error_m), hazard, jumped | early)


def _train_passings(bench: Bench) -> tuple[dict[str, list[Passing]], dict[str, int]]:
    """When the train passed each balise of the path, and how the path runs over its net element."""
    index, balises = bench.evidence.network.track.index, bench.solution.balises.unique("balise_id", keep="first")
    rows = balises.select("balise_id", "netelement_id", "measure_m", "path_m", "leg").rows()
    places = {name: Place(index[element], measure) for name, element, measure, _, _ in rows}
    forward = {}
    for name, _, measure, path_m, leg in rows:
        place = places[name]
        _, sense = bench.legs[leg].coordinate(np.array([place.element]), np.array([measure]), np.array([path_m]))
        forward[name] = int(sense[0]) or 1
    at_ns = _look_at(bench)
    evidence = bench.evidence.at(at_ns, bench.stood)
    hazards = bench.config.hazards
    return train_passings(at_ns, evidence, places, hazards.known_error_m, bench.config.lds.rearm_m), forward


def _look_at(bench: Bench) -> Ints:
    """The instants of the positions, and others between those that are far apart."""
    at_ns, step_ns = bench.at_ns, round(bench.config.align.speed_window_s * NS_PER_S)
    long = np.flatnonzero(np.diff(at_ns) > 1.5 * step_ns)
    between = [
        np.arange(begin, end, step_ns, dtype=np.int64)[1:]
        for begin, end in zip(at_ns[long].tolist(), at_ns[long + 1].tolist(), strict=True)
    ]
    return np.unique(np.concatenate([at_ns, *between]))


def _healthy(bench: Bench, across: tuple[Floats, Floats]) -> dict[str, Bools]:
    factor = bench.config.hazards.evidence_factor
    sigmas = floats(bench.epochs, "sigma_cross_m"), floats(bench.epochs, "sigma_up_m")
    return healthy_across(across, sigmas, bench.judged.half_m / factor, factor)


def _epochs(
    bench: Bench,
    used_s: Floats,
    spans: Sequence[tuple[int, int]],
    across: tuple[Floats, Floats],
) -> pl.DataFrame:
    config, judged = bench.config, bench.judged
    moving, sure = moving_by_evidence(
        bench.at_ns,
        bench.by_reference_m,
        judged.half_m,
        bench.odometer_moves,
        bench.odometer_told,
        bench.stood,
        config.matching.deadband_mps,
        config.align.speed_window_s,
    )
    suspect = within_spans(bench.t_ns, spans) & bench.epochs["tvb"].fill_null(value=False).to_numpy()
    known = np.isfinite(bench.path_m)
    return pl.DataFrame(
        [
            pl.Series("error_along_m", judged.known_m(config.hazards.known_error_m), nan_to_null=True),
            pl.Series("error_low_m", np.where(known, judged.low_m, np.nan), nan_to_null=True),
            pl.Series("error_high_m", np.where(known, judged.high_m, np.nan), nan_to_null=True),
            pl.Series("error_cross_m", across[0], nan_to_null=True),
            pl.Series("error_up_m", across[1], nan_to_null=True),
            judgement_words(judged.code),
            pl.Series("in_use", used_s > 0.0),
            pl.Series("direction", bench.positions.direction, dtype=pl.Int8),
            lds_states(bench.epochs, judged, bench.odometer_wrong),
            pl.Series("suspect_after_the_fact", suspect),
            pl.select(pl.when(pl.Series(sure)).then(pl.Series(moving)).alias("moving")).to_series(),
        ]
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
