"""Checks of places: the reference, balise reads and the survey against the positions."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.plausibility.check import Check, State, fits, not_checked
from pipeline.plausibility.corrections import correction
from pipeline.plausibility.course import Places, places_of, seconds_since
from pipeline.plausibility.frames import SLIPS, Datum, datums_at
from pipeline.plausibility.reference import PlaceFit, common_lag, fit_places
from pipeline.plausibility.survey import Line, SurveyFit, fit_survey, line_of
from pipeline.plausibility.witnesses import Lag
from pipeline.track.geodesy import earth_centred_m, points_of
from schemas.arrays import Floats
from schemas.config import IngestConfig, Vehicle
from schemas.run import Site

_REFERENCE = "places of the reference against the positions"
_SURVEY = "positions against the survey"
_HEIGHTS = "heights against the survey"
# A lag explains places if so many agree then, and so many less do not than as recorded.
_EXPLAINS, _LESS = 0.5, 0.6
# A shift explains positions beside the track if it leaves at most this share of the distance.
_LEAVES, _SHARE = 0.5, 0.75
# Named datums are so far from WGS 84 at least, the least known to within some metres.
_DATUM_M = 30.0
# No railway is built so far from its survey's height; the geoid lies up to 107 m from the ellipsoid.
_HEIGHT_TOLD_M, _GEOID_M = 12.0, 107.0
_FOOT_M = 0.3048
# A balise is read where the train is within so much of it.
_READ_M = 60.0
# So many reads agree on a lag, within so much [s]; a shorter one may be positions that are off by 150 m [s].
_READ_SHARE, _READ_AGREES_S, _READ_LEAST_S = 0.7, 1.0, 12.0


def reference_lag(
    gnss: Places, reference: pl.DataFrame, epoch_ns: int, config: IngestConfig
) -> tuple[Lag, list[Check]]:
    """Clock and place of the reference."""
    record = places_of(reference, epoch_ns)
    if record is None:
        return Lag("reference", reason="hardly any place"), []
    found = fit_places(gnss, record)
    if found.reason:
        return Lag("reference", reason=found.reason), [_elsewhere(gnss, record, found)]
    explains = found.agreeing >= _EXPLAINS and 1.0 - found.agreeing <= _LESS * (1.0 - found.as_recorded)
    told = abs(found.lag_s) > max(config.fit_lag_told_s, 5.0 * found.lag_sigma_s)
    small = abs(found.lag_s) <= config.fit_lag_limit_s and found.agreeing >= _EXPLAINS and found.lag_is_steady
    lag = Lag("reference", found.lag_s, found.lag_sigma_s, sure=told and (explains or small))
    words = f"{towards(found.east_m, found.north_m)} of them"
    if found.agreeing < _EXPLAINS:
        return lag, [not_checked(_REFERENCE, "no one lag or shift explains them; the positions may be wrong")]
    if found.shift_m <= config.fit_shift_told_m or not found.shift_is_steady:
        return lag, [fits(_REFERENCE, words)]
    # No lines: the judge believes the reference, and nobody should shift it to where the positions want it.
    cause, advice = "another datum, or a fixed offset between both antennas", "Find out which of both is off."
    return lag, [Check(_REFERENCE, State.MISFIT, words, cause, advice=advice)]


def _elsewhere(gnss: Places, record: Places, found: PlaceFit) -> Check:
    """A reference far away: perhaps its axes or signs are wrong."""
    centre = points_of(np.median(gnss.latitude_deg, keepdims=True), np.median(gnss.longitude_deg, keepdims=True))
    latitude, longitude = np.median(record.latitude_deg, keepdims=True), np.median(record.longitude_deg, keepdims=True)
    for slip in SLIPS:
        mended = slip.mended(latitude, longitude)
        if abs(mended[0][0]) <= 90.0 and np.linalg.norm(points_of(*mended).surface - centre.surface) < 30_000.0:
            lines = correction("reference", slip.factors, exchange=_exchange(slip.exchanged))
            cause = f"in the reference {slip.cause}"
            return Check(_REFERENCE, State.IMPOSSIBLE, found.reason, cause, "the configuration", lines)
    return not_checked(_REFERENCE, found.reason)


def reads_lag(gnss: Places, reads: pl.DataFrame, site: Site, epoch_ns: int) -> Lag:
    """The clock of the balise reads: where the positions pass a balise that was read."""
    places = _balise_places(site)
    t_s = seconds_since(epoch_ns, reads)
    surface = points_of(gnss.latitude_deg, gnss.longitude_deg).surface
    lags: list[float] = []
    read = 0
    for at_s, name in zip(t_s.tolist(), reads["balise_id"].to_list(), strict=True):
        if name in places:
            read += 1
            away_m = np.linalg.norm(surface - places[name], axis=1)
            near = away_m < _READ_M
            passes = np.flatnonzero(near & (away_m <= np.roll(away_m, 1)) & (away_m <= np.roll(away_m, -1)))
            lags += (at_s - gnss.t_s[passes]).tolist()
    if read < 3:
        return Lag("balise_reads", reason="fewer than three reads of balises of the site")
    lag_s = common_lag(np.array(lags))
    agreeing = 0 if lag_s is None else int(np.sum(np.abs(np.array(lags) - lag_s) <= _READ_AGREES_S))
    if lag_s is None or agreeing < _READ_SHARE * read:
        return Lag("balise_reads", reason="no one lag explains the reads")
    # Epochs are up to half a second apart from the passage, and positions wrong by metres.
    return Lag("balise_reads", lag_s, 1.0, sure=abs(lag_s) > _READ_LEAST_S)


def _balise_places(site: Site) -> dict[str, Floats]:
    """Places of the balises on their net elements, at height zero."""
    if site.balises is None:
        return {}
    places: dict[str, Floats] = {}
    tracks = {part["netelement_id"][0]: part for part in site.track.partition_by("netelement_id", maintain_order=True)}
    for name, element, measure_m in site.balises.select("balise_id", "netelement_id", "measure_m").iter_rows():
        if (track := tracks.get(element)) is None:
            continue
        at = [np.interp(measure_m, track["measure_m"], track[column]) for column in ("latitude_deg", "longitude_deg")]
        places[name] = earth_centred_m(np.array(at[:1]), np.array(at[1:]), np.zeros(1))[0]
    return places


def survey_checks(gnss: Places, site: Site, vehicle: Vehicle, config: IngestConfig) -> list[Check]:
    """Positions and heights against the survey."""
    found = fit_survey(gnss, line_of(site.track))
    if found.far_m > 2_000.0:
        return [_far(found)]
    found, datum = _by_datum(found, gnss, line_of(site.track), config)
    checks = [_beside(found, datum, config)]
    if np.isfinite(found.up_m):
        checks.append(_heights(found, vehicle))
    return checks


def _far(found: SurveyFit) -> Check:
    words = f"they lie {found.far_m / 1000.0:.0f} km from every track"
    if found.slip is None:
        advice = "Check that run and site belong together, and axes and datum of both."
        return Check(_SURVEY, State.MISFIT, words, "run and site of different places", advice=advice)
    if not found.slip.by_configuration:
        advice = "Convert the positions: degrees are the whole part plus the rest times 100/60."
        return Check(_SURVEY, State.IMPOSSIBLE, words, found.slip.cause, advice=advice)
    lines = correction("gnss", found.slip.factors, exchange=_exchange(found.slip.exchanged))
    return Check(_SURVEY, State.IMPOSSIBLE, words, found.slip.cause, "the configuration", lines)


def _exchange(exchanged: bool) -> tuple[str, str] | None:
    return ("latitude_deg", "longitude_deg") if exchanged else None


def _by_datum(found: SurveyFit, gnss: Places, line: Line, config: IngestConfig) -> tuple[SurveyFit, Datum | None]:
    """The datum that the survey may be in; between curves a large shift is found only from near it."""
    if max(found.shift_m, found.aside_m) < _DATUM_M or found.aside_m < config.fit_shift_told_m:
        return found, None
    datums = datums_at(float(np.median(gnss.latitude_deg)), float(np.median(gnss.longitude_deg)))
    fits_of = [(found, one) for one in datums if _constant(found)]
    if not _constant(found):
        fits_of = [(fit_survey(gnss, line, (one.east_m, one.north_m)), one) for one in datums]
    named = [
        (fit, one) for fit, one in fits_of if _constant(fit) and one.explains(fit.east_m, fit.north_m, fit.one_heading)
    ]
    return min(named, key=lambda item: _off_m(*item), default=(found, None))


def _off_m(fit: SurveyFit, datum: Datum) -> float:
    return float(np.hypot(fit.east_m - datum.east_m, fit.north_m - datum.north_m))


def _constant(found: SurveyFit) -> bool:
    """Whether one shift explains most of how the positions lie beside the track."""
    return found.left_m < _LEAVES * found.aside_m and found.share > _SHARE and found.shift_is_steady


def _beside(found: SurveyFit, datum: Datum | None, config: IngestConfig) -> Check:
    words = (
        f"the survey lies {towards(found.east_m, found.north_m)} of them"
        f"{' (along the track not known: one heading)' if found.one_heading else ''}"
    )
    told = found.shift_m > config.fit_shift_told_m and found.aside_m > 0.4 * config.fit_shift_told_m
    if not told or not _constant(found):
        if found.aside_m > config.fit_shift_told_m:
            return Check(_SURVEY, State.MISFIT, f"they lie {found.aside_m:.0f} m beside the track, not by one shift")
        return fits(_SURVEY, f"{found.aside_m:.1f} m beside the track usually")
    if datum is not None:
        cause = (
            f"the survey {'may be' if found.one_heading else 'is'} in {datum.name}, EPSG:{datum.epsg}, not in WGS 84"
        )
        lines = f"# epsg: {datum.epsg}\n"
        advice = "Name the code in the site's track: first line of track.csv, a column epsg, or crs of GeoJSON."
        return Check(_SURVEY, State.MISFIT, words, cause, "track.csv, as its first line", lines, advice)
    lines = _shift_lines("gnss", found.east_m, found.north_m)
    advice = "Name the survey's EPSG code or mend the survey; only where the shift is known to be the map's:"
    cause = "a datum or map shift, or an antenna far from the track's middle"
    return Check(_SURVEY, State.MISFIT, words, cause, "the configuration", lines, advice)


def towards(east_m: float, north_m: float) -> str:
    """A shift in words."""
    east, north = ("east" if east_m >= 0 else "west"), ("north" if north_m >= 0 else "south")
    return f"{abs(east_m):.0f} m {east}, {abs(north_m):.0f} m {north}"


def _shift_lines(stream: str, east_m: float, north_m: float) -> str:
    return correction(stream, shift_m={"east": round(east_m, 1), "north": round(north_m, 1)})


def _heights(found: SurveyFit, vehicle: Vehicle) -> Check:
    up_m = found.up_m + vehicle.antenna_height_m
    words = f"the survey lies {up_m:.0f} m above them"
    if abs(up_m) <= _HEIGHT_TOLD_M or not found.up_is_steady:
        return fits(_HEIGHTS, words)
    if abs(found.height_ratio * _FOOT_M - 1.0) < 0.03:
        lines = correction("gnss", {"height_m": _FOOT_M})
        return Check(_HEIGHTS, State.MISFIT, words, "heights of the positions are in feet", "the configuration", lines)
    if abs(up_m) <= _GEOID_M:
        cause = "one of both is above the sea (geoid), the other above the ellipsoid"
        lines = correction("gnss", shift_m={"up": round(up_m, 1)})
        return Check(_HEIGHTS, State.MISFIT, words, cause, "the configuration", lines)
    return Check(_HEIGHTS, State.MISFIT, words, "another unit or another zero of the heights")
