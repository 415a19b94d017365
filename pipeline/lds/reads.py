"""Telegrams of physical balises, placed on the path: crossings of another kind."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.lds.crossings import Balise, Crossing
from pipeline.lds.journey import Journey


def reads_of(
    frame: pl.DataFrame | None, balises: list[Balise], journey: Journey
) -> tuple[list[Crossing], pl.DataFrame]:
    """Telegrams (`t, balise_id`, `odometer_m` at each) in order of time, and those of balises not on the path."""
    if frame is None:
        return [], pl.DataFrame(schema={"t": pl.Datetime("ns", "UTC"), "balise_id": pl.String})
    known = frame["balise_id"].is_in([balise.balise_id for balise in balises])
    rows = frame.filter(known).sort("t", "balise_id").with_columns(t_ns=pl.col("t").dt.epoch("ns"))
    odometer = rows["odometer_m"] if "odometer_m" in rows.columns else [None] * rows.height
    reads: list[Crossing] = []
    last: Crossing | None = None
    for t_ns, balise_id, odometer_m in zip(rows["t_ns"], rows["balise_id"], odometer, strict=True):
        places = [balise for balise in balises if balise.balise_id == balise_id]
        reads.append(_read(t_ns, places, odometer_m, journey, last))
        last = last if odometer_m is None else reads[-1]
    return reads, frame.filter(~known).select("t", "balise_id")


def _read(
    t_ns: int, places: list[Balise], odometer_m: float | None, journey: Journey, last: Crossing | None
) -> Crossing:
    """One telegram at the visit of the path that it belongs to; `last`: the one before with a known odometer."""
    epoch = min(int(np.searchsorted(journey.t_ns, t_ns)), journey.t_ns.size - 1)
    before = max(int(np.searchsorted(journey.t_ns, t_ns, side="right")) - 1, 0)
    here_m = float(np.nan_to_num(journey.path_m[epoch]))
    # Where the train is, the telegram before and the odometer tell; the position only where these do not tell it.
    before_m = None if last is None or journey.segment[last.before] != journey.segment[before] else last.odometer_m
    if last is not None and before_m is not None and odometer_m is not None:
        here_m = last.balise.path_m + odometer_m - before_m
    leg, direction = int(journey.leg[epoch]), int(journey.direction[epoch])
    since_m = float(journey.odometer_m[epoch]) - (np.nan if odometer_m is None else odometer_m)
    return Crossing(
        balise=min(places, key=lambda balise: (balise.leg != leg, abs(balise.path_m - here_m))),
        before=before,
        epoch=epoch,
        t_ns=t_ns,
        sense=direction,
        direction=direction,
        odometer_m=odometer_m,
        travelled_m=float(journey.travelled_m[epoch]) - since_m * int(journey.travel[max(epoch - 1, 0)]),
        confidence_m=None,
    )
