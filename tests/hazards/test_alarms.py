"""Alarm episodes, their verdict, and whom they point at."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.hazards import Case, classify, establish_truth
from schemas.config import Configuration
from tests.hazards.synthetic import Journey, judge, locate, seconds, truth_of


def alarms(journey):
    return judge(journey).alarms.to_dicts()


def test_fails_less_than_the_recovery_time_apart_are_one_alarm():
    fails = {"along_raw": ((10.0, 10.0), (39.9, 39.9), (75.0, 75.0)), "cross_raw": ((11.0, 12.0),)}
    first, second = alarms(Journey(fails=fails))
    assert (seconds(first["t_start"]), seconds(first["t_end"])) == (10.0, 39.9)
    assert first["monitors"] == ["along_raw", "cross_raw"]
    assert first["peak_ratio"] == pytest.approx(1.5)
    assert seconds(second["t_start"]) == 75.0
    apart = alarms(Journey(fails={"along_raw": ((10.0, 10.0), (40.0, 40.0))}))
    assert len(apart) == 2


def test_alarm_with_a_healthy_position_is_false():
    (row,) = alarms(Journey(fails={"along_raw": ((50.0, 51.0),)}))
    assert (row["verdict"], row["suspect"], row["hazard_id"]) == ("false", "unknown", None)


def test_alarm_of_a_hazard_is_true_and_linked():
    result = judge(Journey(steps=((34.0, 38.0, 45.0),), fails={"along_raw": ((34.0, 34.1),)}))
    (row,) = result.alarms.to_dicts()
    assert (row["verdict"], row["suspect"], row["hazard_id"]) == ("true", "gnss", 0)


def test_error_up_to_300_s_before_makes_the_alarm_true():
    # 6 m (more than 5 m and 3 sigma) from 20 s to 30 s, no VB hit beyond 20 m; alarm at 100 s.
    journey = Journey(duration_s=400.0, steps=((20.0, 30.0, 6.0),), balises_m=(100.0,))
    assert alarms(journey.but(fails={"along_raw": ((100.0, 101.0),)}))[0]["verdict"] == "true"
    assert alarms(journey.but(fails={"along_raw": ((331.0, 332.0),)}))[0]["verdict"] == "false"
    smaller = journey.but(steps=((20.0, 30.0, 4.9),), fails={"along_raw": ((100.0, 101.0),)})
    assert alarms(smaller)[0]["verdict"] == "false"


def test_slip_is_the_odometers_fault_and_no_hazard():
    journey = Journey(slip=(50.0, 55.0, 6.0), fails={"along_raw": ((50.2, 55.0),)})
    result = judge(journey)
    (row,) = result.alarms.to_dicts()
    assert (row["verdict"], row["suspect"]) == ("false", "odometer")
    assert result.hazards.height == 0


def test_no_truth_leaves_the_verdict_unknown():
    journey = Journey(reference=False, fails={"along_raw": ((50.0, 51.0),)})
    epochs_without_odometer = judge_without_odometer(journey)
    (row,) = epochs_without_odometer.alarms.to_dicts()
    assert row["verdict"] == "unknown"
    assert epochs_without_odometer.epochs_columns["lds_state"].null_count() > 0


def judge_without_odometer(journey):
    config = Configuration()
    nothing = pl.lit(None, pl.Float64)
    epochs = journey.epochs().with_columns(odometer_m=nothing, scale_sigma=nothing, odometer_white_m2_per_s=nothing)
    passages = journey.passages()
    reference = journey.reference_frame() if journey.reference else None
    truth = establish_truth(epochs, reference, None, passages, config)
    return classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))


def test_without_odometer_hazards_are_still_judged_by_the_reference():
    result = judge_without_odometer(Journey(steps=((31.0, 36.0, 300.0),)))
    first, back = result.hazards.to_dicts()
    assert (first["hazard"], first["evidence"], first["detected"]) == ("VB_JUMP_1A", "reference", False)
    assert back["caused_by"] == 0


@pytest.mark.parametrize(("off_m", "suspect"), [(3.0, "map"), (0.0, "unknown")])
def test_a_reference_that_leaves_the_map_with_the_position_points_at_the_map(off_m, suspect):
    """Where it does not, one alarm of cross and up monitors may be chance: the map shows over several runs."""
    fails = {"cross_raw": ((50.0, 51.0),), "up_raw": ((50.5, 51.0),)}
    (row,) = alarms(Journey(fails=fails, survey=(50.0, 60.0, off_m)))
    assert (row["verdict"], row["suspect"]) == ("false", suspect)


def test_a_map_error_across_says_nothing_of_an_alarm_of_height():
    (row,) = alarms(Journey(fails={"up_raw": ((50.0, 51.0),)}, survey=(50.0, 60.0, 3.0)))
    assert row["suspect"] == "unknown"


def test_ambiguous_track_is_suspected():
    journey = Journey(fails={"cross_raw": ((50.0, 51.0),)})
    doubtful = journey.within(((49.0, 52.0),))
    epochs = journey.epochs().with_columns(
        gate_probability=pl.when(pl.Series(doubtful)).then(0.6).otherwise(pl.col("gate_probability"))
    )
    result = classify(
        Case("primary", epochs, truth_of(journey), journey.passages(), journey.balises(), None, locate, Configuration())
    )
    assert result.alarms["suspect"].to_list() == ["track"]


def test_truth_that_is_missing_for_longer_than_a_second_leaves_the_verdict_open():
    journey = Journey(fails={"along_raw": ((50.0, 51.0),)})
    config, passages = Configuration(), journey.passages()
    nothing = pl.lit(None, pl.Float64)
    epochs = journey.epochs().with_columns(odometer_m=nothing)
    for first_s, verdict in ((0.5, "false"), (3.0, "unknown")):
        reference = journey.reference_frame().slice(round(first_s * 20))
        truth = establish_truth(epochs, reference, None, passages, config)
        result = classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))
        assert result.alarms["verdict"].to_list() == [verdict]


def test_slip_long_after_an_error_of_the_position_is_the_odometers_fault():
    # 6 m from 20 s to 30 s make the verdict true; at 100 s the position is sound and the odometer is not.
    journey = Journey(duration_s=400.0, steps=((20.0, 30.0, 6.0),), balises_m=(100.0,), slip=(100.0, 105.0, 6.0))
    (row,) = alarms(journey.but(fails={"along_raw": ((100.2, 105.0),)}))
    assert (row["verdict"], row["suspect"]) == ("true", "odometer")


def test_bank_that_rings_on_while_negated_keeps_its_suspect():
    fails = {"along_raw": ((50.2, 55.0),), "along_ewma_0p001": ((395.0, 400.0),)}
    journey = Journey(duration_s=450.0, slip=(50.0, 55.0, 6.0), fails=fails)
    standing, returned = (alarms(journey.but(negated=(span,))) for span in ((50.2, 450.0), (50.2, 100.0)))
    assert [row["suspect"] for row in standing] == ["odometer", "odometer"]
    assert returned[1]["suspect"] == "unknown"


def test_error_across_says_nothing_of_an_alarm_along():
    epochs_wrong_across = Journey(fails={"along_raw": ((50.0, 51.0),)})
    frame = epochs_wrong_across.epochs().with_columns(
        cross_track_m=pl.when(pl.Series(epochs_wrong_across.within(((50.0, 51.0),)))).then(4.0).otherwise(0.0)
    )
    arguments = (truth_of(epochs_wrong_across), epochs_wrong_across.passages(), epochs_wrong_across.balises(), None)
    result = classify(Case("primary", frame, *arguments, locate, Configuration()))
    assert result.alarms["suspect"].to_list() == ["unknown"]


def test_an_alarm_across_the_track_is_not_the_odometers_fault():
    """The odometer slips by 6 m while a height monitor fails by chance: that monitor never saw the odometer."""
    slipping = Journey(slip=(50.0, 51.0, 6.0))
    (across,) = alarms(slipping.but(fails={"up_raw": ((50.5, 51.0),)}))
    (along,) = alarms(slipping.but(fails={"along_raw": ((50.5, 51.0),), "up_raw": ((50.5, 51.0),)}))
    assert (across["suspect"], along["suspect"]) == ("unknown", "odometer")
