"""Whether a result is still what its manifest says, and whether the same logs give it again."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.campaign.plan import make_plan
from pipeline.campaign.run import run_campaign
from pipeline.results import store
from pipeline.results.manifest import NAME, Manifest, contents_of, own_file_names, read_manifest, write_manifest
from pipeline.storage.address import Address, join, redacted
from schemas.config import Configuration, Vehicle
from schemas.errors import UsageError
from schemas.tables import TABLES

Progress = Callable[[int, int], None]
_RUNS_AT_ONCE = 50
_COLUMNS = ("what", "found", "expected")


@dataclass(frozen=True)
class Verification:
    """What was compared and what differs: `what, found, expected`, digests shortened."""

    compared: str
    problems: tuple[tuple[str, str, str], ...]

    @property
    def table(self) -> pl.DataFrame:
        return pl.DataFrame(self.problems, schema=dict.fromkeys(_COLUMNS, pl.String), orient="row")

    @property
    def sentence(self) -> str:
        if not self.problems:
            return f"{self.compared}: all agree"
        return f"{self.compared}: {len(self.problems)} do not agree"


def verify(out: Address, progress: Progress | None = None) -> Verification:
    """Hold every table of a result, its configuration and its campaign's tables against `OUT/manifest.json`.

    Raises `UsageError` where there is no manifest.
    """
    manifest = _manifest(out)
    problems = list(_other_runs(store.run_ids(out), manifest))
    own = manifest["files"]
    for name in sorted({*own, *own_file_names(out)}):
        problems += _difference(name, _sha256(storage.content_of(join(out, name))), own.get(name, {}).get("sha256"))
    runs = [run for run in store.run_ids(out) if run in manifest["runs"]]
    for first in range(0, len(runs), _RUNS_AT_ONCE):
        for name, found, expected in _tables(out, runs[first : first + _RUNS_AT_ONCE], manifest):
            problems += _difference(name, found, expected)
        if progress is not None:
            progress(min(first + _RUNS_AT_ONCE, len(runs)), len(runs))
    files = len(own) + len(TABLES) * len(runs)
    return Verification(f"{files} files of {len(runs)} runs against {NAME}", tuple(problems))


def recompute(
    out: Address,
    logs: Sequence[str],
    site: Address | None,
    config: Configuration | None,
    vehicle: Vehicle,
    routes: Address | None = None,
    jobs: int = 1,
) -> Verification:
    """Replay logs again, in a folder of their own, and hold logs, site and tables against the manifest.

    Without a configuration, with that of the result. What the manifest does not name is a problem; runs of it whose
    logs are not given are counted.
    """
    manifest = _manifest(out)
    if site is None:
        raise UsageError("needs the site", place="--logs", remedy="Give it with --site.")
    with tempfile.TemporaryDirectory(prefix="balise-verify-") as folder:
        plan = make_plan(logs, site, folder, config or store.read_config(out), vehicle, routes)
        known = tuple(job for job in plan.jobs if job.run_id in manifest["runs"])
        if known:
            run_campaign(replace(plan, jobs=known), jobs=jobs)
        again = write_manifest(folder)["runs"]
    problems = [(f"run {job.run_id}", "a log", "not in the manifest") for job in plan.jobs if job not in known]
    for run_id, found in again.items():
        expected = manifest["runs"][run_id]
        if found["config_digest"] != expected["config_digest"]:
            problems.append((f"run {run_id}, settings", "others", _settings(expected["config_digest"], manifest)))
        made, named = _parts(found), _parts(expected)
        for what in dict.fromkeys([*made, *named]):
            problems += _difference(f"run {run_id}, {what}", made.get(what), named.get(what))
    return Verification(f"{len(again)} of {len(manifest['runs'])} runs replayed again", tuple(problems))


def _parts(run: dict[str, Any]) -> dict[str, str | None]:
    """The digest of everything that made a run but its settings, and of its tables."""
    made = {"site": run["site"], "route": run["route_sha256"], "program": run["software_digest"]}
    logs = {f"log {file['name']}": file["sha256"] for file in sorted(run["log"], key=lambda file: file["name"])}
    return {**made, **logs, **run["tables"]}


def _manifest(out: Address) -> Manifest:
    store.complete_runs(out)
    found = read_manifest(out)
    if found is None:
        remedy = "Results of an earlier version have none: replay them again."
        raise UsageError(f"has no {NAME}", place=redacted(str(out)), remedy=remedy)
    return found


def _other_runs(there: Sequence[str], manifest: Manifest) -> Iterator[tuple[str, str, str]]:
    """Runs that only one of the two has; a call that was ended leaves some that the manifest does not name yet."""
    named = manifest["runs"]
    for run in sorted({*there, *named}):
        if run not in named:
            yield f"run {run}", "complete", "not in the manifest: the call may have been interrupted. Repeat it."
        elif run not in there:
            yield f"run {run}", "missing", "complete"


def _tables(out: Address, runs: Sequence[str], manifest: Manifest) -> Iterator[tuple[str, str, str]]:
    """Name, digest found and digest expected of each table of some runs."""
    places = {(run, table): str(store.table_address(out, table, run)) for run in runs for table in TABLES}
    found = contents_of(list(places.values()))
    for (run, table), place in places.items():
        yield f"run {run}, {table}", _sha256(found.get(place)), manifest["runs"][run]["tables"][table]


def _settings(config_digest: str, manifest: Manifest) -> str:
    """The settings files that gave this digest, as options of the command."""
    for entry in manifest["settings"].get(config_digest, []):
        named = {"--config": entry["configuration"], "--vehicle": entry["vehicle"]}
        given = [f"{option} {file['name']}" for option, file in named.items() if file]
        return " ".join(given) or "no files"
    return _short(config_digest)


def _difference(what: str, found: str | None, expected: str | None) -> list[tuple[str, str, str]]:
    return [] if found == expected else [(what, _short(found), _short(expected))]


def _short(digest: str | None) -> str:
    return "nothing" if not digest else digest[:12]


def _sha256(content: bytes | None) -> str:
    return "" if content is None else hashlib.sha256(content).hexdigest()
