"""Telegrams of physical balises, placed on the journey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.lds.crossings import Balise
from pipeline.lds.journey import Journey

NO_STRETCH = -1


@dataclass(frozen=True, slots=True)
class Read:
    """A telegram; `epoch`: the first GNSS epoch not before it; distances at the read, where known.

    `stretch`: that of the odometer reading, which is the one of the epoch before; `NO_STRETCH` where the distance was
    lost between the epochs that it was interpolated from.
    """

    balise: Balise
    t_ns: int
    epoch: int
    odometer_m: float | None
    travelled_m: float
    stretch: int


def reads_of(frame: pl.DataFrame | None, balises: list[Balise], journey: Journey) -> tuple[list[Read], pl.DataFrame]:
    """Telegrams in order of time, and those of balises that are not on the path.

    A balise with several places on the path is read at the given `leg` and `path_m`, else on the leg that the
    train is on.
    """
    if frame is None:
        return [], pl.DataFrame(schema={"t": pl.Datetime("ns", "UTC"), "balise_id": pl.String})
    known = frame["balise_id"].is_in([balise.balise_id for balise in balises])
    rows = frame.filter(known).sort("t", "balise_id").with_columns(t_ns=pl.col("t").dt.epoch("ns"))
    reads = [_read(row, balises, journey) for row in rows.iter_rows(named=True)]
    return reads, frame.filter(~known).select("t", "balise_id")


def _read(row: dict[str, object], balises: list[Balise], journey: Journey) -> Read:
    t_ns, name = int(str(row["t_ns"])), row["balise_id"]
    epoch = min(int(np.searchsorted(journey.t_ns, t_ns)), journey.t_ns.size - 1)
    named = [balise for balise in balises if balise.balise_id == name]
    leg, path_m = row.get("leg"), row.get("path_m")
    if leg is None or path_m is None:
        balise = next((here for here in named if here.leg == journey.leg[epoch]), named[0])
    else:
        balise = next(here for here in named if (here.leg, here.path_m) == (leg, path_m))
    given = row.get("odometer_m")
    odometer_m = float(str(given)) if given is not None else _odometer_at(journey, t_ns, epoch)
    since_m = journey.odometer_m[epoch] - (np.nan if odometer_m is None else odometer_m)
    travelled_m = float(journey.travelled_m[epoch] - since_m * journey.travel[max(epoch - 1, 0)])
    before = max(int(np.searchsorted(journey.t_ns, t_ns, side="right")) - 1, 0)
    whole = given is not None or journey.stretch[before] == journey.stretch[epoch]
    return Read(
        balise, t_ns, epoch, odometer_m, travelled_m, stretch=int(journey.stretch[before]) if whole else NO_STRETCH
    )


def _odometer_at(journey: Journey, t_ns: int, epoch: int) -> float | None:
    """Odometer between the two epochs around a time, `None` where they are too far apart."""
    before = max(epoch - 1, 0)
    t_0, t_1 = int(journey.t_ns[before]), int(journey.t_ns[epoch])
    if not (t_0 <= t_ns <= t_1 and t_1 - t_0 <= journey.gap_ns):
        return None
    ends_m = journey.odometer_m[[before, epoch]]
    if not np.isfinite(ends_m).all():
        return None
    return float(np.interp(t_ns - t_0, [0, max(t_1 - t_0, 1)], ends_m))
