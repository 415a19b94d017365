"""The Monte Carlo against naive simulation, against theory, and against the paper's findings."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest

from datasets.experiment import monte_carlo
from datasets.experiment.diagnostics import detection_times, geometry_table, run_diagnostics, simulate
from datasets.experiment.figures import drawn_figures
from datasets.experiment.geometry import CONSTELLATIONS, DEFAULT_NS, TAUS_S, default_geometry, geometry_at
from datasets.experiment.monte_carlo import (
    NEVER,
    SIGNALS,
    ExperimentPlan,
    NoisePaths,
    bank_forms,
    failure_forms,
    first_passages,
)
from datasets.experiment.tables import time_columns
from datasets.experiment.workers import random_generator
from pipeline.show.svg_plot import even_ticks
from pipeline.stages.monitors.pseudorange import range_variances_m2
from tests.experiment.sigmas import bank_sigmas, limit_sigmas

SMALL = {"span_s": 700, "onset_s": 100, "rates_mps": (0.05, 0.5, 5.0), "headings_deg": (0.0, 45.0)}


def small_plan(**changes: object) -> ExperimentPlan:
    return replace(ExperimentPlan(default_geometry("gps")), **(SMALL | changes))  # type: ignore[arg-type]


def test_variances_at_45_degrees_give_the_shares_of_table_1() -> None:
    variances = range_variances_m2(np.array([45.0]))[0]
    assert variances / variances.sum() == pytest.approx([0.083, 0.014, 0.150, 0.752], abs=1.5e-3)


def test_position_covariance_is_the_inverse_of_the_weighted_normal_matrix() -> None:
    geometry = default_geometry("gps_galileo")
    total = geometry.source_covariances_m2.sum(axis=0)
    azimuth, elevation = np.radians(geometry.azimuth_deg), np.radians(geometry.elevation_deg)
    galileo = np.array([sv.startswith("E") for sv in geometry.svs], dtype=float)
    design = np.column_stack(
        [
            -np.cos(elevation) * np.sin(azimuth),
            -np.cos(elevation) * np.cos(azimuth),
            -np.sin(elevation),
            galileo,
            1.0 - galileo,
        ]
    )
    weight = np.diag(1.0 / geometry.range_variance_m2.sum(axis=1))
    assert total == pytest.approx(np.linalg.inv(design.T @ weight @ design)[:3, :3], rel=1e-9)


def naive_first(plan: ExperimentPlan, basis: np.ndarray, weights: np.ndarray, rate: float, question: int) -> np.ndarray:
    """First epoch after onset at which any monitor of the question fails, one monitor and epoch at a time."""
    forms = bank_forms(plan)
    elapsed = np.arange(1, plan.span_s + 1) - plan.onset_s
    failing = np.zeros((plan.span_s, basis.shape[2]), dtype=bool)
    for form in np.flatnonzero(forms.members[question]):
        alpha = plan.alphas[forms.alpha[form]]
        ramp = np.zeros(plan.span_s)
        for k in range(1, plan.span_s):
            ramp[k] = alpha * (rate * forms.slope[form] if elapsed[k] > 0 else 0.0) + (1 - alpha) * ramp[k - 1]
        value = np.tensordot(basis, forms.rows[form] * weights, axes=(1, 0)) + ramp[:, None]
        failing |= np.abs(value) > forms.threshold[:, form][:, None]
    failing[elapsed <= 0] = False
    return np.where(failing.any(axis=0), elapsed[failing.argmax(axis=0)], NEVER)


@pytest.mark.parametrize("probability", [1e-7, 1e-3])
def test_first_passages_equal_those_of_naive_evaluation(probability: float) -> None:
    plan = small_plan(false_alarm_probability=probability)
    paths = NoisePaths(plan, 10, random_generator(5))
    basis = np.concatenate([paths.advance(50).copy() for _ in range(plan.span_s // 50)])
    fast = first_passages_from(plan, basis)
    for question in range(len(plan.questions)):
        for index, rate in enumerate(plan.rates_mps):
            slow = naive_first(plan, basis, paths.weights, rate, question)
            assert fast[question, index].tolist() == slow.tolist()


def first_passages_from(plan: ExperimentPlan, basis: np.ndarray) -> np.ndarray:
    """The fast evaluation on a given path."""
    weights = NoisePaths(plan, 1, random_generator(0)).weights
    watch = monte_carlo.FirstAnswers(plan, bank_forms(plan), failure_forms(plan), weights, basis.shape[2])
    for begin, end in monte_carlo._growing_blocks(plan.onset_s, plan.span_s, 4):
        watch.after_onset(basis[begin:end], begin)
    return watch.first[: len(plan.questions)]


def test_failure_is_the_first_epoch_beyond_the_limit() -> None:
    plan = small_plan(rates_mps=(1.0, 5.0))
    paths = NoisePaths(plan, 15, random_generator(6))
    basis = np.concatenate([paths.advance(50).copy() for _ in range(plan.span_s // 50)])
    watch = monte_carlo.FirstAnswers(plan, bank_forms(plan), failure_forms(plan), paths.weights, 15)
    for begin, end in monte_carlo._growing_blocks(plan.onset_s, plan.span_s, 4):
        watch.after_onset(basis[begin:end], begin)
    east_north = basis[:, -2:]
    elapsed = np.maximum(np.arange(1, plan.span_s + 1) - plan.onset_s, 0)
    for heading, row in zip(plan.headings_deg, watch.first[len(plan.questions) :], strict=True):
        along = plan.geometry.axes(heading)[0]
        for rate, fast in zip(plan.rates_mps, row, strict=True):
            drift = rate * (along @ plan.geometry.ramp_direction) * elapsed
            error = along[0] * east_north[:, 0] + along[1] * east_north[:, 1] + drift[:, None]
            beyond = (np.abs(error) > plan.failure_limit_m) & (elapsed > 0)[:, None]
            slow = np.where(beyond.any(axis=0), elapsed[beyond.argmax(axis=0)], NEVER)
            assert fast.tolist() == slow.tolist()


def test_vector_processes_equal_satellite_processes_in_law() -> None:
    """Covariances over a lag: simulated basis against the sum over satellites worked out directly."""
    plan = small_plan(span_s=64, onset_s=32)
    paths = NoisePaths(plan, 20_000, random_generator(7))
    basis = paths.advance(31)
    gain, variances = plan.geometry.gain, plan.geometry.range_variance_m2
    for lag in (0, 30):
        phi = np.exp(-lag / TAUS_S)
        wanted = np.einsum("ai,ij,j,bi->ab", gain[:2], variances, phi, gain[:2])
        first, last = basis[30 - lag, -2:], basis[30, -2:]
        assert first @ last.T / 20_000 == pytest.approx(wanted, abs=0.03)


def test_exact_sigmas_are_those_of_the_simulated_monitors() -> None:
    plan = small_plan(span_s=400, onset_s=399)
    forms = bank_forms(plan)
    paths = NoisePaths(plan, 4_000, random_generator(8))
    for _ in range(8):
        basis = paths.advance(50)
    values = (forms.rows * paths.weights) @ basis[-1]
    sigma = forms.threshold[399] / 5.326723886384098
    # 4000 runs: the standard error of a sigma is 1.1 %; 42 monitors.
    assert values.std(axis=1) / sigma == pytest.approx(np.ones(len(sigma)), abs=0.045)


def test_recursion_ends_at_the_closed_form_at_1_and_10_hz() -> None:
    variances = np.array([0.2, 0.05, 0.3, 1.5])
    alphas = np.array([1.0, 0.1, 0.01])
    for rate_hz in (1.0, 10.0):
        long_after = bank_sigmas(alphas, int(3000 * rate_hz), variances, TAUS_S, 0.05, 0.7, rate_hz)[-1]
        assert long_after == pytest.approx(limit_sigmas(alphas, variances, TAUS_S, 0.05, 0.7, rate_hz), rel=1e-9)


def test_white_odometer_noise_alone_gives_the_textbook_ewma_sigma() -> None:
    alphas = np.array([1.0, 0.1, 0.001])
    sigma = limit_sigmas(alphas, np.zeros(4), TAUS_S, 0.05, 0.0)
    assert sigma == pytest.approx(0.05 * np.sqrt(alphas / (2.0 - alphas)))


def test_signals_and_basis_agree_in_size() -> None:
    plan = small_plan()
    assert plan.basis_size == len(SIGNALS) * plan.alphas.size + 2
    assert NoisePaths(plan, 3, random_generator(1)).weights.size == plan.basis_size


@pytest.mark.usefixtures("in_process")
def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    plans = tuple(replace(ExperimentPlan(default_geometry(name)), **SMALL) for name in CONSTELLATIONS)  # type: ignore[arg-type]
    one, two = (simulate(plans, 300, seed=3, jobs=jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert (a.detected_s == b.detected_s).all()
        assert (a.failed_s == b.failed_s).all()


def test_tables_of_hand_made_passages() -> None:
    plan = small_plan(rates_mps=(1.0,), headings_deg=(0.0,), readings=("increments",), sensors=("odometer",))
    passages = monte_carlo.FirstPassages(
        np.array([[[10, 20, 40, NEVER]]], dtype=np.int32),
        np.array([[[30, 30, 30, 30]]], dtype=np.int32),
        np.array([[False, True, False, False]]),
    )
    row = detection_times(plan, passages).row(0, named=True)
    assert (row["repetitions"], row["censored"], row["failed"]) == (4, 1, 4)
    assert row["detected"] == 0.75
    assert row["time_to_detect_s"] == pytest.approx((10 + 20 + 40 + 600) / 4)
    assert row["time_since_failure_s"] == pytest.approx((-20 - 10 + 10 + 570) / 4)
    assert row["pmd_at_failure"] == 0.5
    assert row["alarmed_before"] == 0.25


def test_bounds_on_mean_and_median_times_cover() -> None:
    """Beta(0.5, 3): mean 1/7, median 0.0756."""
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(300):
        row = time_columns("wait", rng.beta(0.5, 3.0, 100), 0.0, 1.0)
        held += (row["wait_low_s"] <= 0.5 / 3.5 <= row["wait_high_s"]) and (  # type: ignore[operator]
            row["wait_median_low_s"] <= 0.0756 <= row["wait_median_high_s"]  # type: ignore[operator]
        )
    assert held >= 0.93 * 300
    assert set(time_columns("wait", np.array([1.0]), 0.0, 1.0).values()) == {None}


@pytest.fixture(scope="module")
def published() -> pl.DataFrame:
    """The paper's grid with few repetitions."""
    return run_diagnostics(repetitions=100, seed=11, jobs=1)["detection"]


