"""What the classification of one solution looks at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.epochs.failure_log import FailureLog, failure_log_of
from pipeline.hazards.passing import TruePassings, true_passings
from pipeline.hazards.series import Series, errors_of, series_of
from pipeline.hazards.suspect import Witnesses, witnesses_of
from schemas.arrays import Bools, Floats
from schemas.config import Configuration

Locate = Callable[[npt.ArrayLike, npt.ArrayLike], tuple[npt.NDArray[np.object_], Floats]]
"""Net elements and measures of path positions: `locate(leg, path_m)`, as `TravelledPath.locate`."""


@dataclass(frozen=True)
class Case:
    """One solution of a run as it was recorded and replayed, with the truth.

    `epochs`: matched, aligned and monitored, with the LDS columns; `truth`: from `establish_truth`, row by row;
    `passages`: of the LDS, with those from `with_unoffered`; `balises`: `leg, balise_id, kind, path_m` on the path;
    `faults`: what was injected, where known; `between`: from `places_between`; `void`: epochs whose evidence is an
    odometer that lost way or may have (`motion.void_evidence`), none by default.
    """

    solution: str
    epochs: pl.DataFrame
    truth: pl.DataFrame
    passages: pl.DataFrame
    balises: pl.DataFrame
    faults: pl.DataFrame | None
    locate: Locate
    config: Configuration
    between: pl.DataFrame | None = None
    void: Bools | None = None

    @cached_property
    def errors(self) -> dict[str, Floats]:
        """Per axis, all epochs (`errors_of`)."""
        return errors_of(self.epochs, self.truth)

    @cached_property
    def series(self) -> Series:
        return series_of(self.epochs, self.truth, self.config.lds)

    @cached_property
    def fails(self) -> FailureLog:
        return failure_log_of(self.epochs, self.config.lds.recovery_s)

    @cached_property
    def witnesses(self) -> Witnesses:
        return witnesses_of(self.epochs, self.truth, self.errors, self.config, self.void)

    @cached_property
    def passings(self) -> TruePassings:
        return true_passings(self.epochs, self.truth, self.balises, self.between)
