"""The matching stage: positions of one solution on the track network."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.matching.claims import Possible, claims, doubtful_stretches, off_stretches
from pipeline.stages.matching.epochs import Assignment, Placed, Written, matched_epochs
from pipeline.stages.matching.fixes import Fixes, digit_steps, fixes_of
from pipeline.stages.matching.path_search import find_path
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import polarity
from pipeline.stages.paths.path_set import path_set
from pipeline.stages.paths.path_steps import path_steps
from pipeline.stages.track.network import network_in_pieces
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import NS_PER_S, Ints, ints, times_ns
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import Site
from schemas.stages import MatchedEpochs


@frozen
class Match:
    """Epochs on the path, the path, when it was in doubt, and when the positions were `off` the network.

    `possible`: elements that no position refutes, in hindsight. `odometer_sign`: of the recorded odometer
    against growing path, set here and nowhere else.
    """

    epochs: MatchedEpochs
    path: TravelledPath
    ambiguous: pl.DataFrame
    off: pl.DataFrame
    possible: Possible
    odometer_sign: int


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
    rows = np.flatnonzero(arrays.valid)
    steps = path_steps(
        arrays.t_ns[rows],
        arrays.points.take(rows),
        np.sqrt(0.5 * (arrays.cov_ee_m2 + arrays.cov_nn_m2))[rows],
        way=None if odometry is None else odometry.distance_between,
        independent=odometry is not None and odometry.independent,
        pinned=_pins_of_positions(pinned, rows),
    )
    found = path_set(steps, network, config)
    path, assignment = find_path(arrays, odometry, found, config)
    placed = Placed.on(arrays, path, assignment)
    element = elements_of(arrays, path, assignment, placed)
    # The set counts from the first position, not from the first epoch.
    since_s = (arrays.t_ns - arrays.t_ns[rows[0]]) / NS_PER_S
    claimed = claims(found, since_s, element, np.sqrt(0.5 * (arrays.cov_ee_m2 + arrays.cov_nn_m2)), config)
    assignment = replace(assignment, path_probability=claimed.hindsight, gate_probability=claimed.live)
    ambiguous = doubtful_stretches(claimed, arrays.t_ns, element, pinned >= 0, network)
    written = Written(str(fixes["solution"][0]), *digit_steps(fixes, fix_sigma.digits_least_m))
    epochs = matched_epochs(arrays, written, path, assignment, placed, vehicle, config)
    sign = _odometer_sign(odometry, epochs, config)
    if sign < 0 and vehicle.gnss_antenna_ahead_m:
        # The odometer falls when reversing (CONTRACT section 1): the leading end faces against growing path, and the
        # antenna stays where it is on the train.
        vehicle = vehicle.model_copy(update={"gnss_antenna_ahead_m": -vehicle.gnss_antenna_ahead_m})
        epochs = matched_epochs(arrays, written, path, assignment, placed, vehicle, config)
    off = off_stretches(claimed, epochs, config.paths_level_s)
    return Match(epochs, path, ambiguous, off, claimed.possible, sign)


def elements_of(fixes: Fixes, path: TravelledPath, assignment: Assignment, placed: Placed) -> Ints:
    """The net element of each epoch on the path, -1 without a position."""
    element, _ = path.locate_index(assignment.leg, placed.antenna_m)
    return np.where(fixes.valid & np.isfinite(placed.antenna_m), element, -1)


def _pins_of_positions(pinned: Ints, rows: Ints) -> Ints:
    """The element of each read at the position that it belongs to: the last one not after its epoch."""
    pins = np.full(rows.size, -1, dtype=np.int64)
    read = np.flatnonzero(pinned >= 0)
    pins[np.maximum(np.searchsorted(rows, read, side="right") - 1, 0)] = pinned[read]
    return pins


def _odometer_sign(odometry: Odometry | None, epochs: MatchedEpochs, config: MatchingConfig) -> int:
    """+1 or -1: the odometer's sign against growing path (DOMAIN section 2); +1 without one."""
    if odometry is None:
        return 1
    path_m = np.where(epochs.fix_valid & epochs.on_track, epochs.path_m, np.nan)
    return polarity(odometry, epochs.t_ns, path_m, config.orientation_distance_m)


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
