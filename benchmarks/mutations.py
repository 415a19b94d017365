"""Seeded defects in the core, one at a time: which of them do the tests catch?

`python -m benchmarks.mutations --count 56 --seed 1` changes one place of the core in a copy of the project, runs the
tests of the room concerned, and says `caught`, `not caught` or `timed out` for each; the defects that no test caught
stand at the end. Some of them change nothing that a run can show; the others ask for a test. The quick tests (those of
`make quick`) judge all defects first, the slow ones only what is then left, until `--minutes` are over.

`--tests-of FOLDER` takes the tests of another checkout: the same defects, judged by two states of the tests.
`--nearest` runs only the first of them for each room, of judge and evidence tables worked out by hand: what those
catch, in a fraction of the time.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from random import Random

from benchmarks.mutants import Mutant, mutants_of

ROOT = Path(__file__).parents[1]
COPIED = ("cli.py", "pyproject.toml", "Makefile", "README.md", "pipeline", "schemas", "datasets", "benchmarks", "docs")
# A room of the core and the tests that hold it, folders or files, the quickest first.
ROOMS: dict[str, tuple[str, ...]] = {
    "pipeline/stages/evidence": ("tests/stages/evidence", "tests/stages/judge", "tests/replay"),
    "pipeline/stages/judge": ("tests/stages/judge/test_parts.py", "tests/stages/judge", "tests/replay"),
    "pipeline/stages/lds": ("tests/stages/lds", "tests/replay"),
    "pipeline/stages/monitors": ("tests/stages/monitors", "tests/replay"),
    "pipeline/stages/alignment": ("tests/stages/alignment", "tests/studies/calibration", "tests/replay"),
    "pipeline/stages/epochs": ("tests/stages/epochs", "tests/stages/run_row", "tests/stages/judge", "tests/replay"),
    "pipeline/stages/odometry": (
        "tests/stages/odometry",
        "tests/stages/alignment",
        "tests/stages/lds",
        "tests/stages/judge",
    ),
    "pipeline/stages/matching": ("tests/stages/matching", "tests/replay"),
    "pipeline/stages/run_row": ("tests/stages/run_row", "tests/stages/judge"),
    "pipeline/stages/clean": ("tests/stages/clean", "tests/replay"),
    "pipeline/stages/track": ("tests/stages/track", "tests/read/site", "tests/stages/matching"),
    "pipeline/stages/reference": ("tests/stages/evidence", "tests/replay"),
    "pipeline/studies/undetected": ("tests/studies/undetected",),
}
_FAILED = re.compile(r"^(?:FAILED|ERROR) ([^ ]+::.*?|[^ ]+)(?: - .*)?$", re.MULTILINE)
_CAUGHT, _PASSED, _NO_TESTS = 1, 0, 5
_QUICK, _SLOW = "not slow", "slow"


def main() -> int:
    """Command line: how many defects, which, for how long, with whose tests, in which rooms."""
    parser = argparse.ArgumentParser(prog="benchmarks.mutations", description=__doc__)
    parser.add_argument("--count", type=int, default=56, help="number of defects, as many of each room as can be")
    parser.add_argument("--seed", type=int, default=1, help="the same seed makes the same defects of the same code")
    parser.add_argument("--limit-s", type=float, default=900.0, help="time for the tests of one defect [s]")
    parser.add_argument("--tests-of", type=Path, default=ROOT, metavar="FOLDER", help="checkout whose tests are run")
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS), choices=list(ROOMS), metavar="ROOM")
    parser.add_argument("--nearest", action="store_true", help="only the first folder of tests of each room")
    parser.add_argument(
        "--minutes", type=float, default=600.0, help="when this time is over no further defect is begun"
    )
    given = parser.parse_args()
    tests = {room: folders[:1] if given.nearest else folders for room, folders in ROOMS.items()}
    chosen = choose(given.rooms, given.count, given.seed)
    end = time.monotonic() + 60.0 * given.minutes
    told: dict[int, str] = {}
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        bench = Bench(copied(Path(folder) / "project", given.tests_of), given.limit_s)
        for speed in (_QUICK, _SLOW):
            for number, (room, mutant) in enumerate(chosen):
                if told.get(number, "not caught") == "not caught" and time.monotonic() < end:
                    told[number] = bench.judged(tests[room], speed, mutant)
    show(told, chosen)
    return 0


def choose(rooms: list[str], count: int, seed: int) -> list[tuple[str, Mutant]]:
    """Defects drawn of each room in turn, the same for the same code and seed; no room counts by its size."""
    drawn = []
    for room in rooms:
        able = [(room, mutant) for path in sources(room) for mutant in mutants_of(path)]
        drawn.append(Random(seed).sample(able, len(able)))
    in_turn = [one for turn in zip_longest(*drawn) for one in turn if one is not None]
    return in_turn[:count]


def sources(room: str) -> list[Path]:
    place = ROOT / room
    return [place] if place.is_file() else sorted(place.rglob("*.py"))


def copied(folder: Path, tests_of: Path) -> Path:
    """The project with the tests of a checkout, to be changed at will."""
    folder.mkdir()
    for name in COPIED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    shutil.copytree(tests_of / "tests", folder / "tests")
    return folder


@dataclass
class Bench:
    """A copy of the project, and which tests fail there without a defect: they can catch none and are left out."""

    copy: Path
    limit_s: float
    failing: dict[tuple[tuple[str, ...], str], list[str]] = field(default_factory=dict)

    def failing_anyway(self, folders: tuple[str, ...], speed: str) -> list[str]:
        """Asked once for the same tests."""
        if (folders, speed) not in self.failing:
            limit_s = 8 * self.limit_s
            done = run_tests(self.copy, folders, ["-m", speed, "-rfE", "--continue-on-collection-errors"], limit_s)
            if done is None:
                raise TimeoutError(f"the tests take longer than {limit_s:g} s without a defect: raise --limit-s")
            failing = self.failing[folders, speed] = _FAILED.findall(done.stdout)
            print(
                f"{' '.join(folders)}, {speed}: {len(failing)} fail without a defect", *failing, sep="\n  ", flush=True
            )
        return self.failing[folders, speed]

    def judged(self, folders: tuple[str, ...], speed: str, mutant: Mutant) -> str:
        """`caught`, `not caught` or `timed out`, said as soon as it is known."""
        left_out = [word for name in self.failing_anyway(folders, speed) for word in left_out_by(name)]
        place = self.copy / mutant.path.relative_to(ROOT)
        original = place.read_text(encoding="utf-8")
        # Made of the copy: the project may be worked on meanwhile.
        place.write_text(replace(mutant, path=place).source(), encoding="utf-8")
        begin = time.monotonic()
        try:
            done = run_tests(self.copy, folders, ["-m", speed, "-x", *left_out], self.limit_s)
        finally:
            place.write_text(original, encoding="utf-8")
        outcome = "timed out" if done is None else outcome_of(done)
        print(f"{outcome:10}  {speed:8}  {told_place(mutant)}  [{time.monotonic() - begin:.0f} s]", flush=True)
        return outcome


def left_out_by(name: str) -> tuple[str, str]:
    """A test is deselected; a file that cannot be collected is ignored."""
    return ("--deselect", name) if "::" in name else ("--ignore", name)


def outcome_of(done: subprocess.CompletedProcess[str]) -> str:
    """The exit status of pytest; a defect that stops the collection is caught too."""
    if done.returncode in (_PASSED, _NO_TESTS):
        return "not caught"
    if done.returncode in (_CAUGHT, 2):
        return "caught"
    raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")


def run_tests(
    copy: Path, folders: Sequence[str], options: list[str], limit_s: float
) -> subprocess.CompletedProcess[str] | None:
    """The tests of some folders; None where they took longer than the limit."""
    command = [sys.executable, "-B", "-m", "pytest", *folders, "-q", "--tb=no", "-p", "no:cacheprovider", *options]
    environment = {**os.environ, "PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
    try:
        return subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return None


def told_place(mutant: Mutant) -> str:
    return f"{mutant.path.relative_to(ROOT)}:{mutant.line}: {mutant.what}"


def show(told: dict[int, str], chosen: Sequence[tuple[str, Mutant]]) -> None:
    """Sums, and the defects that survived."""
    outcomes = list(told.values())
    counts = {outcome: outcomes.count(outcome) for outcome in ("caught", "not caught", "timed out")}
    print(", ".join(f"{number} {outcome}" for outcome, number in counts.items()) + f" of {len(chosen)}")
    for number, outcome in told.items():
        if outcome == "not caught":
            print(f"survived: {told_place(chosen[number][1])}")


if __name__ == "__main__":
    sys.exit(main())
