"""Frames between stages out of tables of a few columns, and back: what a test does not give is not known."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline.stages.epochs.verdicts import Verdicts
from pipeline.stages.monitors.bank import MonitorBank
from schemas.config import Configuration
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table


def bank_over(table: pl.DataFrame, singles: Mapping[str, Verdicts], config: Configuration) -> MonitorBank:
    """The bank over a table of aligned epochs."""
    return MonitorBank(arrays_of_table(AlignedEpochs, table), singles, config)


def verdict_table(verdicts: Verdicts) -> pl.DataFrame:
    """`value, threshold, state, reason` per epoch."""
    columns = verdicts.columns("monitor")
    return pl.DataFrame([column.alias(column.name.removeprefix("monitor_")) for column in columns])
