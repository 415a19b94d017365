"""From raw logs, a line and balises to a project: `balise trial`."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

import polars as pl
import tomli_w

from pipeline.make.survey.make import make_site
from pipeline.project.convert import Recordings, convert_entry
from pipeline.project.found import Kind, is_one_log, is_prose, is_site, logs_below, look_around, require_name
from pipeline.project.looking import InspectedLog, look_at, look_at_dates
from pipeline.project.opened import OpenedProject, named_from
from pipeline.project.recorded_runs import RecordedRun, group_into_runs, stem_of
from pipeline.project.run import requested_site
from pipeline.read.ingest import read_run
from pipeline.read.ingest.correct import correct_further
from pipeline.read.ingest.parts import LogPart, lines_of_parts
from pipeline.read.site.alike import ambiguities, summarise_findings
from pipeline.read.site.read import read_site
from pipeline.storage.files import require_regular
from pipeline.studies.plausibility.check import CONFIGURATION, FitState
from pipeline.studies.plausibility.fit import FitReport, fit_report
from schemas.config import IngestConfig, StreamCorrection, settings_from, toml_of
from schemas.errors import BaliseError, InputError, UsageError
from schemas.frozen import frozen
from schemas.project import FILE_NAME, ConvertEntry, Project, ReplayEntry, TrackEntry
from schemas.run import Site, Stream
from schemas.words import say

_ZONES_S = 900.0  # time zones are whole quarters of an hour apart
_ROUNDS = 4  # a clock shows when the unit is right, an axis when the clock is


@frozen
class Wanted:
    """What the user named: logs, line, balises; `references`: those of the logs that are the truth.

    `strict`: a log that cannot be read is an error, not a remark.
    """

    raws: Sequence[Path]
    track: Sequence[Path] = ()
    balises: str | None = None
    references: Sequence[Path] = ()
    day: date | None = None
    vehicle: Path | None = None
    config: Path | None = None
    strict: bool = True


@frozen
class Proposal:
    """Corrections that would make the streams of one run fit, and what was found."""

    run_id: str
    found: tuple[str, ...]
    corrections: tuple[StreamCorrection, ...]
    accepted: bool


@dataclass
class Drafted:
    """A project to be written, and what there is to say of it."""

    opened: OpenedProject
    logs: pl.DataFrame
    proposals: list[Proposal] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    parts: tuple[LogPart, ...] = ()
    """Of all logs: what they consist of, and what of it is used."""


Accept = Callable[[str, Sequence[str], Sequence[StreamCorrection]], bool]
"""Asked once per run: its id, what does not fit, and the corrections that would mend it."""


def draft_project(wanted: Wanted, folder: Path, recordings: Recordings, accept: Accept) -> Drafted:
    """Look at all logs, sort them into rides, and propose what mends those that do not fit.

    Raises `InputError` for a log that was named and cannot be read, `SiteError` or `UsageError` for the line.
    """
    folder = folder.absolute()
    base = _project_without_runs(wanted, folder)
    remarks: list[str] = []
    logs, unread = _look_at_logs(wanted, base.given_config().ingest, recordings, remarks)
    remarks += _ignored_files(wanted)
    remarks += [f"{log.path.name}: {text}" for log in logs for text in log.assumed]
    recorded_runs, alone = group_into_runs(logs, [path.absolute() for path in wanted.references])
    if not recorded_runs and logs:
        # Why the log that does could not be read is what has to be mended.
        raise InputError(
            "no log holds positions",
            place=", ".join(str(log.path) for log in logs),
            expected="GNSS",
            remedy=" ".join(remarks) or None,
        )
    remarks += [_unused_words(log) for log in alone]
    parts = tuple(part for log in logs for part in log.parts)
    drafted = Drafted(base, _rides_table(recorded_runs), [], remarks + lines_of_parts(parts), parts)
    drafted.remarks += _remark_on_odometers(recorded_runs)
    drafted.remarks += [note for recorded_run in recorded_runs for note in _receiver_remarks(recorded_run)]
    site = _provisional_site(base)
    if site is not None:
        listed = "`balise inspect` of the site lists them"
        drafted.remarks += summarise_findings(ambiguities(site, base.given_config()), listed)
    entries = []
    ready = []
    of_odometers: dict[str, Sequence[str]] = {}
    for recorded_run in recorded_runs:
        proposal, entry, report = _check_fit(recorded_run, base, site, recordings, wanted.day, accept)
        of_odometers[recorded_run.run_id] = report.of_odometers()
        drafted.proposals += [proposal] if proposal else []
        if recorded_run.is_ready and proposal is None:
            ready.append(named_from(recorded_run.logs[0].path, folder))
        else:
            entries.append(entry)
    drafted.remarks += _unique(of_odometers)
    own = {"convert": tuple(entries), "replay": ReplayEntry(runs=tuple(ready))}
    own["unread"] = tuple(named_from(path, folder) for path in unread)
    drafted.opened = OpenedProject(base.file, base.project.model_copy(update=own))
    return drafted


def _project_without_runs(wanted: Wanted, folder: Path) -> OpenedProject:
    """The project without its runs."""

    def named(path: Path) -> str:
        """A path as the project names it."""
        return named_from(path.absolute(), folder)

    settings = {"vehicle": wanted.vehicle, "config": wanted.config}
    given: dict[str, Any] = {name: named(path) for name, path in settings.items() if path is not None}
    sites = [path for path in wanted.track if is_site(path)]
    if sites and (len(wanted.track) > 1 or wanted.balises):
        raise UsageError(
            "is a site already",
            place=str(sites[0]),
            expected="a site alone, or surveys to make one of",
            remedy="Its balises stand in its file balises.csv or balises.parquet; leave --balises out.",
        )
    for path in wanted.track:
        if not path.exists():
            expected = "a map, a table of points, or a site"
            raise UsageError("does not exist", place=f"--track {path}", expected=expected)
    if sites:
        given["site"] = named(sites[0])
    elif wanted.track:
        balises = wanted.balises
        if balises is not None and not balises.startswith("every"):
            if not Path(balises).is_file():
                raise UsageError("does not exist", place=f"--balises {balises}", expected="a table, or `every 1000`")
            balises = named(Path(balises))
        given["track"] = TrackEntry(survey=tuple(map(named, wanted.track)), balises=balises)
    return OpenedProject(folder / FILE_NAME, Project(**given))


def _look_at_logs(
    wanted: Wanted, config: IngestConfig, recordings: Recordings, remarks: list[str]
) -> tuple[list[InspectedLog], list[Path]]:
    """Every log that was named, and of folders those that can be read; then files of folders that may be logs."""
    named = _named_logs(wanted)
    inspected: dict[Path, InspectedLog] = {}
    unread: dict[Path, BaliseError] = {}
    for place, (path, _) in named.items():
        try:
            inspected[place] = replace(look_at(path, config, wanted.day, recordings), path=place)
        except BaliseError as error:
            unread[place] = error
    lost: list[Path] = []
    sure = list(inspected.values())
    for place, reason in unread.items():
        if (log := look_at_dates(place, config, sure)) is not None:
            inspected[place] = log
            remarks.append(f"{place.name}: days and months of its dates in the order that fits the other logs")
        elif named[place][1]:
            raise reason
        elif is_prose(place):
            remarks.append(f"not used: {reason}")
        else:
            lost.append(place)
            remarks.append(f"NOT READ, `balise run` will say so: {reason}")
    return [inspected[place] for place in named if place in inspected], lost


def _named_logs(wanted: Wanted) -> dict[Path, tuple[Path, bool]]:
    """Each log by its place, as named or found in a folder; and whether one that cannot be read is an error."""
    surveys = {path.absolute() for path in wanted.track} | {Path(wanted.balises or "").absolute()}
    named: dict[Path, tuple[Path, bool]] = {}
    for raw in [*_resolve_patterns(wanted.raws), *_resolve_patterns(wanted.references)]:
        is_log = is_one_log(raw)
        for path in [raw] if is_log else logs_below(raw):
            if path.absolute() not in surveys:
                named.setdefault(path.absolute(), (path, is_log and wanted.strict))
    return named


_TAKEN_FOR: Mapping[Kind, str] = {
    "surveys": "a line",
    "sites": "a site",
    "balises": "a list of balises",
    "vehicles": "a vehicle file",
    "configs": "a configuration",
}


_OF_A_RIDE = "; of positions of a ride make a CSV of time, latitude and longitude"


def _ignored_files(wanted: Wanted) -> list[str]:
    """What lies in folders of logs, is no log by its kind, and is named nowhere else."""
    own = [wanted.vehicle, wanted.config, *wanted.track, *([Path(wanted.balises)] if wanted.balises else [])]
    named = {path.absolute() for path in own if path is not None}
    folders = [raw for raw in _resolve_patterns(wanted.raws) if raw.is_dir() and not is_one_log(raw)]
    found = [(kind, path) for folder in folders for kind, paths in look_around(folder).items() for path in paths]
    return [
        f"not used: {path}: taken for {_TAKEN_FOR[kind]}" + (_OF_A_RIDE if kind == "surveys" else "")
        for kind, path in found
        if kind in _TAKEN_FOR and path.absolute() not in named
    ]


def _resolve_patterns(raws: Sequence[Path]) -> list[Path]:
    """The files and folders that were named; patterns too, which not every shell resolves."""
    found: list[Path] = []
    for raw in raws:
        matches = [raw] if os.path.lexists(raw) else sorted(map(Path, glob.glob(str(raw), recursive=True)))
        if not matches:
            raise UsageError("does not exist", place=str(raw), expected="a log, a folder of logs, or a pattern")
        for match in matches:
            require_name(match)
            require_regular(match)
        found += matches
    return found


def _unused_words(log: InspectedLog) -> str:
    """A remark on a log that belongs to no ride."""
    streams = ", ".join(log.spans)
    return (
        f"not used: {log.path}: {streams} from {log.start:%Y-%m-%d %H:%M:%S} to {log.end:%H:%M:%S}, in no ride's time"
    )


def _remark_on_odometers(recorded_runs: Sequence[RecordedRun]) -> list[str]:
    """A remark on rides without an odometer; nothing where all have one."""
    bare = [
        recorded_run.run_id
        for recorded_run in recorded_runs
        if not any("odometer" in log.spans for log in recorded_run.logs)
    ]
    which = "no run has an odometer" if len(bare) == len(recorded_runs) else f"without odometer: {', '.join(bare)}"
    return [f"{which}; nothing is monitored along the track"] if bare else []


def _receiver_remarks(recorded_run: RecordedRun) -> list[str]:
    """Remarks on a ride with several receivers: their names, and which could be the truth."""
    if len(recorded_run.receivers) < 2:
        return []
    names = ", ".join(
        f"{files[0].path.name} ({_solution_name(recorded_run, files)})" for files in recorded_run.receivers
    )
    fixed = [files[0].path for files in recorded_run.receivers if files[0].mostly_fixed and not recorded_run.references]
    return [
        f"{recorded_run.run_id}: receivers of the same time, each a solution of its own: {names}",
        *(
            f"{recorded_run.run_id}: {path.name} is RTK-fixed; if it is the truth, add --reference {path}"
            for path in fixed
        ),
    ]


def _solution_name(recorded_run: RecordedRun, files: Sequence[InspectedLog]) -> str:
    """The first receiver is `primary`, others are named after their logs."""
    place = next(number for number, other in enumerate(recorded_run.receivers) if other is files)
    stems = [stem_of(others[0].path) for others in recorded_run.receivers]
    if place == 0:
        return "primary"
    return stems[place] if stems.count(stems[place]) == 1 else f"{stems[place]}_{place + 1}"


def _convert_entry(recorded_run: RecordedRun, folder: Path, day: date | None) -> ConvertEntry:
    """The table of the project that converts a ride."""
    logs: list[dict[str, Any]] = []
    for files in recorded_run.receivers:
        name = _solution_name(recorded_run, files)
        # A log of several solutions has their names itself.
        own = {} if name == "primary" else {"solution": name}
        logs.append({"files": [log.path for log in files], **own, **files[0].mapping})
    logs += [{"files": [log.path], "stream": "reference", **log.mapping} for log in recorded_run.references]
    logs += [{"files": [log.path], **log.mapping} for log in recorded_run.others]
    for log in logs:
        if day is not None and any(path.suffix.lower() not in (".csv", ".mcap") for path in log["files"]):
            log["date"] = day
        log["files"] = [named_from(path, folder) for path in log["files"]]
    # A run that lies where converted ones go is not overwritten by its correction.
    home = "converted" if folder / "runs" / recorded_run.run_id in [log.path for log in recorded_run.logs] else "runs"
    return settings_from({"to": f"{home}/{recorded_run.run_id}", "logs": logs}, ConvertEntry, str(folder / FILE_NAME))


def _check_fit(
    recorded_run: RecordedRun,
    base: OpenedProject,
    site: Site | None,
    recordings: Recordings,
    day: date | None,
    accept: Accept,
) -> tuple[Proposal | None, ConvertEntry, FitReport]:
    """What mends a ride whose streams do not fit each other, the ride with it where that is accepted, and how it fits
    then.
    """
    config = base.given_config()
    vehicle = base.given_vehicle()
    entry = _convert_entry(recorded_run, base.folder, day)
    if recorded_run.is_ready:
        run = read_run(recorded_run.logs[0].path, config.ingest, with_digest=False)
    else:
        run = convert_entry(base, entry, config.ingest, config.fix_sigma, recordings).run
    corrections: list[StreamCorrection] = []
    found: list[str] = []
    for _ in range(_ROUNDS):
        report = fit_report(run, config, site, vehicle)
        proposed = _proposed_corrections(report)
        if not proposed:
            break
        fresh, log = _correct_recorder(proposed, recorded_run, report)
        sentences = _misfit_words(report)
        if log is not None:
            mine = say("misfit_places", "rather_in_stream", log.path.name, "GNSS")
            sentences = [text.replace(say("misfit_places", "in_stream", "GNSS"), mine) for text in sentences]
        found += [sentence for sentence in sentences if sentence not in found]
        corrections += fresh
        run = correct_further(run, fresh)
    if not corrections:
        return None, entry, report
    accepted = accept(recorded_run.run_id, found, corrections)
    proposal = Proposal(recorded_run.run_id, tuple(found), tuple(corrections), accepted)
    return proposal, entry.model_copy(update={"correct": tuple(corrections)}) if accepted else entry, report


def _unique(said: Mapping[str, Sequence[str]]) -> list[str]:
    """Each sentence once, behind the runs that it was said of."""
    runs: dict[str, list[str]] = {}
    for run_id, sentences in said.items():
        for sentence in sentences:
            runs.setdefault(sentence, []).append(run_id)
    return [f"{', '.join(ids) if len(ids) < len(said) else 'all runs'}: {text}" for text, ids in runs.items()]


def correction_lines(corrections: Sequence[StreamCorrection]) -> list[str]:
    """Corrections as lines of a project file."""
    tables = [tomli_w.dumps(correction.model_dump(exclude_defaults=True)) for correction in corrections]
    return [line for table in tables for line in ("[[convert.correct]]", *table.splitlines())]


def _proposed_corrections(report: FitReport) -> list[StreamCorrection]:
    """Corrections of the configuration that a report on the fit of the streams proposes."""
    lines = report.mending.get(CONFIGURATION, "")
    ingest = toml_of(lines.encode(), "lines that mend it").get("ingest")
    return list(settings_from(ingest, IngestConfig, "lines that mend it").correct) if isinstance(ingest, dict) else []


def _correct_recorder(
    proposed: list[StreamCorrection], recorded_run: RecordedRun, report: FitReport
) -> tuple[list[StreamCorrection], InspectedLog | None]:
    """The same for all streams of one log, which have one clock; and that log, where its clock and not the GNSS's is
    corrected: what a receiver sends is never a time zone off.
    """
    shared = [log for log in recorded_run.others if len(log.spans) > 1]
    if len(shared) != 1:
        return proposed, None
    log = shared[0]
    shift_s = next((one.shift_s for one in proposed if one.stream == "gnss"), 0.0)
    of_receivers = not any(other.mapping or other.is_run for files in recorded_run.receivers for other in files)
    if (
        shift_s
        and shift_s % _ZONES_S == 0.0
        and of_receivers
        and len(recorded_run.others) == 1
        and not recorded_run.references
    ):
        kept = [one for one in proposed if one.stream not in ("gnss", "satellites")]
        return [*kept, *(_clock_correction(name, -shift_s) for name in log.spans)], log
    shifts = [one.shift_s for one in proposed if one.shift_s and one.stream in log.spans]
    named = [one.stream for one in proposed]
    unchecked = [name for name in log.spans if name not in named and not _clock_fits(report, name)]
    return [*proposed, *(_clock_correction(name, shift_s) for shift_s in shifts for name in unchecked)], None


def _clock_correction(stream: str, shift_s: float) -> StreamCorrection:
    """A correction of the clock of one stream."""
    return StreamCorrection.model_validate({"stream": stream, "shift_s": shift_s})


def _clock_fits(report: FitReport, stream: Stream) -> bool:
    """Whether the report says that the clock of a stream fits that of the GNSS."""
    what = f"clock of the {stream.replace('_', ' ')} against the GNSS"
    states = report.tables["Fit"].filter(pl.col("check") == what)["state"]
    return states.head(1).to_list() == [FitState.FITS.value]


def _misfit_words(report: FitReport) -> list[str]:
    """What does not fit, in sentences."""
    states = (FitState.MISFIT.value, FitState.IMPOSSIBLE.value)
    rows = report.tables["Fit"].filter(pl.col("state").is_in(states)).iter_rows(named=True)
    return [f"{row['check']}: {row['found']}" + (f" ({row['cause']})" if row["cause"] else "") for row in rows]


def _provisional_site(base: OpenedProject) -> Site | None:
    """The line as far as it is known: made here to be looked at, not written."""
    config = base.given_config()
    if base.project.track is not None:
        return make_site(requested_site(base, base.project.track), base.given_vehicle(), config)
    named = base.place(base.project.site)
    return read_site(named, config.site) if Path(named).exists() else None


def _rides_table(recorded_runs: Sequence[RecordedRun]) -> pl.DataFrame:
    """Rides as a table: each log with the streams that it feeds, and their times."""
    columns = ("run_id", "log", "feeds", "rows", "from", "to")
    rows = []
    for recorded_run in recorded_runs:
        for log in recorded_run.logs:
            for stream, span in log.spans.items():
                feeds = "reference" if log in recorded_run.references and stream == "gnss" else stream
                start, end = (f"{time:%Y-%m-%d %H:%M:%S}" for time in (span.start, span.end))
                rows.append((recorded_run.run_id, log.path.name, feeds, str(span.rows), start, end))
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.String), orient="row").cast({"rows": pl.Int64})
