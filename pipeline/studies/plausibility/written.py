"""Whether positions are written as WGS 84 latitude and longitude in degrees, and if not, whose are not."""

from __future__ import annotations

import numpy as np

from pipeline.stages.track.geodesy import points_of
from pipeline.studies.plausibility.causes import COORDINATE_MISTAKES, CoordinateMistake
from pipeline.studies.plausibility.check import Check, FitState, KnownCause, Whose, correction, misfit, not_checked
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.records import Places
from schemas.arrays import Floats, floats
from schemas.enums import MisfitCause, MisfitPlace

_WHAT = "positions as written"
_REFERENCE = "places of the reference against the positions"


def written_checks(of: Recording) -> list[Check]:
    """What keeps positions from being compared at all, empty where nothing does or no track tells."""
    line = of.line
    if line is None:
        return []
    far_m = line.far_m(of.gnss.latitude_deg, of.gnss.longitude_deg)
    if far_m <= of.config.same_line_m:
        return []
    words = f"they lie {far_m / 1000.0:.0f} km from every track"
    for mistake in COORDINATE_MISTAKES:
        mended = of.placed(*mistake.mended(floats(of.fixes, "latitude_deg"), floats(of.fixes, "longitude_deg")))
        if mended is None or line.far_m(mended.gnss.latitude_deg, mended.gnss.longitude_deg) > of.config.same_line_m:
            continue
        # The run's own streams decide whether it is the survey that is written wrongly.
        if _witnesses(mended) >= _witnesses(of):
            return [_mistaken(_WHAT, words, "gnss", mistake)]
        causes = (KnownCause(mistake.code),)
        advice = "Mend the columns of the site's track."
        return [Check(_WHAT, FitState.IMPOSSIBLE, words, causes, advice=advice, whose=Whose(MisfitPlace.IN_SURVEY))]
    advice = "Check that run and site belong together, and axes and datum of both."
    return [misfit(_WHAT, words, MisfitCause.OTHER_PLACE, advice=advice)]


def reference_elsewhere(of: Recording) -> list[Check]:
    """A reference far away: perhaps its axes or signs are wrong; empty where it is near."""
    record = of.reference
    limit_m = 10.0 * of.config.same_line_m
    if record is None or (far_m := _apart_m(of.gnss, record.latitude_deg, record.longitude_deg)) < limit_m:
        return []
    words = f"it is {far_m / 1000:.0f} km from the positions"
    for mistake in COORDINATE_MISTAKES:
        latitude, longitude = mistake.mended(record.latitude_deg, record.longitude_deg)
        if np.max(np.abs(latitude)) <= 90.0 and _apart_m(of.gnss, latitude, longitude) < limit_m:
            return [_mistaken(_REFERENCE, words, "reference", mistake, Whose(MisfitPlace.IN_REFERENCE))]
    return [not_checked(_REFERENCE, words)]


def _mistaken(what: str, words: str, stream: str, mistake: CoordinateMistake, whose: Whose | None = None) -> Check:
    """No lines for minutes, which no factor mends."""
    exchange = ("latitude_deg", "longitude_deg") if mistake.exchanged else None
    lines = "" if mistake.minutes else correction(stream, mistake.factors, exchange=exchange)
    advice = "Convert the positions: degrees are the whole part plus the rest times 100/60." if mistake.minutes else ""
    return Check(what, FitState.IMPOSSIBLE, words, (KnownCause(mistake.code),), lines, advice=advice, whose=whose)


def _witnesses(of: Recording) -> int:
    """How many of the run's other streams fit its positions; exchanged axes and minutes distort ways."""
    agreeing = 0
    limit = of.config.scale_limit
    agreeing += any(pair.constant > 0.5 and abs(abs(pair.factor) - 1.0) <= limit for pair in of.pairs.values())
    if of.velocity is not None:
        agreeing += of.velocity.best == 0 and abs(of.velocity.ratio - 1.0) <= limit
    if of.reference is not None:
        far_m = _apart_m(of.gnss, of.reference.latitude_deg, of.reference.longitude_deg)
        agreeing += far_m < of.config.same_line_m
    return agreeing


def _apart_m(gnss: Places, latitude_deg: Floats, longitude_deg: Floats) -> float:
    """How near another record of positions comes to these [m]."""
    from scipy.spatial import cKDTree

    step = max(1, len(latitude_deg) // 200)
    tree = cKDTree(points_of(latitude_deg[::step], longitude_deg[::step]).surface)
    return float(np.min(tree.query(gnss.points.surface[:: max(1, len(gnss.t_s) // 200)])[0]))
