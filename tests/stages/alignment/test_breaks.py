"""What a position brings back from a break is never learned as odometer scale."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest

from pipeline.stages.alignment.odometer_filter import ScaleLatencyFilter, estimates_of, moved_m2, prior_of
from pipeline.stages.monitors.axis import error_model
from schemas.config import Configuration, Vehicle
from tests.stages.alignment.straight import (
    Straight,
    align_run,
    align_with,
    distance,
    odometer_of,
    odometry_from,
    run,
    times,
)

CONFIG = Configuration()
REAL = Straight(duration_s=900.0, period_s=1.0, scale=1.004, latency_s=0.08)
SEEDS = range(7)
LEARNED = ("odometer_scale", "scale_sigma", "latency_s", "latency_sigma_s")


def seconds(epochs):
    return epochs["t"].dt.timestamp("ns").to_numpy() * 1e-9


def learned(seed, missing=(), fault=None, plan=REAL, vehicle=None):
    """Aligned epochs of a run without positions between these times [s]."""
    epochs, odometer = run(plan, seed, fault)
    found = counted(plan, seed) if vehicle is None else odometry_from(odometer, vehicle)
    t_s = seconds(epochs)
    kept = ~np.any([(t_s > begin) & (t_s < end) for begin, end in missing], axis=0) if missing else t_s >= 0.0
    return align_with(epochs.filter(pl.Series(kept)), found, vehicle or Vehicle(), CONFIG)


@cache
def counted(plan, seed):
    """The odometer of a run, which is the same whatever becomes of the positions."""
    return odometry_from(run(plan, seed)[1])


@cache
def plain_sigma(seed):
    """Sigma of the scale at the end of a run that lacks nothing."""
    return learned(seed)["scale_sigma"][-1]


def away(aligned, from_s, scale=REAL.scale):
    """Largest error of the learned scale over its own sigma from this time on."""
    later = aligned.filter(pl.Series(seconds(aligned) >= from_s))
    return float(((later["odometer_scale"] - scale) / later["scale_sigma"]).abs().max())


def after_each(tunnels, size_m, decay_s):
    """An offset that each tunnel but the first brings with the other sign, and how it decays."""

    def fault(t_s):
        offset = np.zeros_like(t_s)
        for index, (_, end) in enumerate(tunnels):
            since_s = t_s - end
            brought = (-1.0) ** index * size_m * np.exp(-np.maximum(since_s, 0.0) / decay_s)
            offset = np.where(since_s >= 0.0, brought, offset)
        return offset

    return fault


ONCE, OFTEN = ((120.0, 210.0),), tuple((120.0 + 240.0 * k, 190.0 + 240.0 * k) for k in range(3))
SHORT = ((300.0, 350.0),)


@pytest.mark.parametrize(
    ("tunnels", "size_m", "decay_s"),
    [
        (ONCE, 6.0, 60.0),
        (ONCE, 12.0, 60.0),
        (OFTEN, 6.0, 60.0),
        (OFTEN, 12.0, 60.0),
        (SHORT, 3.0, np.inf),
        (SHORT, 4.0, np.inf),
    ],
)
def test_an_offset_out_of_a_tunnel_is_not_learned_as_scale(tunnels, size_m, decay_s):
    fault = after_each(tunnels, size_m, decay_s)
    worst = [away(learned(seed, tunnels, fault), tunnels[0][1]) for seed in SEEDS]
    assert max(worst) < 4.5
    assert np.sqrt(np.mean(np.square(worst))) < 2.4


@pytest.mark.parametrize("tunnels", [ONCE, OFTEN, SHORT])
def test_a_tunnel_that_brings_nothing_costs_the_learning_little(tunnels):
    runs = [learned(seed, tunnels) for seed in SEEDS]
    ratios = [aligned["scale_sigma"][-1] / plain_sigma(seed) for seed, aligned in zip(SEEDS, runs, strict=True)]
    assert np.median(ratios) < 1.6
    assert max(away(aligned, tunnels[0][1]) for aligned in runs) < 4.5


def test_single_missing_epochs_cost_the_learning_little():
    missing = tuple((float(t), t + 2.0) for t in range(50, 890, 15))
    ratios = [learned(seed, missing)["scale_sigma"][-1] / plain_sigma(seed) for seed in SEEDS]
    assert np.median(ratios) < 1.2


def test_missing_epochs_of_a_noisy_position_cost_the_learning_little():
    noisy = replace(REAL, sigma_m=5.0)
    missing = tuple((float(t), t + 2.0) for t in range(50, 890, 5))
    pairs = [(learned(seed, missing, plan=noisy), learned(seed, plan=noisy)) for seed in SEEDS]
    assert np.median([some["scale_sigma"][-1] / every["scale_sigma"][-1] for some, every in pairs]) < 1.2


def test_stamps_that_scatter_are_no_breaks():
    ratios = []
    for seed in SEEDS:
        epochs, _ = run(REAL, seed)
        late_s = np.random.default_rng(seed).uniform(0.0, 0.7, epochs.height)
        late = epochs.with_columns(times(seconds(epochs) + late_s))
        aligned = align_with(late, counted(REAL, seed), Vehicle(), CONFIG)
        ratios.append(aligned["scale_sigma"][-1] / plain_sigma(seed))
    assert np.median(ratios) < 1.3


def steps_out(size_m, left_m):
    """30 m for 70 s, which an alarm sees, and what is left beside the place afterwards and decays."""

    def fault(t_s):
        since_s = np.maximum(t_s - 370.0, 0.0)
        away = np.where(t_s < 370.0, size_m, left_m * np.exp(-since_s / 60.0))
        return np.where(t_s < 300.0, 0.0, away)

    return fault


def test_after_an_alarm_learning_goes_on_where_the_position_came_back():
    back, beside = ([learned(seed, fault=steps_out(30.0, left_m)) for seed in SEEDS] for left_m in (0.0, 8.0))
    for aligned in (*back, *beside):
        held = aligned.filter(pl.Series((seconds(aligned) > 301.0) & (seconds(aligned) < 398.0)))
        assert held["odometer_scale"].n_unique() == 1
    ratios = [aligned["scale_sigma"][-1] / plain_sigma(seed) for seed, aligned in zip(SEEDS, back, strict=True)]
    assert np.median(ratios) < 1.55
    assert max(away(aligned, 300.0) for aligned in beside) < 4.5


def test_what_the_odometer_loses_while_positions_go_on_is_no_break_of_theirs():
    epochs, odometer = run(REAL, 3)
    slip = pl.Series("slip", (seconds(odometer) > 400.0) & (seconds(odometer) < 403.0))
    slipped = align_run(epochs, odometer.with_columns(slip), Vehicle(), CONFIG)
    plain = align_run(epochs, odometer, Vehicle(), CONFIG)
    assert slipped["scale_sigma"][-1] < 1.6 * plain["scale_sigma"][-1]
    outage = (seconds(epochs) > 390.0) & (seconds(epochs) < 410.0)
    both = align_run(epochs.filter(pl.Series(~outage)), odometer.with_columns(slip), Vehicle(), CONFIG)
    assert both["scale_sigma"][-1] > 1.2 * slipped["scale_sigma"][-1]


def test_a_known_scale_and_latency_stay_through_a_tunnel():
    known = Vehicle(odometer_scale=1.004, odometer_scale_sigma=2e-4)
    aligned = learned(1, ONCE, after_each(ONCE, 12.0, 60.0), vehicle=known)
    assert aligned["odometer_scale"].unique().to_list() == [1.004]
    assert aligned["scale_sigma"].unique().to_list() == [2e-4]


def test_learning_over_tunnels_uses_the_past_only():
    tunnels, fault = OFTEN, after_each(OFTEN, 6.0, 60.0)
    epochs, odometer = run(REAL, 5, fault)
    t_s = seconds(epochs)
    epochs = epochs.filter(pl.Series(~np.any([(t_s > begin) & (t_s < end) for begin, end in tunnels], axis=0)))
    whole = align_run(epochs, odometer, Vehicle(), CONFIG)
    for cut_s in (195.0, 300.0, 440.0, 700.0):
        before = epochs.filter(pl.Series(seconds(epochs) <= cut_s))
        part = align_run(before, odometer.filter(pl.Series(seconds(odometer) <= cut_s)), Vehicle(), CONFIG)
        assert part.select(LEARNED).equals(whole[: part.height].select(LEARNED))


def test_learning_on_after_an_alarm_knows_nothing_of_a_later_tunnel():
    epochs, odometer = run(replace(REAL, duration_s=1200.0), 4, steps_out(30.0, 0.0))
    t_s = seconds(epochs)
    epochs = epochs.filter(pl.Series((t_s <= 800.0) | (t_s >= 870.0)))
    whole = align_run(epochs, odometer, Vehicle(), CONFIG)
    before = epochs.filter(pl.Series(seconds(epochs) <= 790.0))
    part = align_run(before, odometer.filter(pl.Series(seconds(odometer) <= 790.0)), Vehicle(), CONFIG)
    assert part.select(LEARNED).equals(whole[: part.height].select(LEARNED))
    assert part["scale_sigma"][-1] < part.filter(pl.Series(seconds(part) <= 400.0))["scale_sigma"][-1]


def filter_at_rest():
    """A filter that has seen five minutes without error, its state, and the odometer's distance after `gap_s`."""
    t_s = np.arange(0.0, 500.0, 0.5)
    odometry = odometry_from(odometer_of(t_s, distance(t_s)))
    learner = ScaleLatencyFilter(*error_model(CONFIG.monitors), odometry, CONFIG.align)
    at_s = np.arange(20.0, 320.0)
    path_m = odometry.distance_at_s(at_s)
    state = learner.start(prior_of(Vehicle(), CONFIG.align), 20.0, float(path_m[0]))
    joints = learner.run(state, at_s, path_m, np.ones(at_s.size), np.zeros(at_s.size))
    return learner, learner.state_after(state, joints[-1], float(at_s[-1])), odometry


