"""The command line: parse, call, show. Whatever is heavy is imported inside the command that needs it."""

from __future__ import annotations

import contextlib
import gc
import io
import json
import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO, TypeVar

from typer import Argument, Exit, Option, Typer, confirm
from typer.core import TyperCommand
from typer.main import get_command

if TYPE_CHECKING:
    import polars as pl

    from pipeline.campaign import CampaignSummary, Interrupted, Plan
    from pipeline.campaign.verify import Verification
    from pipeline.project.trial import Wanted
    from schemas.config import Configuration, StreamCorrection, Vehicle
    from schemas.run import RunLog
    from schemas.run import Site as Ground

# By default the collector goes through all modules time and again while they are loaded. Set here and not in `main`,
# because the workers of a campaign load this module as well.
gc.set_threshold(50_000)

Command = TypeVar("Command", bound=Callable[..., None])

OK, RUNS_NOT_OK, USAGE, DEFECT = 0, 1, 2, 3

app = Typer(
    name="balise",
    help="Replay recorded train journeys and judge whether satellite positioning could have replaced balises.",
    epilog="Exit status: 0 ok; 1 a run failed or is partial, results differ, or --fail-on; 2 wrong usage, "
    "configuration or site; 3 defect of the program; 129, 130, 143 interrupted. --debug shows the traceback.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


class _OfProject(TyperCommand):
    """Takes what is not given from the project (`--project`, or that of the working directory), and says so."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with those that are missing taken from the project."""
        given, _, _ = self.make_parser(ctx).parse_args(list(args))
        if not given.get("help") and (given.get("project") or Path("balise.toml").is_file()):
            from pipeline.project.opened import values_from_project

            named = given.pop("project", None)
            missing = [option.name for option in self.params if given.get(option.name or "") in (None, [], ())]
            # A single word is the query or the run, though the result comes first.
            second = {"sql": "query", "export": "run"}.get(self.name or "")
            shifted = second in missing and "out" not in missing
            missing = ["out"] if shifted else missing
            say = None if given.get("quiet") else _print_to_stderr
            ctx.default_map = values_from_project(named, self.name or "", missing, say)
            args = [ctx.default_map["out"], *args] if shifted and ctx.default_map else args
        return super().parse_args(ctx, args)


def _command(*examples: str, name: str | None = None, of_project: bool = False) -> Callable[[Command], Command]:
    """A command with examples under its help; an empty line keeps each on a line of its own."""
    epilog = "\n\n".join(["Examples:", *examples])
    return app.command(name, epilog=epilog, cls=_OfProject if of_project else None)


def _local_path(value: Any) -> Any:
    """Refuse addresses where a path is meant: `s3://bucket/run` would become a folder called `s3:`."""
    for path in value if isinstance(value, list | tuple) else [value]:
        if path is not None and re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(path)):
            from pipeline.storage.address import redacted
            from schemas.errors import UsageError

            place = redacted(str(path).replace(":/", "://", 1))
            raise UsageError("is an address", place=place, expected="a path on this machine")
    return value


_place = partial(Argument, callback=_local_path)
_file = partial(Option, callback=_local_path)
_NEW_RUN = "The run to write: a folder, or a file *.mcap."
_LOGS = "UBX, SBF, NMEA, NovAtel, RTKLIB .pos, bags, MCAP, CSV with --config, a public recording; archives of these."

_CSV = "Write CSV; `-` is standard output."

_CALIBRATE = (
    "Vehicle and noise from these fault-free runs of the same vehicle (again for more), or `auto`: each run from the "
    "others given that raise no alarm beyond their noise. Replays them once more; a fault common to all is learned."
)

