"""Everything of a project brought up to date: convert, site, calibrate, replay, report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pipeline import storage
from pipeline.campaign import CampaignSummary, Plan, find_runs, make_plan, run_campaign
from pipeline.campaign.watch import Follower
from pipeline.make.receivers import words_for_dropped
from pipeline.make.survey.make import SiteRequest, make_site, site_request, write_site
from pipeline.project.convert import Recordings, convert_entry, logs_of
from pipeline.project.made import Product, Record, digest_over
from pipeline.project.opened import MEASURED_CONFIG, MEASURED_VEHICLE, RECORD, OpenedProject, named_from
from pipeline.read.ingest import read_run
from pipeline.read.site.alike import summarise_findings
from pipeline.read.site.read import read_site
from pipeline.results import store
from pipeline.results.manifest import settings_files
from pipeline.results.packing import remove_runs
from pipeline.results.workers import watched
from pipeline.show.report import write_report
from pipeline.show.report.site_page import site_page
from pipeline.storage.address import is_url
from schemas.config import Configuration, Vehicle, digest_of, load_settings, to_toml
from schemas.errors import InputError, UsageError
from schemas.frozen import frozen
from schemas.project import CalibrateEntry, ConvertEntry, TrackEntry, load_configuration

Said = Callable[[str, str], None]
"""Receives a step and what there is to say of it."""


@frozen
class CallOptions:
    """What one call of `balise run` adds: none of it decides a result. `prune`: results of other runs are removed."""

    said: Said
    watches: Sequence[Follower] = ()
    pages: Callable[[int, int], None] | None = None
    jobs: int = 1
    force: bool = False
    prune: bool = False


@frozen
class ProjectOutcome:
    """How the replay ended, and the first page of the report; `changed`: whether anything had to be done.

    `unread`: logs of the trial that no run was made of, since they could not be read.
    """

    summary: CampaignSummary
    page: Path | None
    changed: bool
    unread: Sequence[str] = ()

    def unread_words(self, file: Path) -> list[str]:
        """A sentence on each log that could not be read, for whoever reads the verdict."""
        return [
            f"NOT REPLAYED: {log} could not be read, and no figure knows of it. Mend it and name it in a [[convert]] "
            f"table; then, or where it is no log, take it out of `unread` in {file}."
            for log in self.unread
        ]


@dataclass
class _Steps:
    """A project on its way: which steps had something to do."""

    opened: OpenedProject
    recordings: Recordings
    call: CallOptions
    record: Record
    changed: list[str] = field(default_factory=list)

    def make_if_changed(self, product: Product, make: Callable[[], Sequence[Path]]) -> bool:
        """Make a product where its inputs changed; whether it was made."""
        brought = self.record.make_if_changed(product, make)
        if brought.made:
            self.changed.append(product.name)
        for place in brought.undigested:
            why = "changed while it was read, or has no digest; the next call does this again"
            self.call.said(product.name, f"{place} {why}")
        return brought.made


def run_project(opened: OpenedProject, recordings: Recordings, call: CallOptions) -> ProjectOutcome:
    """Do what is left to do. Raises `InputError` where logs cannot be converted: then nothing is replayed.

    Raises `Interrupted` when asked to stop; the same call then does the rest.
    """
    steps = _Steps(opened, recordings, call, Record(opened.folder, call.force))
    _convert_runs(steps)
    _make_site_if_changed(steps)
    _calibrate_if_changed(steps)
    plan = plan_of(opened)
    _refuse_other_results(plan, call)
    options = opened.project.replay
    call.said("replay", f"{len(plan.jobs)} runs")
    summary = run_campaign(
        _with_calibration(steps, plan),
        jobs=call.jobs,
        scheduler=options.scheduler,
        force=call.force,
        time_limit_s=options.time_limit_s,
        watches=call.watches,
    )
    changed = bool(steps.changed) or not all(outcome.skipped for outcome in summary.outcomes)
    return ProjectOutcome(summary, _write_report(steps, plan), changed, [*map(opened.place, opened.project.unread)])


def plan_of(opened: OpenedProject) -> Plan:
    """The replay of all runs, each with its own vehicle file."""
    project = opened.project
    config = load_configuration(opened.config_file)
    vehicle = load_settings(opened.vehicle_file, Vehicle)
    given = settings_files(opened.config_file, opened.vehicle_file)
    if not opened.runs():
        raise UsageError(
            "names no run",
            place=str(opened.file),
            expected="logs under [[convert]], or `runs` under [replay]",
            remedy="`balise trial` writes them for your logs; docs/project.md has an example.",
        )
    route, to = opened.path(project.replay.route), opened.path(project.replay.write_route)
    site = opened.place(project.site)
    plan = make_plan(opened.runs(), site, opened.place(project.out), config, vehicle, route, to, given)
    return _with_vehicles(plan, opened) if project.vehicles else plan


def _with_vehicles(plan: Plan, opened: OpenedProject) -> Plan:
    """Runs, each with the vehicle file that the project names for it."""
    files = {job.run_id: opened.vehicle_of(job.run_id) for job in plan.jobs}
    vehicles = {file: load_settings(file, Vehicle) for file in set(files.values())}
    digests = {file: digest_of(plan.config, vehicle) for file, vehicle in vehicles.items()}
    jobs = tuple(
        replace(job, vehicle=vehicles[files[job.run_id]], config_digest=digests[files[job.run_id]]) for job in plan.jobs
    )
    given = {digest: settings_files(opened.config_file, file) for file, digest in digests.items()}
    return replace(plan, jobs=jobs, given_by_digest=given)


def _convert_runs(steps: _Steps) -> None:
    """Convert every run of logs; all that fail are reported at once."""
    entries = steps.opened.project.convert
    config = steps.opened.given_config()
    failures: list[InputError] = []
    made = 0
    for entry in entries:
        try:
            product = _run_product(steps, entry, config)
            made += steps.make_if_changed(product, partial(_convert_run, steps, entry, config))
        except InputError as error:
            failures.append(error)
    if failures:
        raise _conversion_error(failures, len(entries), steps.opened)
    if entries:
        steps.call.said("convert", f"{made} converted, {len(entries) - made} up to date")


def _run_product(steps: _Steps, entry: ConvertEntry, config: Configuration) -> Product:
    """The converted run of an entry, with the settings that decide it."""
    logs = [named_from(log.absolute(), steps.opened.folder.absolute()) for log in logs_of(steps.opened, entry)]
    settings = digest_over(entry, config.ingest, config.fix_sigma, logs)
    return Product(f"run {entry.to}", Path(steps.opened.place(entry.to)), settings)


def _convert_run(steps: _Steps, entry: ConvertEntry, config: Configuration) -> list[Path]:
    """Convert the logs of an entry and write the run; returns its files."""
    logs = sum(len(log.files) for log in entry.logs)
    steps.call.said("convert", f"{entry.run_id}: {logs} {'log' if logs == 1 else 'logs'}")
    converted = convert_entry(steps.opened, entry, config.ingest, config.fix_sigma, steps.recordings)
    for reason, count in sorted(converted.dropped.items()):
        steps.call.said("convert", f"{entry.run_id}: {words_for_dropped(reason)}: {count} x {reason}")
    place = Path(steps.opened.place(entry.to))
    steps.recordings.write(converted.run, place)
    return [place] if place.is_file() else sorted(place.glob("*.parquet"))


def _conversion_error(failures: Sequence[InputError], of: int, opened: OpenedProject) -> InputError:
    """One error for all runs that cannot be converted."""
    if of == 1:
        return failures[0]
    return InputError(
        f"{len(failures)} of {of} runs cannot be converted, and nothing was replayed\n  "
        + "\n  ".join(map(str, failures))
        + "\n",
        place=str(opened.file),
        remedy="Mend these logs, or take their [[convert]] tables out of the project.",
    )


def _make_site_if_changed(steps: _Steps) -> None:
    """Make the site of the project's survey where anything of it changed."""
    entry = steps.opened.project.track
    if entry is None:
        return
    config = steps.opened.given_config()
    vehicle = steps.opened.given_vehicle()
    request = requested_site(steps.opened, entry)
    sources = [*request.surveys, *([request.balise_list] if request.balise_list else [])]
    _require_sources(sources, steps.opened)
    site = Path(steps.opened.place(steps.opened.project.site))
    product = Product(f"site {steps.opened.project.site}", site, digest_over(entry, vehicle, config))
    if not steps.make_if_changed(product, lambda: _make_site(steps, request, site, vehicle, config)):
        steps.call.said("site", "up to date")


