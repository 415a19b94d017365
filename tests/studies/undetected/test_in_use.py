"""The largest error still in use, worked by hand on a train that stands still but for its fault, and against faults."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from math import hypot, sqrt

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.relink import journey
from pipeline.one_run import replay
from pipeline.studies.undetected.in_use import Returns, in_use_errors
from pipeline.studies.undetected.watched import NO_ROW, FaultWindow, Watched
from schemas.arrays import NS_PER_S, Floats
from schemas.config import Configuration, LdsConfig, MonitorConfig, UndetectedConfig
from tests.stages.alignment.straight import NO_NOISE

ROWS, FIRST, UNNOTICED_M, THRESHOLD_MPS = 700, 5, 1.0, 0.1
CONFIG = Configuration(monitors=MonitorConfig(ewma_alphas=(0.3, 0.2, 0.1)))
WINDOWS = [FaultWindow(0, FIRST, 0, 0.0), FaultWindow(FIRST, ROWS - 1, FIRST * NS_PER_S, float(FIRST))]
FIX_S = 100
# How wrong the position may be at the fix: k_T times its sigma of 1 m and the read's.
AT_FIX_M = 5.3267 * hypot(1.0, CONFIG.hazards.balise_read_sigma_m)


def rows() -> Watched:
    """One row a second, one average with weight 0.1, nothing recorded moves."""
    zero = np.zeros(ROWS)
    return Watched(
        epoch=np.arange(ROWS),
        t_s=np.arange(float(ROWS)),
        fresh=np.arange(ROWS) == 0,
        free=zero > 0,
        fastest_m=zero + 5.0,
        gain_s=zero + 1.0,
        rate_mps=zero,
        least_mps=zero - 1.0,
        most_mps=zero + 1.0,
        weight=zero[:, None] + 0.1,
        average_mps=zero[:, None],
        threshold_mps=zero[:, None] + THRESHOLD_MPS,
        low_m=zero - np.inf,
        high_m=zero + np.inf,
        anchor=np.full(ROWS, NO_ROW),
        held_low_m=zero - np.inf,
        held_high_m=zero + np.inf,
        learned_m=zero,
        learned_late_m=zero,
    )


def returns() -> Returns:
    """Sigma 1 m, no scale error."""
    zero = np.zeros(ROWS)
    return Returns(zero, zero + 1.0, zero, zero, 0.0)


def largest(
    given: Returns | None, config: Configuration = CONFIG, watched: Watched | None = None, first_tvb: int = 2
) -> Floats:
    """With a fix at 5 s and TVBs from `first_tvb` on."""
    unnoticed = np.full((2, ROWS), UNNOTICED_M)
    validated = np.arange(ROWS) >= first_tvb
    ahead, behind = in_use_errors(watched or rows(), WINDOWS, unnoticed, validated, given, config)
    np.testing.assert_array_equal(ahead, behind)
    return ahead


def bound_m(waited_s: float) -> float:
    """k_T sqrt(2 sigma^2 + 0.05^2 t), here below half the failure limit."""
    return 5.3267 * sqrt(2.0 + 0.0025 * waited_s)


def test_from_the_fix_to_the_return_and_on() -> None:
    """Fix at 5 s, no bound before; an alarm right after may be over at 35 s; held for 10 s, growth from 9 s on."""
    found = largest(returns())
    assert np.isnan(found[: FIRST + 1]).all()
    assert found[FIRST + 1 : 35] == pytest.approx([UNNOTICED_M] * 29)
    assert found[35:44] == pytest.approx([AT_FIX_M + bound_m(t) for t in range(30, 39)], rel=1e-4)
    # From row 44 on: w / way = 10 s of threshold at the end, 9 at the start, and each row's own in between.
    grown = AT_FIX_M + bound_m(39) + THRESHOLD_MPS * (10 + 9 + (100 - 44 - 1))
    assert found[100] == pytest.approx(grown, rel=1e-4)


def test_a_latency_learned_late_counts_at_the_anchor_and_at_the_row() -> None:
    """Half a metre at each: the fix as an anchor, and the row that is held to it."""
    late = replace(rows(), learned_late_m=np.full(ROWS, 0.5))
    assert largest(returns(), watched=late)[35] == pytest.approx(AT_FIX_M + bound_m(30) + 0.5 + 0.5, rel=1e-4)


def test_without_a_return_it_is_the_unnoticed_error() -> None:
    found = largest(None)
    assert np.isnan(found[: FIRST + 1]).all()
    assert found[FIRST + 1 :] == pytest.approx([UNNOTICED_M] * (ROWS - FIRST - 1))


@pytest.mark.parametrize("given", [None, returns()])
@pytest.mark.parametrize("first_tvb", [FIRST, ROWS])
def test_what_is_noticed_before_the_first_tvb_is_forgotten_and_not_bounded(
    given: Returns | None, first_tvb: int
) -> None:
    """The fix came before anything was validated: the LDS initialises anew with the fault, whatever returns."""
    assert np.isnan(largest(given, first_tvb=first_tvb)).all()


def test_a_start_of_mission_forgets_what_was_validated() -> None:
    """TVBs from 2 s to 7 s, a mission at 8 s, fixes at 5 s, 9 s and 20 s, the next TVB at 12 s."""
    start = datetime.fromtimestamp(8, UTC)
    config = CONFIG.model_copy(update={"lds": LdsConfig(starts_of_mission=(start,))})
    edges = [0, 5, 8, 9, 20, ROWS - 1]
    windows = [FaultWindow(a, b, a * NS_PER_S, float(a)) for a, b in pairwise(edges)]
    tvb = np.isin(np.arange(ROWS), [*range(2, 8), *range(12, ROWS)])
    ahead, _ = in_use_errors(rows(), windows, np.full((2, ROWS), UNNOTICED_M), tvb, None, config)
    assert np.flatnonzero(np.isfinite(ahead)).tolist() == [6, 7, 8, *range(21, ROWS)]


def test_a_lost_distance_ends_the_bound() -> None:
    lost = replace(returns(), doubt_m=1e6 * (np.arange(ROWS) >= 300))
    found = largest(lost)
    assert np.isfinite(found[FIRST + 1 : 300]).all()
    assert np.isnan(found[300:]).all()


def test_a_threshold_not_known_after_the_hold_leaves_no_bound() -> None:
    blind = rows()
    blind.threshold_mps[60] = np.inf
    found = largest(returns(), watched=blind)
    assert np.isfinite(found[FIRST + 1 : 60]).all()
    assert np.isnan(found[61:]).all()


def test_without_a_hold_growth_counts_from_the_return() -> None:
    monitors = MonitorConfig(ewma_alphas=(0.3, 0.2, 0.1), disabled=("link_distance",))
    found = largest(returns(), Configuration(monitors=monitors))
    assert found[40] == pytest.approx(AT_FIX_M + bound_m(30) + THRESHOLD_MPS * (10 + 9 + 4), rel=1e-4)


RETURNING_S = np.arange(1_600.0)


@pytest.fixture(scope="module")
def bounds() -> pl.DataFrame:
    """Those of a run without a fault."""
    computed = Configuration(undetected=UndetectedConfig(compute=True, fixes=("reference",)))
    return _replayed(np.zeros(RETURNING_S.size), RETURNING_S, computed)


@pytest.mark.parametrize("step_m", [6.0, -6.0])
def test_a_noticed_fault_that_returns_stays_within_the_bound(bounds: pl.DataFrame, step_m: float) -> None:
    """A step of 6 m, found at once and back after 30 s, for it is within the bound of the re-link; later a drift."""
    t_s = RETURNING_S
    fault_m = np.where(t_s >= 150, step_m, 0.0) + np.sign(step_m) * 0.005 * np.maximum(t_s - 300.0, 0.0)
    epochs = _replayed(fault_m, t_s, Configuration())
    used = (epochs["lds_mode"] != "fail_safe").to_numpy() & epochs["withheld_for"].is_null().to_numpy()
    name = "ahead" if step_m > 0 else "behind"
    bound = bounds[f"undetected_{name}_in_use_m"].cast(pl.Float64).fill_null(np.inf).to_numpy()
    unnoticed = bounds[f"undetected_{name}_m"].cast(pl.Float64).fill_null(np.inf).to_numpy()
    assert epochs["alarm"][150]
    assert used[200:].any()
    assert np.isfinite(bound[FIX_S + 1 :]).all()
    assert (np.abs(fault_m) <= bound)[used].all()
    assert (unnoticed <= bound).all()


def test_a_fault_before_the_first_tvb_goes_on_in_use_without_a_figure() -> None:
    """A step of 60 m at 40 s, found at once and forgotten: in use 60 m off; of the clean run 12.5 m go unnoticed."""
    t_s = np.arange(400.0)
    computed = Configuration.model_validate({"monitors": NO_NOISE, "undetected": {"compute": True}})
    clean = _replayed(np.zeros(t_s.size), t_s, computed)
    epochs = _replayed(np.where(t_s >= 40, 60.0, 0.0), t_s, computed)
    assert epochs["alarm"][40]
    assert epochs["in_use"][120:].all()
    assert clean["undetected_ahead_m"].drop_nulls().max() < 12.5
    assert clean["undetected_ahead_in_use_m"].null_count() == clean.height


def _replayed(fault_m: Floats, t_s: Floats, config: Configuration) -> pl.DataFrame:
    made = journey(np.random.default_rng(3), t_s, fault_m, 1.0)
    fix = made.run.gnss[FIX_S : FIX_S + 1].select("t", "latitude_deg", "longitude_deg", "height_m", sigma_m=2.0)
    run = made.run.with_streams(odometer=made.run.odometer.with_columns(sensor=pl.lit("primary")), reference=fix)
    return replay(run, made.site, made.vehicle, config).epochs
