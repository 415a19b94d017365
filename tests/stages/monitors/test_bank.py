"""The bank as the LDS sees it: states with reasons, gaps, restarts, borders; hand-worked where numbers count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from pipeline.stages.epochs.verdicts import DISABLED, NO_ODOMETER, NO_POSITION, NO_VALUE, first_reason, verdicts
from pipeline.stages.monitors.axes import NO_HEIGHT, OFF_TRACK
from pipeline.stages.monitors.bank import FIRST_EPOCH, MonitorBank
from pipeline.stages.monitors.single import NO_VELOCITY, channel_monitor, doppler_monitor, paired
from schemas.config import Configuration, Vehicle, threshold_factor
from schemas.monitors import BANK_MONITORS
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.frames import bank_over, verdict_table
from tests.stages.alignment.straight import NO_NOISE, Straight, align_run, epochs_of, odometer_of, run

CONFIG = Configuration.model_validate({"monitors": NO_NOISE})
FACTOR = threshold_factor(1e-7)
KNOWN = Vehicle(odometer_scale=1.0, gnss_latency_s=0.0)


def bank_of(epochs, odometer=None, config=CONFIG, vehicle=KNOWN):
    return bank_over(align_run(epochs, odometer, vehicle, config), {}, config)


def table(bank):
    return pl.DataFrame(bank.columns())


def steady(n, speed_mps=20.0, period_s=1.0, **columns):
    t = np.arange(n) * period_s
    odometer_t = np.arange(0.0, t[-1] + 0.05, 0.05)
    return epochs_of(t, speed_mps * t, **columns), odometer_of(odometer_t, speed_mps * odometer_t)


def test_rates_by_hand_at_one_hertz():
    """GNSS ahead by 3 m at epoch 2: raw 3 m/s, EWMA 0.1 gives 0.3, then 0.27 (DIAG eq. 1 and 8)."""
    epochs, odometer = steady(5)
    path = epochs["path_m"].to_numpy().copy()
    path[2:] += 3.0
    result = table(bank_of(epochs.with_columns(path_m=pl.Series(path)), odometer))
    assert result["along_raw_value"].to_list()[0] is None
    np.testing.assert_allclose(result["along_raw_value"].to_list()[1:], [0.0, 3.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(result["along_ewma_0p1_value"].to_list()[1:], [0.0, 0.3, 0.27, 0.243], atol=1e-9)


def test_raw_threshold_by_hand_at_one_hertz():
    """k_T sqrt(sum 2 R_j (1 - phi_j) + 0.05^2) with sigma 1 m."""
    result = table(bank_of(*steady(3, survey_sigma_m=[0.1] * 3)))
    phi = np.exp(-1.0 / np.array([360.0, 1800.0, 3600.0, 100.0]))
    expected = 5.3267 * np.sqrt((2 * np.array([0.083, 0.014, 0.15, 0.752]) * (1 - phi)).sum() + 0.05**2)
    assert result["along_raw_threshold"][1] == pytest.approx(expected, rel=1e-4)
    across = 5.3267 * np.sqrt((2 * np.array([0.083, 0.014, 0.15, 0.752]) * (1 - phi)).sum())
    assert result["cross_raw_threshold"][1] == pytest.approx(across, rel=1e-4)


def test_a_flat_survey_of_no_stated_accuracy_may_wander():
    """0.3 m, decorrelated over 20 m of way as exp(-20/100), on top of the receiver's variance."""
    stated = table(bank_of(*steady(3, survey_sigma_m=[0.1] * 3)))["cross_raw_threshold"][1] / FACTOR
    unstated = table(bank_of(*steady(3)))["cross_raw_threshold"][1] / FACTOR
    assert unstated**2 - stated**2 == pytest.approx(2 * 0.3**2 * (1 - np.exp(-0.2)), rel=1e-9)


def test_a_stated_survey_changes_along_the_track_by_configuration_alone():
    """0.1 m, decorrelated over 20 m of way as exp(-20/500) where a length is configured; along the track never."""
    epochs = steady(3, survey_sigma_m=[0.1] * 3)
    changing = Configuration.model_validate({"monitors": {"survey_length_m": 500.0, **NO_NOISE}})
    constant, wandering = (table(bank_of(*epochs, config=config)) for config in (CONFIG, changing))
    before, after = (one["cross_raw_threshold"][1] / FACTOR for one in (constant, wandering))
    assert after**2 - before**2 == pytest.approx(2 * 0.1**2 * (1 - np.exp(-20.0 / 500.0)), rel=1e-9)
    assert constant["along_raw_threshold"].equals(wandering["along_raw_threshold"])


def test_a_curve_turns_the_error_along_the_track_across_it():
    straight = table(bank_of(*steady(3)))["cross_raw_threshold"][2] / FACTOR
    curved = table(bank_of(*steady(3, curvature_per_m=[1e-3] * 3)))["cross_raw_threshold"][2] / FACTOR
    assert curved**2 - straight**2 == pytest.approx((1e-3 * 20.0) ** 2, rel=1e-6)


