"""What `balise inspect` and `balise convert` say of how a run fits: checks, and the lines that mend it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field

import numpy as np
import polars as pl

from pipeline.stages.clean.clean import CleanCounts, clean, require_one_journey
from pipeline.stages.judge.epochs import under_injection
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.studies.plausibility.causes import explain_accuracy
from pipeline.studies.plausibility.check import Cause, Check, FitState
from pipeline.studies.plausibility.fit import Fit, clock_advice, fit_run, lines_of, with_checks
from pipeline.studies.plausibility.odometer import follows_checks, origins_table, undeclared
from schemas.arrays import Bools, Floats
from schemas.config import Configuration, Vehicle
from schemas.enums import MisfitCause
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site, Stream
from schemas.words import say

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
    impossible = dict.fromkeys(check.sentence for fit in failing for check in fit.impossible)
    return FitReport(tables, problems + tuple(impossible), mending)


def _in_order(run: RunLog) -> RunLog:
    """The run with its streams sorted by time, for a run that `clean` refuses."""
    streams: tuple[Stream, ...] = ("gnss", "odometer", "reference", "balise_reads")
    return run.with_streams(**{name: frame.sort("t") for name in streams if (frame := run.stream(name)) is not None})


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
    counted = ~under_injection(epochs.t_ns, faults, config.lds.recovery_s) & ~epochs.negated
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
