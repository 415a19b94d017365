"""From when on a fault may have begun: the last independent fix before each row."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import polars as pl

from pipeline.undetected.watched import Watched
from schemas.arrays import Ints, times_ns
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


def windows(rows: Watched, t_ns: Ints, fixes: Ints) -> list[tuple[int, int]]:
    """First and last row of each window: the fault is zero at its first row and free up to its last one.

    `t_ns`: stamps of all epochs. The first row of a window is the last one at or before the fix.
    """
    if not rows.rows:
        return []
    last = np.searchsorted(t_ns[rows.epoch], fixes, side="right") - 1
    starts = np.unique(np.append(np.maximum(last, 0), 0)).tolist()
    return [(begin, end) for begin, end in zip(starts, [*starts[1:], rows.rows - 1], strict=True) if end > begin]