def test_uncertain_scale_and_latency_widen_the_raw_threshold():
    vehicle = Vehicle(odometer_scale=1.0, odometer_scale_sigma=0.01, gnss_latency_s=0.0)
    plain = table(bank_of(*steady(3)))["along_raw_threshold"][2]
    wide = table(bank_of(*steady(3), vehicle=vehicle))["along_raw_threshold"][2]
    assert wide**2 == pytest.approx(plain**2 + (FACTOR * 0.01 * 20.0) ** 2, rel=1e-9)


def test_absence_of_data_is_never_a_pass():
    epochs, odometer = steady(6, fix_valid=[True, True, False, True, True, True])
    epochs = epochs.with_columns(near_track=pl.Series([True, True, True, True, False, True]))
    result = table(bank_of(epochs, odometer))
    assert result["along_raw_state"].to_list() == [
        "not_evaluated",
        "pass",
        "not_evaluated",
        "pass",
        "not_evaluated",
        "pass",
    ]
    assert result["along_raw_reason"].to_list() == [FIRST_EPOCH, None, NO_POSITION, None, OFF_TRACK, None]
    assert result["up_raw_reason"].to_list() == [NO_HEIGHT, NO_HEIGHT, NO_POSITION, NO_HEIGHT, OFF_TRACK, NO_HEIGHT]


def test_without_odometer_only_the_along_axis_is_blind():
    epochs, _ = steady(4)
    result = table(bank_of(epochs))
    assert result["along_ewma_0p01_reason"].unique().to_list() == [NO_ODOMETER]
    assert result["along_ewma_0p01_state"].unique().to_list() == ["not_evaluated"]
    assert result["cross_raw_state"].to_list() == ["not_evaluated", "pass", "pass", "pass"]


def test_a_gap_is_a_longer_step_up_to_the_limit_and_a_restart_beyond():
    t = np.array([0.0, 1.0, 41.0, 42.0, 142.0, 143.0])
    path = 20.0 * t + np.array([0.0, 0.0, 12.0, 12.0, 500.0, 500.0])
    odometer_t = np.arange(0.0, 143.1, 0.05)
    result = table(bank_of(epochs_of(t, path), odometer_of(odometer_t, 20.0 * odometer_t)))
    assert result["along_raw_value"][2] == pytest.approx(12.0 / 40.0)
    assert result["along_raw_state"].to_list()[4] == "not_evaluated"
    assert result["along_raw_reason"].to_list()[4] == FIRST_EPOCH


def test_a_restart_forgets_what_rang():
    epochs, odometer = steady(60)
    path = epochs["path_m"].to_numpy().copy()
    path[20:] += 45.0
    bank = bank_of(epochs.with_columns(path_m=pl.Series(path)), odometer)
    assert bank.failed(20)
    assert bank.failed(40)
    assert not bank.failed(19)
    bank.restart(30)
    assert [k for k in range(60) if bank.failed(k)] == list(range(20, 30))
    assert not bank.along_evaluated(30)
    assert bank.along_evaluated(31)


def test_recovery_looks_at_raw_and_the_fastest_average_only():
    epochs, odometer = steady(200)
    path = epochs["path_m"].to_numpy().copy()
    path[50:] += 45.0
    bank = bank_of(epochs.with_columns(path_m=pl.Series(path)), odometer)
    assert bank.failed(199)
    assert not bank.fast_failed(199)


def test_results_do_not_depend_on_how_far_was_asked_before():
    epochs, odometer = run(Straight(), 12)
    one, other = bank_of(epochs, odometer), bank_of(epochs, odometer)
    for k in range(0, epochs.height, 17):
        one.failed(k)
    one.restart(1_000)
    other.failed(1_200)
    other.restart(1_000)
    assert table(one).equals(table(other))


def test_a_survey_step_at_an_element_border_is_judged_by_the_survey_not_averaged():
    """1.5 m aside at the border: no alarm, nothing rings; 15 m aside is no survey error."""
    elements = ["a"] * 10 + ["b"] * 10
    for step_m, expected in ((1.5, []), (15.0, [10])):
        cross = np.where(np.arange(20) >= 10, step_m, 0.0)
        epochs, odometer = steady(20, netelement_id=elements, cross_track_m=cross)
        bank = bank_of(epochs, odometer)
        assert [k for k in range(20) if bank.failed(k)] == expected
        assert table(bank)["cross_ewma_0p1_value"].drop_nulls().abs().max() == 0.0


def test_a_switched_off_monitor_says_so_and_raises_no_alarm():
    config = Configuration.model_validate({"monitors": {"disabled": ["along_raw", "along_doppler"], **NO_NOISE}})
    epochs, odometer = steady(5)
    path = epochs["path_m"].to_numpy().copy()
    path[2:] += 4.0
    aligned = align_run(epochs.with_columns(path_m=pl.Series(path)), odometer, KNOWN, config)
    bank = bank_over(
        aligned, {"along_doppler": doppler_monitor(arrays_of_table(AlignedEpochs, aligned), config)}, config
    )
    result = table(bank)
    assert result["along_raw_reason"].unique().to_list() == [DISABLED]
    assert result["along_doppler_reason"].unique().to_list() == [DISABLED]
    assert result["along_raw_state"].unique().to_list() == ["not_evaluated"]


