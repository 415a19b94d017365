"""Checks of places: positions as written, the reference, balise reads and the survey against the positions.

A reference that copies the solution under test is refused: every position would be judged by itself. A copy has the
solution's own errors, written at the same stamps; an independent record, however good, writes other places.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import SEMI_MAJOR_AXIS_M, Points, points_of
from pipeline.stages.track.network import surveyed_track
from pipeline.studies.plausibility.check import KNOWN, Cause, Check, FitState, correction, fits, misfit, not_checked
from pipeline.studies.plausibility.clocks import StreamLag
from pipeline.studies.plausibility.odometer import odometer_checks, velocity_checks
from pipeline.studies.plausibility.pairs import (
    LEAST,
    SIGNIFICANT_SIGMAS,
    explains,
    halves_agree,
    quantile_of_known,
    split_in_half,
)
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.shifts import SurveyLine, common_lag, fit_places, fit_survey, in_words, passing_lags
from schemas.arrays import NS_PER_S, Floats, Ints, floats, times_ns
from schemas.config import FixSigma
from schemas.enums import Fix, MisfitCause, MisfitPlace
from schemas.run import Site

_REFERENCE = "reference against the positions"
_WITHOUT_COPY = "Leave the reference out of the run, or record one with another, better instrument."
# Fewer moving places in common show nothing.
_FEWEST_IN_COMMON = 3 * LEAST
# Degrees, minutes and seconds of an angle are written with so many decimals; finer is rounding of the computer [deg].
_DIGITS_DEG = sorted(unit / 10.0**decimals for unit in (1.0, 1 / 60.0, 1 / 3600.0) for decimals in range(2, 10))
_LEAST_DEG = 1e-9
# Recorders round stamps to no more than this [ns].
_STAMP_NS = 2_000_000
# Positions as near to the track as this share of their sigma have no errors of their own; 0.67 is usual.
_WITHOUT_ERROR = 0.2


def copy_check(of: Recording) -> Check | None:
    """`impossible` where the reference has the places of the solution at its stamps, exact, thinned or rounded.

    None where it is no copy, or nobody can know. Positions that a program drew without errors equal a true reference:
    they lie on the survey far nearer than their sigma.
    """
    positions, references = _at_same_stamps(of)
    if len(positions) < _FEWEST_IN_COMMON:
        return None
    digit_deg = max(_digit_deg(positions), _digit_deg(references))
    equal = np.all(np.abs(positions - references) <= 1.001 * digit_deg, axis=1)
    if equal.mean() < of.config.copy_share:
        return None
    sigma_m = _sigma_m(of.fixes)
    digit_m = digit_deg * np.radians(SEMI_MAJOR_AXIS_M) * np.array([1.0, np.cos(np.radians(positions[0, 0]))])
    # Of a normal error, so much lies within a digit on either side.
    chance = float(np.prod(np.minimum(1.0, 2.0 * digit_m / (np.sqrt(2.0 * np.pi) * sigma_m))))
    if chance > of.config.copy_chance:
        return None
    if of.line is not None:
        aside_m = fit_survey(of.gnss, of.line, of.config.reported_shift_m).aside_m
        if aside_m < _WITHOUT_ERROR * float(sigma_m.min()):
            return None
    found = (
        f"{equal.sum()} of {equal.size} places are those of the positions to the last digit ({digit_m[0]:.1g} m); an "
        f"independent one would be so near in {chance:.1g} of all cases"
    )
    causes = (Cause(MisfitCause.COPY),)
    return Check(_REFERENCE, FitState.IMPOSSIBLE, found, causes, advice=_WITHOUT_COPY, of_evidence=True)


def _at_same_stamps(of: Recording) -> tuple[Floats, Floats]:
    """Positions, and the reference's places in motion, of the same 2 ms, (n, 2) each [deg]: recorders round stamps."""
    if of.run.reference is None or of.reference is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    (stamps, fixes), (of_reference, references) = (_by_stamp(frame) for frame in (of.fixes, of.run.reference))
    both_ns, here, there = np.intersect1d(stamps, of_reference, assume_unique=True, return_indices=True)
    moves = of.reference.moves(np.asarray((both_ns - of.epoch_ns) * 1e-9, dtype=np.float64))
    return fixes[here[moves]], references[there[moves]]


