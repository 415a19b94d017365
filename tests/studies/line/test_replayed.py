"""`balise line` on replayed runs whose fault is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from datasets.scenario import Scenario
from datasets.trial import write_trial
from pipeline import replay
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from pipeline.studies.line.passes import PieceIndex, passes_of
from pipeline.studies.line.pieces import middles_in_plane_m, pieces_of
from schemas.config import Configuration, settings_from
from schemas.line import LineCriteria


def trial(**run: Any) -> Scenario:
    """2 km at up to 20 m/s, without odometer; positions at 1 Hz without velocities."""
    data: dict[str, Any] = {
        "name": "line",
        "seed": 7,
        "line": {
            "sections": [{"length_m": 2000.0}],
            "elements": [{"id": "A", "length_m": 2000.0}],
            "balises": [{"id": f"VB{at}", "at_m": float(at)} for at in (400, 800, 1200)],
        },
        "reference": {"rate_hz": 2.0},
        "odometer": False,
        "runs": [
            {"id": "run", "motion": {"start_m": 100.0, "phases": [{"speed_mps": 20.0}, {"stop_at_m": 1900.0}]}, **run}
        ],
    }
    data["gnss"] = {"rate_hz": 1.0, "velocity": False} | run.get("gnss", {})
    return settings_from(data, Scenario, "test")


def replayed(scenario: Scenario, folder: Path) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Epochs, and passes with `from_m`, of its run."""
    (path,) = write_trial(scenario, folder)
    site, config, criteria = read_site(folder / "site"), Configuration(), LineCriteria()
    tables = replay(read_run(path, config.ingest), site, scenario.vehicle, config)
    pieces = pieces_of(site, criteria.piece_m)
    ground = PieceIndex.of_pieces(site, pieces, middles_in_plane_m(site, pieces))
    passes = passes_of(tables.epochs, tables.passages, tables.alarms, ground, criteria, config)
    return tables.epochs, passes.with_columns(from_m=pl.Series(pieces.from_m[passes["piece"].to_numpy()]))


def test_a_position_that_jumps_back_turns_no_train(tmp_path: Path) -> None:
    """70 m back across VB800 for 3 s, without odometer: the train went on, and no pass is of the other direction."""
    back = {"kind": "step", "at_m": 830.0, "duration_s": 3.0, "size_m": -70.0}
    epochs, passes = replayed(trial(faults=[back]), tmp_path)
    path = epochs["path_m"].diff().drop_nulls()
    assert (path < -30.0).any()
    assert set(epochs["direction"]) == {1}
    assert set(passes["growing"]) == {True}
    claimed = passes.filter("claimed")["from_m"]
    assert claimed.min() is not None
    assert claimed.is_between(750.0, 830.0).all()
    # Where the train was: position less error.
    jumped = epochs.filter(pl.col("error_along_m") < -60.0)
    assert jumped.height == 3
    train_m = (epochs["path_m"] - epochs["direction"] * epochs["error_along_m"]).drop_nulls()
    assert (train_m.diff().drop_nulls() > -0.5).all()
