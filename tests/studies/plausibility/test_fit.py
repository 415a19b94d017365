"""Wrong units, clocks, axes and shifts are reported with their cause and a remedy; faulty runs do not fail."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace

import polars as pl
import pytest

from benchmarks.truth.plausibility import applies, fit_of, is_reported
from datasets.random_trials import random_trial
from pipeline.one_run import replay as replayed
from pipeline.read.ingest.correct import correct_run
from pipeline.stages.clean.clean import clean
from pipeline.studies.calibration.calibrate import calibrate
from pipeline.studies.plausibility.check import CONFIGURATION, Cause, FitState, explain_factor, explain_lag
from pipeline.studies.plausibility.fit import Fit, fit_report, fit_run, lines_of
from schemas.config import Configuration, IngestConfig, PlausibilityConfig, Vehicle, settings_from
from schemas.enums import MisfitCause
from schemas.errors import ConfigError, InputError
from schemas.run import RunLog, Site
from tests.studies.plausibility.trips import Trip, trip
from tests.studies.plausibility.wrongs import WRONGS, Wrong, moved_site, scaled, shifted

# Short; one with a stop and all streams, one with a reversal, one without a stop.
SEEDS = (27, 26, 29, 7)
TRIED = [
    wrong for wrong in WRONGS if wrong.place is None and not wrong.least_hours and "odometer earlier" not in wrong.name
][::3]
_AXES = ("latitude_deg", "longitude_deg")
NOON_NS = 1_741_176_000 * 10**9  # 2025-03-05 12:00 UTC


@pytest.fixture(scope="module")
def trips() -> list[Trip]:
    return [trip(seed, faulty=False) for seed in SEEDS]


@pytest.mark.parametrize("wrong", TRIED, ids=lambda wrong: wrong.name)
def test_what_is_wrong_is_reported_and_its_lines_mend_it(wrong: Wrong, trips: list[Trip]) -> None:
    drawn = next(one for one in trips if applies(wrong, one))
    assert is_reported(wrong, drawn)[0], is_reported(wrong, drawn)[1]
    if wrong.vehicle or wrong.site:
        return
    changed = wrong.change(drawn.run)
    found = fit_run(changed, "primary", Vehicle(), PlausibilityConfig(), drawn.site)
    lines = lines_of(found.impossible_checks).get(CONFIGURATION)
    if lines is None:
        return
    config = settings_from({**tomllib.loads(lines)["ingest"]}, IngestConfig, "the lines")
    mended = fit_of(correct_run(changed, config.correct), drawn.site)
    assert not isinstance(mended, str)
    assert mended.impossible_checks == ()


def test_nothing_is_reported_of_healthy_trips(trips: list[Trip]) -> None:
    for drawn in trips:
        found = fit_of(drawn.run, drawn.site)
        assert not isinstance(found, str)
        assert [check.sentence for check in found.misfits] == []


@pytest.mark.parametrize("seed", range(10_000, 10_008))
def test_a_faulty_run_does_not_fail(seed: int) -> None:
    drawn = trip(seed)
    found = fit_of(drawn.run, drawn.site)
    assert not isinstance(found, str)
    assert [check.sentence for check in found.impossible_checks] == []


def test_a_run_at_constant_speed_tells_no_clock() -> None:
    t = pl.datetime_range(pl.datetime(2025, 3, 5), pl.datetime(2025, 3, 5, 0, 10), "1s", time_zone="UTC", eager=True)
    way = pl.Series(range(len(t)), dtype=pl.Float64) * 30.0
    gnss = pl.DataFrame({"t": t.cast(pl.Datetime("ns", "UTC")), "latitude_deg": 50.0 + way / 111_229.0})
    nothing = {name: pl.lit(None, dtype=pl.Float64) for name in ("height_m", "vel_e_mps", "vel_n_mps", "vel_u_mps")}
    gnss = gnss.with_columns(longitude_deg=4.0, solution=pl.lit("primary"), fix=pl.lit("sbas"), **nothing)
    later = pl.col("t") + pl.duration(seconds=18)
    odometer = pl.DataFrame({"t": gnss["t"], "distance_m": way}).with_columns(later, speed_mps=pl.lit(None, pl.Float64))
    run = random_trial(0).run.with_streams(gnss=gnss, odometer=odometer, reference=None)
    states = {
        check.what: (check.state, check.found)
        for check in fit_run(run, "primary", Vehicle(), PlausibilityConfig()).checks
    }
    assert states["clock of the odometer against the GNSS"] == (FitState.NOT_CHECKED, "the speed changes too little")
    assert states["odometer distance against the positions"][0] is FitState.FITS


@pytest.mark.parametrize(
    ("lag_s", "cause"),
    [
        (18.4, ("gps_as_utc",)),
        (-16.6, ("gps_as_utc",)),
        (-7200.9, ("time_zone", "2 h")),
        (12_600.0, ("time_zone", "3.5 h")),
        (172_800.0, ("wrong_day", "2 days")),
        (5_097_600.0, ("wrong_day", "59 days")),
        (619_315_200.0, ("gps_week", "1024 weeks")),
        (-619_315_199.4, ("gps_week", "1024 weeks")),
        # In March 2025 GPS is 18 s ahead of UTC, 1024 weeks before 13 s.
        (619_315_195.3, ("gps_week", "1024 weeks and -5 s")),
        (619_315_182.0, ("gps_week", "1024 weeks and -18 s")),
        (-619_315_218.0, ("gps_week", "1024 weeks and +18 s")),
    ],
)
def test_causes_of_lags(lag_s: float, cause: tuple[str, ...]) -> None:
    explained = explain_lag(lag_s, NOON_NS, 0.5)
    assert explained is not None
    assert (explained[0].code, *explained[0].figures) == cause
    assert abs(explained[1] - lag_s) < 2.0


def test_an_hour_and_a_minute_are_of_no_known_clock() -> None:
    assert explain_lag(3660.0, NOON_NS, 0.5) is None


def test_leap_seconds_are_those_of_the_day() -> None:
    in_2014 = explain_lag(16.0, 1_400_000_000 * 10**9, 0.1)
    assert in_2014 is not None
    assert in_2014[1] == 16


@pytest.mark.parametrize(
    ("factor", "speed", "cause"), [(3.5, True, "km/h"), (1.95, True, "knots"), (0.00101, False, "km")]
)
def test_causes_of_factors(factor: float, speed: bool, cause: str) -> None:
    explained = explain_factor(factor, speed)
    assert explained is not None
    assert explained[0] == Cause(MisfitCause.UNIT, (cause,))


@pytest.mark.parametrize("factor", [1.03, 0.95, 1.3, 2.6])
def test_no_unit_makes_these_factors(factor: float) -> None:
    assert explain_factor(factor, True) is None


def test_a_replay_of_an_impossible_run_fails_or_is_unproven() -> None:
    trial = random_trial(0)
    odometer = trial.run.odometer
    assert odometer is not None
    wrong = trial.run.with_streams(odometer=odometer.with_columns(pl.col("distance_m", "speed_mps") * 3.6))
    with pytest.raises(InputError, match=r"km/h.*ingest\.correct = \[\{ stream = \"odometer\""):
        replayed(wrong, trial.site, trial.vehicle)
    with pytest.raises(InputError, match="km/h"):
        calibrate([wrong], trial.site)
    warn = Configuration.model_validate({"ingest": {"plausibility": "warn"}})
    (row,) = replayed(wrong, trial.site, trial.vehicle, warn).runs.to_dicts()
    assert row["verdict"] in ("unproven", "unsafe")
    assert "does not fit: odometer" in row["notes"]


def test_low_availability_has_its_reason() -> None:
    trial = random_trial(0)
    aside = trial.run.gnss.with_columns(pl.col("latitude_deg") + 0.0004, pl.col("longitude_deg") + 0.0004)
    (row,) = replayed(trial.run.with_streams(gnss=aside), trial.site, trial.vehicle).runs.to_dicts()
    assert row["availability"] < 0.1
    assert "positions against the survey: the survey lies" in row["notes"]
    assert "of the moving time, the rest lost to: " in row["notes"]


def test_placeholders_are_no_positions() -> None:
    trial = random_trial(0)
    row = pl.int_range(pl.len())
    origin, default = row.is_between(40, 49), row.is_between(100, 119)
    place = {
        name: pl.when(origin).then(0.0).when(default).then(value).otherwise(name).alias(name)
        for name, value in (("latitude_deg", 31.0), ("longitude_deg", 121.0))
    }
    marked, counts = clean(trial.run.with_streams(gnss=trial.run.gnss.with_columns(**place)))
    assert counts.solutions["primary"].placeholders == 30
    assert (marked.gnss["fix"].cast(pl.String) == "none").sum() == 30


def test_a_jump_of_the_position_is_no_placeholder() -> None:
    trial = random_trial(0)
    far = (
        pl.when(pl.int_range(pl.len()).is_between(100, 130))
        .then(pl.col("latitude_deg") + 1.0)
        .otherwise("latitude_deg")
    )
    _, counts = clean(trial.run.with_streams(gnss=trial.run.gnss.with_columns(far.alias("latitude_deg"))))
    assert counts.solutions["primary"].placeholders == 0


def test_a_correction_of_what_is_not_there_is_refused() -> None:
    run = random_trial(0).run
    for wrong in ({"stream": "satellites", "shift_s": 1.0}, {"stream": "odometer", "factors": {"speed": 2.0}}):
        config = IngestConfig.model_validate({"correct": [wrong]})
        with pytest.raises(ConfigError, match="correct"):
            correct_run(run, config.correct)


def _fit(run: RunLog, site: Site | None = None, vehicle: Vehicle | None = None) -> Fit:
    return fit_run(run, "primary", vehicle or Vehicle(), PlausibilityConfig(), site)


def test_a_survey_with_exchanged_axes_is_not_taken_for_the_positions_fault(trips: list[Trip]) -> None:
    track = trips[0].site.track
    turned = track.with_columns(pl.col(one).alias(other) for one, other in (_AXES, _AXES[::-1]))
    (check,) = _fit(trips[0].run, replace(trips[0].site, track=turned)).misfits
    assert check.causes == (Cause(MisfitCause.AXES_EXCHANGED),)
    assert not check.lines


def test_positions_are_never_moved_onto_the_survey(trips: list[Trip]) -> None:
    """A drift of the whole run looks like a shift of the map."""
    (check,) = _fit(trips[0].run, moved_site(24.0, 18.0)(trips[0].site)).misfits
    assert check.causes == (Cause(MisfitCause.MAP_SHIFT),)
    assert not check.lines


def test_what_is_reported_is_configuration(trips: list[Trip]) -> None:
    run, moved = trips[0].run, moved_site(24.0, 18.0)(trips[0].site)
    late = shifted(10.0, "odometer")(run)
    wide = PlausibilityConfig(reported_shift_m=60.0, lag_limit_s=12.0)
    assert [check.what for check in _fit(run, moved).misfits] == ["positions against the survey"]
    assert fit_run(run, "primary", Vehicle(), wide, moved).misfits == ()
    (clock,) = _fit(late, trips[0].site).impossible_checks
    assert clock.what == "clock of the odometer against the GNSS"
    assert fit_run(late, "primary", Vehicle(), wide, trips[0].site).impossible_checks == ()


def test_a_unit_is_mended_once(trips: list[Trip]) -> None:
    vehicle = Vehicle(odometer_scale=1.0 / trips[0].scale, odometer_scale_sigma=2e-4)
    found = _fit(scaled("odometer", distance_m=0.001)(trips[0].run), trips[0].site, vehicle)
    assert list(lines_of(found.misfits)) == [CONFIGURATION], "no second line for the vehicle file"
    percent = vehicle.model_copy(update={"odometer_scale": 100.0})
    (check,) = _fit(trips[0].run, trips[0].site, percent).impossible_checks
    assert check.into == "write instead in the vehicle file"


def test_a_counter_that_is_reset_is_no_wrong_sign(trips: list[Trip]) -> None:
    run = trips[0].run
    assert run.odometer is not None
    middle = run.odometer.height // 2
    reset = pl.col("distance_m") - pl.when(pl.int_range(pl.len()) >= middle).then(40_000.0).otherwise(0.0)
    for sign in (1.0, -1.0):
        turned = run.odometer.with_columns(distance_m=reset * sign, speed_mps=pl.col("speed_mps") * sign)
        assert _fit(run.with_streams(odometer=turned)).impossible_checks == ()


def test_recorders_of_different_hours_are_reported_with_lines(trips: list[Trip]) -> None:
    run = shifted(7200.0, "odometer")(trips[0].run)
    report = fit_report(run, Configuration())
    assert "does not overlap" in report.problems[0]
    assert "shift_s = -7200.0" in report.lines()
    (inline,) = re.findall(r"ingest\.correct = .*\]", report.problems[0])
    assert tomllib.loads(inline)["ingest"]["correct"] == [{"stream": "odometer", "shift_s": -7200.0}]
