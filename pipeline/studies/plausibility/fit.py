"""The one fit of a run: every check of units, clocks, axes and shifts, for `inspect`, `replay`, `calibrate`."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.stages.prepare import PreparedRun
from pipeline.studies.plausibility.check import Check, FitState, not_checked
from pipeline.studies.plausibility.clocks import clock_checks
from pipeline.studies.plausibility.odometer import follows_check, odometer_checks, velocity_checks
from pipeline.studies.plausibility.places import (
    read_stamp_checks,
    reads_lag,
    reference_checks,
    reference_elsewhere,
    survey_checks,
    written_check,
)
from pipeline.studies.plausibility.recording import Recording, recording_of
from schemas.config import PlausibilityConfig, Vehicle
from schemas.enums import MisfitCause, Note
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site
from schemas.words import Remark


@frozen
class Fit:
    """All checks of one solution."""

    checks: tuple[Check, ...]

    @property
    def impossible(self) -> tuple[Check, ...]:
        """What no train can have, and a known cause explains."""
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
        return (*self.impossible, *(check for check in self.checks if check.state is FitState.MISFIT))

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
    impossible = fit_run(run, run.solutions()[0], Vehicle(), PlausibilityConfig()).impossible
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
    impossible = fit.impossible
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
