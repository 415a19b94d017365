"""Whether positions are written as WGS 84 latitude and longitude in degrees, and if not, whose are not.

The track tells where a run should be. Without it, or where positions lie far from it, the run's own witnesses decide:
the odometer (exchanged axes and minutes distort ways), the GNSS velocity and the reference.
"""

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


def written_checks(of: Recording) -> list[Check]:
    """What keeps positions from being compared at all, empty where nothing does."""
    line = of.line
    same_m = of.config.same_line_m
    far_m = 0.0 if line is None else line.far_m(of.gnss.latitude_deg, of.gnss.longitude_deg)
    if line is not None and far_m <= same_m:
        return []
    recorded = _witnesses(of)
    if line is None:
        return [] if recorded and all(recorded.values()) else _without_survey(of, recorded)
    words = f"they lie {far_m / 1000.0:.0f} km from every track"
    for mistake in COORDINATE_MISTAKES:
        mended = _mended(of, mistake)
        if mended is None or line.far_m(mended.gnss.latitude_deg, mended.gnss.longitude_deg) > same_m:
            continue
        if sum(_witnesses(mended).values()) >= sum(recorded.values()):
            return [_mistaken(mistake, words)]
        causes = (KnownCause(mistake.code),)
        advice = "Mend the columns of the site's track."
        return [Check(_WHAT, FitState.IMPOSSIBLE, words, causes, advice=advice, whose=Whose(MisfitPlace.IN_SURVEY))]
    advice = "Check that run and site belong together, and axes and datum of both."
    return [misfit(_WHAT, words, MisfitCause.OTHER_PLACE, advice=advice)]


def _without_survey(of: Recording, recorded: dict[str, bool]) -> list[Check]:
    """The mistake that makes every other stream fit, if there is one."""
    words = "no other stream fits them"
    for mistake in COORDINATE_MISTAKES:
        mended = _mended(of, mistake)
        after = {} if mended is None else _witnesses(mended)
        if not all(after.values()) or sum(after.values()) <= sum(recorded.values()):
            continue
        if "odometer" in after and not recorded.get("odometer", False):
            return [_mistaken(mistake, words)]
        # Signs leave the ways as they are: the velocity alone says that they differ.
        causes = (KnownCause(mistake.code),)
        advice = "A site tells which: name it with --site."
        return [Check(_WHAT, FitState.IMPOSSIBLE, words, causes, advice=advice, whose=Whose(MisfitPlace.OR_VELOCITY))]
    return []


def _mistaken(mistake: CoordinateMistake, words: str) -> Check:
    advice = "Convert the positions: degrees are the whole part plus the rest times 100/60." if mistake.minutes else ""
    return Check(_WHAT, FitState.IMPOSSIBLE, words, (KnownCause(mistake.code),), _lines("gnss", mistake), advice=advice)


def _lines(stream: str, mistake: CoordinateMistake) -> str:
    """None for minutes, which no factor mends."""
    exchange = ("latitude_deg", "longitude_deg") if mistake.exchanged else None
    return "" if mistake.minutes else correction(stream, mistake.factors, exchange=exchange)


def _witnesses(of: Recording) -> dict[str, bool]:
    """What of the run's other streams fits its positions, by name; without those that show nothing."""
    agreeing: dict[str, bool] = {}
    limit = of.config.scale_limit
    if known := [pair for pair in of.pairs.values() if pair.known]:
        agreeing["odometer"] = any(pair.constant > 0.5 and abs(abs(pair.factor) - 1.0) <= limit for pair in known)
    if of.velocity is not None:
        agreeing["velocity"] = of.velocity.best == 0 and abs(of.velocity.ratio - 1.0) <= limit
    if of.reference is not None:
        far_m = _apart_m(of.gnss, of.reference.latitude_deg, of.reference.longitude_deg)
        agreeing["reference"] = far_m < of.config.same_line_m
    return agreeing


def _mended(of: Recording, mistake: CoordinateMistake) -> Recording | None:
    return of.placed(*mistake.mended(floats(of.fixes, "latitude_deg"), floats(of.fixes, "longitude_deg")))


def _apart_m(gnss: Places, latitude_deg: Floats, longitude_deg: Floats) -> float:
    """How near another record of positions comes to these [m]."""
    from scipy.spatial import cKDTree

    step = max(1, len(latitude_deg) // 200)
    tree = cKDTree(points_of(latitude_deg[::step], longitude_deg[::step]).surface)
    return float(np.min(tree.query(gnss.points.surface[:: max(1, len(gnss.t_s) // 200)])[0]))


def reference_elsewhere(of: Recording) -> list[Check]:
    """A reference far away: perhaps its axes or signs are wrong; empty where it is near."""
    record = of.reference
    limit_m = 10.0 * of.config.same_line_m
    if record is None or (far_m := _apart_m(of.gnss, record.latitude_deg, record.longitude_deg)) < limit_m:
        return []
    what = "places of the reference against the positions"
    words = f"it is {far_m / 1000:.0f} km from the positions"
    for mistake in COORDINATE_MISTAKES:
        latitude, longitude = mistake.mended(record.latitude_deg, record.longitude_deg)
        if np.max(np.abs(latitude)) <= 90.0 and _apart_m(of.gnss, latitude, longitude) < limit_m:
            advice = "Convert its positions." if mistake.minutes else ""
            whose = Whose(MisfitPlace.IN_REFERENCE)
            lines = _lines("reference", mistake)
            return [
                Check(what, FitState.IMPOSSIBLE, words, (KnownCause(mistake.code),), lines, advice=advice, whose=whose)
            ]
    return [not_checked(what, words)]
