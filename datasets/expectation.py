"""What a replay of a synthetic run has to find, written down with the scenario."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from schemas.config import NonNegative, Positive, Settings
from schemas.enums import FailureMode, Hazard, PassageStatus, RunVerdict, Timing


class ExpectedHazard(Settings):
    """One row of the hazard table. `caused_by` is the place in this list of the row whose end made this one."""

    hazard: Hazard
    failure_mode: FailureMode
    timing: Timing
    balise_ids: tuple[str, ...]
    accepted_ids: tuple[str, ...] = ()
    detected: bool
    before_failure: bool | None = None
    caused_by: Annotated[int, Field(ge=0)] | None = None


class ExpectedRun(Settings):
    """What must be found in one run: its verdict, all hazards in order, the status of each balise on the path, alarms.

    `passages` names for each balise the status of all its rows; `once` are balises with exactly one row.
    `alarms`: `none`, `true` (at least one, none of them false) or `false` (at least one, all of them false).
    """

    verdict: RunVerdict
    hazards: tuple[ExpectedHazard, ...] = ()
    passages: dict[str, PassageStatus]
    once: tuple[str, ...] = ()
    alarms: Annotated[str, Field(pattern=r"^(none|true|false|unknown)$")] = "none"
    suspect: str | None = None
    odometer_scale: Positive | None = None
    odometer_scale_tolerance: NonNegative = 1e-3