def at(published: pl.DataFrame, reading: str, **chosen: object) -> pl.DataFrame:
    return published.filter(pl.col("reading") == reading, **chosen)


CONSTELLATION_NAMES = pytest.mark.parametrize("constellation", CONSTELLATIONS)
AHEAD = {"sensors": "odometer", "heading_deg": 0.0}


@CONSTELLATION_NAMES
def test_with_noise_on_position_ramps_from_3_cm_per_s_on_are_detected_by_the_failure(
    published: pl.DataFrame, constellation: str
) -> None:
    """DIAG Fig. 5: no run at 0.03 and 0.10 m/s is undetected at the failure, some at 0.01 m/s are."""
    ahead = at(published, "position", constellation=constellation, **AHEAD)
    pmd = dict(ahead.select("rate_mps", "pmd_at_failure").iter_rows())
    assert pmd[0.03] == pmd[0.1] == 0.0
    assert pmd[0.01] > 0.3


@CONSTELLATION_NAMES
def test_turning_away_from_the_satellite_doubles_the_time_to_detect(
    published: pl.DataFrame, constellation: str
) -> None:
    """DIAG Fig. 6, at 0.10 m/s: 75 degrees against 0; with odometer only."""
    turned = at(published, "position", constellation=constellation, sensors="odometer", rate_mps=0.1)
    row = {heading: (time_s, share) for heading, time_s, share in turned.select(
        "heading_deg", "time_to_detect_s", "detected").iter_rows()}  # fmt: skip
    assert row[75.0][0] >= 2.0 * row[0.0][0] or row[75.0][1] == 0.0


