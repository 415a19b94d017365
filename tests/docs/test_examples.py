"""The scripts of `examples/` run as their reader would run them, and show what their page says of them."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline import read_run, read_site, replay
from tests.docs.blocks import ROOT

EXAMPLES = ROOT / "examples"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Names of a script, which may import its neighbours."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_page_lists_the_scripts() -> None:
    page = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in sorted(EXAMPLES.glob("*.py")) if f"]({path.name})" not in page] == []


def test_first_run_is_healthy_and_its_jump_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = script("first_run", monkeypatch)
    names["main"](tmp_path)
    said = capsys.readouterr().out
    assert "healthy: safe" in said
    assert "jump: unsafe" in said
    # The train is at 3,460 m when the position jumps by 60 m: over the balise at 3,500 m, and no other.
    jump = replay(read_run(tmp_path / "jump"), read_site(tmp_path / "site"), names["VEHICLE"])
    assert jump.hazards["hazard"].to_list() == ["VB_JUMP_1B"]
    assert jump.hazards["balise_ids"].to_list() == [["VB3500"]]
    assert jump.hazards["size_m"].item() == pytest.approx(60.0, abs=2.0)


def test_thresholds_trade_alarms_for_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = script("thresholds", monkeypatch)
    table = names["main"](tmp_path)
    assert "alarm_after_s" in capsys.readouterr().out
    assert table.height == len(names["PROBABILITIES"]) * len(names["DRIFTS_MPS"])
    assert table.filter(pl.col("k_T") == 5.33).height == len(names["DRIFTS_MPS"])
    for _, of_drift in table.group_by("drift_mps"):
        assert of_drift.sort("k_T")["alarm_after_s"].is_sorted()
    # A drift of rate r has moved the position by r t, but for noise of 0.3 m and five sigmas of it.
    moved_m = table["drift_mps"] * table["alarm_after_s"]
    assert (table["error_m"] - moved_m).abs().max() < 1.5  # type: ignore[operator]


def test_analysts_session_answers_and_draws(
    asked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    names = script("analysts_session", monkeypatch)
    picture = tmp_path / "error.png"
    answers = names["main"](asked / "OUT", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert set(answers) == {word for word in capsys.readouterr().out.split() if word in answers}
    ranks = answers["verdicts"]["verdict"].cast(pl.String).to_list()
    assert ranks == sorted(ranks, key=["unsafe", "unproven", "safe", None].index)
    assert None in ranks, "the broken run has no verdict, and stands last"
    tables = [pl.read_parquet(path) for path in (asked / "OUT" / "passages").glob("*/*.parquet")]
    virtual = pl.concat(table.select("kind", "status") for table in tables).filter(pl.col("kind") == "virtual")
    assert answers["balises"]["passages"].sum() == virtual.height
    assert answers["balises"]["accepted"].sum() == virtual.filter(pl.col("status") == "accepted").height
    assert answers["detections"]["hazards"].sum() > answers["detections"]["undetected"].sum() > 0
    assert answers["lost"]["lost_s"].is_sorted(descending=True)