def resumed(gap_s, beside_m, jitter_s=0.0):
    learner, state, _ = filter_at_rest()
    return learner, state, resumed_from(learner, state, gap_s, beside_m, jitter_s)


def resumed_from(learner, state, gap_s, beside_m, jitter_s=0.0):
    t_s = state.t_s + gap_s
    path_m = float(learner.odometry.distance_at_s(np.array([t_s]))[0]) + beside_m
    return learner.resume(state, t_s, path_m, 1.0, jitter_s, 20.0)


def updated_by(learner, state, beside_m, sigma_m=1.0):
    """The joint state once the position at the state's own time is learned from."""
    at_s = np.array([state.t_s])
    return learner.run(state, at_s, learner.odometry.distance_at_s(at_s) + beside_m, np.full(1, sigma_m), np.zeros(1))[
        -1
    ]


def test_stamps_that_scatter_tell_less_of_a_move():
    assert resumed(2.0, 2.0, jitter_s=0.1)[2].unsettled_m2 < 0.1 * resumed(2.0, 2.0)[2].unsettled_m2


def test_what_has_not_settled_does_so_over_the_next_break_and_after_it():
    learner, _, brought = resumed(90.0, 12.0)
    brought = brought._replace(joint=updated_by(learner, brought, 12.0))
    again = resumed_from(learner, brought, 10.0, 12.0)
    lost = learner.restart(brought, brought.t_s + 10.0, 0.0, 1.0)
    left_m2 = brought.unsettled_m2 * np.exp(-10.0 / 25.0)
    assert left_m2 <= again.unsettled_m2 < 1.2 * left_m2
    assert lost.unsettled_m2 == pytest.approx(left_m2)
    assert learner.restart(brought, brought.t_s + 10.0, 0.0, 400.0).unsettled_m2 == 400.0


