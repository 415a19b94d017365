"""Faults that were put into the positions on purpose, as the `faults` stream of a trial names them."""

from __future__ import annotations

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Ints

# An axis of the position, the position itself, a constellation or a satellite; any other target is no fault of GNSS.
_GNSS = r"(?i)^(along|cross|up|east|north|position|velocity|gnss|satellites?|gps|galileo|glonass|beidou|[A-Z][0-9]{2})$"


def under_injection(t_ns: Ints, faults: pl.DataFrame | None, recovery_s: float) -> Bools:
    """Instants from the begin of an injected fault of GNSS to `recovery_s` after its end, where it has one."""
    under = np.zeros(t_ns.size, dtype=np.bool_)
    if faults is None:
        return under
    of_gnss = faults.filter(pl.col("target").str.contains(_GNSS))
    spans = of_gnss.select(pl.col("t_start", "t_end").dt.timestamp("ns")).iter_rows()
    for begin_ns, end_ns in spans:
        under |= (t_ns >= begin_ns) & (end_ns is None or t_ns <= (end_ns or 0) + round(recovery_s * NS_PER_S))
    return under
