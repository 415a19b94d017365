"""The fit of a run: wrong units, clocks, axes and shifts that must be reported, and faulty runs that must not fail.

python -m benchmarks.truth.plausibility --trips 12 --runs 1000
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.results import Figure
from pipeline.stages.clean.clean import clean
from pipeline.studies.plausibility.check import Check, FitState
from pipeline.studies.plausibility.fit import Fit, clock_advice, fit_run
from schemas.config import Configuration, Vehicle
from schemas.errors import InputError
from schemas.run import RunLog, Site
from tests.studies.plausibility.trips import Trip, trip
from tests.studies.plausibility.wrongs import WRONGS, Wrong

_CONFIG = Configuration()


def fit_of(run: RunLog, site: Site, vehicle: Vehicle | None = None) -> Fit | str:
    """The fit of a run as a replay makes it, or the error of one that has no time in common."""
    try:
        cleaned, _ = clean(run, _CONFIG, clock_advice)
    except InputError as error:
        return str(error)
    return fit_run(cleaned, "primary", vehicle or Vehicle(), _CONFIG.plausibility, site)


def applies(wrong: Wrong, drawn: Trip) -> bool:
    """Whether the trip holds what the wrong changes, and enough movement to show it."""
    if wrong.least_hours > drawn.hours or (wrong.speed_changes and drawn.hours < 0.1):
        return False
    return all(_has(need, drawn) for need in wrong.needs)


def _has(need: str, drawn: Trip) -> bool:
    if need == "reverses":
        return drawn.reverses
    stream, _, column = need.partition(".")
    frame = drawn.run.stream(stream)  # type: ignore[arg-type]
    return frame is not None and frame.height > 4 and frame[column].null_count() < frame.height


def is_reported(wrong: Wrong, drawn: Trip) -> tuple[bool, list[str]]:
    """Whether the mistake is reported as it should be, and what was said."""
    site = wrong.site(drawn.site) if wrong.site else drawn.site
    vehicle = wrong.vehicle(drawn.scale, drawn.latency_s) if wrong.vehicle else None
    found = fit_of(wrong.change(drawn.run), site, vehicle)
    if isinstance(found, str):
        return all(word in found for word in wrong.reported), [found]
    checks = found.impossible_checks if wrong.fails else found.misfits
    return any(_says(check, wrong) for check in checks), [check.sentence for check in found.misfits]


def _says(check: Check, wrong: Wrong) -> bool:
    return all(word in check.sentence for word in wrong.reported)


def faulty(count: int, first: int = 0) -> Iterator[tuple[int, Trip, Fit | str, float]]:
    """Plausible runs with faults in them: seed, trip, fit and seconds of the processor."""
    for seed in range(first, first + count):
        drawn = trip(10_000 + seed)
        begun = time.process_time()
        fit = fit_of(drawn.run, drawn.site)
        yield seed, drawn, fit, time.process_time() - begun


def measure(_: Path) -> list[Figure]:
    """A part of it, as figures beside targets."""
    tried, found = 0, 0
    for wrong in WRONGS:
        for drawn in [drawn for seed in range(8) if applies(wrong, drawn := trip(seed, place=wrong.place))][:3]:
            tried, found = tried + 1, found + is_reported(wrong, drawn)[0]
    refused = sum(isinstance(fit, str) or bool(fit.impossible_checks) for _, _, fit, _ in faulty(100))
    return [
        Figure("wrong recordings reported with their cause", found / tried, "1", target=0.97, better="above"),
        Figure("faulty but plausible runs that fail, of 100", float(refused), "1", target=0.0),
    ]


def main() -> int:
    """Print what was not reported, and each plausible run that fails; exit status 1 if there is one."""
    parser = argparse.ArgumentParser(prog="benchmarks.truth.plausibility", description=__doc__)
    parser.add_argument("--trips", type=int, default=12, help="of each wrong")
    parser.add_argument("--runs", type=int, default=1000, help="faulty but plausible ones")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    drawn = [trip(seed) for seed in range(3 * given.trips)]
    missed, tried = 0, 0
    for wrong in WRONGS:
        chosen = [one for one in drawn if applies(wrong, one)][: given.trips]
        chosen = chosen if wrong.place is None else [trip(seed, place=wrong.place) for seed in range(given.trips)]
        results = [(one.run.run_id, *is_reported(wrong, one)) for one in chosen]
        good = sum(result[1] for result in results)
        missed, tried = missed + len(results) - good, tried + len(results)
        if good < len(results) or given.verbose:
            print(f"{wrong.name}: reported {good} of {len(results)}", flush=True)
            for run_id, right, said in results:
                if not right:
                    print(f"    {run_id}: {'; '.join(said)}", flush=True)
    print(f"{len(WRONGS)} wrongs, {tried} recordings, {missed} not reported", flush=True)
    return 1 if missed + _plausible(given.runs) else 0


def _plausible(count: int) -> int:
    refused, noted, seconds = 0, Counter[str](), []
    for seed, _, fit, taken in faulty(count):
        seconds.append(taken)
        if isinstance(fit, str) or fit.impossible_checks:
            refused += 1
            said = fit if isinstance(fit, str) else "; ".join(check.sentence for check in fit.impossible_checks)
            print(f"plausible run {seed} fails: {said}", flush=True)
        else:
            noted.update(check.what for check in fit.checks if check.state is FitState.MISFIT)
    print(
        f"{count} plausible runs, {refused} fail; {1e3 * np.median(seconds):.0f} ms each, at most {max(seconds):.2f} s"
    )
    print("reported of them: " + ", ".join(f"{what} {number}" for what, number in noted.most_common()))
    return refused


if __name__ == "__main__":
    sys.exit(main())
