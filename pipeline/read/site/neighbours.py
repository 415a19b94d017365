"""Which neighbouring tracks positions can tell apart at the survey's stated sigma, and where (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.read.site.alike import neighbouring_tracks, track_resolution
from pipeline.stages.track.network import network_of, surveyed_track
from schemas.arrays import Floats
from schemas.config import Configuration
from schemas.run import Site

_RESOLVED_BY = ("nothing but a route or a read", "a switch taken", "the offset")
_COLUMNS: dict[str, type[pl.DataType]] = {
    "netelement_id": pl.String,
    "from_m": pl.Float64,
    "to_m": pl.Float64,
    "neighbour_id": pl.String,
    "apart_m": pl.Float64,
    "survey_sigma_m": pl.Float64,
    "told_apart_by": pl.String,
    "offset_tells_from_m": pl.Float64,
    "switch_tells_from_m": pl.Float64,
}
# Tracks farther apart are distinguished by any receiver whose accuracy is of use here [m].
_NEIGHBOUR_M = 10.0
# Distances are medians over so many places: surveys scatter about a limit.
_PLACES = 5


def neighbour_table(site: Site, config: Configuration) -> pl.DataFrame:
    """One row per pair of net elements and stretch of at least `parallel_least_m`; measures are those of the first.

    With exact positions: a receiver's own sigma comes on top of the survey's. Empty where a route is given.
    """
    if site.route is not None:
        return pl.DataFrame(schema=_COLUMNS)
    network = network_of(surveyed_track(site), site.links)
    ids = network.track.ids
    resolution = track_resolution(network.track, config.matching)
    limit_m = np.fmax(_NEIGHBOUR_M, np.fmax(resolution.by_offset_m, resolution.by_switch_m))
    rows = []
    for part in neighbouring_tracks(network, limit_m, config.matching).parts():
        one, other = divmod(int(part.pair[0]), network.count)
        apart_m = _smooth(part.apart_m)
        offset_m, switch_m = float(resolution.by_offset_m[one]), float(resolution.by_switch_m[one])
        kind = np.where(apart_m >= offset_m, 2, np.where(apart_m >= switch_m, 1, 0))
        for stretch in np.split(np.arange(kind.size), np.flatnonzero(np.diff(kind)) + 1):
            ends_m = float(part.measure_m[stretch[0]]), float(part.measure_m[stretch[-1]])
            if ends_m[1] - ends_m[0] >= config.site.parallel_least_m:
                apart = float(np.median(part.apart_m[stretch]))
                by = _RESOLVED_BY[int(kind[stretch[0]])]
                rows.append(
                    (ids[one], *ends_m, ids[other], apart, float(resolution.survey_m[one]), by, offset_m, switch_m)
                )
    return pl.DataFrame(rows, schema=_COLUMNS, orient="row")


def _smooth(apart_m: Floats) -> Floats:
    """Distances, smoothed by a running median."""
    if apart_m.size < _PLACES:
        return apart_m
    padded = np.pad(apart_m, _PLACES // 2, mode="edge")
    return np.asarray(np.median(sliding_window_view(padded, _PLACES), axis=1))