def test_every_monitor_of_the_bank_has_its_four_columns():
    names = table(bank_of(*steady(3))).columns
    assert names == [f"{m}_{part}" for m in BANK_MONITORS for part in ("value", "threshold", "state", "reason")]


def test_doppler_sides_with_gnss_when_the_wheels_slip():
    t = np.arange(0.0, 20.0, 0.1)
    odometer_t = np.arange(0.0, 20.0, 0.05)
    slip = 5.0 * np.clip(odometer_t - 10.0, 0.0, 1.0)
    epochs = epochs_of(t, 20.0 * t, velocity_along_mps=np.full(t.size, 20.0))
    aligned = align_run(epochs, odometer_of(odometer_t, 20.0 * odometer_t + slip), KNOWN, CONFIG)
    result = verdict_table(doppler_monitor(arrays_of_table(AlignedEpochs, aligned), CONFIG))
    fails = [t[k] for k in range(t.size) if result["state"][k] == "fail"]
    assert 10.0 < fails[0] < 10.5
    assert fails[-1] < 12.1
    assert result["value"][120] == pytest.approx(-1.0, abs=4.1)
    without = align_run(epochs_of(t, 20.0 * t), odometer_of(odometer_t, 20.0 * odometer_t), KNOWN, CONFIG)
    without = verdict_table(doppler_monitor(arrays_of_table(AlignedEpochs, without), CONFIG))
    assert without["reason"].unique().to_list() == [NO_VELOCITY]


def test_channels_are_compared_where_both_have_a_position():
    one = epochs_of([0.0, 1.0, 2.0], [0.0, 20.0, 40.0])
    other = epochs_of([0.0, 1.0, 2.0], [0.0, 30.0, 41.0], fix_valid=[True, True, False])
    result = verdict_table(channel_monitor(one, other, CONFIG))
    assert result["state"].to_list() == ["pass", "fail", "not_evaluated"]
    assert result["value"].to_list() == [0.0, -10.0, None]
    assert result["threshold"][0] == pytest.approx(FACTOR * np.sqrt(2.0))


def test_a_channel_is_compared_with_this_solution_at_its_own_time():
    """Once a second at 20 m/s, 3 s of nothing after 2 s; the channel at 1 s, 1.75 s, 3 s and 5.5 s."""
    epochs = epochs_of(np.array([0.0, 1.0, 2.0, 5.0, 6.0]), 20.0 * np.array([0.0, 1.0, 2.0, 5.0, 6.0]))
    channel = epochs_of(np.array([1.0, 1.75, 3.0, 5.5]), np.zeros(4))
    found = paired(epochs, channel, CONFIG.lds)
    # 3 s lies in the gap, and before 1 s there is no row.
    assert found["path_m"].to_list() == [None, 20.0, 35.0, None, 110.0]
    assert found["row_other"].to_list() == [None, 0, 1, None, 3]


def test_a_single_monitor_without_value_or_threshold_is_no_pass():
    nothing = np.nan
    found = verdicts(
        np.array([1.0, 3.0, nothing, 1.0, 1.0]),
        np.array([2.0, 2.0, 2.0, nothing, 2.0]),
        first_reason((np.arange(5) == 4, NO_POSITION)),
    )
    frame = verdict_table(found)
    assert frame["state"].to_list() == ["pass", "fail", "not_evaluated", "not_evaluated", "not_evaluated"]
    assert frame["reason"].to_list() == [None, None, NO_VALUE, NO_VALUE, NO_POSITION]


def test_an_axis_without_any_epoch_hides_no_fail_of_the_others():
    """No heights; a step of 30 m along the track far behind what is looked at first."""
    count = 8400
    path_m = 20.0 * np.arange(count) + np.where(np.arange(count) >= 8300, 30.0, 0.0)
    epochs, odometer = steady(count)
    bank = bank_of(epochs.with_columns(path_m=pl.Series(path_m)), odometer)
    assert [bank.failed(k) for k in (0, 8299, 8300)] == [False, False, True]


@pytest.mark.parametrize(("epoch", "end", "quiet"), [(1, 9, 4), (4, 9, 4), (5, 9, 8), (5, 7, 7), (1, 3, 3)])
def test_quiet_until_the_next_fail_or_the_end_of_what_is_known(epoch: int, end: int, quiet: int) -> None:
    """Fails at the fourth and the ninth epoch; ten are known."""
    fails = np.isin(np.arange(10), [4, 8])
    bank = SimpleNamespace(_look=lambda _: None, _stops=fails, _known_to=9)
    assert MonitorBank.first_alarm_from(cast(Any, bank), epoch, end) == quiet