Result = Annotated[str, Argument(help="A result of `balise replay`.")]
ResultFolder = Annotated[Path, _place(help="A result of `balise replay`.")]
Run = Annotated[str, Argument(help="A recorded run.")]
Site = Annotated[str, Option(help="Site: a folder with track, links, balises and route, or a GeoJSON file.")]
LogsAgain = Annotated[list[str] | None, Option("--logs", help="Logs to replay again: paths, folders, patterns.")]
Guard = Annotated[
    bool,
    Option("--guard/--no-guard", help="CSV: an apostrophe before texts that spreadsheets would run (=, +, -, @)."),
]
LogsSite = Annotated[str | None, Option("--site", help="Site of these logs.")]
OutFolder = Annotated[Path, _file("--out", help="Folder to write.")]
VehicleFile = Annotated[Path | None, _file("--vehicle", help="Vehicle file (TOML).")]
ConfigFile = Annotated[Path | None, _file("--config", help="Configuration file (TOML).")]
RouteFiles = Annotated[Path | None, _file("--route", help="Known route: a file, or a folder with RUN.csv or .parquet.")]
Solution = Annotated[str, Option(help="Solution of the runs.")]
Jobs = Annotated[
    int,
    Option(min=0, callback=lambda jobs: jobs or os.cpu_count() or 1, help="Parallel processes; 0: one per core."),
]
Day = Annotated[
    datetime | None,
    Option("--date", formats=["%Y-%m-%d"], callback=lambda at: at and at.date(), help="Day (UTC) of NMEA logs."),
]
Balises = Annotated[str | None, Option(help="`every 1000` (m), or a table of places or kilometres.")]
AcceptAll = Annotated[bool, Option("--accept-corrections", help="Accept the proposed corrections.")]
ProjectFile = Annotated[Path | None, _file("--project", help="Project: its folder or file; default: balise.toml here.")]
OfProject = Annotated[Path | None, _file("--project", help="Project for options not given; default: balise.toml here.")]
Force = Annotated[bool, Option("--force", help="Overwrite existing files.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="No progress, no tables; errors only.")]
Json = Annotated[bool, Option("--json", help="Print the answer as JSON (docs/json.md), progress on standard error.")]


@app.callback(invoke_without_command=True)
def _about(
    version: Annotated[bool, Option("--version", help="Print the version of the program and of its tables.")] = False,
) -> None:
    if version:
        from schemas.version import SOFTWARE

        print(SOFTWARE)
        raise Exit(OK)


@_command(
    "balise replay logs/*.mcap --site line9 --out week12 --vehicle train7.toml",
    "balise replay logs/*.mcap --site line9 --out week12 --calibrate auto",
    "balise replay s3://trial/logs --site line9 --out s3://trial/week12 --jobs 8",
    of_project=True,
)
def replay(
    runs: Annotated[list[str], Argument(help="Runs: logs, run folders, folders of runs, glob patterns or addresses.")],
    site: Site,
    out: Annotated[str, Option(help="Result to write: a folder or an address.")],
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    route: RouteFiles = None,
    write_route: Annotated[Path | None, _file(help="Folder for the routes found, doubtful parts marked.")] = None,
    jobs: Jobs = 0,
    scheduler: Annotated[str | None, Option(help="Run on this Dask cluster (tcp://host:port).")] = None,
    force: Annotated[bool, Option("--force", help="Also replay runs that are already complete.")] = False,
    time_limit: Annotated[float, Option(min=0.1, help="Seconds that one run may take; a slower run fails.")] = 3600.0,
    undetected: Annotated[bool, Option("--undetected", help="Also the largest error no monitor would notice.")] = False,
    calibrate: Annotated[list[str] | None, Option(metavar="RUNS|auto", help=_CALIBRATE)] = None,
    fail_on: Annotated[
        Literal["unsafe", "unproven"] | None, Option(help="Exit status 1 also for this verdict or a worse one.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Replay recorded runs on a site and write the tables hazards, passages, alarms, epochs and runs."""
    _check_named(runs)
    from pipeline.campaign import Interrupted, make_plan, run_campaign
    from pipeline.results.manifest import settings_files
    from pipeline.show.progress import show_summary, watches

    settings, given = _load_configuration(config), settings_files(config, vehicle)
    if undetected:
        settings = settings.model_copy(update={"undetected": settings.undetected.model_copy(update={"compute": True})})
    plan = make_plan(runs, site, out, settings, _load_vehicle(vehicle), route, write_route, given)
    plan = _calibrate_plan(plan, calibrate, jobs, quiet) if calibrate else plan
    shown = watches(quiet, as_json)
    places = {"site": site, "options": _options(vehicle, config)}
    try:
        summary = run_campaign(
            plan, jobs=jobs, scheduler=scheduler, force=force, time_limit_s=time_limit, watches=shown
        )
    except Interrupted as interrupted:
        raise _report_interruption(interrupted, out, quiet, as_json, places) from None
    show_summary(summary, out, quiet, as_json, has_pages=False, **places)
    raise Exit(_exit_status(summary, fail_on))


def _options(vehicle: Path | None, config: Path | None) -> str:
    """The settings files as options of a command."""
    files = {"vehicle": vehicle, "config": config}
    return "".join(f" --{name} {shlex.quote(str(file))}" for name, file in files.items() if file)


def _check_named(runs: list[str]) -> None:
    """What is mistyped is said before anything is loaded; of stores, when they are asked for the runs."""
    from pipeline.storage import require_match
    from pipeline.storage.address import is_url

    for name in runs:
        if not is_url(name):
            require_match(name)


def _report_interruption(
    interrupted: Interrupted, out: str, quiet: bool, as_json: bool, places: Mapping[str, str]
) -> Exit:
    """Say what is done of an interrupted campaign."""
    from pipeline.show.progress import show_summary

    # A terminal that was closed takes no more words.
    with contextlib.suppress(OSError):
        if interrupted.summary is not None:
            show_summary(interrupted.summary, out, quiet, as_json, has_pages=False, **places)
        print("balise: interrupted; repeat the command to continue", file=sys.stderr)
    return Exit(128 + interrupted.signum)


def _exit_status(summary: CampaignSummary, fail_on: str | None) -> int:
    """Exit status of a campaign; `fail_on`: the verdict from which on it counts as not ok."""
    refused = {"unsafe": ["unsafe"], "unproven": ["unsafe", "unproven"]}.get(fail_on or "", [])
    acceptable = summary.all_ok and not any(summary.head.counts()[verdict] for verdict in refused)
    return DEFECT if summary.count_defects else OK if acceptable else RUNS_NOT_OK


def _calibrate_plan(plan: Plan, runs: list[str], jobs: int, quiet: bool) -> Plan:
    """The plan with each run's calibration, its progress shown."""
    from pipeline.campaign.calibrated import calibrate_plan

    with _progress_shown("runs looked at to calibrate", quiet):
        return calibrate_plan(plan, runs, jobs)


@_command(
    'balise trial morning.ubx odometer.csv --track line.gpx --balises "every 1000" --to week12',
    "balise trial raw --track line9 --reference raw/rover.pos --to week12 --accept-corrections",
)
def trial(
    raws: Annotated[list[Path], _place(metavar="RAW...", help=_LOGS + " Folders of these.")],
    to: Annotated[Path, _file("--to", "--out", help="Folder of the project.")],
    track: Annotated[list[Path] | None, _file(help="The line: maps (GPX, GeoJSON, ...), points, or a site.")] = None,
    balises: Balises = None,
    reference: Annotated[list[Path] | None, _file(help="Log whose positions are the reference.")] = None,
    date: Day = None,
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    accept_corrections: AcceptAll = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a project for raw logs: the stream that each log feeds, the logs of each ride, the corrections needed."""
    from pipeline.project.trial import Wanted

    if not track:
        from schemas.errors import UsageError

        remedy = (
            "Give a map (GPX, GeoJSON, ...), a table of points, a run with a reference, or a site: --track line.gpx"
        )
        raise UsageError("needs the line that the train ran on", place="--track", remedy=remedy)
    raws, balises = _spacing(raws, balises)
    wanted = Wanted(raws, track, balises, reference or (), date, vehicle, config)
    _write_project(wanted, to, accept_corrections, force, as_json)


@_command("balise init week12")
def init(
    folder: Annotated[Path, _place(help="Folder of the project.")] = Path(),
    accept_corrections: AcceptAll = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a project from the contents of a folder: logs, runs, survey or site, balises, settings; or an empty one."""
    from pipeline.project.init import wanted_of_folder

    _write_project(wanted_of_folder(folder), folder, accept_corrections, force, as_json)


def _spacing(raws: list[Path], balises: str | None) -> tuple[list[Path], str | None]:
    """`--balises every 1000` without quotes leaves its number among the logs."""
    if balises != "every":
        return raws, balises
    number = next((raw for raw in raws if raw.name.isdigit() and not raw.exists()), None)
    return [raw for raw in raws if raw is not number], "every" if number is None else f"every {number}"


def _write_project(wanted: Wanted, folder: Path, accept: bool, force: bool, as_json: bool) -> None:
    """Draft a project, ask about its corrections, write it, and say what comes next."""
    from datasets.recordings import public_recordings
    from pipeline.project.init import json_answer, refuse_existing, result_lines, write_project
    from pipeline.project.trial import correction_lines, draft_project

    def accept_corrections(run_id: str, found: Sequence[str], corrections: Sequence[StreamCorrection]) -> bool:
        """Whether the corrections of a run are accepted: as the options say, else as a person answers."""
        if accept or as_json or not sys.stdin.isatty():
            # Moved positions could hide what the program is to find: only a person takes that.
            return accept and not any(correction.moves for correction in corrections)
        _print_to_stderr("\n".join([f"\n{run_id} does not fit as recorded:", *found, *correction_lines(corrections)]))
        return confirm("Accept these corrections?", err=True)

    refuse_existing(folder, force)
    drafted = draft_project(wanted, folder, public_recordings(), accept_corrections)
    file = write_project(drafted, folder)
    _print_answer(as_json, json_answer(drafted, file), {"Logs": drafted.logs}, *result_lines(drafted, file))


@_command("balise run", "balise run --project week12 --jobs 4")
def run(
    project: ProjectFile = None,
    jobs: Annotated[int | None, Option(min=0, help="Parallel processes; default: the project's.")] = None,
    force: Annotated[bool, Option("--force", help="Repeat every step, even where nothing changed.")] = False,
    prune: Annotated[bool, Option("--prune", help="Remove results of runs that the project does not name.")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Bring a project up to date: convert, site, calibrate, replay, report; only what changed is run again."""
    from datasets.recordings import public_recordings
    from pipeline.campaign import Interrupted
    from pipeline.project.opened import open_project
    from pipeline.project.run import CallOptions, run_project
    from pipeline.results.manifest import anchor, anchor_words
    from pipeline.show.progress import show_summary, summary_answer, watches
    from pipeline.show.terminal import progress_printer

    opened = open_project(project)
    options = opened.project.replay
    out = opened.place(opened.project.out)
    named = _options(opened.vehicle_file, opened.config_file)
    places = {"site": opened.place(opened.project.site), "options": named, **opened.message_words}
    pages = None if quiet or as_json else progress_printer("pages")
    at_once = (options.jobs if jobs is None else jobs) or os.cpu_count() or 1
    call = CallOptions(_step_printer(quiet, as_json), watches(quiet, as_json), pages, at_once, force, prune)
    try:
        ended = run_project(opened, public_recordings(), call)
    except Interrupted as interrupted:
        raise _report_interruption(interrupted, out, quiet, as_json, places) from None
    if as_json:
        digest, runs = anchor(out)
        manifest = {"sha256": digest, "runs": runs}
        made = {"page": ended.page, "changed": ended.changed, "unread": ended.unread, "manifest": manifest}
        _print_json({**summary_answer(ended.summary, out), **made})
    else:
        show_summary(ended.summary, out, quiet, False, has_pages=ended.page is not None, **places)
        for line in ended.unread_words(opened.file):
            print(line, file=sys.stderr if quiet else sys.stdout)
    if not (quiet or as_json):
        print(f"Report: {ended.page}" + ("" if ended.changed else "\nAll was up to date."))
        print(anchor_words(*anchor(out)))
    raise Exit(_exit_status(ended.summary, options.fail_on) or (RUNS_NOT_OK if ended.unread else OK))


def _step_printer(quiet: bool, as_json: bool) -> Callable[[str, str], None]:
    """Says what a project's steps do, one line each, on standard error."""
    if quiet:
        return lambda step, text: None
    if as_json:
        return lambda step, text: _print_to_stderr(json.dumps({"event": "step", "step": step, "text": text}))
    return lambda step, text: _print_to_stderr(f"{step:<10}{text}")


@_command("balise dictionary --table hazards", "balise dictionary --markdown > dictionary.md")
def dictionary(
    as_json: Json = False,
    markdown: Annotated[bool, Option("--markdown", help="Print as one Markdown page.")] = False,
    table: Annotated[str | None, Option(help="Show this table only.")] = None,
) -> None:
    """List every table with its columns, units and meaning, and every key of the configuration."""
    from schemas.dictionary import dictionary_frame, dictionary_markdown, settings_frame

    if markdown:
        print(dictionary_markdown(), end="")
        return
    columns = dictionary_frame(table)
    if as_json:
        _print_json(columns if table else {"columns": columns, "settings": settings_frame()})
        return
    for name, rows in columns.group_by("group", "table", maintain_order=True):
        _print_table(rows.drop("group", "table"), f"{name[1]} ({name[0]})")
        print()
    if table is None:
        _print_table(settings_frame(), "Configuration and vehicle")


@_command("balise demo", "balise demo --out /tmp/demo --seed 7")
def demo(
    out: OutFolder = Path("demo-out"),
    seed: Annotated[int | None, Option(help="Seed of the trial; another seed gives other noise.")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write a synthetic trial with faults, replay it, and compare the hazards found with the faults injected."""
    from datasets.demo import make_demo as run_demo

    result = run_demo(out, seed, None if quiet else _print_to_stderr)
    if as_json:
        _print_json({"out": out, **result.as_dict()})
    elif not quiet:
        if not result.agrees:
            _print_table(result.differing, "What was found differs from what was expected")
        print(f"{result.head}\nTrial in {out}, tables in {out / 'tables'}, report: {result.page}\n")
        _print_table(result.lines)
        print(result.sentence)
    raise Exit(OK if result.agrees else RUNS_NOT_OK)


@_command("balise synth scenario.toml --out trial")
def synth(
    scenario: Annotated[Path, _place(help="Scenario (TOML).")],
    out: OutFolder,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write a synthetic trial: site, runs and the faults injected into them."""
    from datasets.scenario import load_scenario
    from datasets.trial import write_trial

    paths = write_trial(load_scenario(scenario), out, None if quiet else _print_to_stderr)
    if as_json or not quiet:
        made = {"out": out, "site": out / "site", "runs": paths}
        _print_answer(as_json, made, {}, f"{len(paths)} runs in {out / 'runs'}, site in {out / 'site'}")


@_command(
    "balise safety", "balise safety week12", "balise safety week12 --config other_level.toml --json", of_project=True
)
def safety(
    out: Annotated[str | None, Argument(help="Result of `balise replay`; without it: the budget only.")] = None,
    config: ConfigFile = None,
    logs: LogsAgain = None,
    site: LogsSite = None,
    vehicle: VehicleFile = None,
    jobs: Jobs = 0,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Print the safety budget and its errata; for a result also its sources and each measured figure with bounds.

    How the verdict depends on the service level is read from the tables. With --logs and --site the logs are replayed
    once per value of `failure_limit_m` and `evidence_factor`, to show how the verdict depends on these.
    """
    if out is not None:
        from pipeline.campaign.again import replay_again
        from pipeline.show.assessment import show_assessment
        from pipeline.show.progress import progress_watch
        from pipeline.studies.safety.assessment import assess

        again = replay_again(logs or [], site, _load_vehicle(vehicle), jobs, progress_watch)
        with _progress_shown("runs of several solutions"):
            found = assess(out, None if config is None else _load_configuration(config), again)
        show_assessment(found, as_json)
        return
    from pipeline.show.terminal import show_tables
    from pipeline.studies.safety import safety_tables

    tables = safety_tables(_load_configuration(config).safety)
    _print_json(tables) if as_json else show_tables(tables)


@_command(
    "balise claim week12 --site line9",
    "balise claim week12 --site line9 --profile newer.toml --csv claim.csv",
    of_project=True,
)
def claim(
    out: Result,
    profile: Annotated[str, Option(help="Requirements: a profile by name, or a TOML file.")] = "lu-2023",
    site: Annotated[str | None, Option(help="Site with areas.csv or areas.parquet.")] = None,
    front_ahead: Annotated[float, Option(metavar="METRES", help="Front end ahead of the balise antenna.")] = 0.0,
    csv: Annotated[Path | None, _file("--csv", "--out", metavar="FILE", help=_CSV)] = None,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Compare a result with published requirements for train localisation: met, not met or not shown."""
    from pipeline.results.answer_files import write_csv
    from pipeline.studies.claim import assess_claim, load_profile, read_areas, rows_for_reading

    wanted = load_profile(profile)
    ground = _read_ground(site, _configuration_of_result(out)) if site else None
    areas = read_areas(site, ground) if site and ground else None
    with _progress_shown("runs"):
        found = assess_claim(out, wanted, ground, areas, front_ahead)
    if csv is not None:
        write_csv(found.table, csv)
    if as_json or str(csv) != "-":
        head = {"profile": wanted.name, "version": wanted.version, "sources": list(wanted.sources)}
        title = f"{wanted.name}, version {wanted.version}: {'; '.join(wanted.sources)}"
        answer = {**head, "notes": found.notes, "requirements": found.table}
        _print_answer(as_json, answer, {title: rows_for_reading(found)}, "", *found.notes)


@_command(
    "balise inspect monday.mcap",
    "balise inspect line9",
    "balise inspect line9 --result week12",
    "balise inspect week12/runs/run_id=monday/runs.parquet",
    of_project=True,
)
def inspect(
    path: Annotated[str, Argument(help="A log, a CSV or Parquet file, a site, or a result of `balise replay`.")],
    result: Annotated[str | None, Option(help="Result of runs on this site, to check its survey.")] = None,
    site: Annotated[str | None, Option(help="Site to compare a log with.")] = None,
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Describe a log, a site or a result, and list problems that need attention."""
    from pipeline.show.kinds import Kind, kind_at

    kind = kind_at(path)  # what is mistyped is said before anything is loaded
    from pipeline.show.inspection import inspect_path, show_inspection

    settings = _load_configuration(config)
    if kind is Kind.RAW:
        from pipeline.project.raw import inspect_raw

        ground = None if site is None else _read_ground(site, settings)
        tables = inspect_raw(Path(path), settings, ground, _load_vehicle(vehicle))
    else:
        tables = inspect_path(path, settings, result, site, _load_vehicle(vehicle))
    _print_json(tables) if as_json else show_inspection(tables)
    raise Exit(RUNS_NOT_OK if "Problems" in tables else OK)


@_command("balise inject monday.mcap ramp.toml --out monday_ramp.mcap")
def inject(
    run: Run,
    out: Annotated[Path, _file(help=_NEW_RUN)],
    fault: Annotated[Path | None, _place(help="Fault file (TOML).")] = None,
    fault_option: Annotated[Path | None, _file("--fault", help="Fault file, if not the second argument.")] = None,
    site: Annotated[str | None, Option(help="Site, for faults along its track.")] = None,
    config: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Add a known fault to a recorded run, to measure detection on real noise."""
    from datasets.inject import inject_into, load_faults

    file = _either_input(fault, fault_option, "FAULT", "--fault")
    faults = load_faults(file)
    settings = _load_configuration(config)
    inject_into(run, settings, faults, _read_ground(site, settings) if site else None, out)
    injected = {"run": run, "fault": file, "out": out, "faults": len(faults)}
    _print_answer(as_json, injected, {}, f"{len(faults)} faults injected into {run}: {out}")


@_command("balise undetected monday.mcap --site line9 --out worst --balise VB07")
def undetected(
    run: Run,
    site: Site,
    out: Annotated[Path, _file(help="Folder for the fault file and its profile.")],
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    solution: Solution = "primary",
    balise: Annotated[str | None, Option(help="Place: where the run passes this balise; default: its end.")] = None,
    at_s: Annotated[float | None, Option(help="Place: this many seconds after the first epoch.")] = None,
    behind: Annotated[bool, Option("--behind", help="Error to the rear of the train instead of ahead.")] = False,
    as_json: Json = False,
) -> None:
    """Write the largest fault that no monitor would have noticed at one place of a run, as a file for `inject`."""
    from datasets.undetected import fault_figures, fault_sentence, largest_fault, write_fault

    settings, train = _load_configuration(config), _load_vehicle(vehicle)
    found = largest_fault(
        _read_log(run, settings), _read_ground(site, settings), train, settings, solution, balise, at_s, behind
    )
    file = write_fault(found, solution if settings.undetected.solutions_at_fault == "one" else None, out)
    check = f"To check it: balise inject {run} {file} --site {site} --out RUN2, and replay RUN2."
    _print_answer(as_json, {"fault": file, **fault_figures(found)}, {}, fault_sentence(found), check)


@_command(
    "balise convert receiver.ubx --out monday",
    "balise convert rover.pos --out monday --stream reference",
    "balise convert second.sbf.gz --out monday --solution second",
    "balise convert positions.csv --config columns.toml --out monday.mcap",
)
def convert(
    logs: Annotated[list[Path], _place(help=_LOGS)],
    out: Annotated[Path, _file("--out", "--to", help=_NEW_RUN + " If it exists, streams are added to it.")],
    config: ConfigFile = None,
    solution: Annotated[str | None, Option(help="Name of the receiver in the run, where it has several.")] = None,
    stream: Annotated[Literal["gnss", "reference"], Option(help="Positions under test, or a reference.")] = "gnss",
    date: Day = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Convert receiver logs to a run, or add streams to a run."""
    from datasets.recordings import convert_logs
    from pipeline.make.receivers import Purpose

    given = None if config is None else _load_configuration(config)
    done = convert_logs(logs, out, given, Purpose(solution, stream), date, force)
    _print_answer(as_json, done.as_dict(), {}, *done.lines())


@_command(
    "balise site line.gpx --balises every 1000 --out line9",
    "balise site railways.geojson --balises wanted.csv --out line9",
    name="site",
)
def make_a_site(
    surveys: Annotated[
        list[Path], _place(help="Maps (GPX, KML, GeoJSON, GeoPackage, Shapefile), CSV, or recorded runs.")
    ],
    out: OutFolder,
    balises: Balises = None,
    direction: Annotated[
        Literal["both", "ahead", "back"],
        Option(help="Balises of `every` are valid for trains away from the survey's start, back to it, or both."),
    ] = "both",
    epsg: Annotated[int | None, Option(help="EPSG code of x and y where a table names none.")] = None,
    join: Annotated[
        float | None, Option(help="Join line ends up to so many metres apart (`survey.same_place_m`).")
    ] = None,
    flat: Annotated[bool, Option("--flat", help="Leave heights out.")] = False,
    id_field: Annotated[
        str | None, Option("--id", help="Attribute of GeoPackage, Shapefile or GeoJSON that names the lines.")
    ] = None,
    sigma: Annotated[
        float | None, Option(help="Standard deviation of the survey across the track in metres, where it states none.")
    ] = None,
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a site from a survey of the line: net elements, links, balises, and a page to check it."""
    from pipeline.make.survey.make import make_site, site_request, write_site
    from pipeline.read.site.describe import elements_table
    from pipeline.show.inspection import findings_table
    from pipeline.show.report.site_page import site_page
    from schemas.enums import TravelAlong

    request = site_request(surveys, balises, epsg, join, flat, TravelAlong(direction), id_field, sigma)
    site = make_site(request, _load_vehicle(vehicle), _load_configuration(config))
    write_site(site, site_page(out.resolve().name, site), out, force)
    elements, findings = elements_table(site), findings_table(site.findings)
    made = {"out": out, "page": out / "site.html", "elements": elements, "findings": findings, "balises": site.balises}
    count = 0 if site.balises is None else site.balises.height
    size = f"\n{elements.height} net elements, {elements['length_m'].sum() / 1000:.2f} km, {count} balises in {out}."
    look = f"Look at {out / 'site.html'} before you replay on it."
    _print_answer(as_json, made, {"Elements": elements.head(25), "Findings": findings}, size, look)


@_command("balise calibrate good/*.mcap --site line9 --out train7.toml")
def calibrate(
    runs: Annotated[list[str], Argument(help="Fault-free runs: paths, folders, glob patterns.")],
    site: Site,
    out: Annotated[Path, _file(help="Vehicle file to write.")],
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    solution: Solution = "primary",
    as_json: Json = False,
) -> None:
    """Measure odometer scale, GNSS latency, fast noise and the monitors' sigmas on fault-free runs."""
    from pipeline.campaign import find_runs
    from pipeline.results.workers import with_progress
    from pipeline.storage import write_bytes
    from pipeline.studies.calibration.calibrate import calibrate as measure
    from schemas.config import to_toml

    settings = _load_configuration(config)
    with _progress_shown("runs read"):
        logs = [_read_log(address, settings) for address in with_progress(find_runs(runs).values())]
    with _progress_shown("runs measured"):
        found = measure(logs, _read_ground(site, settings), _load_vehicle(vehicle), settings, solution)
    write_bytes(out, to_toml(found.vehicle).encode())
    vehicle_found = found.vehicle.model_dump()
    measured = {"out": out, "vehicle": vehicle_found, "monitors": found.monitors, "alarms": found.alarms}
    tables = {"Scale and latency": found.runs, "Sigma of the monitors": found.sigmas}
    none = "\nNo latency in the vehicle file: only changes of speed show it, and these runs have too few."
    words = [none] if found.vehicle.gnss_latency_s is None else []
    words += [
        f"\n{run_id}: {', '.join(monitors)} failed beyond its noise. Leave it out unless nothing was wrong."
        for run_id, monitors in found.alarms.items()
    ]
    words.append(f"\nFor the configuration:\n\n{found.monitors_toml()}\nVehicle file: {out}")
    _print_answer(as_json, {**measured, "runs": found.runs, "sigmas": found.sigmas}, tables, *words)


@_command(
    "balise experiment list",
    "balise experiment diagnostics --repetitions 50",
    "balise experiment recorded good/*.mcap --site line9 --vehicle train7.toml --plan plan.toml --out pmd",
)
def experiment(
    name: Annotated[str, Argument(help="Name of the experiment; `list` prints all names.")],
    runs: Annotated[list[str] | None, Argument(help="Fault-free recorded runs (`recorded` only).")] = None,
    site: Annotated[str | None, Option(help="Site of these runs.")] = None,
    vehicle: VehicleFile = None,
    plan: Annotated[Path | None, _file(help="Faults, counts and banks (TOML, `recorded` only).")] = None,
    solution: Solution = "primary",
    out: OutFolder = Path("experiment-out"),
    repetitions: Annotated[
        int | None, Option(min=1, help="Number of repetitions, of `recorded` per cell; default: as published.")
    ] = None,
    seed: Annotated[int | None, Option(min=0, help="Seed of all random numbers; default: 1, or the plan's.")] = None,
    jobs: Jobs = 0,
    config: Annotated[Path | None, _file(help="Monitor bank to assess (`rare`, `catalogue`, `recorded` only).")] = None,
    noise_of: Annotated[
        Path | None, _file(help="Result of fault-free runs whose noise replaces the published one (`rare` only).")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Repeat the published experiment, by default with its own number of runs, or on recorded runs (`recorded`)."""
    from datasets.experiment import EXPERIMENTS, RECORDED, experiment_of

    if name == "list":
        names = [*EXPERIMENTS, RECORDED]
        _print_answer(as_json, {"experiments": names}, {}, *names)
        return
    with _progress_shown("pieces of work", quiet):
        if name == RECORDED:
            from datasets.experiment.recorded.command import recorded_experiment, tables_for_screen

            settings = _load_configuration(config)
            made = recorded_experiment(
                runs or [], site, out, plan, vehicle, settings, seed, repetitions, solution, jobs, _print_to_stderr
            )
        else:
            wanted = experiment_of(name, on_recordings=bool(runs or site or vehicle or plan))
            bank = None if config is None else _load_configuration(config)
            files = wanted(out, repetitions, 1 if seed is None else seed, jobs, bank, noise_of)
    if name != RECORDED:
        _print_answer(as_json, {"experiment": name, "out": out, "files": files}, {}, *map(str, files))
        return
    for run_id, error in made.failed.items():
        _print_to_stderr(f"{run_id} is not used: {error}")
    if as_json or not quiet:
        answer = {"experiment": name, "out": out, "files": made.files}
        _print_answer(as_json, answer, tables_for_screen(made), "", *made.remarks, f"\nBegin with {made.files[0]}")
    raise Exit(RUNS_NOT_OK if made.failed else OK)


@_command(
    'balise sql week12 "SHOW TABLES"',
    'balise sql week12 "SELECT run_id, verdict FROM runs" --out runs.csv',
    'balise sql week12 "SELECT r.run_id, r.verdict, o.verdict FROM runs r JOIN old_runs o USING (run_id)"'
    " --with old=week11",
    of_project=True,
)
def sql(
    out: Result,
    query: Annotated[str, Argument(help="One SELECT, SHOW TABLES, or DESCRIBE table.")],
    compared: Annotated[
        list[str] | None,
        Option("--with", metavar="NAME=OUT", help="Another result; its tables are NAME_runs, NAME_hazards, ..."),
    ] = None,
    csv: Annotated[Path | None, _file("--csv", metavar="FILE", help=_CSV)] = None,
    guard: Guard = True,
    parquet: Annotated[Path | None, _file(metavar="FILE", help="Write Parquet.")] = None,
    xlsx: Annotated[Path | None, _file(metavar="FILE", help="Write an Excel workbook (extra `excel`).")] = None,
    as_json: Json = False,
    file: Annotated[
        Path | None, _file("--out", metavar="FILE", help="Write CSV, Parquet or Excel, as the suffix says.")
    ] = None,
    allow_files: Annotated[bool, Option("--allow-files", help="Let the query read other files (`read_csv`).")] = False,
    project: OfProject = None,
) -> None:
    """Query the tables of a result in SQL: hazards, passages, alarms, epochs, runs and those of the campaign."""
    from pipeline.results.answer_files import write_answer
    from pipeline.results.query import named_results, run_sql

    answer = run_sql(out, query, allow_files, named_results(compared or []))
    written = write_answer(answer, csv, parquet, xlsx, file, guard)
    for name in written:
        _print_to_stderr(f"{answer.height} rows in {name}")
    if as_json or not (written or csv):
        _print_answer(as_json, answer, {"": answer})


@_command(
    "balise report week12 --site line9",
    "balise report week12 --run monday",
    "balise report week12 --against week11",
    of_project=True,
)
def report(
    out: ResultFolder,
    site: Annotated[str | None, Option(help="Site, for plans of the track.")] = None,
    jobs: Annotated[int, Option(min=0, help="Parallel processes; 0: one per core if there are many pages.")] = 0,
    run: Annotated[str | None, Option(help="Write the page of this run alone.")] = None,
    most: Annotated[
        int, Option("--pages", min=0, help="Above so many runs, write pages of runs only with --run.")
    ] = 1000,
    against: Annotated[
        str | None, Option(help="Another result of the same runs: write the page of both side by side.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Write HTML pages for the campaign and each run. They open offline.

    Pages of runs that have not changed since the last report are left as they are.
    """
    from pipeline.results.packs import read_twice_if_moved
    from pipeline.show.report import write_against, write_page, write_report

    ground = _read_ground(site, _configuration_of_result(out)) if site else None

    def write_pages() -> list[Path]:
        """Write the pages that are asked for."""
        if against is not None:
            return [write_against(out, against)]
        return write_report(out, ground, jobs, most) if run is None else [write_page(out, run, ground, most)]

    with _progress_shown("pages", quiet):
        pages = read_twice_if_moved(write_pages)
    if as_json or not quiet:
        _print_answer(as_json, {"page": pages[0], "files": pages}, {}, f"{len(pages)} files; begin with {pages[0]}")


@_command(
    "balise line week12 --site line9",
    "balise line week12 --site line9 --criteria ours.toml --points signals.csv --out placing",
    of_project=True,
)
def line(
    out: ResultFolder,
    site: Annotated[str, Option(help="Site that the runs were replayed on.")],
    criteria: Annotated[Path | None, _file(help="Criteria (TOML).")] = None,
    points: Annotated[Path | None, _file(help="Stations and signals: CSV with name, netelement_id, measure_m.")] = None,
    solution: Annotated[str | None, Option(help="Solution of the runs; `primary` where there are several.")] = None,
    to: Annotated[Path | None, _file("--out", help="Folder to write; by default OUT/line.")] = None,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Classify each piece of track: may virtual balises be placed there? Propose places for them."""
    from pipeline.show.line import write_line
    from pipeline.studies.line import read_points, study_line
    from schemas.config import read_toml, settings_from
    from schemas.line import LineCriteria

    given, keys = None if points is None else read_points(points), "docs/line.md lists every key."
    decided = settings_from({} if criteria is None else read_toml(criteria), LineCriteria, str(criteria), keys)
    with _progress_shown("runs"):
        result = study_line(out, _read_ground(site, _configuration_of_result(out)), decided, solution, given)
    files = write_line(result, to or out / "line")
    tables = {"pieces": result.pieces, "proposals": result.proposals}
    answer = {"page": files[0], "files": files, **tables, "remarks": list(result.remarks)}
    shown = {"Pieces of track": result.summary, "Proposals": result.proposals}
    _print_answer(as_json, answer, shown, "\n".join(result.remarks), f"{len(files)} files; begin with {files[0]}")


@_command(
    "balise export week12 monday --out monday.mcap --site line9",
    "balise export week12 monday --out monday.gpkg --site line9",
    of_project=True,
)
def export(
    out: ResultFolder,
    run: Annotated[str, Argument(help="Id of the run.")],
    to: Annotated[
        Path,
        _file("--out", "--to", help="F.mcap (with a Foxglove layout), .geojson, .gpx, .gpkg or .parquet (GeoParquet)."),
    ],
    site: Annotated[str | None, Option(help="Site, for positions on the ground.")] = None,
    log: Annotated[str | None, Option(help="The recorded run, for its raw positions.")] = None,
    ros: Annotated[bool, Option("--ros", help="ROS 2 messages instead of Foxglove's protobuf.")] = False,
    config: ConfigFile = None,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Export one run with its results to MCAP viewers (Foxglove, Lichtblick, Rerun) or maps."""
    from pipeline.results.packs import read_twice_if_moved
    from pipeline.show.export import export_run

    recorded = _read_log(log, _load_configuration(config), True) if log else None
    ground = _read_ground(site, _configuration_of_result(out)) if site else None
    layout: Literal["ros", "foxglove"] = "ros" if ros else "foxglove"
    files, missing = read_twice_if_moved(lambda: export_run(out, run, to, ground, recorded, layout))
    words = ["Wrote " + " and ".join(map(str, files)), *(f"Without {text}" for text in missing)]
    _print_answer(as_json, {"files": files, "missing": missing}, {}, *words)


@_command(
    "balise verify week12", "balise verify week12 --logs logs --site line9 --vehicle train7.toml", of_project=True
)
def verify(
    out: Result,
    logs: LogsAgain = None,
    site: LogsSite = None,
    vehicle: VehicleFile = None,
    config: ConfigFile = None,
    route: RouteFiles = None,
    expect: Annotated[str | None, Option("--expect", help="SHA-256 of manifest.json as it was kept elsewhere.")] = None,
    jobs: Jobs = 0,
    quiet: Quiet = False,
    as_json: Json = False,
    project: OfProject = None,
) -> None:
    """Check a result against its manifest; with --logs, replay the logs again and compare every table."""
    from pipeline.campaign.verify import verify as compare
    from pipeline.campaign.verify import verify_by_replay, verify_manifest
    from pipeline.results.manifest import anchor, anchor_words
    from pipeline.show.progress import progress_watch

    found = [verify_manifest(out, expect)] if expect else []
    with _progress_shown("runs", quiet):
        found.append(compare(out))
    if logs:
        settings = _load_configuration(config) if config else None
        shown = [] if quiet else [progress_watch()]
        found += _from_raw_logs(logs, project)
        found.append(verify_by_replay(out, logs, site, settings, _load_vehicle(vehicle), route, jobs, shown))
    if as_json:
        compared = [{"compared": v.compared, "not_compared": v.not_compared, "problems": v.table} for v in found]
        digest, runs = anchor(out)
        manifest = {"sha256": digest, "runs": runs}
        _print_json({"agrees": not any(one.problems for one in found), "manifest": manifest, "comparisons": compared})
    for one in found if not as_json else []:
        if one.problems or not quiet:
            _print_answer(False, None, {"": one.table} if one.problems else {}, one.sentence)
    if not (as_json or quiet):
        print(anchor_words(*anchor(out)))
    raise Exit(RUNS_NOT_OK if any(one.problems for one in found) else OK)


def _from_raw_logs(logs: list[str], project: Path | None) -> list[Verification]:
    """In a project: whether the raw logs of these runs give them again."""
    from datasets.recordings import public_recordings
    from pipeline.campaign import find_runs
    from pipeline.project.opened import project_here
    from pipeline.project.reconvert import verify_conversion

    opened = project_here(project)
    if opened is None or not opened.project.convert:
        return []
    return [verify_conversion(opened, public_recordings(), find_runs(logs).values())]


@_command("balise compact week12", "balise compact s3://trial/week12 --runs-per-file 5000")
def compact(
    out: Result,
    runs_per_file: Annotated[int, Option(min=1, help="Most runs in one file; fewer if runs are long.")] = 2000,
    undo: Annotated[bool, Option("--undo", help="Split into one file per run and table again, byte for byte.")] = False,
    jobs: Jobs = 0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Merge the tables of many runs into few files. Every command reads both forms, also mixed."""
    from pipeline.campaign import compact as packing

    with _progress_shown("runs", quiet):
        found = packing.undo(out) if undo else packing.compact(out, runs_per_file, jobs)
    left_out = [f"{run} keeps files of its own: {reason}" for run, reason in found.left_out.items()]
    if as_json or not quiet:
        _print_answer(as_json, asdict(found), {}, found.sentence, *left_out)
    raise Exit(RUNS_NOT_OK if left_out else OK)


@_command(
    "balise diff week11 week12",
    "balise diff week11 week12 --detail",
    "balise diff golden result --tolerance availability=0.001 --ignore runs.notes",
    "balise diff golden result --rules diff.toml",
)
def diff(
    out_a: Result,
    out_b: Annotated[str, Argument(help="The result to compare it with.")],
    detail: Annotated[bool, Option("--detail", help="Also list every changed value.")] = False,
    tolerance: Annotated[
        list[str] | None,
        Option(help="COLUMN=VALUE: a column (`availability`, `runs.availability`) may differ by so much, in its unit."),
    ] = None,
    ignore: Annotated[list[str] | None, Option(help="A column that is not compared.")] = None,
    rules: Annotated[Path | None, _file("--rules", help="TOML: `ignore = [...]`, `[tolerance]`.")] = None,
    as_json: Json = False,
) -> None:
    """Compare two results; exit status 1 if they differ."""
    from pipeline.results.diff.results import diff_results
    from pipeline.results.diff.rules import rules_of
    from schemas.errors import visible

    allowed = rules_of(tolerance or [], ignore or [], rules)
    with _progress_shown("runs"):
        found = diff_results(out_a, out_b, allowed)
    if as_json:
        _print_json(found.as_dict())
    else:
        print(visible(found.text(detail)))
    raise Exit(OK if found.is_same else RUNS_NOT_OK)


def main() -> None:
    """Entry point of the program: turns whatever happens into one message and an exit status."""
    sys.stdout, sys.stderr = _ignore_broken_pipe(sys.stdout), _ignore_broken_pipe(sys.stderr)
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    status = _run_guarded(arguments, debug="--debug" in sys.argv[1:])
    gc.freeze()
    sys.exit(status)


class _Unbroken(io.FileIO):
    """What is written where nobody reads any more (`| head`) is lost, and changes neither the work nor its status."""

    def write(self, data: Any) -> int:
        """Write what somebody still reads; what nobody does counts as written."""
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)


def _ignore_broken_pipe(stream: TextIO) -> TextIO:
    """The stream, which takes what is written where nobody reads it any more."""
    try:
        raw = _Unbroken(stream.fileno(), "w", closefd=False)
    except (OSError, ValueError, AttributeError):  # there is none
        return stream
    at_once = stream is sys.stderr or raw.isatty()
    return io.TextIOWrapper(io.BufferedWriter(raw), stream.encoding, stream.errors, line_buffering=at_once)


@cache
def _command_parser() -> Callable[..., Any]:
    """Made once of all signatures; whoever calls the program many times in one process does not wait for it again."""
    return get_command(app)


def _run_guarded(arguments: list[str], debug: bool) -> int:
    """Run a command; every error becomes one message and an exit status."""
    from schemas.errors import BaliseError, InputError

    try:
        _command_parser()(arguments, prog_name="balise", standalone_mode=True)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else USAGE
    except BaliseError as error:
        _print_error(str(error), debug)
        return RUNS_NOT_OK if isinstance(error, InputError) else USAGE
    except KeyboardInterrupt:
        _print_error("interrupted", debug)
        return 128 + signal.SIGINT
    except BaseException as error:  # panics of libraries are no `Exception`
        _print_error(f"a defect of this program: {type(error).__name__}: {error}", debug)
        print("Please report it with the output of the same command and --debug.", file=sys.stderr)
        return DEFECT
    return OK


def _print_error(text: str, debug: bool) -> None:
    """Print an error on standard error; with `debug` its traceback before."""
    if debug:
        traceback.print_exc()
    from schemas.errors import visible

    print(f"balise: {visible(text)}", file=sys.stderr)


def _load_configuration(file: Path | None) -> Configuration:
    """The configuration of a file; the default without one."""
    from schemas.project import load_configuration

    return load_configuration(file)


def _load_vehicle(file: Path | None) -> Vehicle:
    """The vehicle of a file; the default without one."""
    from schemas.config import Vehicle, load_settings

    return load_settings(file, Vehicle)


def _either_input(positional: Path | None, option: Path | None, name: str, flag: str) -> Path:
    """An input that may stand among the arguments or behind its option, once."""
    from schemas.errors import UsageError

    if (positional is None) == (option is None):
        found = "neither" if option is None else "both"
        raise UsageError("is wanted once", place=name, found=found, expected=f"{name}, or {flag} {name}")
    return positional or option  # type: ignore[return-value]


def _read_log(address: str, settings: Configuration, with_digest: bool = False) -> RunLog:
    """The run at an address."""
    from pipeline.read.ingest import read_run

    return read_run(address, settings.ingest, with_digest)


def _read_ground(site: str, settings: Configuration) -> Ground:
    """The site at an address."""
    from pipeline.read.site.read import read_site

    return read_site(site, settings.site)


def _configuration_of_result(out: str | Path) -> Configuration:
    """The configuration that a result was made with."""
    from pipeline.results.store import read_config

    return read_config(out) or _load_configuration(None)


def _print_table(table: pl.DataFrame, title: str = "") -> None:
    """Print a table for people."""
    from pipeline.show.terminal import show_table

    show_table(table, title)


def _progress_shown(things: str, quiet: bool = False) -> contextlib.AbstractContextManager[None]:
    """Say on standard error how many of how many of these things are done, and how long the others will take."""
    from pipeline.results.workers import watched
    from pipeline.show.terminal import progress_printer

    return watched(None if quiet else progress_printer(things))


def _print_answer(as_json: bool, value: Any, tables: Mapping[str, pl.DataFrame], *words: str) -> None:
    """The value as JSON, or for people: tables under their titles, then what they mean."""
    if as_json:
        _print_json(value)
        return
    for title, table in tables.items():
        _print_table(table, title)
    if words:
        print("\n".join(words))


def _print_to_stderr(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr, flush=True)


def _print_json(value: Any) -> None:
    """Print a value as JSON."""
    from pipeline.show.terminal import to_json

    print(to_json(value))


if __name__ == "__main__":
    main()
