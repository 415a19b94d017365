"""What a command loads before it does anything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.conftest import SmallTrial

ROOT = Path(__file__).parents[2]

LOADED = """
import json, sys, cli
for arguments in json.loads(sys.argv[1]):
    cli._run_guarded(arguments, False)
    loaded = [name for name in ('polars', 'numpy', 'scipy', 'pyarrow', 'schemas.config') if name in sys.modules]
    print("loaded", *arguments, *loaded, sep="|", flush=True)
"""

# The worker is stopped where it would read the log; `inspect` reads it.
OF_A_LOG = """
import os, sys, cli
log, site, out = sys.argv[1:]
parts = ('scipy.spatial', 'scipy.sparse', 'scipy.linalg', 'scipy.special')
def loaded():
    print([name for name in parts if name in sys.modules], flush=True)
cli._run_guarded(['inspect', log, '--json'], False)
loaded()
import pipeline.campaign.worker as worker
def stop(*given, **named):
    loaded()
    os._exit(0)
for name in ('read_run', 'RecordedLog'):
    if hasattr(worker, name):
        setattr(worker, name, stop)
cli._run_guarded(['replay', log, '--site', site, '--out', out, '--quiet'], False)
"""


def said(code: str, *arguments: str | Path) -> list[str]:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=True).stdout.splitlines()


MISTYPED = [["inspect", "/nowhere"], ["replay", "/nowhere", "--site", "/nowhere", "--out", "/nowhere"]]


def test_what_needs_no_table_loads_no_tables() -> None:
    """One command after the other in one process: none of them may load anything."""
    commands = [["-h"], ["replay", "--help"], ["--version"], ["experiment", "list"], *MISTYPED]
    lines = [line for line in said(LOADED, json.dumps(commands)) if line.startswith("loaded|")]
    assert lines == ["|".join(["loaded", *arguments]) for arguments in commands]


def test_a_log_needs_no_search_trees_and_no_matrices(small_trial: SmallTrial, tmp_path: Path) -> None:
    lines = said(OF_A_LOG, small_trial.paths[0], small_trial.site, tmp_path / "out")
    assert [line for line in lines if line.startswith("[") and line.endswith("]")][-2:] == ["[]", "[]"]


REPLAYED = """
import sys, cli
log, site, out = sys.argv[1:]
cli._run_guarded(['replay', log, '--site', site, '--out', out, '--quiet'], False)
others = ('pandas', 'matplotlib', 'shapely', 'pyogrio', 'duckdb', 'msgspec', 'dask')
print([name for name in others if name in sys.modules])
"""


def test_a_replay_loads_nothing_that_only_others_need(small_trial: SmallTrial, tmp_path: Path) -> None:
    """Some libraries load pandas when they are handed an array, if it is there."""
    assert said(REPLAYED, small_trial.paths[0], small_trial.site, tmp_path / "out")[-1] == "[]"
    assert (tmp_path / "out" / "runs").is_dir()
