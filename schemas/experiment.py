"""Contracts of the tables of `balise experiment recorded`: faults put into recorded runs, and what became of them."""

from __future__ import annotations

import dataframely as dy

from schemas.columns import count, flag, instant, one_of, real, text, texts
from schemas.enums import OwnError, RunStatus
from schemas.monitors import SCALES


def _with_bounds(name: str, meaning: str) -> dict[str, dy.Column]:
    """Columns of a share and its bounds."""
    return {
        name: real("1", meaning, min=0, max=1),
        f"{name}_low": real("1", f"{meaning}: lower 95 % bound, over passes", min=0, max=1),
        f"{name}_high": real("1", f"{meaning}: upper 95 % bound, over passes", min=0, max=1),
    }


_CELL: dict[str, dy.Column] = {
    "bank": text("bank of the plan; `bank` where the plan names none"),
    "cell": text("kind, target, amount and direction of the fault"),
    "kind": text("kind of the fault, as in a fault file"),
    "target": text("what it hits; in `injections` the satellite that was drawn"),
    "direction": text(
        "ahead, behind, left, right, ...; of a range longer or shorter; null without a direction", nullable=True
    ),
    "amount": dy.Float64(
        description="rate, size, duration, latency or scale, in `unit`; negative in the second direction"
    ),
    "unit": text("unit of the amount"),
}


