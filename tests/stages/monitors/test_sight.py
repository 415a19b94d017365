"""How good ranges are by the elevation of their satellite, against the formulas of DO-229 worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.monitors.pseudorange import line_of_sight_rows, range_variances_m2


def test_variances_of_a_range_at_three_elevations() -> None:
    """Obliquity squared 1 / (1 - (6378.1363 cos E / 6728.1363)^2): 9.8683 at the horizon (and below), 3.0675, 1."""
    found = range_variances_m2(np.array([-1.0, 0.0, 30.0, 90.0]))
    assert found[:, 0] == pytest.approx(0.09 * np.array([9.8683, 9.8683, 3.0675, 1.0]), rel=2e-5)
    # 0.12 m times 1.001, over the root of 0.002001 and the squared sine of the elevation.
    assert found[:, 1] == pytest.approx(0.12012**2 / np.array([0.002001, 0.002001, 0.252001, 1.002001]))
    assert found[:, 2:].tolist() == [[0.3, 1.5]] * 4  # DIAG Table 1: orbit and clock, user


def test_lines_of_sight() -> None:
    """A range shrinks as the receiver moves to its satellite: east at 60 degrees, north at the horizon, above."""
    found = line_of_sight_rows(np.array([90.0, 0.0, 0.0]), np.array([60.0, 0.0, 90.0]))
    np.testing.assert_allclose(found, [[-0.5, 0, -np.sqrt(0.75)], [0, -1, 0], [0, 0, -1]], atol=1e-12)
