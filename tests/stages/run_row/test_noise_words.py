"""What measured noise adds to the thresholds, worked out by hand."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.stages.run_row.noise import widened_by_noise
from schemas.config import Configuration
from schemas.words import noise_words
from tests.tables import epochs

CONFIG = Configuration()


def test_thresholds_against_the_models() -> None:
    """Model 0.1 m/s at 1 Hz; white noise of 10 cm adds 3 * 0.1² to 0.1²: twice the model's."""
    factor = CONFIG.monitors.threshold_factor
    nothing = {f"{axis}_raw_threshold": pl.lit(None, pl.Float64) for axis in ("cross", "up")}
    frame = epochs([0.0, 1.0, 2.0]).with_columns(along_raw_threshold=pl.lit(0.2 * factor), **nothing)
    run = {"white_noise_along_m": 0.1, "white_noise_cross_m": 0.1, "white_noise_up_m": None}
    found = widened_by_noise(frame, run, CONFIG)
    assert list(found) == ["along"]
    assert found["along"] == (pytest.approx(2.0), 0.1)
    assert noise_words(found) == "along the track 2.0 times (white noise 10 cm)"
    assert widened_by_noise(frame.head(1), run, CONFIG) == {}


def test_noise_of_millimetres_is_told_in_millimetres() -> None:
    assert "across it 1.1 times (white noise 5 mm)" in noise_words({"cross": (1.1, 0.005)})
    assert noise_words({}) == ""
