"""Matching one solution to the network: the path shown, the epochs on it, and the route as a file (DOMAIN 2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import least_belief
from pipeline.stages.matching.claims import Possible, claim_tracks, doubtful_stretches, off_network_stretches
from pipeline.stages.matching.epochs import (
    Assignment,
    Fixes,
    PlacedEpochs,
    RecordedDigits,
    digit_deviations_m,
    fixes_of,
    matched_epochs,
)
from pipeline.stages.matching.least_squares import (
    LegsOfSteps,
    PathCourse,
    least_squares_course,
    legs_with_positions,
    path_states,
    polarity_of_parts,
    split_into_legs,
    step_positions_m,
    with_direction_kept,
)
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import grows_with, polarity
from pipeline.stages.paths.growth import path_set
from pipeline.stages.paths.path_set import PathSet
from pipeline.stages.paths.path_steps import Moves, PathSteps, path_steps
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import network_in_pieces
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.segments import Leg, segments_at
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, ints, times_ns
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import Site
from schemas.stages import ONE_TRACK_LEFT, MatchedEpochs


@frozen
class Match:
    """Epochs on the path, the path, stretches in which it was in doubt, and those `off` the network.

    `possible`: elements that no position refutes, in hindsight. `odometer_sign`: of the recorded odometer against
    growing path, set here and nowhere else.
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
    """Place one solution's epochs on the site's track.

    Args:
        fixes: `gnss` rows of one solution, in order of unique `t`, shape (n,).
        odometry: the odometer of the run as recorded, or None.
        site: track, links, balises and, if given, the route.
        vehicle: places of the antennas [m].
        config: the section `matching` of the configuration.
        fix_sigma: standard deviations by kind of fix, for rows without a covariance [m].
        balise_reads: telegrams received (`t`, `balise_id`), which say on which net element the train was.

    Returns:
        The epochs on the path (shape (n,)), the path, and where it was in doubt.

    Raises:
        InputError: no row has a position, or no position comes near any track.

    Source:
        DOMAIN section 2.
    """
    arrays = fixes_of(fixes, fix_sigma)
    arrays = replace(arrays, height_m=arrays.height_m - vehicle.antenna_height_m)
    if not arrays.valid.any():
        raise InputError("no epoch has a position", place="gnss", expected="latitude, longitude and a fix")
    network = network_in_pieces(site).unsearched()
    read_element = read_elements(arrays, site, network.track, balise_reads)
    rows = np.flatnonzero(arrays.valid)
    steps = path_steps(
        arrays.t_ns[rows],
        arrays.points.take(rows),
        np.sqrt(0.5 * (arrays.cov_ee_m2 + arrays.cov_nn_m2))[rows],
        distance=None if odometry is None else odometry.distance_between,
        independent=odometry is not None and odometry.independent,
        read_elements=_read_elements_of_positions(read_element, rows),
    )
    found = path_set(steps, network, config)
    path, assignment = find_path(arrays, odometry, found, config)
    placed = PlacedEpochs.on_path(arrays, path, assignment)
    element = elements_of_epochs(arrays, path, assignment, placed)
    # The set counts from the first position, not from the first epoch.
    since_s = (arrays.t_ns - arrays.t_ns[rows[0]]) / NS_PER_S
    claimed = claim_tracks(found, since_s, element, np.sqrt(0.5 * (arrays.cov_ee_m2 + arrays.cov_nn_m2)), config)
    assignment = replace(assignment, path_probability=claimed.hindsight, gate_probability=claimed.live)
    ambiguous = doubtful_stretches(claimed, arrays.t_ns, element, read_element >= 0, network)
    written = RecordedDigits(str(fixes["solution"][0]), *digit_deviations_m(fixes, fix_sigma.digits_least_m))
    epochs = matched_epochs(arrays, written, path, assignment, placed, vehicle, config)
    sign = _odometer_sign(odometry, epochs, config)
    if sign < 0 and vehicle.gnss_antenna_ahead_m:
        # The odometer falls when reversing (CONTRACT section 1): the leading end faces against growing path, and the
        # antenna stays where it is on the train.
        vehicle = vehicle.model_copy(update={"gnss_antenna_ahead_m": -vehicle.gnss_antenna_ahead_m})
        epochs = matched_epochs(arrays, written, path, assignment, placed, vehicle, config)
    off = off_network_stretches(claimed, epochs, config.paths_level_s)
    return Match(epochs, path, ambiguous, off, claimed.possible, sign)


