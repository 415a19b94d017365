"""Finding the path shown: the one of the set with the least sum of squared residuals (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np

from pipeline.stages.matching.decode import Decoded, aligned, decode, legs_of, positions_m
from pipeline.stages.matching.epochs import Assignment
from pipeline.stages.matching.fixes import Fixes
from pipeline.stages.matching.least_squares import Course, least_squares
from pipeline.stages.matching.path_states import path_states, polarity_of_parts
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import grows_with
from pipeline.stages.paths.moves import Moves
from pipeline.stages.paths.path_set import PathSet
from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Floats, Ints
from schemas.config import MatchingConfig
from schemas.errors import InputError


def find_path(
    fixes: Fixes, odometry: Odometry | None, found: PathSet, config: MatchingConfig
) -> tuple[TravelledPath, Assignment]:
    """The path shown, and each epoch's leg on it. Raises `InputError` where no position is near any track."""
    network = found.network
    if not found.candidates.step.size:
        raise off_the_network(fixes, network.track, config)
    middle = _middle_rows(fixes, found.steps)
    states = path_states(found, fixes.height_m[middle], np.sqrt(fixes.cov_uu_m2[middle]), config)
    moves = Moves.without_odometer(network, found.steps, config)
    if odometry is not None:
        at_ns = found.steps.t_ns
        counted_m = (odometry.scale or 1.0) * odometry.distance_at(at_ns)
        since_m = np.full(states.step.size, np.nan)
        since_m[1:] = odometry.distance_between(at_ns[states.step[:-1]], at_ns[states.step[1:]])
        doubt_m = odometry.doubt_at_s(odometry.seconds(at_ns))
        moves = Moves(network, found.steps, counted_m, doubt_m, polarity_of_parts(network, states, since_m), config)
    course = least_squares(states, moves)
    decoded = aligned(moves, course, decode(course, moves))
    legs = legs_of(moves, course, decoded)
    at_m = positions_m(decoded, legs)
    if not grows_with(at_m, found.steps.t_ns[course.step], odometry, config.orientation_distance_m):
        decoded = decoded.turned(network, range(len(decoded.chains)))
        legs = legs_of(moves, course, decoded)
        at_m = positions_m(decoded, legs)
    return TravelledPath(network.track, tuple(legs)), _assign(fixes, found.steps, course, decoded, at_m)


def _middle_rows(fixes: Fixes, steps: PathSteps) -> Ints:
    """The epoch with a position in the middle of each step."""
    rows = np.flatnonzero(fixes.valid)
    return np.asarray(rows[np.minimum(np.searchsorted(fixes.t_ns[rows], steps.t_ns), rows.size - 1)])


def _assign(fixes: Fixes, steps: PathSteps, course: Course, decoded: Decoded, at_m: Floats) -> Assignment:
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
        found=f"positions {_length(float(nearest_m[row]))} or more from any track, nearest at "
        f"{latitude:.5f}, {longitude:.5f} (track at {track.latitude_deg[at]:.5f}, {track.longitude_deg[at]:.5f})",
        expected=f"positions within {config.reach_m:g} m of a net element",
        remedy=remedy,
    )


def _length(metres: float) -> str:
    return f"{metres / 1000:.0f} km" if metres >= 10_000 else f"{metres:.0f} m"