def test_what_a_break_brought_is_judged_by_its_length_and_by_how_far_the_position_came_back():
    unsettled_m2 = {
        (gap_s, beside_m): resumed(gap_s, beside_m)[2].unsettled_m2
        for gap_s in (2.0, 90.0)
        for beside_m in (0.0, 1.0, 3.0, 12.0)
    }
    assert unsettled_m2[2.0, 0.0] < 0.01
    assert 0.1 < unsettled_m2[90.0, 0.0] < 0.4
    assert 6.0 < unsettled_m2[90.0, 3.0] < 9.0
    assert 9.0 < unsettled_m2[2.0, 3.0] < 10.0
    for gap_s in (2.0, 90.0):
        values = [unsettled_m2[gap_s, beside_m] for beside_m in (0.0, 1.0, 3.0, 12.0)]
        assert values == sorted(values)
        assert values[-1] == pytest.approx(144.0, rel=0.05)
    assert unsettled_m2[90.0, 1.0] > unsettled_m2[2.0, 0.0]


@pytest.mark.parametrize("beside_m", [0.0, 2.0, 9.0, -25.0])
@pytest.mark.parametrize("variance_m2", [0.5, 16.0, 900.0])
@pytest.mark.parametrize("probability", [0.05, 0.8])
def test_what_a_position_moved_by_follows_from_bayes(beside_m, variance_m2, probability):
    moved_m = np.linspace(-200.0, 200.0, 400_001)
    prior = np.exp(-0.5 * (moved_m / 20.0) ** 2) / np.sqrt(2.0 * np.pi) / 20.0
    likelihood = np.exp(-0.5 * (beside_m - moved_m) ** 2 / variance_m2)
    stayed = (1.0 - probability) * np.exp(-0.5 * beside_m**2 / variance_m2)
    weight = probability * prior * likelihood
    expected = np.trapezoid(moved_m**2 * weight, moved_m) / (np.trapezoid(weight, moved_m) + stayed)
    assert moved_m2(beside_m, variance_m2, 20.0, probability) == pytest.approx(expected, rel=1e-6)


