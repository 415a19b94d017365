"""Requirements held against replayed runs whose fault is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from datasets.scenario import Scenario
from datasets.trial import write_trial
from pipeline.campaign import make_plan, run_campaign
from pipeline.read.site.read import read_site
from pipeline.studies.claim import assess_claim, load_profile, read_areas
from schemas.config import Configuration, settings_from

MOTION = {"start_m": 200.0, "phases": [{"speed_mps": 30.0, "acceleration_mps2": 1.0, "hold_m": 1200.0}]}
STEP = {"kind": "step", "at_m": 1200.0, "size_m": 45.0}


def test_a_step_exceeds_mapo_once_and_a_clean_run_never(tmp_path: Path) -> None:
    """45 m too far ahead at 1200 m, in use for one epoch: beyond 30 m on the main line, nothing in the node before."""
    data: dict[str, Any] = {
        "name": "step",
        "seed": 3,
        "vehicle": {"odometer_scale": 1.0, "odometer_scale_sigma": 1e-4, "gnss_latency_s": 0.0,
                    "gnss_latency_sigma_s": 0.002},
        "line": {
            "sections": [{"length_m": 2500.0}],
            "elements": [{"id": "A", "length_m": 2500.0}],
            "balises": [{"id": "VB1", "at_m": 500.0}],
        },
        "gnss": {"rate_hz": 1.0, "sigma_east_m": 0.5, "sigma_north_m": 0.5},
        "odometer": {"rate_hz": 5.0},
        "reference": {"rate_hz": 2.0},
        "runs": [{"id": "clean", "motion": MOTION}, {"id": "step", "motion": MOTION, "faults": [STEP]}],
    }  # fmt: skip
    scenario = settings_from(data, Scenario, "test")
    write_trial(scenario, tmp_path)
    areas = "netelement_id,from_m,to_m,area_type\nA,0,1000,node\nA,1000,2500,mainline\n"
    (tmp_path / "site" / "areas.csv").write_text(areas, encoding="utf-8")
    site = read_site(tmp_path / "site")
    events = {}
    for run in ("clean", "step"):
        out = tmp_path / run
        plan = make_plan(
            [str(tmp_path / "runs" / run)], str(tmp_path / "site"), str(out), Configuration(), scenario.vehicle
        )
        run_campaign(plan, jobs=1)
        table = assess_claim(out, load_profile("lu-2023"), site, read_areas(tmp_path / "site", site)).table
        assert "met" not in set(table["finding"])
        mapo = table.filter(pl.col("requirement").is_in(["mapo", "safe_front_end"])).filter(pl.col("events") > 0)
        events[run] = mapo.select("requirement", "applies_to", "finding", "events").rows()
        worst_m = mapo["worst"].to_list()
    assert events["clean"] == []
    assert events["step"] == [
        ("mapo", "mainline", "not met", 1),
        ("safe_front_end", "mainline", "not met", 1),
        ("safe_front_end", "all", "not met", 1),
    ]
    # 45 m less what the reference's clock leaves open: a journey this short measures no lag.
    assert all(40.0 < size_m < 48.0 for size_m in worst_m)
