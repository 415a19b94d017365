"""What `balise inspect` and `balise convert` say of how a run fits: checks, and the lines that mend it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

import polars as pl

from pipeline.stages.clean.clean import CleanCounts, clean
from pipeline.stages.clean.journey import require_one_journey
from pipeline.studies.plausibility.check import FitState
from pipeline.studies.plausibility.fit import Fit, clock_advice, fit_run, lines_of, with_checks
from pipeline.studies.plausibility.witnesses import follows_checks, origins_table, undeclared
from schemas.config import Configuration, Vehicle
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site, Stream

ODOMETERS = "Odometers"
"""Title of the table that says where each odometer comes from."""


@frozen
class FitReport:
    """Tables by title, what keeps the run from being replayed, and the lines that mend it by what to do with them."""

    tables: dict[str, pl.DataFrame]
    problems: tuple[str, ...]
    mending: Mapping[str, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """For programs: what keeps the run from being replayed, every check, and the lines that mend it."""
        mending = self.tables.get("Lines that mend it")
        mends = [] if mending is None else mending["toml"].to_list()
        return {
            "problems": list(self.problems),
            "fit": self.tables.get("Fit", []),
            "odometers": self.tables.get(ODOMETERS, []),
            "mends": mends,
        }

    def of_odometers(self) -> Sequence[str]:
        """What is to be said of odometers that are not declared to be independent, or are not."""
        return undeclared(self.tables[ODOMETERS]) if ODOMETERS in self.tables else []

    def lines(self) -> list[str]:
        """The same as plain lines, without what fits or could not be checked."""
        lines = [f"does not fit: {problem}" for problem in self.problems]
        if "Fit" in self.tables:
            misfits = self.tables["Fit"].filter(pl.col("state") == FitState.MISFIT.value)
            lines += [
                f"does not fit: {row['check']}: {row['found']} {row['cause']}".rstrip()
                for row in misfits.iter_rows(named=True)
            ]
        lines += self.of_odometers()
        if "Lines that mend it" in self.tables:
            lines += self.tables["Lines that mend it"]["toml"].to_list()
        return lines


def fit_report(
    run: RunLog, config: Configuration, site: Site | None = None, vehicle: Vehicle | None = None
) -> FitReport:
    """Every check of every solution; a run that cannot be cleaned has its error as problem."""
    problems: tuple[str, ...] = ()
    try:
        cleaned, counts = clean(run, config, clock_advice)
    except InputError as error:
        # Recorders of different times: what moves one to the other is said all the same.
        cleaned = _in_order(run)
        counts = CleanCounts()
        problems = (str(error),)
        if cleaned.gnss.height < 2:
            return FitReport({}, problems)
    fits: dict[str, Fit] = {}
    for name in cleaned.solutions():
        try:
            require_one_journey(cleaned.gnss.filter(pl.col("solution") == name), f"solution {name!r}", config.ingest)
        except InputError as error:
            problems += (str(error),)
        else:
            fit = fit_run(cleaned, name, vehicle or Vehicle(), config.plausibility, site)
            fits[name] = with_checks(fit, follows_checks(cleaned, name, config))
    tables = {"Fit": _checks(fits, counts)}
    if (origins := origins_table(cleaned, vehicle or Vehicle(), config)).height:
        tables[ODOMETERS] = origins
    mending: dict[str, str] = {}
    for fit in fits.values():
        for into, lines in lines_of(fit.misfits).items():
            known = mending.setdefault(into, lines)
            mending[into] = known if lines in known else known + "\n" + lines
    text = "\n".join(f"# {into}\n{lines}" for into, lines in mending.items())
    if text:
        tables["Lines that mend it"] = pl.DataFrame({"toml": text.splitlines()})
    failing = fits.values() if config.ingest.plausibility == "fail" and not problems else ()
    impossible = dict.fromkeys(check.sentence for fit in failing for check in fit.impossible)
    return FitReport(tables, problems + tuple(impossible), mending)


def _in_order(run: RunLog) -> RunLog:
    streams: tuple[Stream, ...] = ("gnss", "odometer", "reference", "balise_reads")
    return run.with_streams(**{name: frame.sort("t") for name in streams if (frame := run.stream(name)) is not None})


def _checks(fits: dict[str, Fit], counts: CleanCounts) -> pl.DataFrame:
    columns = ("solution", "check", "state", "found", "cause")
    rows = [
        (name, check.what, check.state.value, check.found, check.cause)
        for name, fit in fits.items()
        for check in fit.checks
    ]
    rows += [
        (
            name,
            "placeholders",
            FitState.MISFIT.value,
            f"{counted.placeholders} taken as no fix",
            "0/0 or a default place",
        )
        for name, counted in counts.solutions.items()
        if counted.placeholders
    ]
    rows += [
        (
            name,
            "repeated positions",
            FitState.MISFIT.value,
            f"{counted.held} rows repeat the position before",
            "logged at a higher rate than the receiver's: left out",
        )
        for name, counted in counts.solutions.items()
        if counted.held
    ]
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.String), orient="row")
