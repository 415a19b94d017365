"""A drift that all satellites share, through the whole replay: it does not come back step by step."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from datasets.experiment.catalogue_faults import CatalogueFault
from datasets.experiment.catalogue_trial import JourneyPlan, stage, with_fault
from pipeline.stages import replay


@pytest.mark.parametrize(("rate_mps", "seed"), [(0.03, 2), (0.03, 5), (0.06, 3)])
def test_a_slow_drift_is_not_taken_up_again_while_it_goes_on(rate_mps: float, seed: int) -> None:
    """Seen 11 to 17 m off; returned to thirty seconds later it reached 30 m and more before the next alarm."""
    ready = stage(JourneyPlan(3_000.0, 500.0), seed, 1.0)
    fault: dict[str, object] = {"kind": "ramp", "target": "along", "start_s": 0.0, "rate_mps": rate_mps}
    run, site = with_fault(ready, CatalogueFault("drift", rate_mps, "m/s", (fault,)))
    # The ranges drift with the position: what sees this is GNSS against odometer alone.
    run = run.with_streams(satellites=None, gnss=run.gnss.filter(pl.col("solution") == "primary"))
    tables = replay(run, site, ready.vehicle)
    negated = tables.epochs["lds_mode"].cast(pl.String) == "fail_safe"
    first = negated.arg_max()
    assert first is not None
    assert negated[first:].all()
    assert _largest(tables.epochs.filter(~negated)["error_along_m"]) < 20.0
    assert tables.runs["unsafe_accepted"][0] == 0
    assert _largest(tables.passages.filter(pl.col("status") == "accepted")["location_error_m"]) < 20.0


def _largest(errors_m: pl.Series) -> float:
    return float(np.abs(errors_m.drop_nulls().to_numpy()).max())
