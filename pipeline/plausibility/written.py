"""Whether positions are written as WGS 84 latitude and longitude in degrees, and if not, whose are not.

The track tells where a run should be. Without it, or where positions lie far from it, the run's own witnesses decide:
the odometer (exchanged axes and minutes distort ways), the GNSS velocity and the reference.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.plausibility.axes import fit_velocity
from pipeline.plausibility.check import Check, State, correction, not_checked
from pipeline.plausibility.course import Places, courses_of, places_of
from pipeline.plausibility.frames import SLIPS, Slip
from pipeline.plausibility.pairs import fit_pair
from pipeline.plausibility.survey import Line
from pipeline.track.geodesy import points_of
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig
from schemas.run import RunLog

_WHAT = "positions as written"


def written_checks(
    run: RunLog, fixes: pl.DataFrame, gnss: Places, line: Line | None, epoch_ns: int, config: PlausibilityConfig
) -> list[Check]:
    """What keeps positions from being compared at all, empty where nothing does."""
    far_m = 0.0 if line is None else line.far_m(gnss.latitude_deg, gnss.longitude_deg)
    if line is not None and far_m <= config.same_line_m:
        return []
    recorded = _witnesses(run, fixes, gnss, epoch_ns, config)
    if line is None:
        return [] if recorded and all(recorded.values()) else _without_survey(run, fixes, recorded, epoch_ns, config)
    words = f"they lie {far_m / 1000.0:.0f} km from every track"
    for slip in SLIPS:
        mended = _mended(fixes, slip, epoch_ns)
        if mended is None or line.far_m(mended.latitude_deg, mended.longitude_deg) > config.same_line_m:
            continue
        if sum(_witnesses(run, fixes, mended, epoch_ns, config).values()) >= sum(recorded.values()):
            return [_slipped(slip, words)]
        cause = f"in the survey {slip.cause}: odometer, velocity or reference fit the positions as they are"
        return [Check(_WHAT, State.IMPOSSIBLE, words, cause, advice="Mend the columns of the site's track.")]
    advice = "Check that run and site belong together, and axes and datum of both."
    return [Check(_WHAT, State.MISFIT, words, "run and site of different places", advice=advice)]


def _without_survey(
    run: RunLog, fixes: pl.DataFrame, recorded: dict[str, bool], epoch_ns: int, config: PlausibilityConfig
) -> list[Check]:
    """The slip that makes every other stream fit, if there is one."""
    words = "no other stream fits them"
    for slip in SLIPS:
        mended = _mended(fixes, slip, epoch_ns)
        found = {} if mended is None else _witnesses(run, fixes, mended, epoch_ns, config)
        if not all(found.values()) or sum(found.values()) <= sum(recorded.values()):
            continue
        if "odometer" in found and not recorded.get("odometer", False):
            return [_slipped(slip, words)]
        # Signs leave the ways as they are: the velocity alone says that they differ.
        cause = f"{slip.cause}, or the velocity has exchanged axes or signs"
        return [Check(_WHAT, State.IMPOSSIBLE, words, cause, advice="A site tells which: name it with --site.")]
    return []


def _slipped(slip: Slip, words: str) -> Check:
    if slip.minutes:
        advice = "Convert the positions: degrees are the whole part plus the rest times 100/60."
        return Check(_WHAT, State.IMPOSSIBLE, words, slip.cause, advice=advice)
    return Check(_WHAT, State.IMPOSSIBLE, words, slip.cause, _lines("gnss", slip))


def _lines(stream: str, slip: Slip) -> str:
    exchange = ("latitude_deg", "longitude_deg") if slip.exchanged else None
    return correction(stream, slip.factors, exchange=exchange)


def _witnesses(
    run: RunLog, fixes: pl.DataFrame, gnss: Places, epoch_ns: int, config: PlausibilityConfig
) -> dict[str, bool]:
    """What of the run's other streams fits positions, by name; without those that tell nothing."""
    found: dict[str, bool] = {}
    for course in courses_of(run.odometer, epoch_ns).values():
        pair = fit_pair(gnss, course, config)
        if pair.told:
            fits = pair.constant > 0.5 and abs(abs(pair.factor) - 1.0) <= config.scale_limit
            found["odometer"] = found.get("odometer", False) or fits
    velocity = fit_velocity(fixes, gnss, epoch_ns, config)
    if velocity is not None:
        found["velocity"] = velocity.best == 0 and abs(velocity.ratio - 1.0) <= config.scale_limit
    if run.reference is not None and (record := places_of(run.reference, epoch_ns)) is not None:
        found["reference"] = apart_m(gnss, record.latitude_deg, record.longitude_deg) < config.same_line_m
    return found


def _mended(fixes: pl.DataFrame, slip: Slip, epoch_ns: int) -> Places | None:
    latitude, longitude = slip.mended(*(fixes[name].to_numpy() for name in ("latitude_deg", "longitude_deg")))
    if not np.nanmax(np.abs(latitude)) <= 90.0:
        return None
    return places_of(fixes.with_columns(latitude_deg=pl.Series(latitude), longitude_deg=pl.Series(longitude)), epoch_ns)


def apart_m(gnss: Places, latitude_deg: Floats, longitude_deg: Floats) -> float:
    """How near another record of positions comes to these [m]."""
    from scipy.spatial import cKDTree

    step = max(1, len(latitude_deg) // 200)
    tree = cKDTree(points_of(latitude_deg[::step], longitude_deg[::step]).surface)
    return float(np.min(tree.query(gnss.points.surface[:: max(1, len(gnss.t_s) // 200)])[0]))


def reference_elsewhere(
    gnss: Places, reference: pl.DataFrame, epoch_ns: int, config: PlausibilityConfig
) -> list[Check]:
    """A reference far away: perhaps its axes or signs are wrong; empty where it is near."""
    record = places_of(reference, epoch_ns)
    if (
        record is None
        or (far_m := apart_m(gnss, record.latitude_deg, record.longitude_deg)) < 10.0 * config.same_line_m
    ):
        return []
    what, words = "places of the reference against the positions", f"it is {far_m / 1000:.0f} km from the positions"
    for slip in SLIPS:
        latitude, longitude = slip.mended(record.latitude_deg, record.longitude_deg)
        if np.max(np.abs(latitude)) <= 90.0 and apart_m(gnss, latitude, longitude) < 10.0 * config.same_line_m:
            cause, advice = f"in the reference {slip.cause}", "Convert its positions." if slip.minutes else ""
            lines = "" if slip.minutes else _lines("reference", slip)
            return [Check(what, State.IMPOSSIBLE, words, cause, lines, advice=advice)]
    return [not_checked(what, words)]
