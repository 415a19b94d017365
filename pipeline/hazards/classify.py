"""From monitored epochs and truth to hazards, alarms and judged passages (DOMAIN section 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.columns import Bools, Floats, flags, times_ns
from pipeline.hazards.alarms import alarms_table
from pipeline.hazards.crossings import beacons_by_leg
from pipeline.hazards.episodes import Draft, find_episodes
from pipeline.hazards.excursions import faulty_spans
from pipeline.hazards.fails import Fails, fails_of
from pipeline.hazards.passages import (
    Links,
    beyond_window,
    judge_passages,
    link_passages,
    link_unoffered,
    location_errors,
    positions_at,
    speeds_at,
    suspicious_passages,
    within_spans,
    wrongly_offered,
)
from pipeline.hazards.passing import TruePassings, true_passings
from pipeline.hazards.rows import Judged, Locate, hazards_table
from pipeline.hazards.series import Series, series_of
from pipeline.hazards.states import contradicted, errors_of, lds_states
from pipeline.hazards.suspect import Witnesses, suspect_of_error, witnesses_of
from pipeline.hazards.timing import Timing, time_hazard
from pipeline.timeline import linking_gap_s
from schemas.config import Configuration
from schemas.enums import PassageStatus, Suspect

__all__ = ["HazardResult", "Locate", "classify"]


@dataclass(frozen=True)
class HazardResult:
    """`hazards`, `alarms` and `passages` by the contract; `epochs_columns`: `error_along_m,
    error_cross_m, error_up_m, lds_state, suspect_after_the_fact`, one row per epoch.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    epochs_columns: pl.DataFrame


def classify(
    solution: str,
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    passages: pl.DataFrame,
    balises: pl.DataFrame,
    faults: pl.DataFrame | None,
    locate: Locate,
    config: Configuration,
    between: pl.DataFrame | None = None,
) -> HazardResult:
    """Judge one solution after the fact.

    `epochs`: matched, aligned and monitored, with the LDS columns; `truth`: from `establish_truth`, row by
    row; `passages`: of the LDS; `balises`: `leg, balise_id, kind, path_m` on the path; `faults`: what was
    injected, where known; `locate(leg, path_m)`: net element and measure; `between`: from `places_between`.
    """
    errors = errors_of(epochs, truth)
    series = series_of(epochs, truth, config.lds)
    fails = fails_of(epochs, config.lds.recovery_s)
    witnesses = witnesses_of(epochs, truth, errors, config)
    drafts, jumps = find_episodes(series, beacons_by_leg(balises), config.hazards)
    judged = []
    for draft in drafts:
        timing = time_hazard(draft, series, jumps, fails, faults, config.hazards)
        judged += _judge(draft, timing, series, fails, witnesses, truth, passages)
    hazards = hazards_table(judged, solution, epochs, series, locate, config.budget_s)
    alarms = alarms_table(fails, judged, solution, witnesses, epochs, config.hazards)
    spans = faulty_spans(series, judged, jumps, fails, faults, config.hazards)
    passings = true_passings(epochs, truth, balises, between)
    seen = _passages(series, judged, spans, epochs, truth, passages, passings, config)
    return HazardResult(hazards, alarms, seen, _epochs(epochs, truth, passages, errors, spans, config))


def _judge(
    draft: Draft,
    timing: Timing,
    series: Series,
    fails: Fails,
    witnesses: Witnesses,
    truth: pl.DataFrame,
    passages: pl.DataFrame,
) -> list[Judged]:
    """The hazard with its suspect; none where the odometer that carries the truth is held to be at fault."""
    first, last = int(series.row[timing.onset_epoch]), int(series.row[min(draft.end, series.size - 1)])
    first, last = min(first, last), max(first, last)
    suspect = suspect_of_error(witnesses, first, last, fails.failed_in(first, last))
    if suspect is Suspect.ODOMETER:
        return []
    evidence = str(truth["evidence"][int(series.row[draft.first_epoch])])
    return [_with_passages(draft, timing, evidence, suspect, passages, series)]


def _with_passages(
    draft: Draft, timing: Timing, evidence: str, suspect: Suspect, passages: pl.DataFrame, series: Series
) -> Judged:
    alone = Judged(draft, timing, evidence, suspect, False, ())
    own = link_passages(passages, [alone], series).hazard == 0
    accepted = passages.filter(own & (passages["status"] == PassageStatus.ACCEPTED.value).to_numpy())
    late = bool((beyond_window(passages) & own).any())
    return Judged(draft, timing, evidence, suspect, late, tuple(accepted["balise_id"].to_list()))


def _passages(
    series: Series,
    judged: list[Judged],
    spans: list[tuple[int, int]],
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    passages: pl.DataFrame,
    passings: TruePassings,
    config: Configuration,
) -> pl.DataFrame:
    t_true = passings.assign(passages)
    links: Links = link_unoffered(passages, t_true, judged, link_passages(passages, judged, series))
    suspicious: Bools = suspicious_passages(passages, spans)
    gap_s = linking_gap_s(series.period_s, config.lds.crossing_gap_s)
    positioned = positions_at(epochs, t_true, gap_s)
    error = location_errors(passages, epochs, truth, gap_s, config.hazards.failure_limit_m)
    wrong = wrongly_offered(passages, error, epochs, truth, config.hazards)
    speed = speeds_at(passages, t_true, epochs, gap_s)
    return judge_passages(passages, error, wrong, t_true, links, suspicious, positioned, speed)


def _epochs(
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    passages: pl.DataFrame,
    errors: dict[str, Floats],
    spans: list[tuple[int, int]],
    config: Configuration,
) -> pl.DataFrame:
    hidden = contradicted(errors["along"], truth, config.hazards.failure_limit_m)
    told = errors | {"along": np.where(hidden, np.nan, errors["along"])}
    columns = [pl.Series(f"error_{axis}_m", values, nan_to_null=True) for axis, values in told.items()]
    state = lds_states(epochs, truth, passages, errors["along"], config.hazards, config.lds)
    suspicious = pl.Series("suspect_after_the_fact", flags(epochs, "tvb") & within_spans(times_ns(epochs), spans))
    return pl.DataFrame([*columns, state, suspicious])
