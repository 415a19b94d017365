"""Whether a result is still what its manifest says, and whether the same logs give it again."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from enum import StrEnum
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.campaign import lock, resume
from pipeline.campaign.outcome import outcome_of
from pipeline.campaign.plan import RunJob, make_plan
from pipeline.campaign.run import campaign_files, campaign_key, run_campaign
from pipeline.campaign.watch import Follower
from pipeline.results import catalogue, packs, store
from pipeline.results.manifest import (
    NAME,
    Manifest,
    anchor,
    earlier_manifest,
    gather_manifest,
    read_manifest,
    runs_found,
)
from pipeline.results.marker import sha256
from pipeline.results.outcome import RunOutcome
from pipeline.results.packing import not_as_marked
from pipeline.results.software import software_digest
from pipeline.results.workers import tell, with_progress
from pipeline.storage.address import Address, join
from schemas.config import Configuration, Vehicle, digest_of
from schemas.enums import RunStatus
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.tables import TABLES

Problem = tuple[str, str, str]
_RUNS_AT_ONCE = 50
_COLUMNS = ("what", "found", "expected")
# What a campaign leaves beside the files that the manifest names.
_OWN_FILES = (NAME, lock.NAME, lock.HELD, "replay.log")


class NotCompared(StrEnum):
    """What of a result could not be made again, and so was compared with nothing."""

    CATALOGUE = "catalogue"
    """What is kept of runs whose tables this build cannot read, or that do not agree themselves."""
    CAMPAIGN_TABLES = "campaign_tables"
    """The same, or runs made by another build of the program."""
    PACKS = "packs"
    """Rows of packed runs of which this build makes other files than the build that wrote them."""


_DERIVED = (NotCompared.CATALOGUE, NotCompared.CAMPAIGN_TABLES)
_NOT_COMPARED = {
    NotCompared.CATALOGUE: "the outcomes kept in .catalogue",
    NotCompared.CAMPAIGN_TABLES: "the tables in campaign/, which the build that made them can make again",
    NotCompared.PACKS: "rows of packed runs with their markers, which the build that made them can compare",
}


@frozen
class Verification:
    """What was compared and what differs: `what, found, expected`, digests shortened."""

    compared: str
    problems: tuple[Problem, ...]
    not_compared: tuple[NotCompared, ...] = ()

    @property
    def table(self) -> pl.DataFrame:
        """One row per problem."""
        return pl.DataFrame(self.problems, schema=dict.fromkeys(_COLUMNS, pl.String), orient="row")

    @property
    def sentence(self) -> str:
        """How much was compared, and how much of it does not agree, for people."""
        left_out = " and ".join(_NOT_COMPARED[item] for item in self.not_compared)
        rest = f"; not compared: {left_out}" if left_out else ""
        return f"{self.compared}: {f'{len(self.problems)} do not' if self.problems else 'all'} agree{rest}"


def verify(out: Address) -> Verification:
    """Hold every file of a result against `OUT/manifest.json`, and the manifest against the runs' own metadata.

    Provenance is read from the markers again. What is kept of runs and the campaign's tables are made again from the
    runs' tables. Files that the manifest does not name are listed. Raises `UsageError` where there is no manifest.
    """
    manifest = _complete_manifest(out)
    again = gather_manifest(out, manifest)
    there = again["runs"]
    named = manifest["runs"]
    problems = [_missing_run(run, run in there) for run in sorted(there.keys() ^ named.keys())]
    problems += _differences("", *(_digests_by_name(of["files"]) for of in (again, manifest)))
    problems += _problems_of_packs(out)
    problems += _differences("page ", _page_digests(out), _digests_by_name(manifest.get("pages", {})))
    problems += _differences("site ", *(_site_digests(of["sites"]) for of in (again, manifest)))
    runs = sorted(there.keys() & named.keys())
    for first in range(0, len(runs), _RUNS_AT_ONCE):
        problems += _problems_of_runs(out, runs[first : first + _RUNS_AT_ONCE], there, named)
        tell(min(first + _RUNS_AT_ONCE, len(runs)), len(runs))
    known = {*manifest["files"], *again["files"], *_OWN_FILES}
    problems += [(name, "there", "not in the manifest") for name in _other_files(out, {*there, *named}, known)]
    not_compared = _DERIVED + ((NotCompared.PACKS,) if packs.read_list(out) else ())
    if not problems:
        problems, not_compared = _problems_of_derived(out, {run["software_digest"] for run in there.values()})
        of_packs, unlike = _problems_of_packed_runs(out, there)
        problems += of_packs
        not_compared += unlike
    files = len(manifest["files"]) + len(manifest.get("pages", {})) + len(TABLES) * len(runs)
    return Verification(f"{files} files of {len(runs)} runs against {NAME}", tuple(problems), not_compared)


def _problems_of_runs(
    out: Address, runs: Sequence[str], there: dict[str, Any], named: dict[str, Any]
) -> Iterator[Problem]:
    """Provenance and tables of some runs; and of tables that agree with the manifest, what the marker says of them."""
    of_run = {run: metadata.get("run_id", "") for run, metadata in store.completed_runs(out, runs).items()}
    packed = store.packed_runs_among(out, runs)
    contents = _table_digests(out, [run for run in runs if run not in packed])
    for run in runs:
        # What stands in its pack was found the same as its files, and the files of the pack are compared.
        present = _inputs_of_run(there[run]) | contents.get(run, there[run]["tables"])
        expected = _inputs_of_run(named[run]) | named[run]["tables"]
        yield from _differences(f"run {run}, ", present, expected)
        yield from _differences(f"marker of run {run}, ", there[run]["tables"], named[run]["tables"])
        if of_run[run] != run:
            yield f"tables of run {run}", f"of run {of_run[run] or 'nobody'}", run


def verify_by_replay(
    out: Address,
    logs: Sequence[str],
    site: Address | None,
    config: Configuration | None,
    vehicle: Vehicle,
    routes: Address | None = None,
    jobs: int = 1,
    watches: Sequence[Follower] = (),
) -> Verification:
    """Replay logs again, in a folder of their own, and hold logs, site and tables against the manifest.

    Without a configuration, with that of the result; a run that was made without vehicle file is replayed without.
    What the manifest does not name is a problem, and so are runs made with settings that are not given: these are not
    replayed. Runs whose logs are not given are counted.
    """
    named = _complete_manifest(out)["runs"]
    if site is None:
        raise UsageError("needs the site", place="--logs", remedy="Give it with --site.")
    with tempfile.TemporaryDirectory(prefix="balise-verify-") as folder:
        plan = make_plan(logs, site, folder, config or store.read_config(out), vehicle, routes)
        known = [_job_as_made(job, named[job.run_id]["config_digest"]) for job in plan.jobs if job.run_id in named]
        ready = tuple(job for job in known if job.config_digest == named[job.run_id]["config_digest"])
        if ready:
            run_campaign(replace(plan, jobs=ready), jobs=jobs, watches=watches)
        again = gather_manifest(folder, earlier_manifest(folder))["runs"]
    others = [named[job.run_id]["config_digest"] for job in known if job not in ready]
    problems = [
        (
            f"settings of {_count_words(others.count(digest))}",
            "others",
            _settings_options(digest, _complete_manifest(out)),
        )
        for digest in dict.fromkeys(others)
    ]
    problems += [(f"run {job.run_id}", "a log", "not in the manifest") for job in plan.jobs if job.run_id not in named]
    for run, made in again.items():
        problems += _differences(f"run {run}, ", *(_inputs_of_run(of) | of["tables"] for of in (made, named[run])))
    return Verification(f"{len(again)} of {len(named)} runs replayed again", tuple(problems))


def _count_words(count: int) -> str:
    """A number of runs in words."""
    return "1 run" if count == 1 else f"{count} runs"


def _job_as_made(job: RunJob, config_digest: str) -> RunJob:
    """The job without vehicle file, where the run was made without."""
    bare = digest_of(job.config, Vehicle())
    return replace(job, vehicle=Vehicle(), config_digest=bare) if bare == config_digest else job


def _inputs_of_run(run: dict[str, Any]) -> dict[str, str | None]:
    """All that made a run."""
    made = {"site": run["site"], "route": run["route_sha256"], "status": run["status"], "software": run["software"]}
    made |= {"program": run["software_digest"], "settings": run["config_digest"]}
    made |= {f"raw log {file['name']}": file["sha256"] for file in run.get("raw", [])}
    return made | {f"log {file['name']}": file["sha256"] for file in run["log"]}


def _site_digests(sites: dict[str, Any]) -> dict[str, str]:
    """Digests of the files of each site."""
    return {f"{site}, {file['name']}": file["sha256"] for site, files in sites.items() for file in files}


def _digests_by_name(files: dict[str, Any]) -> dict[str, str]:
    """Digests of files, by name."""
    return {name: file["sha256"] for name, file in files.items()}


def verify_manifest(out: Address, digest: str) -> Verification:
    """Hold the manifest against its SHA-256 as somebody kept it elsewhere. Raises `UsageError` for what is none."""
    if not re.fullmatch("[0-9a-fA-F]{64}", digest):
        raise UsageError("is no SHA-256", place=f"--expect {digest}", expected="64 hexadecimal digits")
    present, runs = anchor(out)
    differences = _differences("", {NAME: present}, {NAME: digest.lower()})
    return Verification(f"{NAME} of {runs} runs against the digest that was kept", tuple(differences))


def _complete_manifest(out: Address) -> Manifest:
    """The manifest of results; runs not yet complete in it are completed."""
    store.complete_runs(out)
    anchor(out)  # there is one
    return read_manifest(out) or {}


def _problems_of_packs(out: Address) -> Iterator[Problem]:
    """Files of packs against the list of packs, which the manifest names."""
    for pack in packs.read_list(out):
        expected = packs.file_digests(pack)
        yield from _differences("", {name: sha256(storage.content_of(join(out, name))) for name in expected}, expected)


def _problems_of_packed_runs(out: Address, there: Mapping[str, Any]) -> tuple[list[Problem], tuple[NotCompared, ...]]:
    """The files that each packed run had against its marker: a pack could have been changed together with the list.

    The build that made a run makes the same bytes again; another one may.
    """
    problems: list[Problem] = []
    unlike: tuple[NotCompared, ...] = ()
    for pack in with_progress(packs.read_list(out)):
        for run, table in not_as_marked(out, pack):
            if there[run]["software_digest"] == software_digest():
                problems.append((f"run {run}, {table} in its pack", "other rows", "those of its marker"))
            else:
                unlike = (NotCompared.PACKS,)
    return problems, unlike


def _missing_run(run: str, is_there: bool) -> Problem:
    """A run that only one of the two has; a call that was ended leaves some that the manifest does not name yet."""
    if is_there:
        return f"run {run}", "complete", "not in the manifest: the call may have been interrupted. Repeat it."
    return f"run {run}", "missing", "complete"


def _table_digests(out: Address, runs: Sequence[str]) -> dict[str, dict[str, str]]:
    """The digest of each table of some runs as it lies there."""
    places = {run: {table: str(store.table_address(out, table, run)) for table in TABLES} for run in runs}
    contents = storage.read_many([place for tables in places.values() for place in tables.values()])
    return {run: {table: sha256(contents.get(place)) for table, place in places[run].items()} for run in runs}


def _page_digests(out: Address) -> dict[str, str]:
    """Digests of the pages of the report, by name."""
    folder = join(out, "report")
    return {name: sha256(storage.content_of(join(folder, name))) for name in storage.files_below(folder)}


def _other_files(out: Address, runs: set[str], known: set[str]) -> Iterator[str]:
    """Files that are neither known, nor of a run, nor of `balise line`; pages and catalogue are looked at elsewhere."""
    # Beside the rows of a packed run its own files are read by nobody but those who read all files.
    own = runs - store.packed_runs_among(out, runs).keys()
    of_runs = {f"{table}/{store.folder_name(run)}/{table}.parquet" for table in TABLES for run in own}
    expected = of_runs | known | {name for pack in packs.read_list(out) for name in packs.file_digests(pack)}
    for name in storage.files_below(out):
        if name not in expected and not name.startswith((f"{catalogue.FOLDER}/", "report/", "line/")):
            yield name


def _problems_of_derived(out: Address, software: set[str]) -> tuple[list[Problem], tuple[NotCompared, ...]]:
    """What is kept of runs and the campaign's tables against the runs' own tables, which agree with the manifest.

    The campaign's tables can be made again by the build that made them, with the configuration that lies there.
    """
    try:
        tables = store.small_tables(out)
    except UsageError:
        # What another build of the program wrote only that build can read.
        return [], _DERIVED
    problems = list(_problems_of_outcomes(out, tables))
    config = store.read_config(out)
    if config is None or software != {software_digest()}:
        return problems, (NotCompared.CAMPAIGN_TABLES,)
    for name, content in campaign_files(tables, config, campaign_key(config, runs_found(out).digests)):
        problems += _differences("", {name: sha256(content)}, {name: sha256(storage.content_of(join(out, name)))})
    return problems, ()


def _problems_of_outcomes(out: Address, tables: Mapping[str, pl.DataFrame]) -> Iterator[Problem]:
    """The outcomes that are kept, with the verdicts and figures that `replay` repeats, against the runs' own tables."""
    parts = {name: tables[name].partition_by("run_id", as_dict=True) for name in ("runs", "hazards", "passages")}
    for run, kept in resume.kept_outcomes(str(out)).items():
        own = {name: of_runs.get((run,), tables[name].clear()) for name, of_runs in parts.items()}
        if not own["runs"].is_empty() and not _is_outcome_of(kept, own):
            yield f"{catalogue.FOLDER}/complete, {run}", "other values", "those of the run's tables"