@CONSTELLATION_NAMES
def test_with_track_every_ramp_is_detected_and_headings_matter_less(
    published: pl.DataFrame, constellation: str
) -> None:
    """DIAG Fig. 6: from 0.03 m/s on; max/min of T_D over headings is at most two thirds of odometer only, to 1 m/s."""
    covered = at(published, "position", constellation=constellation).filter(pl.col("rate_mps") >= 0.03)
    assert covered.filter(sensors="odometer_and_track")["censored"].sum() == 0
    spread = (
        covered.filter(pl.col("rate_mps") <= 1.0)
        .group_by("rate_mps", "sensors")
        .agg(ratio=pl.col("time_to_detect_s").max() / pl.col("time_to_detect_s").min())
        .pivot("sensors", index="rate_mps", values="ratio")
    )
    assert spread.height == 6
    assert (spread["odometer_and_track"] <= 2.0 / 3.0 * spread["odometer"]).all()


def test_dual_constellation_is_ahead_at_every_rate(published: pl.DataFrame) -> None:
    """DIAG Fig. 7: expected T_dsf of GPS + Galileo, cut off at the end of the 15,000 s, is below that of GPS."""
    times = at(published, "position", **AHEAD).pivot("constellation", index="rate_mps", values="time_since_failure_s")
    assert times.height == 10
    assert (times["gps_galileo"] < times["gps"]).all()


