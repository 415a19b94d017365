"""Windows cannot be tried here: at least no module needs at its import what only POSIX has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

from pipeline.results.store import file_name

ROOT = Path(__file__).parents[1]
_HIDDEN = """
import importlib, signal, sys
import polars, pyarrow, rich.console, pyproj, pyogrio  # what libraries need is theirs
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
for name in ("SIGHUP", "SIGALRM", "SIGKILL", "setitimer", "ITIMER_REAL"):
    delattr(signal, name)
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def test_every_module_is_imported_without_posix() -> None:
    files = [path for layer in ("schemas", "pipeline", "datasets") for path in sorted((ROOT / layer).rglob("*.py"))]
    names = [path.relative_to(ROOT).as_posix().removesuffix(".py").replace("/", ".") for path in files]
    modules = [name.removesuffix(".__init__") for name in names]
    ended = subprocess.run(
        [sys.executable, "-c", _HIDDEN, "cli", *modules], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr[-2000:]


def test_run_ids_become_names_that_windows_takes() -> None:
    name = file_name('a<b>:"c/d\\e|f?g*h\x01')
    assert set(name).isdisjoint('<>:"/\\|?*\x01')
    assert unquote(name) == 'a<b>:"c/d\\e|f?g*h\x01'
