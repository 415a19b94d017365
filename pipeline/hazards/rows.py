"""The `hazards` table from episodes and their timing (CONTRACT section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.hazards.case import Case
from pipeline.hazards.crossings import Crossing
from pipeline.hazards.episodes import Draft
from pipeline.hazards.series import Series
from pipeline.hazards.timing import Timing
from schemas.arrays import NS_PER_S
from schemas.enums import Evidence, FailureMode, Hazard, Suspect
from schemas.enums import Timing as Early
from schemas.tables import Hazards


def schema_of(table: type[dy.Schema]) -> pl.Schema:
    """Columns and types of a table of the contract."""
    return pl.Schema({name: column.dtype for name, column in table.columns().items()})


@dataclass(frozen=True)
class Judged:
    """One hazard with everything that its row tells."""

    draft: Draft
    timing: Timing
    evidence: str
    suspect: Suspect
    beyond_window: bool
    accepted: tuple[str, ...]


def hazards_table(case: Case, judged: list[Judged]) -> pl.DataFrame:
    """Rows in order of time; `hazard_id` is the position in `judged`."""
    ids = {id(item.draft): number for number, item in enumerate(judged)}
    rows = []
    for number, item in enumerate(judged):
        cause = item.draft.caused_by
        rows.append(
            {
                "solution": case.solution,
                "hazard_id": number,
                "caused_by": None if cause is None else ids.get(id(cause)),
                **_kind(item),
                **_instants(item.timing),
                **_verdict(item.timing, case.config.budget_s),
                **_size(item, case.series),
                **_place(item.draft, case),
            }
        )
    return pl.DataFrame(rows, schema=schema_of(Hazards))


def _kind(item: Judged) -> dict[str, Any]:
    draft = item.draft
    ids = list(dict.fromkeys(hit.balise_id for hit in draft.hits))
    return {
        "hazard": draft.hazard.value,
        "failure_mode": _failure_mode(item).value,
        "timing": timing_of(draft.hits[0]).value,
        "evidence": item.evidence,
        "suspect": item.suspect.value,
        "balise_ids": ids,
        "accepted_ids": [balise for balise in ids if balise in item.accepted],
    }


def timing_of(hit: Crossing) -> Early:
    """Offered before (+) or after the train is there."""
    if hit.error_m == 0.0:
        return Early.NONE
    return Early.EARLY if hit.error_m > 0 else Early.LATE


def _failure_mode(item: Judged) -> FailureMode:
    if item.draft.hazard is not Hazard.VB_SHIFT or timing_of(item.draft.hits[0]) is Early.EARLY:
        return FailureMode.INSERTION
    return FailureMode.DELETION if item.beyond_window else FailureMode.NONE


def _instants(timing: Timing) -> dict[str, Any]:
    return {
        "t_onset": timing.onset_ns,
        "t_failure": timing.failure_ns,
        "t_detected": timing.detected_ns,
        "t_negated": timing.negated_ns,
        "t_end": timing.end_ns,
        "monitor": timing.monitor,
        "detected": timing.detected_ns is not None,
        "alarm_before_onset": timing.alarm_before_onset,
        "time_to_detect_s": _seconds(timing.onset_ns, timing.detected_ns),
        "time_since_failure_s": _seconds(timing.failure_ns, timing.detected_ns),
    }


def _seconds(begin_ns: int | None, end_ns: int | None) -> float | None:
    return None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / NS_PER_S


def _verdict(timing: Timing, budget_s: float) -> dict[str, Any]:
    """Hazardous time (what TVB eq. 7 allows) and whether it stays within the budget.

    A failure that is never negated is beyond every budget; without a failure nothing can be said.
    """
    until_negated = _seconds(timing.failure_ns, timing.negated_ns)
    hazardous = None if until_negated is None else max(0.0, until_negated)
    within = None if timing.failure_ns is None else hazardous is not None and hazardous <= budget_s
    return {"hazardous_s": hazardous, "budget_s": budget_s, "within_budget": within}


def _size(item: Judged, series: Series) -> dict[str, Any]:
    """Largest error with its sign, and its slope from onset to failure.

    A jump back leaves no error: its size is the step itself. The offers count too: where the odometer since the
    LRVB is the evidence, the error starts anew at the VB that was offered wrong and accepted. So does a jump's step
    there, and where the evidence cannot resolve its errors: by how much the position was wrong before is not known.
    """
    draft, timing = item.draft, item.timing
    lasting = slice(timing.onset_epoch, max(draft.end, draft.first_epoch + 1))
    epochs = np.concatenate((np.arange(series.size)[lasting], [hit.epoch for hit in draft.hits])).astype(np.int64)
    errors = np.concatenate((series.error_m[lasting], [hit.error_m for hit in draft.hits]))
    resolved = item.evidence != Evidence.ODOMETER.value and (np.abs(errors) > series.bound_m[epochs]).any()
    if draft.jump is not None and not resolved:
        errors = np.append(errors, draft.jump.step_m)
    size = float(errors[int(np.argmax(np.abs(errors)))])
    if draft.caused_by is not None and draft.jump is not None:
        size = draft.jump.step_m
    return {"size_m": size, "rate_mps": _rate(timing, draft, series)}


def _rate(timing: Timing, draft: Draft, series: Series) -> float | None:
    if timing.is_step:
        return None
    until = draft.first_epoch if timing.failure_epoch is None else timing.failure_epoch
    begin = int(np.searchsorted(series.t_ns, timing.onset_ns))
    t_s = (series.t_ns[begin : until + 1] - timing.onset_ns) / NS_PER_S
    if t_s.size < 2:
        return None
    slope: float = np.polyfit(t_s, series.error_m[begin : until + 1], 1)[0]
    return float(slope)


def _place(draft: Draft, case: Case) -> dict[str, Any]:
    """Time and place of the hazard; the place is the train's own, not the one offered."""
    epoch, series = draft.first_epoch, case.series
    speed = case.epochs["speed_mps"][int(series.row[epoch])]
    if draft.jump is not None:
        t_ns, place = int(series.t_ns[epoch]), float(series.truth_m[epoch])
    else:
        hit = draft.hits[0]
        t_ns, place = hit.t_ns, hit.path_m - hit.error_m * float(series.direction[epoch])
    elements, measures = case.locate([int(series.leg[epoch])], [place])
    measure = float(measures[0])
    return {
        "t_hazard": t_ns,
        "path_m": place,
        "netelement_id": elements[0],
        "measure_m": measure if np.isfinite(measure) else None,
        "speed_mps": None if speed is None else abs(float(speed)),
    }