def test_noise_on_increments_contradicts_the_paper_for_two_constellations(published: pl.DataFrame) -> None:
    ahead = at(published, "increments", rate_mps=0.03, **AHEAD)
    pmd = dict(ahead.select("constellation", "pmd_at_failure").iter_rows())
    assert pmd["gps"] == 0.0 < pmd["gps_galileo"]


def test_ramp_of_1_cm_per_s_is_mostly_missed_at_the_failure(published: pl.DataFrame) -> None:
    missed = published.filter(
        (pl.col("rate_mps") == 0.01) & (pl.col("heading_deg") == 0.0) & (pl.col("sensors") == "odometer")
    )["pmd_at_failure"]
    assert missed.min() > 0.3  # type: ignore[operator]


def test_a_sky_without_the_faulty_satellite_is_refused() -> None:
    with pytest.raises(ValueError, match="below the mask"):
        geometry_at(DEFAULT_NS + 12 * 3_600_000_000_000, "gps")


def test_fault_free_runs_are_not_alarmed_more_often_than_the_bank_allows() -> None:
    plan = small_plan(span_s=501, onset_s=500, false_alarm_probability=1e-3)
    result = first_passages(plan, bank_forms(plan), failure_forms(plan), 1000, random_generator(9))
    assert result.alarmed_before[:, :].mean() < 4 * 9 * 500 * 1e-3
    stricter = replace(plan, false_alarm_probability=1e-6)
    calm = first_passages(stricter, bank_forms(stricter), failure_forms(stricter), 1000, random_generator(9))
    assert calm.alarmed_before.mean() < 0.02 < result.alarmed_before.mean()


def test_figures_of_hand_made_tables() -> None:
    """Every figure stands for itself, and is drawn where the tables know nothing too."""
    geometry = geometry_table(default_geometry("gps"))
    plan = small_plan(rates_mps=(0.03, 0.1, 1.0), readings=("increments",))
    few = first_passages(plan, bank_forms(plan), failure_forms(plan), 1, random_generator(3))
    detection = detection_times(plan, few)
    assert detection["time_to_detect_s"].null_count() == detection.height
    pmd = pl.DataFrame(
        {
            "constellation": "gps",
            "reading": "increments",
            "sensors": "odometer",
            "heading_deg": 0.0,
            "rate_mps": 0.03,
            "time_since_failure_s": [-10.0, 0.0, 10.0],
            "pmd": [1.0, 0.5, 0.0],
            "pmd_low": [0.9, 0.4, 0.0],
            "pmd_high": [1.0, 0.6, 0.1],
        }
    )
    drawn = drawn_figures(pmd, detection, geometry)
    assert len(drawn) == 11
    for drawing in drawn.values():
        assert ElementTree.fromstring(drawing).tag.endswith("svg")
    assert "GPS, 0.03 m/s" in drawn["figure_5_pmd_increments.svg"]
    assert drawn["figure_4_sky_gps.svg"].count('r="4"') == geometry.height


def test_ticks_are_round_numbers_within_the_axis() -> None:
    assert even_ticks(-900.0, 100.0) == [-900.0 + 100.0 * number for number in range(11)]
    assert even_ticks(0.0, 3.0) == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert even_ticks(0.3, 1.0) == pytest.approx([0.3 + 0.1 * number for number in range(8)])
