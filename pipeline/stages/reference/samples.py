"""The samples of a reference, and the nearest place of each on every net element within reach."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.paths.candidates import Candidates, Search, candidates_of, search_about, segments_of
from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.network import Network
from pipeline.stages.track.segments import box_about
from schemas.arrays import Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration
from schemas.frozen import frozen


@frozen
class Samples:
    """`sigma_m` of each; `near`: places by sample, `survey_m` the survey's sigma at each of these, `root_m` of both.

    `search`: where all that may be near the run is looked for.
    """

    t_ns: Ints
    points: Points
    sigma_m: Floats
    near: Candidates
    survey_m: Floats
    search: Search

    @property
    def root_m(self) -> Floats:
        return np.hypot(self.sigma_m[self.near.step], self.survey_m)

    def placed(self, factor: float) -> Bools:
        """Samples with an element within `factor` roots."""
        placed = np.zeros(self.t_ns.size, dtype=np.bool_)
        placed[self.near.step[self.near.distance_m <= factor * self.root_m]] = True
        return placed


def samples_of(reference: pl.DataFrame, network: Network, config: Configuration) -> Samples:
    """Of a reference stream; places twice as far off as any that can be a sample's."""
    hazards = config.hazards
    sigma_m = reference["sigma_m"].fill_null(hazards.reference_sigma_m).to_numpy()
    points = points_of(floats(reference, "latitude_deg"), floats(reference, "longitude_deg"))
    factor = 2.0 * config.align.sure_sigmas
    # Long chords are far off their curves: only those count that the run may be near.
    most_m = float(np.hypot(sigma_m, network.most_survey_sigma_m(hazards.survey_sigma_m)).max())
    segments = segments_of(network.track)
    box = box_about(points.surface, factor * most_m)
    vertex = segments.vertex[box.touched_by(segments.start, segments.end)]
    survey_m = network.survey_sigmas_m(hazards.survey_sigma_m, vertex).max(initial=hazards.survey_sigma_m)
    reach_m = factor * float(np.hypot(sigma_m, survey_m).max())
    search = search_about(points.surface, network, max(reach_m, config.matching.reach_m))
    near = candidates_of(points, network, search, reach_m)
    near_survey_m = network.survey_sigmas_m(hazards.survey_sigma_m, near.vertex)
    return Samples(times_ns(reference), points, sigma_m, near, near_survey_m, search)
