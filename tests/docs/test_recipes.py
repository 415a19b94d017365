"""The recipes of `docs/developer.md` followed in a copy of the project: a monitor, a column, an input stream."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest

from tests.docs.blocks import ROOT

SINGLE, TABLES = "pipeline/stages/monitors/single.py", "schemas/tables.py"
FIGURES = "pipeline/stages/run_row/run_figures.py"
INPUTS, RUN, CONFIG = "schemas/inputs.py", "schemas/run.py", "schemas/config.py"
KEYS = "docs/configuration.md"

MONITOR = [
    (
        SINGLE,
        "def _window(",
        "def offside_monitor(epochs: AlignedEpochs, factor: float) -> Verdicts:\n"
        "    unknown = np.isnan(epochs.cross_track_m) | np.isnan(epochs.sigma_cross_m)\n"
        "    reasons = first_reason((unknown, NO_POSITION))\n"
        "    return verdicts(epochs.cross_track_m, factor * epochs.sigma_cross_m, reasons)\n\n\n",
    ),
    (SINGLE, '    "channel": lambda', '    "offside": lambda seen: offside_monitor(seen.epochs, 5.3),\n'),
    (TABLES, '    Monitor("channel"', '    Monitor("offside", "m", "other", "off side"),\n'),
]
COLUMN = [
    (TABLES, "    part_verdict = one_of(", '    epochs_on_track = count("epochs on the track")\n'),
    (
        FIGURES,
        '        "outages": lost_s.size,',
        '        "epochs_on_track": int(epochs.on_track.sum()),\n',
    ),
]
STREAM = [
    (
        INPUTS,
        "class Faults(dy.Schema)",
        'class Doors(dy.Schema):\n    t = instant("time of validity")\n    open = flag("a door is open")\n\n\n',
    ),
    (INPUTS, '    "faults": Faults,', '    "doors": Doors,\n'),
    (RUN, '"faults"]', '"doors", '),
    (RUN, '    "faults",\n', '    "doors",\n'),
    (RUN, "    faults: pl.DataFrame", "    doors: pl.DataFrame | None = None\n"),
    (CONFIG, "    balise_reads: tuple[StreamMapping", "    doors: tuple[StreamMapping, ...] = ()\n"),
    (
        KEYS,
        "| `ingest.balise_reads` |",
        "| `ingest.doors` | none | mappings of topics that hold door states | as above |\n",
    ),
]
CHECK = """
import json, sys
from pathlib import Path
import polars as pl
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline import read_run, replay
from pipeline.show.report.series import monitor_lines, time_data
from pipeline.results.store import write_run
from schemas.config import Configuration, settings_from
from schemas.dictionary import dictionary_markdown
import numpy as np

scenario = settings_from(json.loads(sys.argv[1]), Scenario, "test")
run = build_run(scenario, scenario.runs[0])
tables = replay(run, build_site(scenario))
states = tables.epochs["offside_state"].value_counts()
page = time_data(tables.epochs, np.array([], dtype=np.int64), 1.0)
folder = Path(sys.argv[2]); folder.mkdir()
run.gnss.write_parquet(folder / "gnss.parquet")
pl.DataFrame({"t": run.gnss["t"][:2], "open": [False, True]}).write_parquet(folder / "doors.parquet")
text = dictionary_markdown()
keys = Path("docs/configuration.md").read_text(encoding="utf-8")
print(json.dumps({
    "undocumented": [name for name in Configuration().ingest.model_dump() if f"`ingest.{name}`" not in keys],
    "states": states["offside_state"].cast(pl.String).to_list(),
    "drawn": monitor_lines()["other"],
    "series": sorted(name for name in page["series"] if "offside" in name),
    "column": tables.runs["epochs_on_track"].to_list(),
    "doors": read_run(folder).doors["open"].to_list(),
    "documented": [name for name in ("offside_value", "epochs_on_track", "doors") if name in text],
    "disabled": Configuration.model_validate({"monitors": {"disabled": ["offside"]}}).monitors.disabled,
}))
"""
TRIAL = """{"name": "recipe", "seed": 7, "gnss": {"rate_hz": 1.0}, "odometer": {"rate_hz": 5.0},
"line": {"sections": [{"length_m": 3000.0}], "elements": [{"id": "A", "length_m": 3000.0}], "balises": []},
"runs": [{"id": "run", "motion": {"start_m": 100.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 2000.0}]}}]}"""


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """What a copy of the project answers once all three recipes are followed in it."""
    copy = tmp_path_factory.mktemp("copy")
    for folder in ("schemas", "pipeline", "datasets", "docs"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file, before, text in (*MONITOR, *COLUMN, *STREAM):
        source = (copy / file).read_text(encoding="utf-8")
        assert source.count(before) == 1, (file, before)
        (copy / file).write_text(source.replace(before, text + before), encoding="utf-8")
    command = [sys.executable, "-c", CHECK, TRIAL, str(copy / "run")]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def test_a_monitor_takes_two_files(followed: dict[str, object]) -> None:
    """Tables, page, configuration and dictionary know it."""
    assert followed["states"] == ["pass"]
    assert ["offside", "off side"] in followed["drawn"]  # type: ignore[operator]
    assert followed["series"] == ["ratio_offside"]
    assert followed["disabled"] == ["offside"]
    assert len({file for file, _, _ in MONITOR}) == 2


def test_a_column_takes_two_files(followed: dict[str, object]) -> None:
    assert followed["column"] != [0]
    assert len({file for file, _, _ in COLUMN}) == 2


def test_a_stream_takes_four_files(followed: dict[str, object]) -> None:
    assert followed["doors"] == [False, True]
    assert followed["undocumented"] == []
    assert len({file for file, _, _ in STREAM}) == 4


def test_the_dictionary_follows(followed: dict[str, object]) -> None:
    assert followed["documented"] == ["offside_value", "epochs_on_track", "doors"]


@pytest.mark.parametrize(("title", "edits"), [("monitor", MONITOR), ("column", COLUMN), ("input stream", STREAM)])
def test_the_page_names_the_files(title: str, edits: list[tuple[str, str, str]]) -> None:
    page = (ROOT / "docs" / "developer.md").read_text(encoding="utf-8")
    recipe = page.split(f"## How to add a{'n' if title == 'input stream' else ''} {title}\n")[1].split("\n## ")[0]
    assert {file for file, _, _ in edits} <= {
        file for file in (SINGLE, TABLES, FIGURES, INPUTS, RUN, CONFIG, KEYS) if file in recipe
    }