def _is_outcome_of(kept: RunOutcome, tables: Mapping[str, pl.DataFrame]) -> bool:
    """Whether all that tables say of a run is what they say now; of a failed run status and verdict alone."""
    # Only of low availability it says what was lost, and which is low was said by the configuration of that call.
    again = outcome_of(kept.run_id, kept.log, math.inf, **tables)
    if again.status is RunStatus.FAILED:
        return (kept.status, kept.verdict) == (again.status, again.verdict)
    of_call = ("skipped", "seconds", "attempts", "proof", "trace", *(() if kept.lost else ("lost",)))
    return asdict(again) | {name: getattr(kept, name) for name in of_call} == asdict(kept)


def _settings_options(config_digest: str, manifest: Manifest) -> str:
    """The settings files that gave this digest, as options of the command."""
    for entry in manifest["settings"].get(config_digest, []):
        named = {"--config": entry["configuration"], "--vehicle": entry["vehicle"]}
        options = [f"{option} {file['name']}" for option, file in named.items() if file]
        return " ".join(options) or "no files"
    return _short_digest(config_digest)


def _differences(what: str, present: Mapping[str, str | None], expected: Mapping[str, str | None]) -> list[Problem]:
    """Names of which the digest is not that expected, and both digests."""
    names = dict.fromkeys([*expected, *present])
    return [
        (f"{what}{name}", _short_digest(present.get(name)), _short_digest(expected.get(name)))
        for name in names
        if (present.get(name) or "") != (expected.get(name) or "")
    ]


def _short_digest(digest: str | None) -> str:
    """A digest in short, for people."""
    return "nothing" if not digest else digest[:12]
