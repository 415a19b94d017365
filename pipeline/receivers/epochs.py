"""Epochs of a receiver log while they are being put together, and their frames.

A receiver spreads one epoch over several messages (position, covariance, protection level, satellites). They are
gathered under the receiver's own time key, and turned into rows when the log is at its end.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any

import dataframely as dy
import polars as pl

from schemas.enums import Fix
from schemas.inputs import Gnss, Satellites
from schemas.run import Stream


@dataclass
class Epoch:
    """What is known of one epoch: `gnss` columns and satellite rows. Without a time it yields nothing."""

    t_ns: int | None = None
    gnss: dict[str, Any] = field(default_factory=dict)
    satellites: list[dict[str, Any]] = field(default_factory=list)

    @property
    def has_fix(self) -> bool:
        """Whether a message said when the epoch was and what kind of fix it has (also: none)."""
        return self.t_ns is not None and "fix" in self.gnss


@dataclass
class Gathered:
    """Epochs by key in order of first sight; counts of what could not be used, by reason."""

    epochs: dict[Hashable, Epoch] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)

    def at(self, key: Hashable) -> Epoch:
        return self.epochs.setdefault(key, Epoch())

    def drop(self, reason: str, count: int = 1) -> None:
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count

    def settled(self) -> Epochs:
        """The epochs whose time and kind of fix are known; the others are counted."""
        told = [epoch for epoch in self.epochs.values() if epoch.gnss or epoch.satellites]
        known = [epoch for epoch in told if epoch.has_fix]
        self.drop("epoch without its position message", len(told) - len(known))
        return Epochs(known)


@dataclass(frozen=True)
class Epochs:
    """The epochs of a log, put together."""

    epochs: list[Epoch]

    @property
    def positions(self) -> int:
        """How many have a position."""
        return sum(epoch.gnss["fix"] != Fix.NONE for epoch in self.epochs)

    def streams(self) -> dict[Stream, pl.DataFrame]:
        """`gnss`, and `satellites` where any epoch has them."""
        fixes = [{"t": epoch.t_ns, "solution": "primary", **_of_fix(epoch.gnss)} for epoch in self.epochs]
        ranges = [{"t": epoch.t_ns, "solution": "primary", **row} for epoch in self.epochs for row in epoch.satellites]
        found: dict[Stream, pl.DataFrame] = {"gnss": frame_of(fixes, Gnss)}
        return found | ({"satellites": frame_of(ranges, Satellites)} if ranges else {})


def _of_fix(gnss: dict[str, Any]) -> dict[str, Any]:
    """Without a fix, what other messages of the epoch say of a position is not to be believed."""
    return gnss if gnss["fix"] != Fix.NONE else {name: gnss.get(name) for name in ("fix", "satellites")}


def frame_of(rows: list[dict[str, Any]], schema: type[dy.Schema]) -> pl.DataFrame:
    """Rows with some of the schema's columns as a frame with all of them; `t` in nanoseconds since 1970."""
    dtypes = {name: pl.Int64() if name == "t" else column.dtype for name, column in schema.columns().items()}
    complete = [{name: row.get(name) for name in dtypes} for row in rows]
    frame = pl.DataFrame(complete, schema=dtypes, orient="row")
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def satellite_name(system: str, number: int) -> str:
    """`G08`, `E11`, `S23`: SBAS satellites by PRN - 100, as in RINEX."""
    return f"{system}{number - 100 if system == 'S' and number >= 100 else number:02d}"
