"""Why a run does not lie on its site, said in a way that can be acted on."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.matching.fixes import Fixes
from pipeline.track.geodesy import points_of
from pipeline.track.survey import Track
from schemas.config import MatchingConfig
from schemas.errors import InputError


def off_the_network(fixes: Fixes, track: Track, config: MatchingConfig) -> InputError:
    """The error for a run of which no epoch is within reach of any track."""
    tree = cKDTree(points_of(track.latitude_deg, track.longitude_deg).surface)
    rows = np.flatnonzero(fixes.valid)
    nearest_m, vertex = tree.query(fixes.points.surface[rows])
    row = int(np.argmin(nearest_m))
    swapped = points_of(fixes.longitude_deg[rows], fixes.latitude_deg[rows]).surface
    swapped_m, _ = tree.query(swapped)
    latitude, longitude = fixes.latitude_deg[rows[row]], fixes.longitude_deg[rows[row]]
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
