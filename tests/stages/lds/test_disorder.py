"""Balises of one step that are offered out of order, worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.stages.lds.link_monitors import count_out_of_order
from schemas.config import Configuration, LdsConfig

CONFIG = Configuration(lds=LdsConfig(odometer_share=0.05))
# k root of (2 m)^2 + (4 m)^2 of the positions, (2 m)^2 + (1 m)^2 of the odometer's rows; 5 % of the 20 m that it went.
ALLOWED_M = 5.0 * CONFIG.monitors.threshold_factor + 1.0


@pytest.mark.parametrize(
    ("excess_m", "count", "sense", "found"),
    [
        (ALLOWED_M + 0.1, 2, 1, 2),
        (ALLOWED_M - 0.1, 2, 1, 0),
        (ALLOWED_M + 0.1, 1, 1, 0),
        (-ALLOWED_M - 0.1, 1, -1, 1),
        (-ALLOWED_M + 0.1, 1, -1, 0),
    ],
)
def test_two_at_once_or_one_backwards_that_the_odometer_does_not_explain(
    excess_m: float, count: int, sense: int, found: int
) -> None:
    journey = SimpleNamespace(
        odometer_m=np.array([0.0, 20.0]), path_m=np.array([0.0, 20.0 + excess_m]), sigma_m=np.array([2.0, 4.0]),
        rows_m=np.array([2.0, 1.0]), direction=np.array([1, 1]),
    )  # fmt: skip
    offered = [SimpleNamespace(before=0, epoch=1, sense=sense)] * count
    assert count_out_of_order(cast(Any, offered), 0, cast(Any, journey), CONFIG) == found
    assert count_out_of_order(cast(Any, offered), 3, cast(Any, journey), CONFIG) == (found or 3)
