"""The epochs of one solution as the train itself knew them: aligned, monitored, with what the LDS said of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Self

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import Verdicts
from schemas.arrays import Bools, Ints
from schemas.config import LdsConfig
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs, LdsEpochs


@frozen
class MonitoredEpochs(AlignedEpochs, LdsEpochs):
    """`AlignedEpochs` and `LdsEpochs` with the verdicts of all monitors, by name, in the order of the contract."""

    verdicts: Mapping[str, Verdicts]

    def series(self) -> list[pl.Series]:
        """All columns, for studies that read tables."""
        monitors = [column for name, one in self.verdicts.items() for column in one.columns(name)]
        return [*super().series(), pl.Series("withheld", self.withheld), *monitors]

    def where(self, rows: Ints) -> Self:
        """Some of the epochs, by their numbers."""
        if rows.size == self.height:
            return self
        parts = {one.name: _part(getattr(self, one.name), rows) for one in fields(self)}
        return type(self)(**parts | {"verdicts": {name: one.at(rows) for name, one in self.verdicts.items()}})

    def trusted(self, config: LdsConfig) -> Bools:
        """Epochs whose position is valid, confident and unambiguous (CONTRACT section 3, `mtbf_h`)."""
        return np.asarray(self.usable & self.confident(config.ci_limit_m) & self.unambiguous)

    def confident(self, limit_m: float) -> Bools:
        """The confidence interval along the track is within its limit [m]."""
        return np.asarray(self.confidence_m <= limit_m)


def _part(values: Any, rows: Ints) -> Any:
    """Some of the epochs of one column; what is not by epoch stays whole."""
    if isinstance(values, np.ndarray):
        return values[rows]
    return values.at(rows) if hasattr(values, "at") else values
