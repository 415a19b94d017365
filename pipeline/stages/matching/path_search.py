"""Finding the path on a network: hidden Markov model over net elements (Newson & Krumm 2009)."""

from __future__ import annotations

import numpy as np

from pipeline.stages.matching.decode import Decoded, aligned, decode, legs_of, positions_m
from pipeline.stages.matching.epochs import Assignment
from pipeline.stages.matching.fixes import Fixes
from pipeline.stages.matching.likelihood import likelihood_of
from pipeline.stages.matching.search import search
from pipeline.stages.matching.steps import Steps, Travelled, believable, spaced, steps_of, travelled
from pipeline.stages.matching.trellis import Trellis, trellis_of
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import grows_with
from pipeline.stages.paths.candidates import Candidates, Search, candidates_of, merged, overtaken, search_about
from pipeline.stages.paths.path_set import PathSet
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.errors import InputError

# Numerics: positions closer to a track than this share of the reach are not looked for any farther.
_NEAR = 0.2


def find_path(
    fixes: Fixes,
    odometry: Odometry | None,
    network: Network,
    pinned: Ints,
    found: PathSet,
    config: MatchingConfig,
) -> tuple[TravelledPath, Assignment]:
    """The path shown, the likeliest of those of the set, and each epoch's leg on it.

    `pinned` holds per epoch the element of a balise read then, -1 without one.
    """
    way = travelled(fixes, odometry)
    believed = believable(fixes, fixes.valid, way, config)
    trellis = _trellis(fixes, believed, way, network, pinned, found, config)
    beliefs = search(trellis)
    decoded = aligned(trellis, decode(trellis, beliefs.best))
    legs = legs_of(trellis, decoded)
    at_m = positions_m(decoded, legs)
    if not grows_with(at_m, fixes.t_ns[trellis.steps.epoch], odometry, config.orientation_distance_m):
        decoded = decoded.turned(network, range(len(decoded.chains)))
        legs = legs_of(trellis, decoded)
        at_m = positions_m(decoded, legs)
    return TravelledPath(network.track, tuple(legs)), _assign(fixes, trellis.steps, decoded, at_m)


def _trellis(
    fixes: Fixes,
    believed: Ints,
    way: Travelled,
    network: Network,
    pinned: Ints,
    found: PathSet,
    config: MatchingConfig,
) -> Trellis:
    """Steps among the believed epochs with their candidates; steps without any are left out.

    Between epochs near a track, epochs further off count too: a position that drifts away slowly still shows
    by its movement which way the train turned.
    """
    rows = spaced(fixes, believed, config)
    farthest_m = max(config.far_reach_factor * config.reach_m, config.jump_aside_m + config.reach_m)
    where = search_about(fixes.points.surface[fixes.valid], network, farthest_m)
    wide = _candidates(fixes, rows, network, where, config)
    nearest = np.full(len(rows), np.inf)
    np.minimum.at(nearest, wide.step, wide.distance_m)
    near = np.flatnonzero(nearest <= config.reach_m)
    if len(near) == 0:
        raise off_the_network(fixes, network.track, config)
    judged = nearest <= (config.far_reach_factor - 1.0) * config.reach_m
    judged[: near[0]] = judged[near[-1] + 1 :] = False
    # A track much further off than the nearest is none of several possible ones; one just out of reach is.
    kept = judged[wide.step] & (wide.distance_m <= nearest[wide.step] + config.reach_m)
    candidates = wide.take(np.flatnonzero(kept), len(rows)).renumbered(judged)
    steps = steps_of(fixes, rows[judged], way)
    candidates = with_tracks_aside(candidates, fixes, believed, steps, network, where, config)
    survey_sigma_m = network.survey_sigmas_m(config.survey_sigma_default_m, candidates.vertex)
    like = likelihood_of(fixes, steps, candidates, survey_sigma_m, config)
    like = like.with_pins(_pins(steps, pinned, candidates) | _refuted(fixes, steps, candidates, found))
    return trellis_of(network, steps, candidates, survey_sigma_m, like, config)


def _candidates(fixes: Fixes, rows: Ints, network: Network, where: Search, config: MatchingConfig) -> Candidates:
    """Places within reach; within far reach where no track is near."""
    points = fixes.points.take(rows)
    candidates = candidates_of(points, network, where, (1.0 + _NEAR) * config.reach_m)
    nearest_m = np.full(len(rows), np.inf)
    np.minimum.at(nearest_m, candidates.step, candidates.distance_m)
    far = np.flatnonzero(nearest_m > _NEAR * config.reach_m)
    if len(far):
        wide = candidates_of(points.take(far), network, where, config.far_reach_factor * config.reach_m)
        near = candidates.take(np.flatnonzero(nearest_m[candidates.step] <= _NEAR * config.reach_m), len(rows))
        candidates = merged(near, wide, far)
    return candidates.take(np.flatnonzero(~overtaken(candidates, network)), len(rows))