def _require_sources(sources: Sequence[Path], opened: OpenedProject) -> None:
    """Refuse surveys and lists that are not there."""
    for source in sources:
        if not source.exists():
            raise UsageError(
                "does not exist",
                place=str(source),
                expected=f"as {opened.file} names it",
                remedy="Put it back, or correct [track]; paths are relative to balise.toml.",
            )


def _make_site(steps: _Steps, request: SiteRequest, site: Path, vehicle: Vehicle, config: Configuration) -> list[Path]:
    """Make the site, write it with its page and findings; returns the files."""
    steps.call.said("site", f"made of {', '.join(path.name for path in request.surveys)}")
    made = make_site(request, vehicle, config)
    write_site(made, site_page(site.resolve().name, made), site, True)
    for line in summarise_findings(made.findings, f"{site / 'findings.csv'}"):
        steps.call.said("site", line)
    count = len(made.findings)
    steps.call.said("site", f"{count} findings in {site / 'findings.csv'}; look at {site / 'site.html'}")
    names = ("track.parquet", "links.parquet", "balises.parquet", "findings.csv", "site.html")
    return [site / name for name in names if (site / name).exists()]


def requested_site(opened: OpenedProject, entry: TrackEntry) -> SiteRequest:
    """The site that is asked for, with places as seen from here."""
    balises = entry.balises
    if balises is not None and not balises.startswith("every"):
        balises = opened.place(balises)
    surveys = [Path(opened.place(named)) for named in entry.survey]
    return site_request(
        surveys, balises, entry.epsg, entry.join_m, entry.flat, entry.direction, entry.id_field, entry.sigma_m
    )


