"""The `alarms` table: episodes, their verdict against the truth, and whom they point at (DOMAIN section 5)."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import AlarmSpan, FailureLog
from pipeline.hazards.arrays import runs_of
from pipeline.hazards.case import Case
from pipeline.hazards.rows import Judged, schema_of
from pipeline.hazards.suspect import Witnesses, suspect_of_alarm
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import HazardConfig
from schemas.enums import Evidence, Verdict
from schemas.tables import Alarms

# Streams rarely begin and end with the same epoch: so little without truth says nothing against it.
_BLIND_S = 1.0


def alarms_table(case: Case, judged: list[Judged]) -> pl.DataFrame:
    """One row per alarm episode in order of time; its place is that of the position at its first fail."""
    rows: list[dict[str, Any]] = []
    for number, span in enumerate(case.fails.alarms):
        row = {"solution": case.solution, "alarm_id": number, **_row(span, judged, case)}
        if row["verdict"] == Verdict.FALSE.value and number and _rings_on(case.fails, number):
            row["suspect"] = rows[-1]["suspect"]
        rows.append(row)
    places = case.epochs.select("netelement_id", "measure_m")[[span.first for span in case.fails.alarms]]
    table = pl.DataFrame(rows, schema=schema_of(Alarms)).drop(places.columns)
    return table.hstack(places).select(Alarms.column_names())


def _rings_on(fails: FailureLog, number: int) -> bool:
    """The position never came back since the alarm before: its fault still rings in the bank (DOMAIN section 4)."""
    between = slice(fails.alarms[number - 1].last, fails.alarms[number].first + 1)
    return bool(fails.negated[between].all())


def _row(span: AlarmSpan, judged: list[Judged], case: Case) -> dict[str, Any]:
    hazard_id = hazard_of(span, judged)
    if hazard_id is None:
        verdict = verdict_of(span, case.witnesses, case.config.hazards)
    else:
        verdict = Verdict.UNKNOWN if _hangs_on_void(judged[hazard_id], case) else Verdict.TRUE
    if hazard_id is not None:
        suspect = judged[hazard_id].suspect
    else:
        suspect = suspect_of_alarm(case.witnesses, span.first, span.last, span.monitors, verdict)
    return {
        "t_start": span.start_ns,
        "t_end": span.end_ns,
        "monitors": list(span.monitors),
        "peak_ratio": span.peak_ratio,
        "verdict": verdict.value,
        "suspect": suspect.value,
        "hazard_id": hazard_id,
    }


def _hangs_on_void(item: Judged, case: Case) -> bool:
    """From its onset to its first VB the hazard is known by an odometer alone that lost way, or may have lost it.

    The hazard stands, for it may be one; nobody knows whether the alarm was right.
    """
    row = case.series.row
    first, last = sorted((int(row[item.timing.onset_epoch]), int(row[item.draft.first_epoch])))
    return item.evidence == Evidence.ODOMETER.value and bool(case.witnesses.void[first : last + 1].any())


def hazard_of(span: AlarmSpan, judged: list[Judged]) -> int | None:
    """The first hazard whose episode the alarm falls into, or that it detected."""
    for number, item in enumerate(judged):
        timing = item.timing
        inside = span.start_ns <= timing.end_ns and span.end_ns >= timing.onset_ns
        detected = timing.detected_ns is not None and span.start_ns <= timing.detected_ns <= span.end_ns
        if inside or detected:
            return number
    return None


def verdict_of(span: AlarmSpan, w: Witnesses, config: HazardConfig) -> Verdict:
    """False when |e| stayed below max(5 m, 3 sigma) from 300 s before the alarm to its end.

    More than a second of positions without truth, an error that the evidence cannot resolve, or one against an odometer
    that lost way or may have lost it, leave it unknown. So does a position that left the odometer by as much over that
    time where the odometer is the evidence: its error starts anew at each accepted VB.
    """
    since_ns = span.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    part = slice(int(np.searchsorted(w.t_ns, since_ns)), span.last + 1)
    error, position = np.abs(w.error_m[part]), np.isfinite(w.path_m[part])
    tolerated = w.tolerated_m[part]
    with np.errstate(invalid="ignore"):
        beyond: Bools = error >= tolerated
        proved = beyond & (error > w.bound_m[part]) & ~w.void[part]
        hidden = (w.slip_m[part] > 0.0) & (error + w.slip_m[part] >= tolerated)
    if proved.any():
        return Verdict.TRUE
    blind = _longest_s(position & ~np.isfinite(error), w.t_ns[part]) > _BLIND_S
    unknown = (beyond | hidden).any() or blind or not np.isfinite(error).any() or _left_odometer(w, part, tolerated)
    return Verdict.UNKNOWN if unknown else Verdict.FALSE


def _left_odometer(w: Witnesses, part: slice, tolerated_m: Floats) -> bool:
    """Position minus odometer moved by more than is tolerated within one stretch, the odometer being the evidence."""
    offset = w.path_m[part] - w.odometer_m[part]
    known = w.by_odometer[part] & np.isfinite(offset)
    for stretch in np.unique(w.stretch[part][known]):
        rows = known & (w.stretch[part] == stretch)
        if float(np.ptp(offset[rows])) >= float(np.nanmedian(tolerated_m[rows])):
            return True
    return False


def _longest_s(mask: Bools, t_ns: Ints) -> float:
    firsts, lasts = runs_of(mask)
    return float((t_ns[lasts] - t_ns[firsts]).max()) / NS_PER_S if firsts.size else 0.0
