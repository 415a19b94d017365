"""Stated accuracy against errors that the evidence shows: refuted, too large, and what must not be blamed."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.studies.plausibility.fit import accuracy_checks, refuted
from schemas.config import Configuration
from schemas.enums import MisfitCause
from tests.arrays_of_table import arrays_of_table

CONFIG = Configuration()
BEGIN = datetime(2025, 3, 3, tzinfo=UTC)


def epochs_of(
    error_m: np.ndarray, stated_m: float, half_m: float = 0.05, hpl_m: float | None = None, negated: bool = False
) -> JudgedEpochs:
    count = error_m.size
    times = pl.Series([BEGIN + timedelta(seconds=second) for second in range(count)], dtype=pl.Datetime("ns", "UTC"))
    table = pl.DataFrame(
        {
            "t": times,
            "sigma_along_m": np.full(count, stated_m),
            "hpl_m": pl.Series([hpl_m] * count, dtype=pl.Float64),
            "error_along_m": error_m,
            "error_low_m": error_m - half_m,
            "error_high_m": error_m + half_m,
            "negated": [negated] * count,
        }
    )
    return arrays_of_table(JudgedEpochs, table)


def found(*args: object, **more: object) -> set[tuple[MisfitCause, str]]:
    checks = accuracy_checks(epochs_of(*args, **more), None, CONFIG)  # type: ignore[arg-type]
    return {(cause.code, cause.figures[0] if cause.figures else "") for check in checks for cause in check.causes}  # type: ignore[misc]


def errors_m(sigma_m: float, count: int = 400) -> np.ndarray:
    return np.random.default_rng(3).normal(0.0, sigma_m, count)


@pytest.mark.parametrize(
    ("true_m", "stated_m", "unit"),
    [
        (1.0, 1.0 / 111120.0, (MisfitCause.SIGMA_UNIT, "deg2 (degrees)")),
        (1.0, 1e-3, (MisfitCause.SIGMA_UNIT, "km")),
        (1.0, 100.0, (MisfitCause.SIGMA_UNIT, "cm")),
        (0.5, 500.0, (MisfitCause.SIGMA_UNIT, "mm")),
        (0.002, 0.002**0.5, (MisfitCause.SIGMA_FOR_VARIANCE, "")),
        (0.02, 0.02**2, (MisfitCause.VARIANCE_FOR_SIGMA, "")),
    ],
)
def test_units_of_a_stated_sigma(true_m: float, stated_m: float, unit: tuple[MisfitCause, str]) -> None:
    causes = found(errors_m(true_m), stated_m, half_m=true_m / 100.0)
    assert unit in causes
    small = MisfitCause.SIGMA_TOO_SMALL in {code for code, _ in causes}
    assert small == (stated_m < true_m)


def test_only_a_sigma_that_is_too_small_refutes() -> None:
    for stated_m, wrong in ((0.01, True), (1.0, False), (100.0, False)):
        assert refuted(accuracy_checks(epochs_of(errors_m(1.0), stated_m), None, CONFIG)) == wrong


def test_a_protection_level_is_looked_at_like_a_sigma() -> None:
    assert (MisfitCause.SIGMA_TOO_SMALL, "1e+02") in found(np.full(400, 1.96), 1.0, half_m=0.0, hpl_m=0.0618)
    assert found(errors_m(1.0), 1.0, hpl_m=6.18) == set()


def test_what_shows_nothing() -> None:
    """Too few epochs, negated ones, errors within what reads and odometer may err by, one epoch in a hundred."""
    assert found(errors_m(1.0, 299), 0.001) == set()
    assert found(errors_m(1.0), 0.001, negated=True) == set()
    assert found(errors_m(0.3), 0.02, half_m=10.0) == set()
    few = np.where(np.arange(400) < 4, 3.0, 0.01)
    assert found(few, 0.02) == set()


def test_the_errors_of_an_injected_fault_are_not_the_receivers() -> None:
    epochs = epochs_of(np.where(np.arange(700) < 350, 8.0, 0.3), 0.5)
    end = BEGIN + timedelta(seconds=349)
    spans = {"t_start": pl.Series([BEGIN]), "t_end": pl.Series([end])}
    faults = pl.DataFrame({"target": ["along"], **spans}).with_columns(
        pl.col("t_start", "t_end").dt.cast_time_unit("ns")
    )
    assert refuted(accuracy_checks(epochs, None, CONFIG))
    assert not refuted(accuracy_checks(epochs, faults, CONFIG))