def find_path(
    fixes: Fixes, odometry: Odometry | None, found: PathSet, config: MatchingConfig
) -> tuple[TravelledPath, Assignment]:
    """The path shown, and each epoch's leg on it.

    Args:
        fixes: positions of one solution, arrays of shape (n,).
        odometry: the odometer of the run, or None.
        found: the paths that the positions do not reject.
        config: the section `matching` of the configuration.

    Returns:
        The path of least squares, and the leg and path position of each epoch (shape (n,)).

    Raises:
        InputError: no position is near any track.

    Source:
        DOMAIN section 2, rule 8 (Viterbi 1967).
    """
    network = found.network
    if not found.candidates.step.size:
        raise off_the_network(fixes, network.track, config)
    middle = _epochs_of_steps(fixes, found.steps)
    states = path_states(found, fixes.height_m[middle], np.sqrt(fixes.cov_uu_m2[middle]), config)
    moves = Moves.without_odometer(network, found.steps, config)
    if odometry is not None:
        at_ns = found.steps.t_ns
        counted_m = (odometry.scale or 1.0) * odometry.distance_at(at_ns)
        since_m = np.full(states.step.size, np.nan)
        since_m[1:] = odometry.distance_between(at_ns[states.step[:-1]], at_ns[states.step[1:]])
        doubt_m = odometry.cumulative_doubt_m(odometry.seconds(at_ns))
        moves = Moves(network, found.steps, counted_m, doubt_m, polarity_of_parts(network, states, since_m), config)
    course = least_squares_course(states, moves)
    decoded = with_direction_kept(moves, course, split_into_legs(course, moves))
    legs = legs_with_positions(moves, course, decoded)
    at_m = step_positions_m(decoded, legs)
    if not grows_with(at_m, found.steps.t_ns[course.step], odometry, config.orientation_distance_m):
        decoded = decoded.with_legs_turned(network, range(len(decoded.chains)))
        legs = legs_with_positions(moves, course, decoded)
        at_m = step_positions_m(decoded, legs)
    return TravelledPath(network.track, tuple(legs)), _assign_epochs(fixes, found.steps, course, decoded, at_m)


def _epochs_of_steps(fixes: Fixes, steps: PathSteps) -> Ints:
    """The epoch with a position in the middle of each step."""
    rows = np.flatnonzero(fixes.valid)
    return np.asarray(rows[np.minimum(np.searchsorted(fixes.t_ns[rows], steps.t_ns), rows.size - 1)])


def _assign_epochs(
    fixes: Fixes, steps: PathSteps, course: PathCourse, decoded: LegsOfSteps, at_m: Floats
) -> Assignment:
    """Every epoch by the step that it is in, or the one before it: its place moved on towards the next step.

    Between the steps of two legs an epoch belongs to the later one.
    """
    own = np.searchsorted(steps.begin_ns, fixes.t_ns, side="right") - 1
    last = np.searchsorted(course.step, own, side="right") - 1
    following = np.clip(last + 1, 0, len(course.step) - 1)
    last = np.maximum(last, 0)
    inside = course.step[last] == own
    leg = np.where(inside, decoded.leg[last], decoded.leg[following])
    # Over a jump or an outage places are hundreds of metres apart: interpolated to tell passages apart.
    begin_ns = steps.t_ns[course.step[last]]
    span_ns = steps.t_ns[course.step[following]] - begin_ns
    share = np.clip((fixes.t_ns - begin_ns) / np.maximum(span_ns, 1), 0.0, 1.0)
    moved_m = np.where(decoded.leg[last] == decoded.leg[following], at_m[following] - at_m[last], 0.0)
    unknown = np.full(len(fixes), np.nan)
    return Assignment(leg, at_m[last] + share * moved_m, unknown, unknown)


