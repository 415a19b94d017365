"""From when on a fault may have begun: the last independent fix before each row."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.undetected.watched import Watched
from schemas.arrays import NS_PER_S, Ints, times_ns
from schemas.config import UndetectedConfig
from schemas.enums import BaliseKind
from schemas.run import RunLog


def fixes_ns(run: RunLog, crossings: pl.DataFrame, missions: tuple[datetime, ...], config: UndetectedConfig) -> Ints:
    """Instants at which something else than GNSS said where the train was, in order [ns].

    Physical balises read on the path, the reference by configuration, and configured starts of mission. The run's
    first row is a start of mission in any case.
    """
    found: list[Ints] = [np.array([round(t.timestamp() * 1e9) for t in missions], dtype=np.int64)]
    if "read" in config.fixes:
        found.append(times_ns(crossings.filter(kind=BaliseKind.PHYSICAL.value)))
    if "reference" in config.fixes and run.reference is not None:
        found.append(times_ns(run.reference))
    return np.unique(np.concatenate(found))


class Window(NamedTuple):
    """Rows over which a fault may grow: none at `start`, the last row at or before the fix, and free up to `end`.

    `since_ns`: the fix, or the first row where the run begins without one; `since_s`: seconds after the first epoch.
    """

    start: int
    end: int
    since_ns: int
    since_s: float


def windows(rows: Watched, t_ns: Ints, fixes: Ints) -> list[Window]:
    """The windows of a run, in order; `t_ns`: stamps of all epochs."""
    if not rows.rows:
        return []
    stamps = t_ns[rows.epoch]
    last = np.searchsorted(stamps, fixes, side="right") - 1
    # Of several fixes between two rows the last one counts.
    began = {0: int(stamps[0])} | dict(zip(last[last >= 0].tolist(), fixes[last >= 0].tolist(), strict=True))
    ends = [*sorted(began)[1:], rows.rows - 1]
    return [
        Window(start, end, began[start], (began[start] - int(t_ns[0])) / NS_PER_S)
        for start, end in zip(sorted(began), ends, strict=True)
        if end > start
    ]
