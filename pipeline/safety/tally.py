"""What one architecture did over some time, as counts that add up over runs."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.figures.bounds import UNKNOWN, clopper_pearson, poisson_rate
from pipeline.figures.estimates import columns_of, continuity_15s, mtbf

Row = dict[str, object]


@dataclass(frozen=True)
class Faults:
    """Faults of the position and what became of them; `common`: the other solution had one at the same time; `judged`:
    failures that a reference or balise reads tell.
    """

    hazards: int = 0
    failures: int = 0
    missed: int = 0
    common: int = 0
    common_missed: int = 0
    time_to_detect_s: tuple[float, ...] = ()
    judged: int = 0
    missed_judged: int = 0


@dataclass(frozen=True)
class Alarms:
    """Alarm episodes, and the time in which the monitors judged [s]."""

    alarms: int = 0
    false: int = 0
    unknown: int = 0
    judged_s: float = 0.0


@dataclass(frozen=True)
class Working:
    """Time with epochs, of this in work [s], and how often work was lost after it had gone on for `up_s`.

    `truth_s`: time judged right or wrong by a reference or balise reads; `wrong_s`: of this in work and judged wrong,
    whether it hit a virtual balise or not (the architecture's P1).
    """

    held_s: float = 0.0
    working_s: float = 0.0
    up_s: float = 0.0
    losses: int = 0
    truth_s: float = 0.0
    wrong_s: float = 0.0


@dataclass(frozen=True)
class Tally:
    """`faults` and `alarms` are None for an architecture that is judged by its continuity alone."""

    faults: Faults | None
    alarms: Alarms | None
    working: Working

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            _added(self.faults, other.faults), _added(self.alarms, other.alarms), _added(self.working, other.working)
        )

    def row(self) -> Row:
        """Figures with exact 95 % bounds."""
        lost = self.working.losses, self.working.up_s / 3600.0
        return {
            **_fault_columns(self.faults),
            **_alarm_columns(self.alarms),
            "availability": self.working.working_s / self.working.held_s if self.working.held_s > 0 else None,
            "wrong_in_use_s": self.working.wrong_s if self.working.truth_s > 0 else None,
            "wrong_in_use_share": self.working.wrong_s / self.working.truth_s if self.working.truth_s > 0 else None,
            **columns_of("mtbf", mtbf(*lost), "_h"),
            **columns_of("continuity_15s", continuity_15s(*lost)),
        }


def _added(one: Any, other: Any) -> Any:
    if one is None or other is None:
        return None
    return type(one)(*(getattr(one, item.name) + getattr(other, item.name) for item in fields(one)))


def _fault_columns(faults: Faults | None) -> Row:
    if faults is None:
        names = list(_fault_columns(Faults()))
        return dict.fromkeys(names)
    detected = faults.time_to_detect_s
    return {
        "hazards": faults.hazards,
        "detected": len(detected),
        "failures": faults.failures,
        "missed": faults.missed,
        "failures_judged": faults.judged,
        "missed_judged": faults.missed_judged,
        **columns_of("missed_share", clopper_pearson(faults.missed_judged, faults.judged)),
        "common_failures": faults.common,
        "common_missed": faults.common_missed,
        "time_to_detect_median_s": float(np.median(detected)) if detected else None,
        "time_to_detect_max_s": max(detected, default=None),
    }


def _alarm_columns(alarms: Alarms | None) -> Row:
    if alarms is None:
        names = list(_alarm_columns(Alarms()))
        return dict.fromkeys(names)
    rate = UNKNOWN if alarms.unknown else poisson_rate(alarms.false, alarms.judged_s / 3600.0)
    return {
        "alarms": alarms.alarms,
        "false_alarms": alarms.false,
        **columns_of("false_alarm_rate", rate, "_per_h"),
        "judged_h": alarms.judged_s / 3600.0,
    }
