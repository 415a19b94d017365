"""The one fit of a run: every check of units, clocks, axes and shifts, for `inspect`, `replay`, `calibrate`.

And what `balise inspect` and `balise convert` say of it: the checks as a table, and the lines that mend the run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field

import numpy as np
import polars as pl

from pipeline.stages.clean.clean import CleanCounts, clean, require_one_journey
from pipeline.stages.judge.epochs import injected_at
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.prepare import PreparedRun
from pipeline.studies.plausibility.check import Cause, Check, FitState, explain_accuracy, not_checked
from pipeline.studies.plausibility.clocks import clock_checks
from pipeline.studies.plausibility.odometer import (
    follows_check,
    follows_checks,
    odometer_checks,
    origins_table,
    undeclared,
    velocity_checks,
)
from pipeline.studies.plausibility.places import (
    read_stamp_checks,
    reads_lag,
    reference_checks,
    reference_elsewhere,
    survey_checks,
    written_check,
)
from pipeline.studies.plausibility.recording import Recording, recording_of
from schemas.arrays import Bools, Floats
from schemas.config import Configuration, PlausibilityConfig, Vehicle
from schemas.enums import MisfitCause, Note
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RECORDED_STREAMS, RunLog, Site
from schemas.words import Remark, say


@frozen
class Fit:
    """All checks of one solution."""

    checks: tuple[Check, ...]

    @property
    def impossible_checks(self) -> tuple[Check, ...]:
        """The checks whose finding no train can have driven, and a known cause explains."""
        return tuple(check for check in self.checks if check.state is FitState.IMPOSSIBLE)

    @property
    def unproving(self) -> tuple[Check, ...]:
        """Evidence that contradicts itself, or is none: nothing is proved by it (DOMAIN section 5.4)."""
        return tuple(check for check in self.checks if check.of_evidence)

    def leaps_s(self, in_step: bool) -> tuple[int, ...]:
        """Whole leap seconds by which the clock of the positions may be off against the judge's recorders.

        `in_step`: these and the odometer have one clock, by their movements. If that is the clock of the positions too,
        as their movements show, a lag of their places is an error along the track: 60 m at 20 m/s look like three
        seconds.
        """
        if in_step and any(check.in_time == "odometer" for check in self.checks):
            return ()
        return tuple(sorted({check.leap_s for check in self.misfits} - {0}))

    @property
    def misfits(self) -> tuple[Check, ...]:
        """What does not fit, the impossible first."""
        return (*self.impossible_checks, *(check for check in self.checks if check.state is FitState.MISFIT))

    @property
    def codes(self) -> list[MisfitCause]:
        """Causes of what does not fit."""
        causes = (cause for check in self.misfits for cause in check.causes)
        return [cause.code for cause in causes if isinstance(cause.code, MisfitCause)]

    @property
    def notes(self) -> list[Remark]:
        """What does not fit, for the `runs` row."""
        return [Remark(Note.MISFIT_MENDED if check.lines else Note.MISFIT, (check.sentence,)) for check in self.misfits]


def clock_advice(run: RunLog) -> str:
    """What makes recorders of different times one journey, in sentences; empty where nothing does."""
    impossible = fit_run(run, run.solutions()[0], Vehicle(), PlausibilityConfig()).impossible_checks
    return " ".join([*(f"{check.sentence}." for check in impossible), remedy_of(impossible)]).rstrip(" ")


def fit_run(run: RunLog, solution: str, vehicle: Vehicle, config: PlausibilityConfig, site: Site | None = None) -> Fit:
    """Compare the streams of a run with one solution, the site and the vehicle file where there are any.

    Args:
        run: the run, cleaned.
        solution: name of the solution.
        vehicle: what is known of the vehicle.
        config: the section `plausibility` of the configuration.
        site: the site; None: positions are not compared with the survey.

    Returns:
        The checks, in order; one that says so where hardly any position is valid.
    """
    of = recording_of(run, solution, config, vehicle, site)
    if of is None:
        return Fit((not_checked("positions", "hardly any is valid"),))
    # Positions that lie on another continent fit nothing else.
    if written := written_check(of):
        return Fit((written,))
    return Fit(tuple(_checks(of)))


def _checks(of: Recording) -> list[Check]:
    """Places, then the velocity, then the clocks, which need all of them."""
    run = of.run
    of_odometer, lags = odometer_checks(of)
    checks = survey_checks(of, of.line) if of.line is not None else []
    checks += of_odometer
    if elsewhere := reference_elsewhere(of):
        checks.append(elsewhere)
    elif run.reference is not None and run.reference.height:
        of_reference, places = reference_checks(of)
        lags.append(of_reference)
        checks += places
    if run.balise_reads is not None and run.balise_reads.height and of.site is not None:
        lags.append(reads_lag(of, run.balise_reads, of.site))
        checks += read_stamp_checks(of, run.balise_reads)
    return [*checks, *velocity_checks(of), *clock_checks(of, lags)]


def with_checks(fit: Fit, checks: Sequence[Check]) -> Fit:
    """The fit with further checks at its end."""
    return Fit((*fit.checks, *checks))


def required_fit(prepared: PreparedRun, solution: str, vehicle: Vehicle) -> Fit:
    """The fit of a solution; raises `InputError` where it has no journey, or no train can have driven it (unless the
    configuration lets that pass).
    """
    prepared.fixes(solution)
    config = prepared.config
    fit = fit_run(prepared.recorded, solution, vehicle, config.plausibility, prepared.site)
    if prepared.odometry is not None:
        sensor = config.lds.odometer_sensor
        fit = with_checks(fit, [follows_check(sensor, prepared.follows_of(solution), config.evidence)])
    impossible = fit.impossible_checks
    if not impossible or config.ingest.plausibility == "warn":
        return fit
    raise InputError(
        "does not fit: " + "; ".join(check.sentence for check in impossible),
        place=f"{prepared.run.run_id}: solution {solution!r}",
        expected="streams of one journey, in the units and times of the contract",
        remedy='To replay it all the same: [ingest] plausibility = "warn". ' + remedy_of(impossible),
    )


def lines_of(checks: Sequence[Check]) -> dict[str, str]:
    """The lines that mend these, by what to do with them."""
    files = dict.fromkeys(check.into for check in checks if check.lines)
    return {into: "\n".join(dict.fromkeys(check.lines for check in checks if check.into == into)) for into in files}


def remedy_of(checks: Sequence[Check]) -> str:
    """What mends all of these in one line: advice, then what to write into which file."""
    advice = list(dict.fromkeys(check.advice for check in checks if check.advice))
    return " ".join([*advice, *(f"{_inline(into, lines)}." for into, lines in lines_of(checks).items())])


def _inline(into: str, lines: str) -> str:
    """The same lines as they can stand on one line of a message, valid TOML all the same."""
    head, *tables = lines.split("[[ingest.correct]]\n")
    if not tables:
        return f"{into[0].upper()}{into[1:]}: {'; '.join(filter(None, head.splitlines()))}"
    entries = [f"{{ {', '.join(filter(None, table.splitlines()))} }}" for table in tables]
    file = "the configuration file (in a project, [[convert.correct]] of this run in balise.toml)"
    return f"First line of {file}: ingest.correct = [{', '.join(entries)}]"


ODOMETERS = "Odometers"
"""Title of the table that says where each odometer comes from."""


@frozen
class FitReport:
    """Tables by title, what keeps the run from being replayed, and the lines that mend it by what to do with them."""

    tables: dict[str, pl.DataFrame]
    problems: tuple[str, ...]
    mending: Mapping[str, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """The report for programs: what keeps the run from being replayed, every check, and the lines that mend it."""
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
    tables = {"Fit": _table_of_checks(fits, counts)}
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
    impossible = dict.fromkeys(check.sentence for fit in failing for check in fit.impossible_checks)
    return FitReport(tables, problems + tuple(impossible), mending)


def _in_order(run: RunLog) -> RunLog:
    """The run with its streams sorted by time, for a run that `clean` refuses."""
    streams = {name: frame.sort("t") for name in RECORDED_STREAMS if (frame := run.stream(name)) is not None}
    return run.with_streams(**streams)


def _table_of_checks(fits: dict[str, Fit], counts: CleanCounts) -> pl.DataFrame:
    """One row per check of each solution, with what cleaning left out."""
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


# Gaussian: 95 % of all errors are within so many sigmas.
_SIGMAS_95 = 1.96


def accuracy_checks(epochs: JudgedEpochs, faults: pl.DataFrame | None, config: Configuration) -> list[Check]:
    """Misfits of the stated sigma and of the receiver's HPL along the track; none where they hold, or nothing shows it.

    Epochs under an injected fault, or negated, are left out: their errors are not the receiver's.
    """
    counted = ~injected_at(epochs.t_ns, faults, config.lds.recovery_s) & ~epochs.negated
    stated_m = {"sigma": epochs.sigma_along_m, "hpl": epochs.hpl_m / config.lds.ci_factor}
    return [check for what, sigma_m in stated_m.items() for check in _check(what, sigma_m, epochs, counted, config)]


def refuted(checks: list[Check]) -> bool:
    """A stated accuracy is too small: no verdict may rest on it."""
    return any(cause.code is MisfitCause.SIGMA_TOO_SMALL for check in checks for cause in check.causes)


def _check(what: str, sigma_m: Floats, epochs: JudgedEpochs, counted: Bools, config: Configuration) -> Iterator[Check]:
    """Whether a reported uncertainty agrees with the errors found."""
    low_m, high_m = epochs.judgements.low_m, epochs.judgements.high_m
    # What it leaves possible is the worst; healthy evidence strays by a part of that.
    strays_m = config.evidence.sigma_evidence_part * 0.5 * (high_m - low_m)
    least_m = np.maximum(np.abs(epochs.error_along_m) - strays_m, 0.0)
    most_m = np.maximum(np.abs(low_m), np.abs(high_m))
    known = counted & np.isfinite(most_m + least_m + sigma_m) & (sigma_m > 0.0)
    settings = config.evidence
    if known.sum() < settings.sigma_epochs_least:
        return
    sigma_m, least_m, most_m = sigma_m[known], least_m[known], most_m[known]
    beyond = float(np.mean(least_m > config.lds.ci_factor * sigma_m))
    if beyond > settings.sigma_refuted_share:
        factor = float(np.quantile(least_m / sigma_m, 0.95)) / _SIGMAS_95
        words = say("accuracy", "beyond", beyond, config.lds.ci_factor)
        yield _misfit(what, words, MisfitCause.SIGMA_TOO_SMALL, factor, sigma_m)
    elif (most_m < sigma_m / settings.sigma_too_large).all():
        factor = float(np.quantile(most_m / sigma_m, 0.95)) / _SIGMAS_95
        words = say("accuracy", "within", settings.sigma_too_large)
        yield _misfit(what, words, MisfitCause.SIGMA_TOO_LARGE, factor, sigma_m)


def _misfit(what: str, words: str, code: MisfitCause, factor: float, sigma_m: Floats) -> Check:
    """`factor`: true over stated."""
    causes = [Cause(code, (f"{factor if factor > 1.0 else 1.0 / factor:.2g}",))]
    if (unit := explain_accuracy(factor, float(np.median(sigma_m)))) is not None:
        causes.append(unit)
    return Check(say("accuracy", what), FitState.MISFIT, words, tuple(causes), advice=say("accuracy", "advice"))
