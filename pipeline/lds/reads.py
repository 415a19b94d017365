"""Telegrams of physical balises, placed on the path: crossings of another kind."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.lds.crossings import Balise, Crossing
from pipeline.lds.journey import Journey


class _Place(NamedTuple):
    """Where the train is by its last telegram."""

    path_m: float
    odometer_m: float
    segment: int


def reads_of(
    frame: pl.DataFrame | None, balises: list[Balise], journey: Journey
) -> tuple[list[Crossing], pl.DataFrame]:
    """Telegrams (`t, balise_id`, optionally `odometer_m`) in order of time, and those of balises not on the path."""
    if frame is None:
        return [], pl.DataFrame(schema={"t": pl.Datetime("ns", "UTC"), "balise_id": pl.String})
    known = frame["balise_id"].is_in([balise.balise_id for balise in balises])
    placing = _Placing(balises, journey)
    rows = frame.filter(known).sort("t", "balise_id").with_columns(t_ns=pl.col("t").dt.epoch("ns"))
    given = rows["odometer_m"] if "odometer_m" in rows.columns else [None] * rows.height
    reads = [placing.read(*row) for row in zip(rows["t_ns"], rows["balise_id"], given, strict=True)]
    return reads, frame.filter(~known).select("t", "balise_id")


class _Placing:
    """Telegrams one after the other, each at the visit of the path that it belongs to."""

    def __init__(self, balises: list[Balise], journey: Journey) -> None:
        self._balises, self._journey = balises, journey
        self._last: _Place | None = None

    def read(self, t_ns: int, balise_id: str, given_m: float | None) -> Crossing:
        """`given_m`: odometer at the telegram [m]; where it is not given, that between the epochs around."""
        journey = self._journey
        epoch = min(int(np.searchsorted(journey.t_ns, t_ns)), journey.t_ns.size - 1)
        before = max(int(np.searchsorted(journey.t_ns, t_ns, side="right")) - 1, 0)
        odometer_m = _odometer_at(journey, t_ns, epoch) if given_m is None else given_m
        balise = self._visited(balise_id, epoch, before, odometer_m)
        if odometer_m is not None:
            self._last = _Place(balise.path_m, odometer_m, int(journey.segment[before]))
        since_m = float(journey.odometer_m[epoch]) - (np.nan if odometer_m is None else odometer_m)
        direction = int(journey.direction[epoch])
        return Crossing(
            balise=balise,
            before=before,
            epoch=epoch,
            t_ns=t_ns,
            sense=direction,
            direction=direction,
            odometer_m=odometer_m,
            travelled_m=float(journey.travelled_m[epoch]) - since_m * int(journey.travel[max(epoch - 1, 0)]),
            confidence_m=None,
        )

    def _visited(self, balise_id: str, epoch: int, before: int, odometer_m: float | None) -> Balise:
        """Of a balise with several places the one on the train's leg, next to where the train is.

        That is told by the telegram before and the odometer, by the position only where these do not tell it.
        """
        places = [balise for balise in self._balises if balise.balise_id == balise_id]
        if len(places) == 1:
            return places[0]
        last, journey = self._last, self._journey
        here_m = float(np.nan_to_num(journey.path_m[epoch]))
        if last is not None and odometer_m is not None and last.segment == journey.segment[before]:
            here_m = last.path_m + odometer_m - last.odometer_m
        leg = int(journey.leg[epoch])
        return min(places, key=lambda balise: (balise.leg != leg, abs(balise.path_m - here_m)))


def _odometer_at(journey: Journey, t_ns: int, epoch: int) -> float | None:
    """Odometer between the two epochs around a time [m]; None where they are too far apart."""
    before = max(epoch - 1, 0)
    t_0, t_1 = int(journey.t_ns[before]), int(journey.t_ns[epoch])
    if not (t_0 <= t_ns <= t_1 and t_1 - t_0 <= journey.gap_ns):
        return None
    ends_m = journey.odometer_m[[before, epoch]]
    if not np.isfinite(ends_m).all():
        return None
    return float(np.interp(t_ns - t_0, [0, max(t_1 - t_0, 1)], ends_m))
