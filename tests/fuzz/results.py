"""Damage a result's caches and its manifest: the same answers, or one error; `balise verify` sees a changed manifest.

    python -m tests.fuzz.results --count 300

Bytes of `.catalogue` or of `manifest.json` of a small result are changed. Queries must answer as before, whatever the
caches hold; of a changed manifest `verify` says so, or fails with one error, but for what SECURITY.md names
(`unnoticed`). `--first N --count 1 --seed S` repeats.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

from datasets.scenario import Scenario
from datasets.trial import write_trial
from pipeline.campaign import make_plan, resume, run_campaign
from pipeline.campaign.verify import verify
from pipeline.results.query import run_sql
from tests.fuzz.files import Case, main, mutated
from tests.fuzz.ingest import Random

_QUERY = "SELECT * FROM runs ORDER BY run_id, solution"
_SCENARIO = {
    "name": "fuzz",
    "seed": 4,
    "line": {
        "heading_deg": 70.0,
        "sections": [{"length_m": 2000.0}],
        "elements": [{"id": "A", "length_m": 2000.0}],
        "balises": [{"id": "VB1", "at_m": 500.0}],
    },
    "runs": [
        {"id": name, "motion": {"start_m": 100.0, "phases": [{"speed_mps": 20.0, "hold_s": 30.0}]}} for name in "ab"
    ],
}


def small_result(folder: Path) -> Path:
    """Two runs, replayed, with their catalogue."""
    write_trial(Scenario.model_validate(_SCENARIO), folder)
    run_campaign(make_plan([str(folder / "runs")], str(folder / "site"), str(folder / "out")))
    return folder / "out"


def cache_case(whole: Path) -> Case:
    """A file of `.catalogue` changed."""
    expected = resume.kept_outcomes(str(whole))

    def case(random: Random, folder: Path) -> str:
        out = _copy(whole, folder)
        files = sorted(file for file in (out / ".catalogue").rglob("*") if file.is_file())
        chosen = files[random.integers(len(files))]
        chosen.write_bytes(mutated(chosen.read_bytes(), random))
        return "whole" if resume.kept_outcomes(str(out)) in ({}, expected) else "WRONG another answer"

    return case


def manifest_case(whole: Path) -> Case:
    """The manifest changed."""
    expected = run_sql(whole, _QUERY)
    intact = json.loads((whole / "manifest.json").read_bytes())

    def case(random: Random, folder: Path) -> str:
        out = _copy(whole, folder)
        manifest = out / "manifest.json"
        manifest.write_bytes(mutated(manifest.read_bytes(), random))
        if not run_sql(out, _QUERY).equals(expected):
            return "WRONG another answer"
        found = verify(out)
        same = _parsed(manifest.read_bytes()) == intact
        return "whole" if same else "seen" if found.problems else "unnoticed"

    return case


def _parsed(content: bytes) -> object:
    try:
        return json.loads(content)
    except ValueError:
        return None


def _copy(whole: Path, folder: Path) -> Path:
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(whole, out)
    return out


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        result = small_result(Path(name))
        sys.exit(main(__doc__, {"cache": cache_case(result), "manifest": manifest_case(result)}, 300))
