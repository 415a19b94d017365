"""The state of the reactive LDS per epoch (DOMAIN section 4; TVB section 4)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.hazards.arrays import words
from pipeline.hazards.case import Case
from schemas.arrays import Bools, Floats, flags, floats, times_ns, truths
from schemas.enums import BaliseKind, LdsState, PassageStatus

_STATES = [member.value for member in LdsState]


def contradicted(error_along_m: Floats, truth: pl.DataFrame, limit_m: float) -> Bools:
    """Errors that may lie on either side of the limit because two reads contradict the odometer around them.

    One within the limit proves nothing though it is larger than the slip: the true one may be the sum of both.
    """
    size, slip = np.abs(error_along_m), np.abs(floats(truth, "truth_slip_m"))
    proves_m = np.maximum(floats(truth, "truth_bound_m"), limit_m)
    with np.errstate(invalid="ignore"):
        hidden: Bools = (slip > 0.0) & (size + slip > limit_m) & (size <= proves_m)
    return hidden


def lds_states(case: Case) -> pl.Series:
    """P2 negated; P3 diagnosis faulty; P1 error beyond the failure limit; P0.

    Null without a truth, and where an error beyond the limit is less than the evidence can resolve, or one within it
    may be beyond it (`contradicted`).
    """
    epochs, limit_m = case.epochs, case.config.hazards.failure_limit_m
    size, bound = np.abs(case.errors["along"]), floats(case.truth, "truth_bound_m")
    with np.errstate(invalid="ignore"):
        failed = size > limit_m
        unresolved = (failed & (size <= bound)) | contradicted(case.errors["along"], case.truth, limit_m)
    state = np.where(failed, _code(LdsState.P1), _code(LdsState.P0))
    state[unresolved | ~np.isfinite(size)] = -1
    faulty = flags(epochs, "diagnosis_faulty") | odometer_beyond_confidence(case)
    state[faulty] = _code(LdsState.P3)
    state[flags(epochs, "negated")] = _code(LdsState.P2)
    return words(_STATES, state).alias("lds_state")


def _code(state: LdsState) -> int:
    return list(LdsState).index(state)


def odometer_beyond_confidence(case: Case) -> Bools:
    """The distance counted since the LRVB is wrong by more than 5 m + 5 % (SUBSET-041 5.3.1.1).

    Only a reference or balise reads can say so; false where they are missing.
    """
    t_ns, truth, lds = times_ns(case.epochs), case.truth, case.config.lds
    travelled, place = floats(case.epochs, "odometer_m"), floats(truth, "truth_path_m")
    virtual = case.passages.filter(case.passages["kind"] == BaliseKind.VIRTUAL.value)
    accepted = virtual.filter(virtual["status"] == PassageStatus.ACCEPTED.value).drop_nulls("t_offered")
    accepted = accepted.sort("t_offered")
    beyond = np.zeros(t_ns.size, dtype=np.bool_)
    known = np.isfinite(travelled) & np.isfinite(place) & truths(truth["evidence"] != "odometer")
    if accepted.height == 0 or not known.any():
        return beyond
    at_ns = times_ns(accepted, "t_offered")
    rows = np.flatnonzero(known)
    odometer_at = np.interp(at_ns, t_ns[rows], travelled[rows])
    truth_at = np.interp(at_ns, t_ns[rows], place[rows])
    last = np.searchsorted(at_ns, t_ns[rows], side="right") - 1
    rows, last = rows[last >= 0], last[last >= 0]
    counted = travelled[rows] - odometer_at[last]
    moved = place[rows] - truth_at[last]
    beyond[rows] = np.abs(counted - moved) > lds.odometer_fixed_m + lds.odometer_share * np.abs(counted)
    return beyond
