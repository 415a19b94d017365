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

from pipeline.read.ingest.stamps import LATEST_NS
from schemas.enums import Fix
from schemas.frozen import frozen
from schemas.inputs import Gnss, Satellites
from schemas.run import Stream

# A message may come so many epochs after its own, as many as a receiver at 20 Hz makes in over a second; with a later
# one another epoch of the same key begins. Numerics of the reading, which has no configuration.
_LATEST_MESSAGE = 32
# Epochs of one key so near to each other are of two receivers, or of stamps that are coarser than the rate.
_EPOCHS_APART = 4


@dataclass
class Epoch:
    """What is known of one epoch: `gnss` columns and satellite rows. Without a time it yields nothing."""

    key: Any  # hashable
    number: int
    t_ns: int | None = None
    gnss: dict[str, Any] = field(default_factory=dict)
    satellites: list[dict[str, Any]] = field(default_factory=list)
    unresolved: bool = False  # the receiver does not know its whole seconds of UTC yet
    positions: dict[str, bytes] = field(default_factory=dict)
    _ranks: dict[str, int] = field(default_factory=dict)

    @property
    def has_fix(self) -> bool:
        """Whether messages said what kind of fix the epoch has and where, or that it has none."""
        return "fix" in self.gnss and (bool(self.positions) or self.gnss["fix"] == Fix.NONE)

    def put_columns(self, what: str, rank: int, columns: dict[str, Any]) -> None:
        """Put columns that several messages give (`what`); those of the highest rank stay, whichever comes first."""
        if rank >= self._ranks.get(what, rank):
            self._ranks[what] = rank
            self.gnss |= columns


@dataclass
class Gathered:
    """Epochs in order of first sight; counts of what could not be used, by reason."""

    epochs: list[Epoch] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    twins: list[tuple[Epoch, Epoch]] = field(default_factory=list)  # neighbours of one key with different positions
    _latest: dict[Hashable, Epoch] = field(default_factory=dict)

    def epoch_at(self, key: Hashable, position: str = "", content: bytes = b"") -> Epoch:
        """The epoch of this key that a message belongs to.

        `position`: name of the message where it is one that tells a position, with its `content`. Another one than the
        epoch already has is of another epoch with the same key, and so is what comes long after: a clock went back,
        logs were joined, or stamps are coarser than the rate. They are neither mixed nor lost.
        """
        epoch = self._latest.get(key)
        if (
            epoch is None
            or epoch.positions.get(position, content) != content
            or len(self.epochs) - epoch.number > _LATEST_MESSAGE
        ):
            earlier = epoch
            epoch = self._latest[key] = Epoch(key, len(self.epochs))
            self.epochs.append(epoch)
            if earlier is not None and epoch.number - earlier.number <= _EPOCHS_APART:
                self.twins.append((earlier, epoch))
        if position:
            epoch.positions[position] = content
        return epoch

    @property
    def rivals(self) -> frozenset[str]:
        """Names of several receivers whose positions the log holds; none where one receiver is known."""
        return frozenset()

    @property
    def rival_distance_m(self) -> float:
        """Largest distance between positions of several receivers at one time [m]."""
        return 0.0

    def count_dropped(self, reason: str, count: int = 1) -> None:
        """Count records that are left out for a reason."""
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count

    def settle_epochs(self) -> Epochs:
        """The epochs whose time and kind of fix are known; the others are counted."""
        filled = [epoch for epoch in self.epochs if epoch.gnss or epoch.satellites]
        known = [epoch for epoch in filled if epoch.has_fix]
        self.count_dropped("epoch without its position message", len(filled) - len(known))
        timed = [epoch for epoch in known if epoch.t_ns is not None and 0 <= epoch.t_ns <= LATEST_NS]
        self.count_dropped("time not valid", len(known) - len(timed))
        return Epochs(timed)


@frozen
class Epochs:
    """The epochs of a log, put together."""

    epochs: list[Epoch]

    @property
    def positions(self) -> int:
        """How many have a position."""
        return sum(epoch.gnss["fix"] != Fix.NONE for epoch in self.epochs)

    def streams(self) -> dict[Stream, pl.DataFrame]:
        """`gnss`, and `satellites` where any epoch has them."""
        fixes = [{"t": epoch.t_ns, "solution": "primary", **_without_unfixed(epoch.gnss)} for epoch in self.epochs]
        ranges = [{"t": epoch.t_ns, "solution": "primary", **row} for epoch in self.epochs for row in epoch.satellites]
        streams: dict[Stream, pl.DataFrame] = {"gnss": frame_of(fixes, Gnss)}
        return streams | ({"satellites": frame_of(ranges, Satellites)} if ranges else {})


def _without_unfixed(gnss: dict[str, Any]) -> dict[str, Any]:
    """The columns; without a fix those of a position are left out, whatever other messages of the epoch say."""
    return gnss if gnss["fix"] != Fix.NONE else {name: gnss.get(name) for name in ("fix", "satellites")}


def frame_of(rows: list[dict[str, Any]], schema: type[dy.Schema]) -> pl.DataFrame:
    """Rows with some of the schema's columns as a frame with all of them; `t` in nanoseconds since 1970."""
    dtypes = {name: pl.Int64() if name == "t" else column.dtype for name, column in schema.columns().items()}
    complete = [{name: row.get(name) for name in dtypes} for row in rows]
    frame = pl.DataFrame(complete, schema=dtypes, orient="row")
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def velocity_columns(east: float, north: float, up: float) -> dict[str, float]:
    """The `gnss` columns of a velocity [m/s]."""
    return {"vel_e_mps": float(east), "vel_n_mps": float(north), "vel_u_mps": float(up)}


def covariance_columns(ee: float, en: float, eu: float, nn: float, nu: float, uu: float) -> dict[str, float]:
    """The `gnss` columns of a covariance [m2]."""
    names = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
    return {name: float(value) for name, value in zip(names, (ee, en, eu, nn, nu, uu), strict=True)}


def satellite_name(system: str, number: int) -> str:
    """`G08`, `E11`, `S23`: SBAS satellites by PRN - 100, as in RINEX."""
    return f"{system}{number - 100 if system == 'S' and number >= 100 else number:02d}"