def _by_stamp(frame: pl.DataFrame) -> tuple[Ints, Floats]:
    """Stamps of 2 ms [ns], each once, and the first place recorded at each, (n, 2) [deg]."""
    degrees = np.column_stack([floats(frame, axis) for axis in _AXES])
    known = np.isfinite(degrees).all(axis=1)
    stamps = (times_ns(frame)[known] + _STAMP_NS // 2) // _STAMP_NS * _STAMP_NS
    each, first = np.unique(stamps, return_index=True)
    return each, degrees[known][first]


def _digit_deg(degrees: Floats) -> float:
    """The coarsest last digit that all coordinates of a record have."""
    whole = (
        digit for digit in reversed(_DIGITS_DEG) if np.abs(degrees / digit - np.rint(degrees / digit)).max() < 1e-3
    )
    return max(next(whole, 0.0), _LEAST_DEG)


def _sigma_m(fixes: pl.DataFrame) -> Floats:
    """How far off the positions may be, north and east: as they state, else as their kind of fix usually is."""
    usual_m = pl.col("fix").cast(pl.String).replace_strict({kind.value: FixSigma().horizontal_m(kind) for kind in Fix})
    stated = (pl.when(pl.col(name) > 0.0).then(pl.col(name).sqrt()) for name in ("cov_nn_m2", "cov_ee_m2"))
    sigma_m = fixes.select(
        pl.coalesce(stated_m, usual_m).median().alias(name) for stated_m, name in zip(stated, "ne", strict=True)
    )
    return np.array(sigma_m.row(0), dtype=np.float64)


_WRITTEN = "positions as written"
_REFERENCE = "places of the reference against the positions"
_SURVEY = "positions against the survey"
_AXES = ("latitude_deg", "longitude_deg")
# Fewer show nothing of the clock that stamps them; positions pass a balise that is read within so much: antenna, survey
# and position together.
_FEWEST_IN_COMMON_READS = 3
_READ_M = 60.0


def written_check(of: Recording) -> Check | None:
    """Positions that lie on another continent than the track, and fit nothing else; None where they do not."""
    line = of.line
    if line is None or (far_m := line.far_m(of.gnss.points)) <= of.config.same_line_m:
        return None
    words = f"they lie {far_m / 1000.0:.0f} km from every track"
    mistaken = _mistake("gnss", of.fixes, lambda points: line.far_m(points) <= of.config.same_line_m)
    if mistaken is None:
        advice = "Check that run and site belong together, and axes and datum of both."
        return misfit(_WRITTEN, words, MisfitCause.OTHER_PLACE, advice=advice)
    cause, lines = mistaken
    # The run's own streams decide whether the positions are written so, or the survey.
    of_run = (*odometer_checks(of)[0], *velocity_checks(of))
    if any(check.state in (FitState.MISFIT, FitState.IMPOSSIBLE) for check in of_run):
        advice = "" if lines else "Convert the positions: degrees are the whole part plus the rest times 100/60."
        return Check(_WRITTEN, FitState.IMPOSSIBLE, words, (cause,), lines, advice=advice)
    advice = "Look at a map which of the two is written so, and mend its columns: positions or track."
    return Check(_WRITTEN, FitState.IMPOSSIBLE, words, (cause,), advice=advice)


def reference_elsewhere(of: Recording) -> Check | None:
    """A reference far away: perhaps its axes or signs are wrong; None where it is near."""
    frame = of.run.reference
    limit_m = 10.0 * of.config.same_line_m
    if frame is None or of.reference is None:
        return None
    far_m = _apart_m(of.gnss.points, of.reference.points)
    if far_m < limit_m:
        return None
    words = f"it is {far_m / 1000:.0f} km from the positions"
    mistaken = _mistake("reference", frame, lambda points: _apart_m(of.gnss.points, points) < limit_m)
    if mistaken is None:
        return not_checked(_REFERENCE, words)
    cause, lines = mistaken
    whose = Cause(MisfitPlace.IN_STREAM, ("reference",))
    return Check(_REFERENCE, FitState.IMPOSSIBLE, words, (cause, whose), lines)


def _mistake(stream: str, frame: pl.DataFrame, mends: Callable[[Points], bool]) -> tuple[Cause, str] | None:
    """How a stream's places were written wrongly, and the lines that mend it; none mend minutes."""
    frame = frame.filter(pl.all_horizontal(pl.col(_AXES).is_finite()))
    places = [floats(frame, axis) for axis in _AXES]
    for mistake in KNOWN.coordinate_mistakes:
        latitude, longitude = mistake.mended(places[0], places[1])
        if np.max(np.abs(latitude)) <= 90.0 and mends(points_of(latitude, longitude)):
            exchange = _AXES if mistake.exchanged else None
            lines = "" if mistake.minutes else correction(stream, mistake.factors, exchange=exchange)
            return Cause(mistake.code), lines
    return None


def _apart_m(one: Points, other: Points) -> float:
    """How near two records of positions come to each other [m]."""
    from scipy.spatial import cKDTree

    some, others = (points.surface[:: max(1, len(points) // 200)] for points in (one, other))
    return float(np.min(cKDTree(others).query(some)[0]))


def reference_checks(of: Recording) -> tuple[StreamLag, list[Check]]:
    """Clock, place and heights of the reference. A copy shows nothing."""
    config = of.config
    record = of.reference
    if record is None:
        return StreamLag("reference", reason="hardly any place"), []
    if copied := copy_check(of):
        return StreamLag("reference", reason="a copy of the positions"), [copied]
    fit = fit_places(of.gnss, record, config)
    if fit.reason:
        return StreamLag("reference", reason=fit.reason), [not_checked(_REFERENCE, fit.reason)]
    significant = abs(fit.lag_s) > max(config.reported_lag_s, SIGNIFICANT_SIGMAS * fit.lag_sigma_s)
    agrees = explains(fit.agreeing, 0.0)
    small = abs(fit.lag_s) <= config.lag_limit_s and agrees
    sure = significant and fit.lag_is_steady and (small or explains(fit.agreeing, fit.as_recorded))
    lag = StreamLag("reference", fit.lag_s, fit.lag_sigma_s, sure=sure)
    if not agrees:
        return lag, [not_checked(_REFERENCE, "no one lag or shift explains them; the positions may be wrong")]
    words = f"{in_words(fit.shift_m)} of them"
    checks = [fits(_REFERENCE, words)]
    if np.hypot(*fit.shift_m) > config.reported_shift_m and fit.shift_is_steady:
        # No lines: the judge believes the reference, and nobody should shift it to where the positions want it.
        advice = "Find out which of the two is off."
        checks = [misfit(_REFERENCE, words, MisfitCause.OFFSET_OF_REFERENCE, advice=advice)]
    known = np.isfinite(record.height_m)
    if known.sum() >= 2:
        t_s = of.gnss.t_s + fit.lag_s
        height_m = np.interp(t_s, record.t_s[known], record.height_m[known])
        up_m = np.where(record.known(t_s), height_m, np.nan) - of.gnss.height_m
        checks += _height_checks("reference", up_m, of)
    return lag, checks


def reads_lag(of: Recording, reads: pl.DataFrame, site: Site) -> StreamLag:
    """The clock of the balise reads: where the positions pass a balise that was read."""
    known = reads.join(_balise_places(site), on="balise_id", how="inner", maintain_order="left")
    if known.height < _FEWEST_IN_COMMON_READS:
        return StreamLag("balise_reads", reason="fewer than three reads of balises of the site")
    places = points_of(*(floats(known, axis) for axis in _AXES)).surface
    lags_s = passing_lags(of.gnss, places, of.seconds(known), _READ_M)
    lag_s, sigma_s = common_lag(lags_s, known.height)
    if lag_s is None:
        return StreamLag("balise_reads", reason="no one lag explains the reads")
    # Antennas far from each other pass a balise at other times: what a train can have may be theirs.
    return StreamLag("balise_reads", lag_s, max(sigma_s, 0.2), sure=abs(lag_s) > 2.0 * of.config.lag_limit_s)


def read_stamp_checks(of: Recording, reads: pl.DataFrame) -> list[Check]:
    """Reads of a recorder that keeps whole seconds: the train may be a second of its movement farther.

    Where there is a reference it is what the judge looks at.
    """
    if of.reference is not None or reads.height < _FEWEST_IN_COMMON_READS or (times_ns(reads) % NS_PER_S).any():
        return []
    words = f"all {reads.height} are whole seconds"
    advice = "Record the reads with finer stamps: until then nothing is proved."
    causes = (Cause(MisfitCause.WHOLE_SECONDS),)
    return [Check("stamps of the balise reads", FitState.MISFIT, words, causes, advice=advice, of_evidence=True)]


def _balise_places(site: Site) -> pl.DataFrame:
    """Latitude and longitude of the balises on their net elements [deg]."""
    track = surveyed_track(site)
    places: list[tuple[str, float, float]] = []
    rows = () if site.balises is None else site.balises.select("balise_id", "netelement_id", "measure_m").iter_rows()
    for name, element, measure_m in rows:
        if (number := track.element_at(element, measure_m)) is not None:
            part = track.vertex_range(number)
            degrees = (track.latitude_deg[part], track.longitude_deg[part])
            latitude, longitude = (float(np.interp(measure_m, track.measure_m[part], axis)) for axis in degrees)
            places.append((name, latitude, longitude))
    schema = {"balise_id": pl.String, **dict.fromkeys(_AXES, pl.Float64)}
    return pl.DataFrame(places, schema=schema, orient="row").unique("balise_id", keep="last", maintain_order=True)


def survey_checks(of: Recording, line: SurveyLine) -> list[Check]:
    """Positions and heights against the survey.

    No lines: a drift of the whole run looks like a shift of the map, and nobody should move positions onto the track.
    """
    limit_m = of.config.reported_shift_m
    fit = fit_survey(of.gnss, line, 1.5 * limit_m)
    heights = _height_checks("survey", fit.up_m + of.vehicle.antenna_height_m, of)
    if fit.constant and np.hypot(*fit.shift_m) > limit_m and fit.aside_m > 0.4 * limit_m:
        words = f"the survey lies {in_words(fit.shift_m)} of them"
        advice = "Name the survey's EPSG code (first line of track.csv, a column epsg, or crs of GeoJSON), or mend it."
        return [misfit(_SURVEY, words, MisfitCause.MAP_SHIFT, advice=advice), *heights]
    if fit.aside_m > limit_m:
        return [misfit(_SURVEY, f"they lie {fit.aside_m:.0f} m beside the track, not by one shift"), *heights]
    return [fits(_SURVEY, f"{fit.aside_m:.1f} m beside the track usually"), *heights]


def _height_checks(base: str, up_m: Floats, of: Recording) -> list[Check]:
    """Heights of the survey or reference, which lie `up_m` above those of the positions."""
    what = f"heights against the {base}"
    apart_m = quantile_of_known(up_m)
    if not np.isfinite(apart_m):
        return []
    words = f"the {base} lies {apart_m:.0f} m above them"
    is_steady = halves_agree(
        *(np.array([quantile_of_known(up_m[part])]) for part in (slice(None), *split_in_half(len(up_m))))
    )
    if abs(apart_m) <= 1.5 * of.config.reported_shift_m or not is_steady:
        return [fits(what, words)]
    # No lines: survey or reference alone cannot show that it is right, and the other may be.
    advice = "Find out which of the two has the other zero or unit, and mend that one."
    return [misfit(what, words, MisfitCause.HEIGHT_ZERO, advice=advice)]