def _injections_schema() -> type[dy.Schema]:
    """Columns of the injections."""
    thresholds = {
        f"along_{scale}_threshold": real("m/s", f"threshold of along_{scale} there", min=0) for scale in SCALES
    }
    columns: dict[str, dy.Column] = {
        "bank": _CELL["bank"],
        "injection_id": count("number of the injection, the same for all banks"),
        **{name: column for name, column in _CELL.items() if name != "bank"},
        "run_id": text("run that it was put into"),
        "solution": text("solution that was replayed"),
        "duration_s": real("s", "how long the fault lasts; null to the end of the watch", min=0),
        "start_s": real("s", "onset after the first epoch of the run, as `balise inject` counts", min=0),
        "t_onset": instant("onset of the fault"),
        "watched_s": real("s", "how long it was watched", min=0),
        "netelement_id": text("net element at the onset, in the run without the fault", nullable=True),
        "measure_m": real("m", "measure there"),
        "path_m": real("m", "path position there"),
        "speed_mps": real("m/s", "speed along growing path there"),
        "curvature_per_m": real("1/m", "curvature of the track there, positive to the left"),
        "satellites": count("satellites used there; null where not recorded", nullable=True),
        "sigma_along_m": real("m", "standard deviation of the position along the track there", min=0),
        **thresholds,
        "noticed": flag("a monitor failed during the watch"),
        "monitors": texts("those that failed first"),
        "time_to_detect_s": real("s", "T_D, from the onset to the first fail; null where none came", min=0),
        "time_to_failure_s": real("s", "from the onset to where the position is certainly wrong", min=0),
        "time_to_failure_may_s": real("s", "from the onset to where the fault may have made it wrong", min=0),
        "time_since_failure_s": real("s", "T_dsf, the least that the evidence leaves"),
        "time_since_failure_may_s": real("s", "T_dsf, the largest that it leaves"),
        "stopped": flag("no wrong position in use after the reaction to the first fail; null unnoticed", nullable=True),
        "hazardous_s": real("s", "time in use with a wrong position, to the end of the watch", nullable=False, min=0),
        "hazardous_may_s": real("s", "the same with the time that is unknown", nullable=False, min=0),
        "unnoticed_m": real("m", "largest displacement before the first fail", nullable=False, min=0),
        "in_use_m": real("m", "largest displacement of a position in use, after a return too", nullable=False, min=0),
        "tvb_lost_s": real("s", "time with a TVB that the fault cost", nullable=False, min=0),
        "accepted": count("virtual balises accepted since the onset"),
        "accepted_wrong": count("of these at a wrong position"),
        "accepted_unknown": count("of these at a position that may be wrong"),
        "accepted_wrong_ids": texts("the balises accepted at a wrong position"),
    }
    doc = "One row per bank and injected fault. Errors are those of the fault-free run and what the fault moved."
    return type("ExperimentInjections", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


ExperimentInjections = _injections_schema()


def _cells_schema() -> type[dy.Schema]:
    """Columns of the cells."""
    columns: dict[str, dy.Column] = {
        **_CELL,
        "wanted": count("injections that the plan asks for"),
        "injections": count("injections replayed"),
        "not_possible": count("instants drawn at which the recording could not take the fault"),
        "reason": text("why there are fewer than wanted", nullable=True),
        "watched_s": real("s", "how long each was watched", min=0),
        "passes": count("independent passes: watches that share no time, each counted as `pass_s` long at least"),
        "noticed": count("injections noticed"),
        **_with_bounds("noticed_share", "share noticed during the watch"),
        "time_to_detect_median_s": real("s", "median of T_D; null where half were not noticed", min=0),
        "time_to_detect_median_low_s": real("s", "its lower 95 % bound, over passes; null of fewer than six", min=0),
        "time_to_detect_median_high_s": real("s", "its upper bound; null also where not reached in the watch", min=0),
        "time_to_detect_p95_s": real("s", "95 % of T_D; null where fewer were noticed", min=0),
        "time_to_detect_max_s": real("s", "largest T_D; null where one was not noticed", min=0),
        "failures": count("injections whose position failed, or may have before it was noticed"),
        "missed_at_failure": count("of these not noticed when the position may have failed"),
        **_with_bounds("pmd_at_failure", "share of the failures not noticed by then (DIAG: Pmd at T_dsf = 0)"),
        "stopped": count("noticed and no wrong position in use after it"),
        "noticed_not_stopped": count("noticed, and a wrong position in use again after it"),
        "accepted_wrong": count("virtual balises accepted at a wrong position"),
        "hazardous_max_s": real("s", "longest time in use with a wrong position", min=0),
        "unnoticed_max_m": real("m", "largest displacement before the first fail", min=0),
        "in_use_max_m": real("m", "largest displacement of a position in use", min=0),
        "tvb_lost_median_s": real("s", "median of the time with a TVB that the fault cost", min=0),
    }
    doc = "One row per bank and cell of the plan. Bounds are over independent passes, not over injections."
    return type("ExperimentCells", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


ExperimentCells = _cells_schema()


def _pmd_schema() -> type[dy.Schema]:
    """Columns of the probability of missed detection over time."""
    columns: dict[str, dy.Column] = {
        **_CELL,
        "time_since_failure_s": real("s", "time after the failure, negative before it", nullable=False),
        "trials": count("injections whose position failed, or may have before it was noticed"),
        "passes": count("independent passes among them"),
        "missed": count("not noticed by then, counted from where the position may have failed"),
        **_with_bounds("pmd", "share not noticed by then"),
        "missed_certain": count("not noticed by then, counted from where the position certainly failed"),
    }
    doc = "Pmd against T_dsf (DIAG Fig. 5): one row per bank, cell and time since failure."
    return type("ExperimentPmd", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


ExperimentPmd = _pmd_schema()


class ExperimentPlaces(dy.Schema):
    """One row per bank and piece of line in which faults began: where is detection weakest?"""

    bank = text("bank")
    netelement_id = text("net element")
    from_m = real("m", "measure at which the piece begins", nullable=False)
    to_m = real("m", "measure at which it ends", nullable=False)
    injections = count("faults that began there")
    cells = count("different cells among them")
    noticed = count("of these noticed")
    slowness = real("1", "median of T_D over the median of its cell; unnoticed counts as the whole watch", min=0)
    time_to_detect_median_s = real("s", "median of T_D of all; null where half were not noticed", min=0)
    unnoticed_max_m = real("m", "largest displacement before the first fail", min=0)
    in_use_max_m = real("m", "largest displacement of a position in use", min=0)
    accepted_wrong = count("virtual balises accepted at a wrong position")
    hazardous_max_s = real("s", "longest time in use with a wrong position", min=0)
    curvature_per_m = real("1/m", "median of |curvature|", min=0)
    speed_mps = real("m/s", "median of the speed", min=0)


class ExperimentBanks(dy.Schema):
    """One row per bank: what it notices, and how often it alarms without a fault, on the same runs."""

    bank = text("bank")
    runs = count("runs replayed")
    hours = real("h", "time without a fault at which an alarm could have begun", min=0)
    alarms = count("alarm episodes in it; false ones, where the recording holds no fault")
    alarm_rate_per_h = real("1/h", "rate of these alarms", min=0)
    alarm_rate_low_per_h = real("1/h", "lower 95 % bound", min=0)
    alarm_rate_high_per_h = real("1/h", "upper 95 % bound", min=0)
    tvb_share = real("1", "share of the recorded time with a TVB, without a fault", min=0, max=1)
    injections = count("faults put in")
    passes = count("independent passes among those that failed")
    noticed = count("of the injections noticed")
    failures = count("injections whose position failed, or may have before it was noticed")
    missed_at_failure = count("of these not noticed when the position may have failed")
    pmd_at_failure = real("1", "share of the failures not noticed by then, over the plan's own mixture", min=0, max=1)
    pmd_at_failure_low = real("1", "lower 95 % bound, over passes", min=0, max=1)
    pmd_at_failure_high = real("1", "upper 95 % bound, over passes", min=0, max=1)
    slowest_cell = text("cell with the largest median of T_D, or one of which half was not noticed", nullable=True)
    noticed_not_stopped = count("noticed, and a wrong position in use again after it")
    accepted_wrong = count("virtual balises accepted at a wrong position")
    hazardous_s = real("s", "time in use with a wrong position, all injections together", min=0)
    in_use_max_m = real("m", "largest displacement of a position in use", min=0)
    tvb_lost_s = real("s", "time with a TVB that the faults cost, all together", min=0)


class ExperimentRuns(dy.Schema):
    """One row per run: what of it faults were put into, and what was left out."""

    run_id = text("run")
    status = one_of(RunStatus, "ok, or failed: not used")
    error = text("why it was not used", nullable=True)
    own_error = one_of(OwnError, "of the recorded position: measured, or assumed to be none", nullable=True)
    duration_s = real("s", "recorded time", min=0)
    usable_s = real("s", "time in which a fault may begin", min=0)
    alarm_s = real("s", "left out: a monitor failed or the position was negated", min=0)
    ambiguous_s = real("s", "left out: track in doubt", min=0)
    no_tvb_s = real("s", "left out: no TVB", min=0)
    not_right_s = real("s", "left out: judged wrong or unknown", min=0)
    too_soon_s = real("s", "left out: within `quiet_s` of one of these or of the beginning", min=0)
    longest_watch_s = real("s", "longest watch without an alarm, from where a fault may begin", min=0)
    has_odometer = flag("odometer recorded", nullable=True)
    has_ranges = flag("satellites recorded beside nearly all positions", nullable=True)
    injections = count("faults put into it")


EXPERIMENT_TABLES: dict[str, type[dy.Schema]] = {
    "experiment_injections": ExperimentInjections,
    "experiment_cells": ExperimentCells,
    "experiment_pmd": ExperimentPmd,
    "experiment_places": ExperimentPlaces,
    "experiment_banks": ExperimentBanks,
    "experiment_runs": ExperimentRuns,
}
