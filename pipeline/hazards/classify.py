"""From monitored epochs and truth to hazards, alarms and judged passages (DOMAIN section 5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.hazards.alarms import alarms_table
from pipeline.hazards.case import Case
from pipeline.hazards.crossings import beacons_by_leg
from pipeline.hazards.episodes import Draft, find_episodes
from pipeline.hazards.excursions import faulty_spans
from pipeline.hazards.passages import beyond_window, judge_passages, link_passages, within_spans
from pipeline.hazards.rows import Judged, hazards_table
from pipeline.hazards.states import contradicted, lds_states
from pipeline.hazards.suspect import left_doppler, suspect_of_error
from pipeline.hazards.timing import Timing, time_hazard
from schemas.arrays import flags, times_ns
from schemas.enums import PassageStatus, Suspect


@dataclass(frozen=True)
class HazardResult:
    """`hazards`, `alarms` and `passages` by the contract; `epochs_columns`: `error_along_m,
    error_cross_m, error_up_m, lds_state, suspect_after_the_fact`, one row per epoch.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    epochs_columns: pl.DataFrame


def classify(case: Case) -> HazardResult:
    """Judge one solution after the fact."""
    drafts, jumps = find_episodes(case.series, beacons_by_leg(case.balises), case.config.hazards)
    judged = []
    for draft in drafts:
        judged += _judge(draft, time_hazard(draft, jumps, case), case)
    spans = faulty_spans(case, judged, jumps)
    return HazardResult(
        hazards=hazards_table(case, judged),
        alarms=alarms_table(case, judged),
        passages=judge_passages(case, judged, spans),
        epochs_columns=_epochs(case, spans),
    )


def _judge(draft: Draft, timing: Timing, case: Case) -> list[Judged]:
    """The hazard with its suspect; none where the odometer that carries the truth is held to be at fault.

    An odometer that slips further while a wrong position lasts did not make that position wrong.
    """
    row, size = case.series.row, case.series.size
    first, last = sorted((int(row[timing.onset_epoch]), int(row[min(draft.end, size - 1)])))
    suspect = suspect_of_error(case.witnesses, first, last, case.fails.failed_in(first, last))
    if suspect is Suspect.ODOMETER:
        came = max(first, int(row[draft.first_epoch]))
        if not left_doppler(case.witnesses, first, came):
            return []
        suspect = Suspect.GNSS
    evidence = str(case.truth["evidence"][int(row[draft.first_epoch])])
    return [_with_passages(Judged(draft, timing, evidence, suspect, False, ()), case)]


def _with_passages(judged: Judged, case: Case) -> Judged:
    passages = case.passages
    own = link_passages(passages, [judged], case.series).hazard == 0
    accepted = passages.filter(own & (passages["status"] == PassageStatus.ACCEPTED.value).to_numpy())
    late = bool((beyond_window(passages) & own).any())
    return replace(judged, beyond_window=late, accepted=tuple(accepted["balise_id"].to_list()))


def _epochs(case: Case, spans: list[tuple[int, int]]) -> pl.DataFrame:
    along = case.errors["along"]
    hidden = contradicted(along, case.truth, case.config.hazards.failure_limit_m)
    told = case.errors | {"along": np.where(hidden, np.nan, along)}
    columns = [pl.Series(f"error_{axis}_m", values, nan_to_null=True) for axis, values in told.items()]
    tvb, t_ns = flags(case.epochs, "tvb"), times_ns(case.epochs)
    suspicious = pl.Series("suspect_after_the_fact", tvb & within_spans(t_ns, spans))
    return pl.DataFrame([*columns, lds_states(case), suspicious])
