"""Checks of places: the reference, balise reads and the survey against the positions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import surveyed
from pipeline.studies.plausibility.causes import Datum, datums_at, explain_factor
from pipeline.studies.plausibility.check import Check, FitState, KnownCause, correction, fits, misfit, not_checked
from pipeline.studies.plausibility.clocks import StreamLag
from pipeline.studies.plausibility.copies import copy_check
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.robust import SIGNIFICANT_SIGMAS, explains, steady, usual
from pipeline.studies.plausibility.shifts import SurveyFit, SurveyLine, common_lag, fit_places, fit_survey, passes
from schemas.arrays import NS_PER_S, Floats, times_ns
from schemas.enums import MisfitCause
from schemas.run import Site

_REFERENCE = "places of the reference against the positions"
_SURVEY = "positions against the survey"
# The geoid lies up to so far from the ellipsoid.
_GEOID_M = 107.0
# Fewer tell nothing of the clock that stamps them; positions pass a balise that is read within so much: antenna, survey
# and position together.
_FEWEST_READS = 3
_READ_M = 60.0


def reference_checks(of: Recording) -> tuple[StreamLag, list[Check], bool]:
    """Clock, place and heights of the reference; and whether it lies where the positions do. A copy tells nothing."""
    config = of.config
    if of.reference is None:
        return StreamLag("reference", reason="hardly any place"), [], False
    if copied := copy_check(of):
        return StreamLag("reference", reason="a copy of the positions"), [copied], False
    shift = fit_places(of.gnss, of.reference, config)
    if shift.reason:
        return StreamLag("reference", reason=shift.reason), [not_checked(_REFERENCE, shift.reason)], False
    significant = abs(shift.lag_s) > max(config.lag_told_s, SIGNIFICANT_SIGMAS * shift.lag_sigma_s)
    agrees = explains(shift.agreeing, 0.0)
    small = abs(shift.lag_s) <= config.lag_limit_s and agrees
    sure = significant and shift.lag_is_steady and (small or explains(shift.agreeing, shift.as_recorded))
    lag = StreamLag("reference", shift.lag_s, shift.lag_sigma_s, sure=sure)
    if not agrees:
        words = "no one lag or shift explains them; the positions may be wrong"
        return lag, [not_checked(_REFERENCE, words)], False
    near = shift.shift_m <= config.shift_told_m
    words = f"{shift.towards} of them"
    # No lines: the judge believes the reference, and nobody should shift it to where the positions want it.
    beside = misfit(_REFERENCE, words, MisfitCause.OFFSET_OF_REFERENCE, advice="Find out which of the two is off.")
    beside = fits(_REFERENCE, words) if near or not shift.shift_is_steady else beside
    return lag, [beside, *_reference_heights(of, shift.lag_s)], near


def _reference_heights(of: Recording, lag_s: float) -> list[Check]:
    record = of.reference
    known = np.zeros(0) if record is None else np.isfinite(record.height_m)
    if record is None or known.sum() < 2:
        return []
    t_s = of.gnss.t_s + lag_s
    height_m = np.where(record.known(t_s), np.interp(t_s, record.t_s[known], record.height_m[known]), np.nan)
    return _heights("reference", height_m - of.gnss.height_m, of.gnss.height_m, of)


def reads_lag(of: Recording, reads: pl.DataFrame, site: Site) -> StreamLag:
    """The clock of the balise reads: where the positions pass a balise that was read."""
    places = _balise_places(site)
    names = reads["balise_id"].to_list()
    known = np.array([name in places for name in names], dtype=np.bool_)
    if known.sum() < _FEWEST_READS:
        return StreamLag("balise_reads", reason="fewer than three reads of balises of the site")
    at_deg = np.array([places[name] for name in names if name in places])
    number, passed_s = passes(of.gnss, points_of(*at_deg.T), _READ_M)
    t_s = of.seconds(reads)[known]
    lag_s, sigma_s = common_lag(t_s[number] - passed_s, int(known.sum()))
    if lag_s is None:
        return StreamLag("balise_reads", reason="no one lag explains the reads")
    # Antennas far from each other pass a balise at other times: what a train can have may be theirs.
    return StreamLag("balise_reads", lag_s, max(sigma_s, 0.2), sure=abs(lag_s) > 2.0 * of.config.lag_limit_s)


def read_stamp_checks(of: Recording, reads: pl.DataFrame) -> list[Check]:
    """Reads of a recorder that keeps whole seconds: the train may be a second of its way farther.

    Where there is a reference it is what the judge looks at.
    """
    if of.reference is not None or reads.height < _FEWEST_READS or (times_ns(reads) % NS_PER_S).any():
        return []
    words = f"all {reads.height} are whole seconds"
    advice = "Record the reads with finer stamps: until then nothing is proved."
    return [misfit("stamps of the balise reads", words, MisfitCause.WHOLE_SECONDS, advice=advice, of_evidence=True)]


def _balise_places(site: Site) -> dict[str, tuple[float, ...]]:
    """Latitude and longitude of the balises on their net elements [deg]."""
    track = surveyed(site)
    places = {}
    rows = () if site.balises is None else site.balises.select("balise_id", "netelement_id", "measure_m").iter_rows()
    for name, element, measure_m in rows:
        if (number := track.element_at(element, measure_m)) is not None:
            part = track.vertices(number)
            degrees = (track.latitude_deg[part], track.longitude_deg[part])
            places[name] = tuple(float(np.interp(measure_m, track.measure_m[part], axis)) for axis in degrees)
    return places


def survey_checks(of: Recording, line: SurveyLine, beside_reference: bool) -> Iterator[Check]:
    """Positions and heights against the survey; `beside_reference`: the reference lies where the positions do."""
    near_m = 1.5 * of.config.shift_told_m
    fit = fit_survey(of.gnss, line, near_m)
    datum = None
    if fit.aside_m >= of.config.shift_told_m:
        fit, datum = _by_datum(fit, of, line, near_m)
    yield _beside(fit, datum, of, ("gnss", "reference") if beside_reference else ("gnss",))
    yield from _heights("survey", fit.up_m + of.vehicle.antenna_height_m, fit.height_m, of)


def _by_datum(fit: SurveyFit, of: Recording, line: SurveyLine, near_m: float) -> tuple[SurveyFit, Datum | None]:
    """The datum that the survey may be in; between curves a large shift is found only from near it."""
    gnss = of.gnss
    datums = datums_at(float(np.median(gnss.latitude_deg)), float(np.median(gnss.longitude_deg)))
    fitted = [
        (fit if fit.constant else fit_survey(gnss, line, near_m, (datum.east_m, datum.north_m)), datum)
        for datum in datums
    ]
    named = [(part, datum) for part, datum in fitted if part.constant and datum.explains(part, part.one_heading)]
    return min(named, key=lambda item: item[1].off_m(item[0]), default=(fit, None))


def _beside(fit: SurveyFit, datum: Datum | None, of: Recording, streams: tuple[str, ...]) -> Check:
    limit_m = of.config.shift_told_m
    if not fit.constant or fit.shift_m <= limit_m or fit.aside_m <= 0.4 * limit_m:
        if fit.aside_m > limit_m:
            return misfit(_SURVEY, f"they lie {fit.aside_m:.0f} m beside the track, not by one shift")
        return fits(_SURVEY, f"{fit.aside_m:.1f} m beside the track usually")
    words = f"the survey lies {fit.towards} of them"
    words += " (along the track not known: one heading)" if fit.one_heading else ""
    if datum is not None:
        code = MisfitCause.DATUM_LIKELY if fit.one_heading else MisfitCause.DATUM
        causes = (KnownCause(code, (datum.name, datum.epsg)),)
        advice = "Name the code in the site's track: first line of track.csv, a column epsg, or crs of GeoJSON."
        lines = f"# epsg: {datum.epsg}\n"
        return Check(_SURVEY, FitState.MISFIT, words, causes, lines, "write as first line of track.csv", advice)
    shift_m = {"east": round(fit.east_m, 1), "north": round(fit.north_m, 1)}
    lines = "".join(correction(stream, shift_m=shift_m) for stream in streams)
    advice = "Name the survey's EPSG code or mend the survey; only where the shift is known to be the map's:"
    code = MisfitCause.MAP_SHIFT_BY_REFERENCE if len(streams) > 1 else MisfitCause.MAP_SHIFT
    return misfit(_SURVEY, words, code, lines=lines, advice=advice)


def _heights(base: str, up_m: Floats, height_m: Floats, of: Recording) -> list[Check]:
    """Heights of the survey or reference, which lie `up_m` above those of the positions, `height_m`."""
    what = f"heights against the {base}"
    half = len(up_m) // 2
    apart_m = usual(up_m)
    if not np.isfinite(apart_m):
        return []
    words = f"the {base} lies {apart_m:.0f} m above them"
    is_steady = steady(*(np.array([usual(part)]) for part in (up_m, up_m[:half], up_m[half:])))
    if abs(apart_m) <= 1.5 * of.config.shift_told_m or not is_steady:
        return [fits(what, words)]
    ratio = usual(height_m / (height_m + up_m))
    for stream, factor in (("positions", ratio), (base, 1.0 / ratio)):
        unit = explain_factor(factor, False)
        if unit is not None and unit.causes[0].figures == ("feet",):
            cause = KnownCause(MisfitCause.HEIGHT_UNIT, (stream, "feet"))
            return [Check(what, FitState.MISFIT, words, (cause,), advice=f"Write heights of the {stream} in metres.")]
    if abs(apart_m) > _GEOID_M:
        return [misfit(what, words, MisfitCause.HEIGHT_UNKNOWN)]
    # No lines: survey or reference alone cannot tell that it is right, and the other may be.
    advice = "Find out which of the two has the other zero, and mend that one."
    return [misfit(what, words, MisfitCause.HEIGHT_ZERO, advice=advice)]
