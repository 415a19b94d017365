"""Where the figures of an odometer come from, as declared (DOMAIN section 5.0)."""

from __future__ import annotations

import polars as pl

from schemas.config import Vehicle
from schemas.enums import Origin

_WORST_LAST = (Origin.WHEEL, Origin.RADAR, Origin.INERTIAL, Origin.UNKNOWN, Origin.FUSED, Origin.GNSS)


def declared_origin(stream: pl.DataFrame, vehicle: Vehicle) -> Origin:
    """What the rows of one sensor say, for those that say nothing the vehicle file.

    Of rows that say different things the origin that proves least: GNSS before a filter before unknown.
    """
    told = stream["origin"].cast(pl.String).unique().to_list() if "origin" in stream.columns else [None]
    unsaid = vehicle.odometer_origin or Origin.UNKNOWN
    origins = {unsaid if name in (None, Origin.UNKNOWN.value) else Origin(name) for name in told}
    return max(origins, key=_WORST_LAST.index, default=unsaid)