def off_the_network(fixes: Fixes, track: SurveyedTrack, config: MatchingConfig) -> InputError:
    """The error for a run of which no epoch is within reach of any track."""
    from scipy.spatial import cKDTree

    tree = cKDTree(track.surface)
    rows = np.flatnonzero(fixes.valid)
    nearest_m, vertex = tree.query(fixes.points.surface[rows])
    row = int(np.argmin(nearest_m))
    swapped = points_of(fixes.longitude_deg[rows], fixes.latitude_deg[rows]).surface
    swapped_m, _ = tree.query(swapped)
    latitude = fixes.latitude_deg[rows[row]]
    longitude = fixes.longitude_deg[rows[row]]
    at = int(vertex[row])
    if float(np.min(swapped_m)) < min(10 * config.reach_m + 1000.0, float(nearest_m[row])):
        remedy = "Latitude and longitude are swapped, in the log or in the site: exchange them."
    elif nearest_m[row] > 10_000.0:
        remedy = "Check that this is the right site, and that track file and log name the correct coordinate system."
    elif nearest_m[row] < 500.0:
        remedy = "A national grid or datum read as WGS 84 gives such a shift: check the EPSG codes of both."
    else:
        remedy = "Check that the site covers this run; matching.reach_m is the largest accepted distance from a track."
    return InputError(
        "all positions of the run are off the track",
        place="gnss: columns latitude_deg, longitude_deg",
        found=f"positions {_length_words(float(nearest_m[row]))} or more from any track, nearest at "
        f"{latitude:.5f}, {longitude:.5f} (track at {track.latitude_deg[at]:.5f}, {track.longitude_deg[at]:.5f})",
        expected=f"positions within {config.reach_m:g} m of a net element",
        remedy=remedy,
    )


def _length_words(metres: float) -> str:
    """A length for people, in km from 10 km on."""
    return f"{metres / 1000:.0f} km" if metres >= 10_000 else f"{metres:.0f} m"


def elements_of_epochs(fixes: Fixes, path: TravelledPath, assignment: Assignment, placed: PlacedEpochs) -> Ints:
    """The net element of each epoch on the path, -1 without a position."""
    element, _ = path.locate_index(assignment.leg, placed.antenna_m)
    return np.where(fixes.valid & np.isfinite(placed.antenna_m), element, -1)


def _read_elements_of_positions(read_element: Ints, rows: Ints) -> Ints:
    """Per position the element of the balise read since, -1 for none; a read belongs to the last one before it."""
    of_position = np.full(rows.size, -1, dtype=np.int64)
    read = np.flatnonzero(read_element >= 0)
    of_position[np.maximum(np.searchsorted(rows, read, side="right") - 1, 0)] = read_element[read]
    return of_position


def _odometer_sign(odometry: Odometry | None, epochs: MatchedEpochs, config: MatchingConfig) -> int:
    """The odometer's sign against growing path (DOMAIN section 2): +1 or -1, +1 without an odometer."""
    if odometry is None:
        return 1
    path_m = np.where(epochs.fix_valid & epochs.on_track, epochs.path_m, np.nan)
    return polarity(odometry, epochs.t_ns, path_m, config.orientation_distance_m)


def read_elements(fixes: Fixes, site: Site, track: SurveyedTrack, balise_reads: pl.DataFrame | None) -> Ints:
    """Element of the balise read at each epoch (the first not before the read), else -1."""
    read_element = np.full(len(fixes), -1, dtype=np.int64)
    if balise_reads is None or site.balises is None:
        return read_element
    # Of an element that is passed twice, or about a cut, a read does not say which it was.
    rows, elements = track.elements_holding(site.balises)
    alone = np.flatnonzero(np.bincount(rows)[rows] == 1)
    places = site.balises[rows[alone]].select("balise_id", element=elements[alone])
    read = balise_reads.select("t", "balise_id").join(places, on="balise_id", maintain_order="left")
    epoch = np.searchsorted(fixes.t_ns, times_ns(read))
    inside = epoch < len(fixes)
    read_element[epoch[inside]] = ints(read["element"])[inside]
    return read_element


