"""The fast noise measured in the run: by hand, against receivers of an own simulation, and what must never enter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.noise import Receiver, epochs_of, first_alarm
from pipeline.stages.monitors.axis import AxisSeries, Source, errors_of
from pipeline.stages.monitors.bank import NOISE_TOO_LARGE, NOISE_UNKNOWN
from pipeline.stages.monitors.noise import NoiseMeter
from schemas.arrays import Floats
from schemas.config import Configuration
from schemas.enums import MonitorState
from tests.frames import bank_over

CONFIG = Configuration()


def series_of(
    offset_m: Floats, period_s: float = 1.0, sigma_m: float = 0.0, beside: Sequence[Source] = ()
) -> AxisSeries:
    """An axis whose offset is this, epoch by epoch, with smooth errors of this sigma stated, and other errors."""
    count = offset_m.size
    dt_s = np.full(count, period_s)
    nothing, never = np.zeros(count), np.zeros(count, dtype=np.bool_)
    return AxisSeries(
        epoch=np.arange(count),
        fresh=np.arange(count) == 0,
        border=never,
        dt_s=dt_s,
        rate_mps=np.diff(offset_m, prepend=offset_m[:1]) / dt_s,
        **errors_of(np.full(count, sigma_m), dt_s, beside, CONFIG.monitors),
        white_m2=nothing,
        border_m2=nothing,
        lasting_mps=np.zeros((count, 0)),
    )


def meter_of(series: AxisSeries, config: Configuration = CONFIG) -> NoiseMeter:
    return NoiseMeter(series, np.ones(series.epoch.size, dtype=np.bool_), None, config)


def noise_m(offset_m: Floats, row: int, **settings: float) -> list[float]:
    config = Configuration.model_validate({"monitors": {"noise_doubt": 0.0, **settings}})
    return np.sqrt(meter_of(series_of(offset_m), config).variance_m2(row, row + 1)[0]).tolist()


def test_by_hand_an_offset_that_alternates() -> None:
    """+-1 cm from epoch to epoch: second differences of 4 cm at one epoch, none at 10 s, which counts as no less.

    All quantiles are 4 cm; the smallest Gaussian value, 0.674, makes the most of it: 4 / 0.674 / 2 = 2.97 cm.
    """
    raw, fast, *_ = noise_m(0.01 * (-1.0) ** np.arange(200), 199)
    assert raw == pytest.approx(0.0297, rel=0.045)
    assert fast == raw


@pytest.mark.parametrize(("kept", "times"), [(0.0, 6.0), (0.5, 2.5), (0.9, 0.42), (1.0, 0.0)])
def test_an_error_that_the_model_knows_is_taken_off_by_its_second_differences(kept: float, times: float) -> None:
    """Of an error that keeps this part from epoch to epoch: (1 + 4 + 1) - (4 + 4) kept + 2 kept^2 times its variance.

    Digits keep nothing, and an offset of the survey all; four variances of a second difference are one of noise.
    """
    config = Configuration.model_validate({"monitors": {"noise_doubt": 0.0}})
    offset_m = 0.01 * (-1.0) ** np.arange(200)
    known = np.full(200, 0.01), np.full(200, 1.0 - kept)
    without, beside = (
        meter_of(series_of(offset_m, beside=errors), config).variance_m2(199, 200)[0, 0] for errors in ([], [known])
    )
    assert without - beside == pytest.approx(0.25 * times * 0.01**2, rel=1e-6, abs=1e-12)


def test_what_lasts_is_taken_off_as_it_is() -> None:
    """2 mm to and fro, as of a latency: second differences of 8 mm, of which a fourth of the square is taken off."""
    config = Configuration.model_validate({"monitors": {"noise_doubt": 0.0}})
    way = (-1.0) ** np.arange(200)
    without = series_of(0.01 * way)
    lasting = replace(without, lasting_mps=np.diff(0.002 * way, prepend=0.002)[:, None])
    noise_m2 = [meter_of(series, config).variance_m2(199, 200)[0, 0] for series in (without, lasting)]
    assert noise_m2[0] - noise_m2[1] == pytest.approx(0.25 * 0.008**2)


def test_the_noise_of_one_row_is_that_of_the_row_among_all() -> None:
    meter = meter_of(series_of(0.01 * (-1.0) ** np.arange(90), 0.5))
    single = np.concatenate([meter.variance_m2(row, row + 1) for row in range(90)])
    np.testing.assert_array_equal(single, meter.variance_m2(0, 90))


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2, 0.25, 0.5, 1.0])
def test_the_noise_is_known_after_30_s_at_every_rate(period_s: float) -> None:
    """`noise_first_s`: with a sample every second the first is at 1 s, and the 29th, of 29.6 s asked for, at 29 s."""
    known_from = meter_of(series_of(np.zeros(round(100.0 / period_s)), period_s)).known_from()
    assert known_from * period_s == pytest.approx(30.0, abs=1.01 * period_s)


def test_a_drift_is_no_noise() -> None:
    assert noise_m(0.5 * np.arange(1000.0), 999) == [0.0] * 4


def test_white_noise_is_taken_for_half_as_much_again() -> None:
    """Its second differences have six times its variance, and four are reckoned with: sqrt(1.5) at every lag."""
    white = np.random.default_rng(1).normal(0.0, 0.05, 20_000)
    np.testing.assert_allclose(noise_m(white, 19_999)[:3], 0.05 * np.sqrt(1.5), rtol=0.15)


def test_what_the_model_knows_is_not_counted_twice() -> None:
    smooth = epochs_of(Receiver(), 1.0, np.random.default_rng(3))
    bank = bank_over(smooth, {}, CONFIG)
    thresholds = pl.DataFrame(bank.columns())["along_raw_threshold"].drop_nulls()
    assert thresholds.max() < 1.3 * thresholds.min()


def test_unknown_for_thirty_seconds_and_said_so() -> None:
    bank = bank_over(epochs_of(Receiver(), 0.1, np.random.default_rng(1)), {}, CONFIG)
    known = [bank.noise_known_at(epoch) for epoch in range(360)]
    assert known == [False] * 30 + [True] * 330
    reasons = pl.DataFrame(bank.columns())["along_raw_reason"]
    assert reasons.to_list() == [NOISE_UNKNOWN] * 30 + [None] * 330


def test_no_verdict_where_noise_hides_a_failure() -> None:
    bank = bank_over(epochs_of(Receiver(white_m=3.0), 0.1, np.random.default_rng(1)), {}, CONFIG)
    assert pl.DataFrame(bank.columns())["along_raw_reason"][40:].unique().to_list() == [NOISE_TOO_LARGE]
    assert not bank.noise_known_at(200)


def test_given_noise_holds_from_the_first_epoch_and_replaces_what_is_measured() -> None:
    given = Configuration.model_validate({"monitors": {"noise_along_m": (0.1, 0.0, 0.0, 0.0)}})
    quiet = epochs_of(Receiver(), 0.1, np.random.default_rng(1))
    thresholds = pl.DataFrame(bank_over(quiet, {}, given).columns())["along_raw_threshold"]
    none = Configuration.model_validate({"monitors": {"noise_along_m": (0.0, 0.0, 0.0, 0.0)}})
    without = pl.DataFrame(bank_over(quiet, {}, none).columns())["along_raw_threshold"]
    factor = CONFIG.monitors.threshold_factor
    more = (thresholds[1:] / factor) ** 2 - (without[1:] / factor) ** 2
    np.testing.assert_allclose(more, 2.0 * 0.1**2, rtol=1e-9)


def test_causal_whatever_comes_later_changes_nothing_before() -> None:
    offset_m = np.random.default_rng(2).normal(0.0, 0.05, 2_000)
    later = offset_m.copy()
    later[1_200:] *= 40.0
    one, other = (meter_of(series_of(offsets, 0.5)).variance_m2(0, 1_200) for offsets in (offset_m, later))
    np.testing.assert_array_equal(one, other)


def test_what_is_under_alarm_never_enters_also_not_later() -> None:
    """Noise ten times as loud from 500 to 700: frozen there, it is as if those rows had never been."""
    offset_m = np.random.default_rng(2).normal(0.0, 0.05, 1_500)
    loud = offset_m.copy()
    loud[500:700] *= 10.0
    meters = [meter_of(series_of(offsets)) for offsets in (offset_m, loud)]
    for meter in meters:
        meter.freeze(500)
    frozen = meters[1].variance_m2(500, 700)
    assert np.isfinite(frozen).all()
    assert (np.ptp(frozen[60:], axis=0) == 0.0).all()
    for meter in meters:
        meter.restart(700)
    np.testing.assert_allclose(*(meter.variance_m2(0, 1_500) for meter in meters), rtol=1e-12)


def test_a_bank_frozen_late_is_one_that_was_frozen_at_once() -> None:
    """The bank looks ahead; what it said of epochs behind the alarm is made anew, what it said before stays."""
    epochs = epochs_of(Receiver(white_m=0.1), 0.4, np.random.default_rng(4))
    ahead, stepwise = bank_over(epochs, {}, CONFIG), bank_over(epochs, {}, CONFIG)
    ahead.failed(epochs.height - 1)
    for bank in (ahead, stepwise):
        bank.failed(600)
        bank.freeze(600)
        bank.failed(640)
        bank.restart(640)
    for one, other in zip(ahead.columns(), stepwise.columns(), strict=True):
        assert one.equals(other, null_equal=True), one.name


def test_an_alarm_before_the_noise_is_known_freezes_nothing() -> None:
    bank = bank_over(epochs_of(Receiver(white_m=0.1), 0.1, np.random.default_rng(4)), {}, CONFIG)
    bank.failed(5)
    bank.freeze(5)
    assert bank.noise_known_at(30)


def test_a_stand_is_no_sample() -> None:
    offset_m = np.random.default_rng(2).normal(0.0, 0.05, 900)
    offset_m[300:600] = offset_m[299]
    moving = np.ones(900, dtype=np.bool_)
    moving[300:600] = False
    before, after = (
        np.sqrt(NoiseMeter(series_of(offset_m), moving, None, CONFIG).variance_m2(row, row + 1)[0, 0])
        for row in (299, 602)
    )
    assert after == pytest.approx(before, rel=0.2)


@pytest.mark.parametrize(
    "receiver",
    [
        Receiver(rate_hz=10.0, white_m=0.05),
        Receiver(rate_hz=10.0, sigma_m=0.02, white_m=0.005),
        Receiver(rate_hz=5.0, white_m=0.12, digits_m=0.11),
        Receiver(tau_s=20.0),
        Receiver(rate_hz=5.0, true_over_stated=2.0, gaps=True, uneven=True, sigma_varies=True),
    ],
)
def test_real_receivers_raise_no_alarm(receiver: Receiver) -> None:
    """Each of them failed the raw monitors at once and for ever (issue 35)."""
    known = dict.fromkeys(("noise_along_m", "noise_cross_m", "noise_up_m"), (0.0, 0.0, 0.0, 0.0))
    epochs = epochs_of(receiver, 0.5, np.random.default_rng(5))
    assert first_alarm(epochs, CONFIG, 0.0) is None
    assert first_alarm(epochs, Configuration.model_validate({"monitors": known}), 0.0) is not None


@pytest.mark.parametrize(("rate_mps", "latest_s"), [(0.03, 600.0), (0.1, 180.0), (1.0, 10.0)])
def test_a_drift_is_found_before_it_is_a_failure(rate_mps: float, latest_s: float) -> None:
    receiver = Receiver(white_m=0.05)
    fault_m = rate_mps * np.maximum(np.arange(0.0, 2_600.0, 0.1) - 1_500.0, 0.0)
    found = first_alarm(epochs_of(receiver, 0.7, np.random.default_rng(2), fault_m), CONFIG, 60.0)
    assert found is not None
    assert 1_500.0 < found[1] <= 1_500.0 + latest_s


def test_a_step_is_found_within_one_epoch() -> None:
    fault_m = np.where(np.arange(0.0, 1_000.0, 0.1) >= 800.0, 20.0, 0.0)
    for receiver in (Receiver(white_m=0.3), Receiver(rate_hz=10.0, white_m=0.3), Receiver(tau_s=20.0)):
        columns = bank_over(epochs_of(replace(receiver), 0.25, np.random.default_rng(6), fault_m), {}, CONFIG).columns()
        raw = next(column for column in columns if column.name == "along_raw_state")
        assert raw.to_list()[round(800.0 * receiver.rate_hz)] == MonitorState.FAIL.value


def test_white_noise_of_the_run() -> None:
    bank = bank_over(epochs_of(Receiver(white_m=0.2), 0.5, np.random.default_rng(8)), {}, CONFIG)
    bank.columns()
    found = bank.white_noise()
    assert found["white_noise_along_m"] == pytest.approx(0.2, rel=0.25)
    assert found["white_noise_up_m"] == pytest.approx(0.3, rel=0.25)


def excess_m2(offset_m: Floats, sigma_m: float) -> Floats:
    return meter_of(series_of(offset_m, sigma_m=sigma_m)).stated_excess_m2()


def nominal_m(sigma_m: float, draw: np.random.Generator, seconds: int = 7200) -> Floats:
    """Gauss-Markov errors of DIAG Table 1 at 1 Hz."""
    total = np.zeros(seconds)
    for share, tau_s in ((0.083, 360.0), (0.014, 1800.0), (0.15, 3600.0), (0.752, 100.0)):
        kept = np.exp(-1.0 / tau_s)
        steps = draw.normal(0.0, sigma_m * np.sqrt(share * (1.0 - kept**2)), seconds)
        error_m = draw.normal(0.0, sigma_m * np.sqrt(share))
        for second in range(seconds):
            error_m = kept * error_m + steps[second]
            total[second] += error_m
    return total


def test_a_stated_sigma_grows_where_the_offset_shows_more() -> None:
    """Three times the stated sigma more than doubles the interval, the stated one leaves it as it is."""
    draw = np.random.default_rng(4)
    healthy, worse = (np.sqrt(1.0 + excess_m2(nominal_m(times, draw), 1.0)[-1]) for times in (1.0, 3.0))
    assert healthy < 1.2
    assert 2.0 < worse < 5.0


def test_what_is_beyond_the_stated_sigma_is_known_from_what_came_before() -> None:
    offset_m = nominal_m(4.0, np.random.default_rng(6), 2400)
    later = offset_m.copy()
    later[1200:] += 50.0 * np.sin(np.arange(1200.0))
    np.testing.assert_array_equal(excess_m2(offset_m, 1.0)[:1200], excess_m2(later, 1.0)[:1200])
    assert excess_m2(later, 1.0)[-1] > 100.0 * excess_m2(offset_m, 1.0)[-1]
