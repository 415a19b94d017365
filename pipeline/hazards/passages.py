"""What the truth says about each passage (CONTRACT section 3): when the train passed, how wrong the offer was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.timeline import linking_gap_s
from pipeline.hazards.arrays import interpolate_known
from pipeline.hazards.case import Case
from pipeline.hazards.rows import Judged
from pipeline.hazards.series import Series, direction_of
from pipeline.hazards.states import contradicted
from pipeline.hazards.truth import valid_ns
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import HazardConfig
from schemas.enums import BaliseKind, Cause, FailureMode, PassageStatus
from schemas.tables import Passages

_MODES = pl.Enum([member.value for member in FailureMode])
_CAUSES = pl.Enum([member.value for member in Cause])


@dataclass(frozen=True)
class Links:
    """Per passage: hazard it belongs to (-1 none), whether a jump of it crossed the balise."""

    hazard: Ints
    jumped: Bools


@dataclass(frozen=True)
class Findings:
    """What the truth says about each passage, row by row.

    `wrong`: offered early or late beyond the limit; `positioned`: a position was there when the train passed;
    `suspicious`: accepted between a fault's onset and its detection. A NaN is a value that is not known.
    """

    t_true: list[int | None]
    error_m: Floats
    wrong: Bools
    positioned: Bools
    speed_mps: Floats
    links: Links
    suspicious: Bools


def judge_passages(case: Case, judged: list[Judged], spans: list[tuple[int, int]]) -> pl.DataFrame:
    """Passages with the columns of the truth filled in; `spans`: from `faulty_spans`."""
    passages, epochs, truth, hazards = case.passages, case.epochs, case.truth, case.config.hazards
    t_true = case.passings.assign(passages)
    gap_s = linking_gap_s(case.series.period_s, case.config.lds.crossing_gap_s)
    error = location_errors(passages, epochs, truth, gap_s, hazards.failure_limit_m)
    found = Findings(
        t_true=t_true,
        error_m=error,
        wrong=wrongly_offered(passages, error, epochs, truth, hazards),
        positioned=positions_at(epochs, t_true, gap_s),
        speed_mps=speeds_at(passages, t_true, epochs, gap_s),
        links=link_unoffered(passages, t_true, judged, link_passages(passages, judged, case.series)),
        suspicious=suspicious_passages(passages, spans),
    )
    return _filled(passages, found)


def _filled(passages: pl.DataFrame, found: Findings) -> pl.DataFrame:
    mode, cause = _modes(passages, found)
    hazard = [None if number < 0 else number for number in found.links.hazard.tolist()]
    filled = passages.with_columns(
        pl.Series("t_true", found.t_true, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC")),
        pl.Series("location_error_m", found.error_m, nan_to_null=True),
        pl.Series("failure_mode", mode, dtype=_MODES),
        pl.Series("cause", cause, dtype=_CAUSES),
        pl.Series("suspect_after_the_fact", found.suspicious),
        pl.Series("hazard_id", hazard, dtype=pl.Int64),
        pl.Series("speed_mps", found.speed_mps, nan_to_null=True),
    )
    return filled.select(Passages.column_names())


def location_errors(
    passages: pl.DataFrame, epochs: pl.DataFrame, truth: pl.DataFrame, gap_s: float, limit_m: float
) -> Floats:
    """How far the train was from the balise at its offer [m], + = offered early; NaN without offer or truth.

    A VB is offered by a position as old as the GNSS latency, a telegram at the instant of its read. NaN too where
    reads contradict the odometer so that nobody knows whether a VB's error is beyond `limit_m`.
    """
    offered = passages["t_offered"].dt.timestamp("ns")
    error = np.full(passages.height, np.nan)
    rows = np.flatnonzero(offered.is_not_null().to_numpy())
    if rows.size == 0:
        return error
    at_ns = offered.drop_nulls().to_numpy()
    virtual = (passages["kind"] == BaliseKind.VIRTUAL.value).to_numpy()[rows]
    place, direction = floats(truth, "truth_path_m"), direction_of(epochs)
    balise = floats(passages, "path_m")[rows]
    for mine, stamps in ((virtual, times_ns(epochs)), (~virtual, valid_ns(epochs))):
        x, at = (stamps - stamps[0]) / NS_PER_S, (at_ns[mine] - stamps[0]) / NS_PER_S
        train = interpolate_known(at, x, place, gap_s)
        near = np.clip(np.searchsorted(x, at), 0, x.size - 1)
        told = (balise[mine] - train) * direction[near]
        hidden = contradicted(told, truth[near], limit_m) & virtual[mine]
        error[rows[mine]] = np.where(hidden, np.nan, told)
    return error


def speeds_at(passages: pl.DataFrame, t_true: list[int | None], epochs: pl.DataFrame, gap_s: float) -> Floats:
    """Speed of the train at the offer, else where it passed by the truth [m/s]; NaN where neither is known."""
    at_ns = passages["t_offered"].dt.timestamp("ns").fill_null(pl.Series(t_true, dtype=pl.Int64))
    speed = np.full(passages.height, np.nan)
    rows = np.flatnonzero(at_ns.is_not_null().to_numpy())
    if rows.size and epochs.height:
        stamps = times_ns(epochs)
        x, at = (stamps - stamps[0]) / NS_PER_S, (at_ns.drop_nulls().to_numpy() - stamps[0]) / NS_PER_S
        speed[rows] = interpolate_known(at, x, np.abs(floats(epochs, "speed_mps")), gap_s)
    return speed


def wrongly_offered(
    passages: pl.DataFrame, error: Floats, epochs: pl.DataFrame, truth: pl.DataFrame, config: HazardConfig
) -> Bools:
    """Location errors beyond the shift limit that the evidence can resolve."""
    offered = ints(passages["t_offered"].dt.timestamp("ns"), 0)
    near = np.clip(np.searchsorted(times_ns(epochs), offered), 0, max(epochs.height - 1, 0))
    bound = np.nan_to_num(floats(truth, "truth_bound_m")[near]) if epochs.height else np.zeros(error.size)
    with np.errstate(invalid="ignore"):
        beyond: Bools = np.abs(error) > np.maximum(config.shift_limit_m, bound)
    return beyond


def link_passages(passages: pl.DataFrame, judged: list[Judged], series: Series) -> Links:
    """The hazard of each passage: the one whose crossing it is, else one that hit the balise meanwhile."""
    hazard = np.full(passages.height, -1, dtype=np.int64)
    jumped = np.zeros(passages.height, dtype=np.bool_)
    if not judged:
        return Links(hazard, jumped)
    balises = passages["balise_id"].to_list()
    offered = passages["t_offered"].dt.timestamp("ns").to_list()
    slack_ns = round(0.5 * series.period_s * NS_PER_S)
    for row, (balise, t_ns) in enumerate(zip(balises, offered, strict=True)):
        if t_ns is None:
            continue
        for number, item in enumerate(judged):
            own = [hit for hit in item.draft.hits if hit.balise_id == balise and abs(hit.t_ns - t_ns) <= slack_ns]
            if own:
                hazard[row] = number
                jumped[row] = item.draft.jump is not None and any(hit in item.draft.jump.crossed for hit in own)
                break
    return Links(hazard, jumped)


def link_unoffered(passages: pl.DataFrame, t_true: list[int | None], judged: list[Judged], links: Links) -> Links:
    """Passages without an offer of their own belong to the hazard that hit their balise while it lasted."""
    hazard = links.hazard.copy()
    offered = passages["t_offered"].is_not_null().to_list()
    for row, balise in enumerate(passages["balise_id"].to_list()):
        t_ns = t_true[row]
        if offered[row] or t_ns is None or hazard[row] >= 0:
            continue
        for number, item in enumerate(judged):
            lasts = item.timing.onset_ns <= t_ns <= item.timing.end_ns
            if lasts and any(hit.balise_id == balise for hit in item.draft.hits):
                hazard[row] = number
                break
    return Links(hazard, links.jumped)


def suspicious_passages(passages: pl.DataFrame, spans: list[tuple[int, int]]) -> Bools:
    """VBs accepted in `onset <= t < detection` of a fault; a telegram does not rest on the position."""
    accepted = (passages["status"] == PassageStatus.ACCEPTED.value).to_numpy()
    accepted &= (passages["kind"] == BaliseKind.VIRTUAL.value).to_numpy()
    offered = ints(passages["t_offered"].dt.timestamp("ns"))
    return accepted & within_spans(offered, spans)


def within_spans(t_ns: Ints, spans: list[tuple[int, int]]) -> Bools:
    """Instants in `onset <= t < detection` of any fault."""
    inside = np.zeros(t_ns.size, dtype=np.bool_)
    for onset_ns, until_ns in spans:
        inside |= (t_ns >= onset_ns) & (t_ns < until_ns)
    return inside


def positions_at(epochs: pl.DataFrame, t_true: list[int | None], gap_s: float) -> Bools:
    """Whether usable positions lie on both sides of each instant, no further apart than `gap_s`."""
    stamps = times_ns(epochs)[flags(epochs, "fix_valid") & np.isfinite(floats(epochs, "path_m"))]
    result = np.zeros(len(t_true), dtype=np.bool_)
    for row, t_ns in enumerate(t_true):
        if t_ns is None or stamps.size < 2:
            continue
        right = int(np.searchsorted(stamps, t_ns))
        if 0 < right < stamps.size:
            result[row] = stamps[right] - stamps[right - 1] <= gap_s * NS_PER_S
    return result


def _modes(passages: pl.DataFrame, found: Findings) -> tuple[list[str], list[str]]:
    """ETCS failure mode and its cause: insertion where offered early or by a jump, deletion where not
    offered inside its window or before it.
    """
    status = passages["status"].cast(pl.String).to_list()
    offered = passages["t_offered"].is_not_null().to_list()
    late = beyond_window(passages)
    modes, causes = [], []
    for row in range(passages.height):
        mode, cause = FailureMode.NONE, Cause.NONE
        if found.links.jumped[row] or (found.wrong[row] and found.error_m[row] > 0):
            mode, cause = FailureMode.INSERTION, Cause.POSITION
        elif status[row] == PassageStatus.NOT_AVAILABLE.value:
            mode, cause = FailureMode.DELETION, Cause.NO_POSITION
        elif not offered[row]:
            mode = FailureMode.DELETION
            cause = Cause.POSITION if found.positioned[row] else Cause.NO_POSITION
        elif late[row]:
            mode, cause = FailureMode.DELETION, Cause.POSITION if found.wrong[row] else Cause.NONE
        modes.append(mode.value)
        causes.append(cause.value)
    return modes, causes


def beyond_window(passages: pl.DataFrame) -> Bools:
    """Offered after its expectation window closed (SUBSET-026 3.4.4.4.3).

    Both count in the direction of travel; both are negative while a train that turned round runs back to the reference.
    """
    with np.errstate(invalid="ignore"):
        return floats(passages, "odometer_distance_m") > floats(passages, "window_close_m")
