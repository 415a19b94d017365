"""Cleaning: order, duplicates and their counts, by hand."""

from __future__ import annotations

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from pipeline.stages.clean.clean import StreamCounts, clean, require_one_journey
from schemas.config import AlignConfig, Configuration, IngestConfig
from schemas.errors import InputError
from schemas.run import RunLog


def gnss(times, solution="primary", latitudes=None):
    return pl.DataFrame(
        {
            "t": pl.Series(times, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC")),
            "solution": [solution] * len(times),
            "latitude_deg": pl.Series(latitudes or [50.0] * len(times), dtype=pl.Float64),
            "longitude_deg": pl.Series([4.0] * len(times), dtype=pl.Float64),
        }
    )


def test_order_is_restored_and_the_first_of_a_double_stays():
    run = RunLog("r", gnss([1, 3, 2, 3, 5], latitudes=[50.1, 50.3, 50.2, 50.9, 50.5]))
    cleaned, counts = clean(run)
    assert cleaned.gnss["latitude_deg"].to_list() == [50.1, 50.2, 50.3, 50.5]
    assert counts.solutions == {"primary": StreamCounts(duplicates=1, out_of_order=1, contradicting=1)}


def test_solutions_share_times_without_being_doubles():
    run = RunLog("r", pl.concat([gnss([1, 2], "egnos"), gnss([1, 2, 2], "gps")]))
    cleaned, counts = clean(run)
    assert cleaned.gnss.height == 4
    assert counts.solutions == {"egnos": StreamCounts(0, 0), "gps": StreamCounts(1, 0)}


def test_the_callers_frames_are_untouched():
    frame = gnss([3, 1, 2])
    clean(RunLog("r", frame))
    assert frame["t"].to_physical().to_list() == [3, 1, 2]


@pytest.mark.parametrize("times", [[7], [7, 7, 7]])
def test_one_time_only_cannot_be_replayed(times):
    with pytest.raises(InputError, match="all rows have the same time"):
        clean(RunLog("r", gnss(times)))


def test_times_of_another_unit_are_the_same_instants():
    run = RunLog("r", gnss([1_000_000, 2_000_000, 3_000_000]))
    coarse = run.with_streams(gnss=run.gnss.with_columns(pl.col("t").cast(pl.Datetime("us", "UTC"))))
    assert_frame_equal(clean(coarse)[0].gnss, clean(run)[0].gnss)


@pytest.mark.parametrize("shift", [-7, 7])
def test_an_odometer_of_another_day_is_refused(shift):
    times = gnss([10, 12, 14])
    day = times.select("t").with_columns(pl.col("t") + pl.duration(nanoseconds=shift, time_unit="ns"))
    with pytest.raises(InputError, match="does not overlap the GNSS in time"):
        clean(RunLog("r", times, day))
    assert clean(RunLog("r", times, times.select("t")))[0].odometer is not None


def test_an_odometer_that_meets_the_gnss_at_one_time_is_kept():
    assert clean(RunLog("r", gnss([10, 12]), gnss([12, 20]).select("t")))[0].odometer is not None


DAY_NS = 86_400_000_000_000
NOW_NS = 20_000 * DAY_NS


def test_positions_with_another_date_are_left_out_and_counted():
    # The date of 1024 weeks before, and none at all: a receiver that does not know the week yet.
    times = [0, NOW_NS - 7168 * DAY_NS, *range(NOW_NS, NOW_NS + 30)]
    other = list(range(NOW_NS, NOW_NS + 30))
    cleaned, counts = clean(RunLog("r", pl.concat([gnss(times), gnss(other, "gps")])))
    assert cleaned.gnss.filter(pl.col("solution") == "primary")["t"].to_physical().to_list() == times[2:]
    assert counts.solutions == {"primary": StreamCounts(far_off=2), "gps": StreamCounts()}


def test_a_journey_of_several_days_is_whole():
    times = [NOW_NS + hour * DAY_NS // 24 for hour in range(72)]
    cleaned, counts = clean(RunLog("r", gnss(times)))
    assert (cleaned.gnss.height, counts.solutions["primary"]) == (72, StreamCounts())
    require_one_journey(cleaned.gnss, "gnss", IngestConfig())


def test_two_journeys_in_one_recording_are_refused():
    cleaned, counts = clean(
        RunLog("r", gnss([*range(NOW_NS, NOW_NS + 30), *range(NOW_NS + 3 * DAY_NS, NOW_NS + 3 * DAY_NS + 20)]))
    )
    assert counts.solutions["primary"].far_off == 0
    with pytest.raises(InputError, match=r"more than a day apart.*2024-10-04.* and 2024-10-07.*Split"):
        require_one_journey(cleaned.gnss, "gnss", IngestConfig())


def test_doubles_of_the_same_place_do_not_contradict():
    run = RunLog("r", gnss([1, 2, 2, 2, 3], latitudes=[50.0, 50.1, 50.1, 50.2, 50.3]))
    assert clean(run)[1].solutions == {"primary": StreamCounts(duplicates=2, contradicting=1)}


def test_what_a_placeholder_is_is_configuration():
    """0.05 degrees from 0/0; and the first places of a run that begins on the other side of the world."""
    times = [NOW_NS + second * 10**9 for second in range(20)]
    far = [-30.0, -30.0001, -30.0002] + [50.0] * 17
    near_origin = RunLog(
        "r", gnss(times, latitudes=[0.05] * 20).with_columns(fix=pl.lit("rtk_fixed"), longitude_deg=0.05)
    )
    far_first = RunLog("r", gnss(times, latitudes=far).with_columns(fix=pl.lit("rtk_fixed")))

    def placeholders(run, **keys):
        config = Configuration(ingest=IngestConfig(**keys))
        return clean(run, config)[1].solutions["primary"].placeholders

    assert placeholders(near_origin) == 0
    assert placeholders(near_origin, placeholder_origin_deg=0.1) == 20
    assert placeholders(far_first) == 3
    assert placeholders(far_first, first_fix_share=0.01, first_fix_s=1.0) == 0
    faster = Configuration(align=AlignConfig(fastest_mps=1e8))
    assert clean(far_first, faster)[1].solutions["primary"].placeholders == 0
