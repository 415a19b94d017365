"""What was converted put into a run: under a solution's name, as its reference, beside what the run has already."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import polars as pl

from schemas.config import FixSigma
from schemas.enums import Fix
from schemas.errors import InputError, UsageError
from schemas.frozen import frozen
from schemas.run import STREAMS, RunLog, Stream

Streams = dict[Stream, pl.DataFrame]
BY_SOLUTION: tuple[Stream, ...] = ("gnss", "satellites")


@frozen
class Purpose:
    """What positions of the logs are for: a solution by its name, or the reference of the run."""

    solution: str | None = None
    stream: Literal["gnss", "reference"] = "gnss"


def assign_purpose(streams: Streams, purpose: Purpose, sigmas: FixSigma) -> Streams:
    """The streams as they are meant; raises `UsageError` where one name would cover several receivers."""
    if purpose.solution is not None and not purpose.solution.strip():
        raise UsageError("is empty", place="--solution", expected="a name for the receiver")
    if purpose.stream == "reference":
        return {name: frame for name, frame in streams.items() if name not in BY_SOLUTION} | _as_reference(
            streams, purpose, sigmas
        )
    if purpose.solution is None or "gnss" not in streams:
        return streams
    names = streams["gnss"]["solution"].unique().sort().to_list()
    if len(names) > 1:
        raise UsageError(
            "several solutions cannot have one name",
            place="--solution",
            found=", ".join(names),
            expected="logs of one receiver",
            remedy="Choose its topic in --config, or leave --solution out.",
        )
    named = {
        name: frame.with_columns(solution=pl.lit(purpose.solution))
        for name, frame in streams.items()
        if name in BY_SOLUTION
    }
    return streams | named


def _as_reference(streams: Streams, purpose: Purpose, sigmas: FixSigma) -> Streams:
    """The positions as the stream `reference`; a receiver that states no accuracy has that of its kind of fix."""
    if "gnss" not in streams:
        return {}
    fixes = (
        streams["gnss"]
        .filter(pl.col("fix").cast(pl.String) != Fix.NONE.value)
        .drop_nulls(["latitude_deg", "longitude_deg"])
    )
    names = fixes["solution"].unique().sort().to_list()
    if len(names) > 1 and purpose.solution is None:
        raise UsageError(
            "several solutions cannot be one reference", place="--stream reference", found=", ".join(names)
        )
    by_fix = {fix.value: sigmas.horizontal_m(fix) for fix in Fix}
    table = pl.col("fix").cast(pl.String).replace_strict(by_fix, return_dtype=pl.Float64)
    mean = (pl.col("cov_ee_m2") + pl.col("cov_nn_m2")) / 2
    half = (pl.col("cov_ee_m2") - pl.col("cov_nn_m2")) / 2
    stated = (mean + (half**2 + pl.col("cov_en_m2") ** 2).sqrt()).sqrt()  # of the worst direction
    columns = ("t", "latitude_deg", "longitude_deg", "height_m")
    return {"reference": fixes.select(*columns, sigma_m=pl.coalesce(stated, table))}


def add_streams(run: RunLog, streams: Streams, force: bool, place: Path) -> RunLog:
    """The run with these streams as well. `force`: in place of those that it has.

    Raises `UsageError` where it has one of them already, `InputError` where they are of another time.
    """
    _refuse_partial_run(run, place)
    merged: Streams = {}
    for name in STREAMS:
        new = streams.get(name)
        old = run.stream(name)
        if new is None:
            continue
        _refuse_other_times(run, name, new, place)
        merged[name] = new if old is None else _add_rows(name, old, new, force, place)
    return run.with_streams(**merged)


def _add_rows(name: Stream, old: pl.DataFrame, new: pl.DataFrame, force: bool, place: Path) -> pl.DataFrame:
    """Rows of a stream with those to add; of a solution there already only if forced."""
    by_solution = name in BY_SOLUTION
    shared = sorted(set(old["solution"]) & set(new["solution"])) if by_solution else [name]
    if shared and not force:
        raise UsageError(
            f"has {'the solution ' if by_solution else 'a stream '}{', '.join(shared)} already",
            place=str(place),
            found=f"{old.height} rows of {name}",
            remedy=("Name the receiver by --solution, or replace" if by_solution else "Replace") + " it with --force.",
        )
    return pl.concat([old.filter(~pl.col("solution").is_in(shared)), new]) if by_solution else new


def _refuse_other_times(run: RunLog, name: Stream, new: pl.DataFrame, place: Path) -> None:
    """Refuse positions of a time that does not overlap the run."""
    run_t = run.gnss["t"].drop_nulls()
    new_t = new.to_series(0).drop_nulls()
    if len(run_t) and len(new_t) and (new_t.max() < run_t.min() or new_t.min() > run_t.max()):  # type: ignore[operator]
        raise InputError(
            f"is of another time than the {name} to add",
            place=str(place),
            found=f"{name} from {new_t.min()!s} to {new_t.max()!s}",
            expected=f"times between {run_t.min()!s} and {run_t.max()!s}",
            remedy="Check the date and the time scale of the log, or name another run.",
        )


def _refuse_partial_run(run: RunLog, place: Path) -> None:
    """Refuse a run of which reading left something out: written anew with all its streams, that would be gone."""
    lost = run.notes.skipped_topics
    if lost:
        raise UsageError(
            "would lose what is no stream",
            place=str(place),
            found=", ".join(lost[:5]),
            expected="a run that `balise convert` wrote",
            remedy="Convert it into a new run together with the logs: balise convert LOG.mcap OTHER --out RUN.",
        )
