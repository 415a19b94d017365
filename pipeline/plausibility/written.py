"""Whether positions are written as WGS 84 latitude and longitude in degrees, and if not, whose are not.

The track tells where a run should be. Without it, or where positions lie far from it, the run's own witnesses decide:
the odometer (exchanged axes and minutes distort ways), the GNSS velocity and the reference.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.plausibility.axes import fit_velocity
from pipeline.plausibility.causes import explain_factor
from pipeline.plausibility.check import Check, State, correction, not_checked
from pipeline.plausibility.course import Places, places_of
from pipeline.plausibility.frames import SLIPS, Slip
from pipeline.plausibility.odometer import courses_of
from pipeline.plausibility.pairs import fit_pair
from pipeline.plausibility.survey import Line
from pipeline.track.geodesy import points_of
from schemas.arrays import Floats
from schemas.config import IngestConfig
from schemas.run import RunLog

_WHAT = "positions as written"
# Positions so far from track or reference are not of the same line [m].
_FAR_M = 2_000.0


def written_checks(
    run: RunLog, fixes: pl.DataFrame, gnss: Places, line: Line | None, epoch_ns: int, config: IngestConfig
) -> list[Check]:
    """What keeps positions from being compared at all, empty where nothing does."""
    far_m = 0.0 if line is None else line.far_m(gnss.latitude_deg, gnss.longitude_deg)
    if line is not None and far_m <= _FAR_M:
        return []
    as_recorded = _witnesses(run, fixes, gnss, epoch_ns, config)
    if line is None and all(as_recorded.values()):
        return []
    words = f"they lie {far_m / 1000.0:.0f} km from every track" if line is not None else "no other stream fits them"
    for slip in SLIPS:
        mended = _mended(fixes, slip, epoch_ns)
        if mended is None or (line is not None and line.far_m(mended.latitude_deg, mended.longitude_deg) > _FAR_M):
            continue
        after = _witnesses(run, fixes, mended, epoch_ns, config)
        if line is None and sum(after.values()) > sum(as_recorded.values()) and all(after.values()):
            return [_slipped(slip, words, sure="odometer" in after and not as_recorded.get("odometer", True))]
        if line is not None and sum(after.values()) >= sum(as_recorded.values()):
            return [_slipped(slip, words, sure=True)]
        if line is not None:
            cause = f"in the survey {slip.cause}: odometer, velocity or reference fit the positions as they are"
            return [Check(_WHAT, State.IMPOSSIBLE, words, cause, advice="Mend the columns of the site's track.")]
    if line is None:
        return []
    advice = "Check that run and site belong together, and axes and datum of both."
    return [Check(_WHAT, State.MISFIT, words, "run and site of different places", advice=advice)]


def _slipped(slip: Slip, words: str, sure: bool) -> Check:
    if not sure:
        cause = f"{slip.cause}, or the velocity has exchanged axes or signs"
        return Check(_WHAT, State.IMPOSSIBLE, words, cause, advice="A site tells which: name it with --site.")
    if not slip.by_configuration:
        advice = "Convert the positions: degrees are the whole part plus the rest times 100/60."
        return Check(_WHAT, State.IMPOSSIBLE, words, slip.cause, advice=advice)
    return Check(_WHAT, State.IMPOSSIBLE, words, slip.cause, _lines("gnss", slip))


def _lines(stream: str, slip: Slip) -> str:
    exchange = ("latitude_deg", "longitude_deg") if slip.exchanged else None
    return correction(stream, slip.factors, exchange=exchange)


def _witnesses(run: RunLog, fixes: pl.DataFrame, gnss: Places, epoch_ns: int, config: IngestConfig) -> dict[str, bool]:
    """What of the run's other streams fits positions, by name; without those that tell nothing."""
    found: dict[str, bool] = {}
    for course in courses_of(run, epoch_ns).values():
        pair = fit_pair(gnss, course)
        if pair.told:
            factor = abs(pair.factor)
            unit = any(explain_factor(factor, speed) is not None for speed in (True, False))
            fits = pair.constant > 0.5 and (abs(factor - 1.0) <= config.fit_scale_limit or unit)
            found["odometer"] = found.get("odometer", True) and fits
    velocity = fit_velocity(fixes, gnss, epoch_ns)
    if velocity is not None:
        near = abs(velocity.ratio - 1.0) <= config.fit_scale_limit or explain_factor(velocity.ratio, True) is not None
        found["velocity"] = velocity.best == 0 and near
    if run.reference is not None and (record := places_of(run.reference, epoch_ns)) is not None:
        found["reference"] = apart_m(gnss, record.latitude_deg, record.longitude_deg) < _FAR_M
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


def reference_elsewhere(gnss: Places, reference: pl.DataFrame, epoch_ns: int) -> list[Check]:
    """A reference far away: perhaps its axes or signs are wrong; empty where it is near."""
    record = places_of(reference, epoch_ns)
    if record is None or (far_m := apart_m(gnss, record.latitude_deg, record.longitude_deg)) < 10.0 * _FAR_M:
        return []
    what, words = "places of the reference against the positions", f"it is {far_m / 1000:.0f} km from the positions"
    for slip in SLIPS:
        latitude, longitude = slip.mended(record.latitude_deg, record.longitude_deg)
        if np.max(np.abs(latitude)) <= 90.0 and apart_m(gnss, latitude, longitude) < 10.0 * _FAR_M:
            cause, advice = f"in the reference {slip.cause}", "" if slip.by_configuration else "Convert its positions."
            lines = _lines("reference", slip) if slip.by_configuration else ""
            return [Check(what, State.IMPOSSIBLE, words, cause, lines, advice=advice)]
    return [not_checked(what, words)]
