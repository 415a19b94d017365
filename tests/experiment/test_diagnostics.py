"""The Monte Carlo against naive simulation, against theory, and against the paper's findings."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from datasets.experiment import passage
from datasets.experiment.diagnostics import detection_times, run_diagnostics, simulate
from datasets.experiment.findings import judge
from datasets.experiment.geometry import (
    BRUSSELS,
    CONSTELLATIONS,
    TAUS_S,
    default_geometry,
    epochs_of_day,
    geometry_at,
)
from datasets.experiment.passage import NEVER, NoisePaths, first_passages
from datasets.experiment.plan import SIGNALS, ExperimentPlan, bank_forms, failure_forms
from datasets.experiment.sigmas import bank_sigmas, limit_sigmas
from datasets.experiment.tables import expected
from datasets.experiment.workers import generator
from pipeline.stages.monitors.pseudorange import range_variances_m2

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
    paths = NoisePaths(plan, 20, generator(5))
    basis = np.concatenate([paths.advance(50).copy() for _ in range(plan.span_s // 50)])
    fast = first_passages_from(plan, basis)
    for question in range(len(plan.questions)):
        for index, rate in enumerate(plan.rates_mps):
            slow = naive_first(plan, basis, paths.weights, rate, question)
            assert fast[question, index].tolist() == slow.tolist()


def first_passages_from(plan: ExperimentPlan, basis: np.ndarray) -> np.ndarray:
    """The fast evaluation on a given path."""
    weights = NoisePaths(plan, 1, generator(0)).weights
    watch = passage.FirstAnswers(plan, bank_forms(plan), failure_forms(plan), weights, basis.shape[2])
    for begin, end in passage._blocks(plan.onset_s, plan.span_s, 4):
        watch.after_onset(basis[begin:end], begin)
    return watch.first[: len(plan.questions)]


def test_failure_is_the_first_epoch_beyond_the_limit() -> None:
    plan = small_plan(rates_mps=(1.0, 5.0))
    paths = NoisePaths(plan, 15, generator(6))
    basis = np.concatenate([paths.advance(50).copy() for _ in range(plan.span_s // 50)])
    watch = passage.FirstAnswers(plan, bank_forms(plan), failure_forms(plan), paths.weights, 15)
    for begin, end in passage._blocks(plan.onset_s, plan.span_s, 4):
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
    paths = NoisePaths(plan, 40_000, generator(7))
    basis = paths.advance(31)
    gain, variances = plan.geometry.gain, plan.geometry.range_variance_m2
    for lag in (0, 30):
        phi = np.exp(-lag / TAUS_S)
        wanted = np.einsum("ai,ij,j,bi->ab", gain[:2], variances, phi, gain[:2])
        first, last = basis[30 - lag, -2:], basis[30, -2:]
        assert first @ last.T / 40_000 == pytest.approx(wanted, abs=0.03)


def test_exact_sigmas_are_those_of_the_simulated_monitors() -> None:
    plan = small_plan(span_s=400, onset_s=399)
    forms = bank_forms(plan)
    paths = NoisePaths(plan, 4_000, generator(8))
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
    assert NoisePaths(plan, 3, generator(1)).weights.size == plan.basis_size


@pytest.mark.usefixtures("in_process")
def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    plans = tuple(replace(ExperimentPlan(default_geometry(name)), **SMALL) for name in CONSTELLATIONS)  # type: ignore[arg-type]
    one, two = (simulate(plans, 300, seed=3, jobs=jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert (a.detected_s == b.detected_s).all()
        assert (a.failed_s == b.failed_s).all()


def test_tables_of_hand_made_passages() -> None:
    plan = small_plan(rates_mps=(1.0,), headings_deg=(0.0,), readings=("increments",), sensors=("odometer",))
    passages = passage.FirstPassages(
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


def test_bounds_on_expectations_cover() -> None:
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(300):
        result = expected(rng.beta(0.5, 3.0, 100), 0.0, 1.0)
        assert result is not None
        held += (result.low <= 0.5 / 3.5 <= result.high) and result.median_low <= 0.0756 <= result.median_high
    assert held >= 0.93 * 300
    assert expected(np.array([1.0]), 0.0, 1.0) is None


@pytest.fixture(scope="module")
def published() -> pl.DataFrame:
    """The paper's grid with few repetitions."""
    return run_diagnostics(repetitions=200, seed=11, jobs=1)["detection"]


def holds(published: pl.DataFrame, finding: str, reading: str) -> dict[str, bool]:
    judged = judge(published).filter((pl.col("finding") == finding) & (pl.col("reading") == reading))
    return dict(zip(judged["constellation"], judged["holds"], strict=True))


@pytest.mark.parametrize(
    "finding",
    [
        "pmd_zero_0p03",
        "pmd_zero_0p1",
        "pmd_not_zero_0p01",
        "turning_away",
        "track_covers",
        "track_steadies",
    ],
)
def test_findings_hold_with_noise_on_position(published: pl.DataFrame, finding: str) -> None:
    assert holds(published, finding, "position") == {"gps": True, "gps_galileo": True}


def test_dual_constellation_is_ahead_at_every_rate(published: pl.DataFrame) -> None:
    assert holds(published, "dual_ahead", "position") == {"gps_galileo": True}
    assert holds(published, "dual_ahead_from_0p02", "position") == {"gps_galileo": True}


def test_noise_on_increments_contradicts_the_paper_for_two_constellations(published: pl.DataFrame) -> None:
    assert holds(published, "pmd_zero_0p03", "increments") == {"gps": True, "gps_galileo": False}


def test_ramp_of_1_cm_per_s_is_mostly_missed_at_the_failure(published: pl.DataFrame) -> None:
    missed = published.filter(
        (pl.col("rate_mps") == 0.01) & (pl.col("heading_deg") == 0.0) & (pl.col("sensors") == "odometer")
    )["pmd_at_failure"]
    assert missed.min() > 0.3  # type: ignore[operator]


def test_geometries_are_spread_over_the_visibility_of_the_faulty_satellite() -> None:
    instants = epochs_of_day(BRUSSELS, 12)
    assert len(set(instants)) == 12
    assert sorted(instants) == instants
    for t_ns in instants:
        geometry = geometry_at(BRUSSELS, t_ns, "gps")
        assert geometry.svs[geometry.faulty] == "G08"


def test_a_sky_without_the_faulty_satellite_is_refused() -> None:
    with pytest.raises(ValueError, match="below the mask"):
        geometry_at(BRUSSELS, epochs_of_day(BRUSSELS, 1)[0] + 12 * 3_600_000_000_000, "gps")


def test_fault_free_runs_are_not_alarmed_more_often_than_the_bank_allows() -> None:
    plan = small_plan(span_s=501, onset_s=500, false_alarm_probability=1e-3)
    result = first_passages(plan, bank_forms(plan), failure_forms(plan), 1000, generator(9))
    assert result.alarmed_before[:, :].mean() < 4 * 9 * 500 * 1e-3
    stricter = replace(plan, false_alarm_probability=1e-6)
    calm = first_passages(stricter, bank_forms(stricter), failure_forms(stricter), 1000, generator(9))
    assert calm.alarmed_before.mean() < 0.02 < result.alarmed_before.mean()
