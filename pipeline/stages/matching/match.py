"""The matching stage: positions of one solution on the track network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.stages.matching.doubt import Posterior, rivals_of
from pipeline.stages.matching.epochs import epoch_frame
from pipeline.stages.matching.fixes import Fixes, digit_noise, fixes_of
from pipeline.stages.matching.path_search import find_path
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import polarity
from pipeline.stages.track.network import network_in_pieces
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Ints, floats, ints, times_ns
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.errors import InputError
from schemas.run import Site


@dataclass(frozen=True)
class Match:
    """Epochs on the path, the path, and when it was in doubt.

    `posterior`: elements that are possible at the steps of the search. `odometer_sign`: of the recorded odometer
    against growing path, set here and nowhere else.
    """

    epochs: pl.DataFrame
    path: TravelledPath
    ambiguous: pl.DataFrame
    posterior: Posterior
    odometer_sign: int

    def rivals(self, limit: float, index: dict[str, int]) -> tuple[Ints, Ints]:
        """Epochs and net elements (numbers by `index`) whose posterior reaches `limit` there, the path's own too."""
        return rivals_of(self.posterior, self.epochs, self.path, index, limit)


def match(
    fixes: pl.DataFrame,
    odometry: Odometry | None,
    site: Site,
    vehicle: Vehicle,
    config: MatchingConfig,
    fix_sigma: FixSigma,
    balise_reads: pl.DataFrame | None = None,
) -> Match:
    """Place one solution's epochs (ordered, unique `t`) on the site's track.

    `odometry`: of the run, as recorded, or none. Raises `InputError` where no
    epoch comes near any track.
    """
    arrays = fixes_of(fixes, fix_sigma)
    arrays = replace(arrays, height_m=arrays.height_m - vehicle.antenna_height_m)
    if not arrays.valid.any():
        raise InputError("no epoch has a position", place="gnss", expected="latitude, longitude and a fix")
    network = network_in_pieces(site).unsearched()
    pinned = pins_of(arrays, site, network.track, balise_reads)
    path, assignment, ambiguous, posterior = find_path(arrays, odometry, network, pinned, config)
    epochs = epoch_frame(arrays, fixes["solution"], path, assignment, vehicle, config)
    sign = _odometer_sign(odometry, epochs, config)
    if sign < 0 and vehicle.gnss_antenna_ahead_m:
        # The odometer falls when reversing (CONTRACT section 1): the leading end faces against growing path, and the
        # antenna stays where it is on the train.
        vehicle = vehicle.model_copy(update={"gnss_antenna_ahead_m": -vehicle.gnss_antenna_ahead_m})
        epochs = epoch_frame(arrays, fixes["solution"], path, assignment, vehicle, config)
    epochs = epochs.with_columns(digit_noise(fixes, floats(epochs, "heading_deg"), config.digits_least_m))
    return Match(epochs, path, ambiguous, posterior, sign)


def _odometer_sign(odometry: Odometry | None, epochs: pl.DataFrame, config: MatchingConfig) -> int:
    """+1 or -1: the odometer's sign against growing path (DOMAIN section 2); +1 without one."""
    if odometry is None:
        return 1
    matched = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy()
    path_m = np.where(matched, floats(epochs, "path_m"), np.nan)
    return polarity(odometry, times_ns(epochs), path_m, config.orientation_distance_m)


def pins_of(fixes: Fixes, site: Site, track: SurveyedTrack, balise_reads: pl.DataFrame | None) -> Ints:
    """Per epoch the element of the balise read then (at the first epoch not before the read), else -1."""
    pinned = np.full(len(fixes), -1, dtype=np.int64)
    if balise_reads is None or site.balises is None:
        return pinned
    # Of an element that is passed twice, or about a cut, a read does not say which it was.
    rows, elements = track.holding(site.balises)
    alone = np.flatnonzero(np.bincount(rows)[rows] == 1)
    places = site.balises[rows[alone]].select("balise_id", element=elements[alone])
    read = balise_reads.select("t", "balise_id").join(places, on="balise_id", maintain_order="left")
    epoch = np.searchsorted(fixes.t_ns, times_ns(read))
    inside = epoch < len(fixes)
    pinned[epoch[inside]] = ints(read["element"])[inside]
    return pinned