ROUTE_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "netelement_id": pl.String,
    "direction": pl.String,
    "leg": pl.Int64,
    "doubtful": pl.Boolean,
    "gate_probability": pl.Float64,
    "path_probability": pl.Float64,
    "rivals": pl.String,
    "cross_bias_m": pl.Float64,
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
}


def travelled_route(match: Match) -> pl.DataFrame:
    """One row per net element in the order of growing path, leg by leg: the route, and what of it is in doubt.

    `doubtful`: the track was, at the time or in hindsight (the least probabilities of both stand next to it), or no
    position tells of it. `rivals`: other elements possible meanwhile, the most probable first, each with its highest
    probability, in words. `cross_bias_m`: by how much the positions lie left of growing path there (median), which
    survey and antenna do and no GNSS fault.
    """
    leg = match.epochs.leg
    rows = [
        _route_row(match, number, one, visits, leg == number)
        for number, one in enumerate(match.path.legs)
        for visits in _visits_by_passage(match.path.track, one)
    ]
    return pl.DataFrame(rows, schema=ROUTE_COLUMNS, orient="row")


def _visits_by_passage(track: SurveyedTrack, leg: Leg) -> list[list[int]]:
    """Numbers of the visits of each passage of an element: its pieces, one after the other.

    Each circuit of a ring is another passage.
    """
    passages: list[list[int]] = []
    ended: object = None
    for number, visit in enumerate(leg.visits):
        measure = track.measure_m[track.vertex_range(visit.element)]
        begin, end = (measure[0], measure[-1]) if visit.forward else (measure[-1], measure[0])
        if passages and ended == (track.ids[visit.element], visit.forward, begin):
            passages[-1].append(number)
        else:
            passages.append([number])
        ended = (track.ids[visit.element], visit.forward, end)
    return passages


def _route_row(match: Match, number: int, leg: Leg, visits: list[int], on_leg: Bools) -> tuple[object, ...]:
    """One row of `ROUTE_COLUMNS`: a passage of a net element on the leg of this number."""
    path_m = match.epochs.path_m
    segment, _ = segments_at(leg, np.nan_to_num(path_m))
    known = np.isfinite(match.epochs.path_probability)
    inside = np.flatnonzero(on_leg & np.isin(leg.visit[segment], visits) & known)
    epochs = match.epochs.table[inside]
    least = epochs.select(least_belief().min()).item()
    first_visit = leg.visits[visits[0]]
    times = match.epochs.table["t"]
    return (
        match.path.track.ids[first_visit.element],
        "AB" if first_visit.forward else "BA",
        number,
        least is None or least < ONE_TRACK_LEFT,
        epochs["gate_probability"].min(),
        epochs["path_probability"].min(),
        _rival_words(match, inside, 1.0 - ONE_TRACK_LEFT),
        float(np.median(match.epochs.cross_track_m[inside])) if len(inside) else None,
        times[int(inside[0])] if len(inside) else None,
        times[int(inside[-1])] if len(inside) else None,
    )


def _rival_words(match: Match, rows: Ints, least: float) -> str:
    """Elements off the path that were possible at some of these epochs, with their probability, in words."""
    if len(rows) == 0:
        return ""
    highest = _highest_confidences(match.possible, int(rows[0]), int(rows[-1]))
    ids = match.path.track.ids
    on_path = set(match.path.element_names())
    order = sorted((-probability, ids[element]) for element, probability in highest.items())
    return "; ".join(f"{name} {-value:.3f}" for value, name in order if -value > least and name not in on_path)


def _highest_confidences(possible: Possible, first: int, last: int) -> dict[int, float]:
    """The highest confidence in each element at the steps from one epoch to another."""
    begin, end = np.searchsorted(possible.epoch, [first, last + 1])
    part = slice(int(possible.first[max(int(begin) - 1, 0)]), int(possible.first[int(end)]))
    found = pl.DataFrame({"element": possible.element[part], "probability": possible.confidence[part]})
    return dict(found.group_by("element").agg(pl.col("probability").max()).iter_rows())
