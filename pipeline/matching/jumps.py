"""Where the positions jumped, and which tracks the train may have been on while they were somewhere else.

A receiver that was lost for a minute shows positions on other tracks, some of them within reach. The track that the
train is on all the while must stay possible, however far off, or the search could only explain the jump by another
track for the whole run.
"""

from __future__ import annotations

import numpy as np

from pipeline.matching.candidates import Candidates, Segments, candidates_of, merged
from pipeline.matching.fixes import Fixes
from pipeline.matching.steps import Steps
from pipeline.track.network import Network
from schemas.arrays import Floats, Ints
from schemas.config import MatchingConfig


def with_tracks_aside(
    found: Candidates,
    fixes: Fixes,
    believed: Ints,
    steps: Steps,
    network: Network,
    segments: Segments,
    config: MatchingConfig,
) -> Candidates:
    """About jumps, also candidates as far off as the jump was long, on elements that are candidates elsewhere."""
    aside_m = _aside_m(fixes, believed, steps, config)
    wider = np.flatnonzero(aside_m > 0)
    if len(wider) == 0:
        return found
    far = candidates_of(fixes.points.take(steps.epoch[wider]), network, segments, float(aside_m.max()) + config.reach_m)
    known = found.step * network.count + found.element
    step = wider[far.step]
    kept = (far.distance_m <= aside_m[step] + config.reach_m) & np.isin(far.element, np.unique(found.element))
    kept &= ~np.isin(step * network.count + far.element, known)
    kept &= (far.past == 0) | ~np.where(far.past < 0, far.linked_start, far.linked_end)
    return merged(found, far.take(np.flatnonzero(kept), len(wider)), wider)


def _aside_m(fixes: Fixes, believed: Ints, steps: Steps, config: MatchingConfig) -> Floats:
    """Per step the length of the longest jump about it [m], 0 where there is none."""
    usable = np.cumsum(fixes.valid)
    after = np.flatnonzero(np.diff(usable[believed]) > 1) + 1
    size = np.linalg.norm(fixes.points.surface[believed[after]] - fixes.points.surface[believed[after - 1]], axis=1)
    t_s, begin_s, end_s = fixes.t_s[steps.epoch], fixes.t_s[believed[after - 1]], fixes.t_s[believed[after]]
    first = np.searchsorted(t_s, begin_s - config.jump_aside_s)
    last = np.searchsorted(t_s, end_s + config.jump_aside_s, side="right")
    aside_m = np.zeros(len(steps))
    for one, (low, high) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        aside_m[low:high] = np.maximum(aside_m[low:high], min(float(size[one]), config.jump_aside_m))
    return aside_m
