"""Epochs of a receiver log while they are being put together, and their frames.

A receiver spreads one epoch over several messages (position, covariance, protection level, satellites). They are
gathered under the receiver's own time key, and turned into rows when the log is at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

import dataframely as dy
import polars as pl

from schemas.inputs import Gnss, Satellites


@dataclass
class Epoch:
    """What is known of one epoch: `gnss` columns and satellite rows. Without a time it yields nothing."""

    t_ns: int | None = None
    gnss: dict[str, Any] = field(default_factory=dict)
    satellites: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Gathered:
    """Epochs by key in order of first sight; counts of what could not be used, by reason."""

    epochs: dict[Hashable, Epoch] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)

    def at(self, key: Hashable) -> Epoch:
        return self.epochs.setdefault(key, Epoch())

    def drop(self, reason: str) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + 1

    def frames(self) -> tuple[pl.DataFrame, pl.DataFrame | None]:
        """`gnss`, and `satellites` where any epoch has them."""
        timed = [epoch for epoch in self.epochs.values() if epoch.t_ns is not None and epoch.gnss]
        fixes = [{"t": epoch.t_ns, "solution": "primary", **epoch.gnss} for epoch in timed]
        ranges = [{"t": epoch.t_ns, "solution": "primary", **row} for epoch in timed for row in epoch.satellites]
        return frame_of(fixes, Gnss), frame_of(ranges, Satellites) if ranges else None


Decoder = Callable[[Gathered, Any, bytes], None]


def frame_of(rows: list[dict[str, Any]], schema: type[dy.Schema]) -> pl.DataFrame:
    """Rows with some of the schema's columns as a frame with all of them; `t` in nanoseconds since 1970."""
    dtypes = {name: pl.Int64() if name == "t" else column.dtype for name, column in schema.columns().items()}
    complete = [{name: row.get(name) for name in dtypes} for row in rows]
    frame = pl.DataFrame(complete, schema=dtypes, orient="row")
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def satellite_name(system: str, number: int) -> str:
    """`G08`, `E11`, `S23`: SBAS satellites by PRN - 100, as in RINEX."""
    return f"{system}{number - 100 if system == 'S' and number >= 100 else number:02d}"