def _calibrate_if_changed(steps: _Steps) -> None:
    """Measure vehicle and noise where their runs or settings changed."""
    entry = steps.opened.project.calibrate
    if entry is None:
        return
    config = steps.opened.given_config()
    vehicle = steps.opened.given_vehicle()
    runs = find_runs(map(steps.opened.place, entry.runs))
    settings = digest_over(entry, vehicle, config, list(runs))
    product = Product("calibration", steps.opened.folder / RECORD / MEASURED_VEHICLE, settings)
    measured = steps.make_if_changed(product, lambda: _calibrate(steps, entry, runs, config, vehicle))
    if not measured:
        steps.call.said("calibrate", "up to date")


def _calibrate(
    steps: _Steps, entry: CalibrateEntry, runs: dict[str, str], config: Configuration, vehicle: Vehicle
) -> list[Path]:
    """Measure vehicle and noise on these runs and write both files; returns them."""
    from pipeline.studies.calibration.calibrate import calibrate  # replays, which most projects do not ask for

    steps.call.said("calibrate", f"on {len(runs)} runs")
    logs = [read_run(address, config.ingest) for address in runs.values()]
    site = read_site(steps.opened.place(steps.opened.project.site), config.site)
    found = calibrate(logs, site, vehicle, config, entry.solution)
    for run_id, monitors in found.alarms.items():
        alarmed = f"{', '.join(monitors)} failed beyond its noise. Leave it out unless nothing was wrong"
        steps.call.said("calibrate", f"{run_id}: {alarmed}")
    files = [steps.opened.folder / RECORD / MEASURED_VEHICLE, steps.opened.folder / RECORD / MEASURED_CONFIG]
    mended = config.model_copy(update={"monitors": config.monitors.model_copy(update=found.monitors)})
    for file, settings in zip(files, (found.vehicle, mended), strict=True):
        storage.write_bytes(file, to_toml(settings).encode())
    return files


def _with_calibration(steps: _Steps, plan: Plan) -> Plan:
    """Vehicle and noise of each run from others, where `[replay]` asks for it."""
    asked = steps.opened.project.replay.calibrate
    if not asked:
        return plan
    from pipeline.campaign.calibrated import AUTO, calibrate_plan

    steps.call.said("calibrate", "each run from others")
    return calibrate_plan(plan, [one if one == AUTO else steps.opened.place(one) for one in asked], steps.call.jobs)


def _refuse_other_results(plan: Plan, call: CallOptions) -> None:
    """Refuse, or remove, results of runs that the project does not name: they would count in its figures."""
    named = {job.run_id for job in plan.jobs}
    others = _other_runs(plan.out, named)
    if others and call.prune:
        remove_runs(plan.out, others)
        call.said("replay", f"removed the results of {', '.join(others)}")
        others = _other_runs(plan.out, named)
    if others:
        raise UsageError(
            "holds results of runs that the project does not name, and they would count in its figures",
            place=plan.out,
            found=", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else ""),
            remedy="Add these runs to balise.toml, remove their results with `balise run --prune`, or change `out`.",
        )


def _other_runs(out: str, named: set[str]) -> list[str]:
    """Runs of a result that are not among these."""
    return sorted(set(store.run_ids(out)) - named)


def _write_report(steps: _Steps, plan: Plan) -> Path | None:
    """Write the report of the results; the first page, None for results that are not on this machine."""
    if is_url(plan.out):
        steps.call.said("report", "none: pages are written for results on this machine")
        return None
    out = Path(steps.opened.place(steps.opened.project.out))
    site = read_site(steps.opened.place(steps.opened.project.site), plan.config.site)
    with watched(steps.call.pages):
        page = write_report(out, site)[0]
    steps.call.said("report", str(page))
    return page
