"""Runs with little in them: no epoch, one epoch, no balises, no position, no truth over the hazard."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.hazards import Case, classify, establish_truth
from schemas.config import Configuration
from schemas.tables import Alarms, Hazards, Passages
from tests.hazards.synthetic import Journey, locate, seconds

STEP = Journey(steps=((34.0, 38.0, 45.0),))


def judge_epochs(journey, epochs, balises=None, reference=True):
    config = Configuration()
    passages = journey.passages([])
    given = journey.reference_frame() if reference else None
    truth = establish_truth(epochs, given, None, passages, config)
    found = journey.balises() if balises is None else balises
    return classify(Case("primary", epochs, truth, passages, found, None, locate, config))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_epochs(count):
    for reference in (True, False):
        result = judge_epochs(STEP, STEP.epochs().head(count), reference=reference)
        assert result.epochs_columns.height == count
        assert result.hazards.height == result.alarms.height == result.passages.height == 0
        Hazards.validate(result.hazards)
        Alarms.validate(result.alarms)
        Passages.validate(result.passages)


def test_site_without_balises():
    result = judge_epochs(STEP, STEP.epochs(), STEP.balises().clear())
    assert result.hazards.height == 0
    assert result.epochs_columns["error_along_m"].abs().max() == pytest.approx(45.0)


def test_run_without_any_position():
    epochs = STEP.epochs().with_columns(fix_valid=pl.lit(False), path_m=pl.lit(None, pl.Float64))
    result = judge_epochs(STEP, epochs)
    assert result.hazards.height == 0
    assert result.epochs_columns["error_along_m"].null_count() == epochs.height


def test_epochs_that_the_log_lost_are_no_jump():
    # Epochs from 34 s to 37 s are missing and the position is sound: nothing happened.
    sound = Journey()
    t = pl.Series(sound.t_s())
    result = judge_epochs(sound, sound.epochs().filter((t <= 34.0) | (t >= 37.0)))
    assert result.hazards.height == 0


def test_truth_that_is_missing_over_the_step_still_shows_the_offset_after_it():
    # Without odometer a hole in the reference hides the step at 31 s; V4 (900 m) is offered 45 m early all the same.
    journey = Journey(steps=((31.0, 60.0, 45.0),))
    nothing = pl.lit(None, pl.Float64)
    epochs = journey.epochs().with_columns(odometer_m=nothing, scale_sigma=nothing, odometer_white_m2_per_s=nothing)
    t = pl.Series(journey.reference_frame()["t"]).dt.timestamp("ns")
    hole = (t - t[0]).is_between(29 * 10**9, 40 * 10**9)
    config = Configuration()
    passages = journey.passages([])
    truth = establish_truth(epochs, journey.reference_frame().filter(~hole), None, passages, config)
    result = classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))
    (row,) = result.hazards.to_dicts()
    assert (row["hazard"], row["balise_ids"][0]) == ("VB_SHIFT", "V4")
    assert seconds(row["t_onset"]) == pytest.approx(40.1)


def test_reversal_under_a_constant_offset_is_no_jump():
    # Forwards to 60 s, then back: an offset of 10 m along the path turns from ahead to behind.
    journey = Journey(steps=((0.0, 200.0, 10.0),))
    t = journey.t_s()
    place = pl.Series([20.0 * s if s <= 60.0 else 20.0 * (120.0 - s) for s in t])
    turned = pl.Series(t > 60.0)
    epochs = journey.epochs().with_columns(
        path_m=place + 10.0,
        odometer_m=place,
        direction=pl.when(turned).then(-1).otherwise(1).cast(pl.Int8),
        speed_mps=pl.when(turned).then(-20.0).otherwise(20.0),
    )
    config = Configuration()
    passages = journey.passages([])
    reference = pl.DataFrame(
        {"t": epochs["t"], "path_m": place, "cross_track_m": place * 0, "vertical_m": place * 0, "sigma_m": place * 0}
    )
    truth = establish_truth(epochs, reference, None, passages, config)
    result = classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))
    assert result.hazards.height == 0
    error = result.epochs_columns["error_along_m"]
    assert error[300] == pytest.approx(10.0)
    assert error[900] == pytest.approx(-10.0)
