"""Error processes: variances and correlations as DIAG Table 1 has them."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.gnss_errors import POSITION_PROCESSES, gauss_markov, position_errors
from datasets.range_errors import RangeErrorSpec, range_errors_m, range_sigma_m, range_variances_m2


@pytest.mark.parametrize(("step_s", "lag"), [(0.1, 100), (1.0, 10)])
def test_gauss_markov_keeps_its_variance_and_correlation_at_any_rate(step_s: float, lag: int) -> None:
    path = gauss_markov(2.0, 10.0, step_s, (600, 4000), np.random.default_rng(3))
    assert path[0].std() == pytest.approx(2.0, rel=0.05)
    assert path[-1].std() == pytest.approx(2.0, rel=0.05)
    correlation = (path[-1] * path[-1 - lag]).mean() / 4.0
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)


def test_shares_make_the_stated_variance() -> None:
    assert sum(process.share for process in POSITION_PROCESSES) == pytest.approx(1.0)
    rng = np.random.default_rng(4)
    last = np.array([position_errors((1.0, 2.0, 3.0), 5, 1.0, rng)[-1] for _ in range(4000)])
    assert last.std(axis=0) == pytest.approx([1.0, 2.0, 3.0], rel=0.05)


def test_range_variances_by_hand() -> None:
    # Zenith: 0.3^2; (0.12 * 1.001)^2 / 1.002001; 0.3; 1.5.
    zenith = range_variances_m2(RangeErrorSpec(), np.array([90.0]))[:, 0]
    assert zenith == pytest.approx([0.09, 0.0144288144 / 1.002001, 0.3, 1.5], rel=1e-9)
    # 30 degrees: shell ratio 6378.1363 cos 30 / 6728.1363 = 0.8209781..., sin^2 = 0.25.
    low = range_variances_m2(RangeErrorSpec(), np.array([30.0]))[:, 0]
    ratio = 6378.1363 * np.sqrt(0.75) / 6728.1363
    assert low[0] == pytest.approx(0.09 / (1 - ratio**2), rel=1e-12)
    assert low[1] == pytest.approx(0.0144288144 / 0.252001, rel=1e-12)


def test_simulated_ranges_have_the_sigma_that_weighs_them() -> None:
    spec, elevation = RangeErrorSpec(), np.tile([5.0, 20.0, 80.0], (2, 1000))
    errors = range_errors_m(spec, elevation, 1.0, np.random.default_rng(5))[0].reshape(1000, 3)
    assert errors.std(axis=0) == pytest.approx(range_sigma_m(spec, np.array([5.0, 20.0, 80.0])), rel=0.08)
