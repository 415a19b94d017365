"""The ladder of evidence, and the same faults with each kind of it."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.hazards import Case, classify, establish_truth
from pipeline.hazards.jumps import find_jumps
from pipeline.hazards.series import series_of
from schemas.config import Configuration, HazardConfig, MonitorConfig
from tests.hazards.synthetic import START_NS, UTC, Journey, judge, locate, seconds, stamps, truth_of, with_hazards

READS = tuple(np.arange(50.0, 2400.0, 500.0))
VBS_ACCEPTED = {"V0": 5.0, "V1": 15.0, "V2": 25.0}

FAULTS = {
    "jump over two": Journey(steps=((31.0, 36.0, 300.0),), accepted=VBS_ACCEPTED),
    "jump over one": Journey(steps=((34.0, 38.0, 45.0),), accepted=VBS_ACCEPTED),
    "offset that stays": Journey(steps=((31.0, 60.0, 60.0),), accepted=VBS_ACCEPTED),
}


@pytest.mark.parametrize("name", FAULTS)
def test_same_faults_with_each_kind_of_evidence(name):
    journey = FAULTS[name]
    by_reference = judge(journey).hazards
    by_balises = judge(journey.but(reference=False, reads=READS)).hazards
    by_odometer = judge(journey.but(reference=False)).hazards
    assert by_reference.height > 0
    for found, evidence in ((by_balises, "balise"), (by_odometer, "odometer")):
        assert found["evidence"].unique().to_list() == [evidence]
        for column in ("hazard", "balise_ids", "t_hazard", "caused_by", "timing"):
            assert found[column].to_list()[:1] == by_reference[column].to_list()[:1], (evidence, column)
        assert found["hazard"].to_list() == by_reference["hazard"].to_list()


def test_slow_drift_that_moves_the_anchors_is_seen_by_balise_reads_but_not_by_the_odometer_alone():
    # Accepted VBs anchor the odometer anew, each a little more wrong: the odometer alone cannot see it.
    accepted = {f"V{i}": (100.0 + 200.0 * i + 5.0) / 20.5 for i in range(8)}
    journey = Journey(ramps=((10.0, 110.0, 0.5),), accepted=accepted, reference=False)
    assert judge(journey).hazards.height == 0
    (row,) = judge(journey.but(reads=READS)).hazards.to_dicts()
    assert (row["hazard"], row["timing"], row["evidence"]) == ("VB_SHIFT", "early", "balise")


def test_alarm_of_a_drift_that_moves_the_anchors_is_not_called_false_on_the_odometers_word():
    fails = {"along_raw": ((60.0, 61.0),)}
    accepted = {f"V{i}": (100.0 + 200.0 * i + 5.0) / 20.5 for i in range(8)}
    drifting = Journey(ramps=((10.0, 110.0, 0.5),), accepted=accepted, reference=False, fails=fails)
    sound = drifting.but(ramps=(), accepted={f"V{i}": 5.0 + 10.0 * i for i in range(8)})
    (row,) = judge(drifting).alarms.to_dicts()
    assert row["verdict"] == "unknown"
    (row,) = judge(sound).alarms.to_dicts()
    assert row["verdict"] == "false"


def test_only_what_exceeds_the_odometers_confidence_is_a_hazard():
    # V2 (500 m) accepted at 25 s; 22 m from 55 s on: V6 (1300 m) offered 778 m after it, 5 + 38.9 m cover that.
    journey = Journey(steps=((55.0, 75.0, 19.5),), ramps=((56.0, 75.0, 0.5),), accepted=VBS_ACCEPTED)
    assert judge(journey).hazards.height == 1
    by_odometer = judge(journey.but(reference=False))
    assert by_odometer.hazards.height == 0
    # 24 m at 65 s: beyond the limit, within 5 m + 5 % of 800 m: neither sound nor failed.
    assert judge(journey).epochs_columns["lds_state"][650] == "P1"
    assert by_odometer.epochs_columns["lds_state"][650] is None


def test_truth_is_interpolated_to_the_time_of_validity():
    # Latency 0.2 s at 20 m/s: the position stamped t is that of the train at t - 0.2 s, 4 m behind.
    journey = Journey(steps=((0.0, 500.0, -4.0),))
    epochs = journey.epochs().with_columns(latency_s=pl.lit(0.2))
    config = Configuration()
    passages = journey.passages([{"balise_id": "V3", "t_offered": 35.2}])
    truth = establish_truth(epochs, journey.reference_frame(), None, passages, config)
    result = classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))
    known = result.epochs_columns["error_along_m"].drop_nulls()
    assert known.abs().max() == pytest.approx(0.0, abs=1e-6)
    (row,) = result.passages.to_dicts()
    assert seconds(row["t_true"]) == pytest.approx(35.0)
    assert row["location_error_m"] == pytest.approx(0.0, abs=1e-6)


def test_gap_in_the_reference_falls_down_the_ladder():
    journey = Journey(reads=READS)
    reference = journey.reference_frame().filter(
        ~pl.col("t").is_between(
            pl.lit(START_NS + 20 * 10**9).cast(UTC), pl.lit(START_NS + 30 * 10**9).cast(UTC), closed="none"
        )
    )
    config = Configuration()
    truth = establish_truth(journey.epochs(), reference, journey.reads_frame(), journey.passages(), config)
    evidence = truth["evidence"].to_list()
    assert (evidence[199], evidence[250], evidence[301]) == ("reference", "balise", "reference")
    assert truth["truth_path_m"].to_numpy() == pytest.approx(journey.truth_m(), abs=1e-6)


def test_odometer_error_between_two_reads_is_shared_out_by_distance():
    # 1 % too much counted between reads at 50 m and 550 m: 5 m; half way the truth is still met.
    journey = Journey(reference=False, reads=(50.0, 550.0), slip=(2.5, 27.5, 0.2))
    truth = truth_of(journey)
    assert truth["truth_path_m"].to_numpy()[25:276] == pytest.approx(journey.truth_m()[25:276], abs=0.03)


def test_reads_that_contradict_the_odometer_widen_the_bound():
    # 60 m slipped between two reads 500 m apart: beyond 2 * 5 m + 5 % of the way; nothing below 60 m is a hazard.
    journey = Journey(reference=False, reads=(50.0, 550.0), slip=(10.0, 20.0, 6.0))
    truth = truth_of(journey)
    assert truth["truth_slip_m"][150] == pytest.approx(60.0 + 3.0 * np.sqrt(2.0 + 0.0025 * 25.0), abs=0.1)
    assert 30.0 + 20.0 <= truth["truth_bound_m"][150] <= truth["truth_slip_m"][150]
    assert judge(journey).hazards.height == 0


@pytest.mark.parametrize(("size_m", "seen"), [(40.0, True), (-40.0, False), (-120.0, True)])
def test_error_that_no_slip_between_the_reads_accounts_for_is_a_hazard(size_m, seen):
    # The odometer counts 60 m too far from 22 s on: a position ahead of where either read puts the train is wrong;
    # one 40 m behind may be right, one 120 m behind is not.
    journey = Journey(reference=False, reads=(50.0, 550.0), slip=(22.0, 25.0, 20.0), steps=((8.5, 20.0, size_m),))
    assert bool(judge(journey).hazards.height) is seen
    state = judge(journey).epochs_columns["lds_state"]
    assert state[120] == ("P1" if seen else None)
    assert judge(journey.but(steps=())).hazards.height == 0


def test_a_slip_excuses_a_jump_no_longer_than_itself_whatever_its_rounding():
    # The odometer counts 60 m too little; the position leaps 100 m ahead. One slip has other last digits from epoch
    # to epoch, and two of them would make 120 m of it.
    journey = Journey(reference=False, reads=(50.0, 550.0), slip=(22.0, 25.0, -20.0), steps=((10.0, 20.0, 100.0),))
    truth = truth_of(journey)
    slip_m = truth["truth_slip_m"].to_numpy().copy()
    assert slip_m[100] < -60.0
    slip_m[100:] += 4.5e-13
    told = truth.with_columns(truth_slip_m=pl.Series(slip_m))
    series = series_of(journey.epochs(), told, Configuration().lds)
    (ahead, *_) = find_jumps(series, (), HazardConfig())
    assert (ahead.first, round(ahead.step_m)) == (100, 100)


def test_one_slip_between_two_reads_excuses_one_jump():
    # The odometer counts 60 m too little at 30 s; at 10 s the position leapt 55 m, which the same slip would excuse.
    journey = Journey(reference=False, reads=(50.0, 1050.0), slip=(30.0, 31.0, -60.0), steps=((10.0, 20.0, 55.0),))
    series = series_of(journey.epochs(), truth_of(journey), Configuration().lds)
    found = [(jump.first, round(jump.step_m)) for jump in find_jumps(series, (), HazardConfig())]
    assert found[:2] == [(100, 55), (200, -55)]
    alone = journey.but(steps=())
    assert find_jumps(series_of(alone.epochs(), truth_of(alone), Configuration().lds), (), HazardConfig()) == []


def test_error_within_the_limit_that_the_slip_may_carry_beyond_it_is_not_known():
    # 15 m slipped just behind the first read, where the place is shared out by distance: 33 m look like 20 m, which is
    # more than the slip itself.
    journey = Journey(reference=False, reads=(50.0, 550.0), slip=(3.0, 4.0, 15.0), steps=((4.5, 6.0, 33.0),))
    told = judge(journey).epochs_columns[45:60]
    seen = journey.epochs()["path_m"][45:60] - truth_of(journey)["truth_path_m"][45:60]
    assert seen.min() < 20.0
    assert "P0" not in told["lds_state"].cast(pl.String).to_list()
    assert told.filter(seen <= 20.0)["error_along_m"].null_count() == (seen <= 20.0).sum()


WITH_DOPPLER = Journey(reference=False, reads=READS, doppler=True)


@pytest.mark.parametrize(
    ("error", "slip"),
    [
        ({"steps": ((31.0, 60.0, 60.0),)}, (40.0, 42.0, 100.0)),
        ({"steps": ((31.0, 60.0, 24.0),)}, (31.0, 32.0, 150.0)),
        ({"ramps": ((30.0, 70.0, 1.0),)}, (36.0, 46.0, -15.0)),
    ],
)
def test_a_slip_beside_a_position_that_left_doppler_hides_no_hazard(error, slip):
    alone, both = (judge(WITH_DOPPLER.but(slip=by, **error)).hazards for by in (None, slip))
    assert alone.height
    assert both["hazard"].to_list() == alone["hazard"].to_list()
    assert set(both["suspect"]) == {"gnss"}
    assert judge(WITH_DOPPLER.but(slip=slip)).hazards.height == 0


def test_slip_with_doppler_is_no_hazard_whatever_the_evidence():
    journey = Journey(
        reference=False,
        doppler=True,
        accepted=VBS_ACCEPTED,
        slip=(40.0, 50.0, 8.0),
        fails={"along_raw": ((40.2, 50.0),)},
    )
    for reads in ((), READS):
        result = judge(journey.but(reads=reads))
        assert result.hazards.height == 0
        (alarm,) = result.alarms.to_dicts()
        assert alarm["suspect"] == "odometer"
        assert alarm["verdict"] != "true"


def test_doppler_names_the_position_where_it_left_alone():
    journey = FAULTS["jump over one"].but(reference=False, doppler=True)
    (row,) = judge(journey).hazards.to_dicts()
    assert row["suspect"] == "gnss"
    (row,) = judge(journey.but(doppler=False)).hazards.to_dicts()
    assert row["suspect"] == "unknown"


@pytest.mark.parametrize("accepted", [{}, {"V5": (1100.0 - 34.0) / 20.0}])
def test_lone_jump_back_is_as_large_as_its_step(accepted):
    # 45 m crept in within 5 m + 5 % of the way, then V7 (1500 m) is crossed by the jump back.
    journey = Journey(ramps=((13.0, 73.0, 0.75),), reference=False, accepted=accepted)
    (row,) = judge(journey).hazards.to_dicts()
    assert (row["hazard"], row["balise_ids"]) == ("VB_JUMP_1B", ["V7"])
    assert row["size_m"] == pytest.approx(-45.0, abs=0.1)


def test_without_reference_and_odometer_there_is_no_truth():
    journey = Journey(reference=False)
    nothing = pl.lit(None, pl.Float64)
    epochs = journey.epochs().with_columns(odometer_m=nothing, scale_sigma=nothing, odometer_white_m2_per_s=nothing)
    config = Configuration()
    truth = establish_truth(epochs, None, None, journey.passages(), config)
    assert truth["evidence"].null_count() == truth.height
    assert truth["truth_path_m"].null_count() == truth.height


def test_stamps_of_the_synthetic_journeys_are_utc():
    assert stamps([0.0]).dtype == UTC


def test_smoothed_reference_sees_what_the_anchors_follow():
    # An offset of 25 m for 20 s under alarm: LRVB anchors with 5 m + 5 % cannot hold it, the smoother can.
    accepted = {**VBS_ACCEPTED, "V3": 35.0}
    journey = Journey(
        reference=False,
        accepted=accepted,
        steps=((60.0, 85.0, 28.0),),
        fails={"along_raw": ((60.0, 61.0),)},
        negated=((60.1, 115.0),),
    )
    assert judge(journey).hazards.height == 0
    result = judge(journey, config=with_hazards(smoothed_reference=True))
    (row,) = result.hazards.to_dicts()
    assert (row["hazard"], row["evidence"], row["timing"]) == ("VB_SHIFT", "odometer", "early")
    assert row["size_m"] == pytest.approx(28.0, abs=0.5)
    truth = truth_of(journey, config=with_hazards(smoothed_reference=True))
    assert truth["truth_smoothed"].all()
    assert truth["truth_path_m"].to_numpy() == pytest.approx(journey.truth_m(), abs=0.5)


def test_smoothed_truth_stays_within_its_own_sigma():
    # 0.1 % of the way counted too much, white position noise of 1 m: the scale error is found with the offset.
    rng = np.random.default_rng(7)
    journey = Journey(duration_s=300.0, reference=False, slip=(0.0, 300.0, 0.02), sigma_m=1.0)
    noise = rng.normal(0.0, 1.0, journey.t_s().size)
    epochs = journey.epochs().with_columns(pl.col("path_m") + pl.Series(noise), scale_sigma=pl.lit(0.01))
    config = with_hazards(smoothed_reference=True)
    truth = establish_truth(epochs, None, None, journey.passages(), config)
    error = truth["truth_path_m"].to_numpy() - journey.truth_m()
    assert np.abs(error).max() < 1.0
    assert np.all(np.abs(error) < 3.0 * truth["truth_sigma_m"].to_numpy())


def test_errors_are_judged_with_the_latency_that_is_known_in_the_end():
    # Positions are 0.1 s old throughout; the estimate in use was 0 for the first minute (20 m/s: 2 m).
    journey = Journey()
    late = np.where(journey.t_s() < 60.0, 0.0, 0.1)
    epochs = journey.epochs().with_columns(path_m=pl.Series(journey.truth_m() - 2.0), latency_s=pl.Series(late))
    config = Configuration()
    truth = establish_truth(epochs, journey.reference_frame(), None, journey.passages(), config)
    error = (epochs["path_m"] - truth["truth_path_m"]).drop_nulls()
    assert error.abs().max() == pytest.approx(0.0, abs=1e-6)
    assert error.len() > 1000


def test_a_latency_that_the_run_cannot_prove_is_noise():
    """At constant speed the estimate wanders: 0.15 s, one sigma from nothing, would be 3 m of healthy positions."""
    journey = Journey(reads=(310.0, 1510.0))
    wandering = {"latency_s": pl.lit(0.15) * (pl.col("t").rank() / 1201.0), "latency_sigma_s": pl.lit(0.14)}
    shifted = pl.col("odometer_m") - 20.0 * pl.col("latency_s")  # counted at t - latency
    epochs = journey.epochs().with_columns(**wandering).with_columns(latency_s=pl.col("latency_s") - 0.15 / 1201.0)
    epochs = epochs.with_columns(odometer_m=shifted)
    config = Configuration()
    for reference in (journey.reference_frame(), None):
        reads = journey.reads_frame().with_columns(odometer_m=pl.Series(journey.reads))
        truth = establish_truth(epochs, reference, reads, journey.passages(), config)
        error = (epochs["path_m"] - truth["truth_path_m"]).drop_nulls()
        assert error.len() > 1000
        assert error.abs().max() < 0.01


@pytest.mark.parametrize(("sigma_s", "error_m"), [(0.06, 0.0), (0.14, 1.6)])
def test_a_learned_latency_counts_where_the_run_halved_the_doubt(sigma_s, error_m):
    # Positions are 0.08 s old at 20 m/s, and the run says so with this sigma; 0.2 s were unknown at its start.
    journey = Journey()
    known = journey.t_s() > 0.0
    epochs = journey.epochs().with_columns(
        path_m=pl.Series(journey.truth_m() - 1.6),
        latency_s=pl.Series(np.where(known, 0.08, 0.0)),
        latency_sigma_s=pl.Series(np.where(known, sigma_s, 0.2)),
    )
    config = Configuration()
    truth = establish_truth(epochs, journey.reference_frame(), None, journey.passages(), config)
    error = (epochs["path_m"] - truth["truth_path_m"]).drop_nulls()
    assert error.median() == pytest.approx(-error_m, abs=1e-6)


def test_doppler_along_a_track_that_heads_elsewhere_hides_no_jump():
    """700 m back for 70 s, to where the track turns the other way: along it, the velocity says -3 m/s.

    30 s later Doppler's sum has lost 700 m against the odometer too, and by the sum alone it sides with the position.
    """
    reads = (150.0, 2350.0)
    journey = Journey(steps=((31.0, 101.0, -700.0),), doppler=True, accepted=VBS_ACCEPTED, duration_s=130.0)
    elsewhere = pl.Series("velocity_along_mps", np.where(journey.within(((31.0, 100.9),)), -3.0, 20.0))
    epochs = journey.epochs().with_columns(elsewhere)
    config = Configuration()
    for given in (None, journey.but(reads=reads).reads_frame()):
        truth = establish_truth(epochs, None, given, journey.passages(), config)
        error = (epochs["path_m"] - truth["truth_path_m"]).to_numpy()
        assert np.abs(error - journey.error_m()).max() < 1.0
        found = classify(
            Case("primary", epochs, truth, journey.passages(), journey.balises(), None, locate, config)
        ).hazards
        first = found.row(0, named=True)
        assert (seconds(first["t_hazard"]), first["suspect"]) == (31.0, "gnss")
        assert first["size_m"] == pytest.approx(-700.0, abs=1.0)


@pytest.mark.parametrize(("margin_m", "evidence_error_m"), [(5.0, 0.0), (4.0, -6.0)])
def test_how_far_a_healthy_position_strays_from_doppler_is_the_margin_of_false_alarms(margin_m, evidence_error_m):
    """The odometer slips by 6 m within a second, in which the position wavers by 4.5 m."""
    wavers = ((50.1, 50.3, 4.5), (50.8, 51.1, 4.5))
    journey = Journey(steps=wavers, slip=(50.0, 51.0, 6.0), doppler=True, fails={"along_raw": ((50.5, 51.0),)})
    config = Configuration(hazards=HazardConfig(false_alarm_margin_m=margin_m))
    epochs, passages = journey.epochs(), journey.passages()
    truth = establish_truth(epochs, None, None, passages, config)
    error_m = (epochs["path_m"] - truth["truth_path_m"])[-1]
    assert error_m == pytest.approx(evidence_error_m, abs=0.1)
    (alarm,) = classify(
        Case("primary", epochs, truth, passages, journey.balises(), None, locate, config)
    ).alarms.iter_rows(named=True)
    assert alarm["suspect"] == ("odometer" if margin_m == 5.0 else "gnss")


@pytest.mark.parametrize(("doppler_sigma_mps", "reached_m"), [(0.1, 0.0), (2.0, -6.0)])
def test_a_slip_is_told_from_the_noise_that_the_velocity_is_known_to_have(doppler_sigma_mps, reached_m):
    """6 m that the odometer slips within a second: the sum of a velocity with 2 m/s of noise tells nothing of them."""
    journey = Journey(slip=(50.0, 51.0, 6.0), doppler=True)
    config = Configuration(monitors=MonitorConfig(doppler_sigma_mps=doppler_sigma_mps))
    epochs = journey.epochs()
    truth = establish_truth(epochs, None, None, journey.passages(), config)
    assert (epochs["path_m"] - truth["truth_path_m"])[-1] == pytest.approx(reached_m, abs=0.1)