def test_a_position_from_far_away_leaves_a_covariance():
    learner, _, after = resumed(90.0, 1e6)
    covariance = updated_by(learner, after, 1e6, sigma_m=0.01)[:, :-1]
    deviations = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(deviations, deviations)).min() > 0.0


def test_a_position_has_settled_after_some_minutes():
    learner, before, after = resumed(90.0, 12.0)
    after_minutes = [learner.state_after(after, after.joint, after.t_s + 60.0 * k).unsettled_m2 for k in range(5)]
    assert before.unsettled_m2 == 0.0
    assert after_minutes == sorted(after_minutes, reverse=True)
    assert after_minutes[0] == after.unsettled_m2
    assert after_minutes[1] > 1.0
    assert after_minutes[4] < 0.02


def test_a_position_far_beside_its_place_says_nothing_of_the_scale():
    learner, before, after = resumed(90.0, 12.0)
    updated, known = estimates_of(updated_by(learner, after, 12.0)), estimates_of(before.joint)
    assert abs(updated.scale - known.scale) < 0.5 * known.scale_sigma
    assert updated.scale_sigma > 0.95 * known.scale_sigma


@pytest.mark.parametrize(("at_s", "speed_mps"), [(0.0, 10.0), (4.0, 15.0), (8.0, 40.0)])
def test_the_speed_is_centred_but_where_the_odometer_ends(at_s, speed_mps):
    """Rows 2 s apart, 10 m/s to 4 s, 20 m/s to 6 s, then 40 m/s; over 2 s to both sides, as far as there are rows."""
    odometry = odometry_from(odometer_of([0.0, 2.0, 4.0, 6.0, 8.0], distance_m=[0.0, 20.0, 40.0, 80.0, 160.0]))
    odometry = replace(odometry, t_s=np.arange(0.0, 9.0, 2.0), distance_m=np.array([0.0, 20.0, 40.0, 80.0, 160.0]))
    learner = ScaleLatencyFilter(*error_model(CONFIG.monitors), odometry, CONFIG.align)
    travelled_m, found_mps = learner._odometer_at(at_s, 0.0)
    assert travelled_m == np.interp(at_s, odometry.t_s, odometry.distance_m)
    assert found_mps == pytest.approx(speed_mps)