def _pins(steps: Steps, pinned: Ints, candidates: Candidates) -> Bools:
    """Candidates on another element than that of a balise read at their step."""
    # A read counts at the first step not before it, at the last step if there is none.
    index = np.searchsorted(steps.epoch, np.flatnonzero(pinned >= 0))
    proved_at = np.full(len(steps), -1, dtype=np.int64)
    proved_at[np.minimum(index, len(steps) - 1)] = pinned[pinned >= 0]
    proved = proved_at[candidates.step]
    return np.asarray((proved >= 0) & (candidates.element != proved))


def _refuted(fixes: Fixes, steps: Steps, candidates: Candidates, found: PathSet) -> Bools:
    """Candidates on an element that the whole run refutes; none where every path is refuted."""
    count = len(found.steps)
    elements = found.network.count
    spans = [(node.element, max(begin - 1, 0), min(end + 1, count)) for node, begin, end in found.to_the_end()]
    keys = [np.arange(begin, end) * elements + element for element, begin, end in spans]
    possible = np.unique(np.concatenate([*keys, np.zeros(0, dtype=np.int64)]))
    known = np.zeros(count, dtype=np.bool_)
    for _, begin, end in found.to_the_end():
        known[begin:end] = True
    at = np.minimum(np.searchsorted(found.steps.end_s, fixes.t_s[steps.epoch], side="left"), count - 1)
    step = at[candidates.step]
    return np.asarray(known[step] & ~np.isin(step * elements + candidates.element, possible))


def _assign(fixes: Fixes, steps: Steps, decoded: Decoded, at_m: Floats) -> Assignment:
    """Every epoch by the step before it: its place moved on towards the next step.

    Between the steps of two legs an epoch belongs to the later one.
    """
    last = np.searchsorted(steps.epoch, np.arange(len(fixes)), side="right") - 1
    following = np.clip(last + 1, 0, len(steps) - 1)
    exact = np.zeros(len(fixes), dtype=bool)
    exact[steps.epoch] = True
    last = np.maximum(last, 0)
    leg = np.where(exact, decoded.leg[last], decoded.leg[following])
    # During a jump that is not believed, steps are hundreds of metres apart: interpolated to tell passages apart.
    begin_s = fixes.t_s[steps.epoch[last]]
    end_s = fixes.t_s[steps.epoch[following]]
    elapsed = np.clip(fixes.t_s - begin_s, 0.0, np.maximum(end_s - begin_s, 0.0))
    share = np.divide(elapsed, end_s - begin_s, out=np.zeros(len(fixes)), where=end_s > begin_s)
    moved_m = np.where(decoded.leg[last] == decoded.leg[following], at_m[following] - at_m[last], 0.0)
    unknown = np.full(len(fixes), np.nan)
    return Assignment(leg, at_m[last] + share * moved_m, unknown, unknown)


def with_tracks_aside(
    candidates: Candidates,
    fixes: Fixes,
    believed: Ints,
    steps: Steps,
    network: Network,
    where: Search,
    config: MatchingConfig,
) -> Candidates:
    """About jumps, also candidates as far off as the jump was long, on elements that are candidates elsewhere.

    A receiver that was lost for a minute shows positions on other tracks, some of them within reach. The track that the
    train is on all the while must stay possible, however far off, or the search could only explain the jump by another
    track for the whole run.
    """
    aside_m = _aside_m(fixes, believed, steps, config)
    wider = np.flatnonzero(aside_m > 0)
    if len(wider) == 0:
        return candidates
    far = candidates_of(fixes.points.take(steps.epoch[wider]), network, where, float(aside_m.max()) + config.reach_m)
    known = candidates.step * network.count + candidates.element
    step = wider[far.step]
    kept = (far.distance_m <= aside_m[step] + config.reach_m) & np.isin(far.element, np.unique(candidates.element))
    kept &= ~np.isin(step * network.count + far.element, known)
    kept &= (far.past == 0) | ~np.where(far.past < 0, far.linked_start, far.linked_end)
    return merged(candidates, far.take(np.flatnonzero(kept), len(wider)), wider)


def _aside_m(fixes: Fixes, believed: Ints, steps: Steps, config: MatchingConfig) -> Floats:
    """Per step the length of the longest jump about it [m], 0 where there is none."""
    usable = np.cumsum(fixes.valid)
    after = np.flatnonzero(np.diff(usable[believed]) > 1) + 1
    size = np.linalg.norm(fixes.points.surface[believed[after]] - fixes.points.surface[believed[after - 1]], axis=1)
    t_s = fixes.t_s[steps.epoch]
    begin_s = fixes.t_s[believed[after - 1]]
    end_s = fixes.t_s[believed[after]]
    first = np.searchsorted(t_s, begin_s - config.jump_aside_s)
    last = np.searchsorted(t_s, end_s + config.jump_aside_s, side="right")
    aside_m = np.zeros(len(steps))
    for jump, (low, high) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        aside_m[low:high] = np.maximum(aside_m[low:high], min(float(size[jump]), config.jump_aside_m))
    return aside_m


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
