"""Where the odometers of a run come from: as declared, and whether one follows the positions all the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import polars as pl

from pipeline.stages.follows import Follows, follows_positions
from pipeline.stages.odometry.origin import declared_origin
from pipeline.studies.plausibility.check import Cause, Check, FitState, fits, not_checked
from schemas.config import Configuration, EvidenceConfig, Vehicle
from schemas.enums import MisfitCause, Origin
from schemas.run import RunLog
from schemas.words import say

COLUMNS = ("sensor", "origin", "declared_by", "what_it_is_good_for")


def follows_check(sensor: str, found: Follows, config: EvidenceConfig) -> Check:
    """Whether the steps of an odometer are those of the positions; no verdict hangs on these words."""
    what = say("odometers", "check", sensor)
    if found.found(config):
        by_steps = found.ratio is not None and found.ratio < config.follows_limit
        words = say("odometers", "copied_noise", found.ratio, config.follows_limit) if by_steps else ""
        words = words or say("odometers", "copied_stand")
        return Check(what, FitState.MISFIT, words, (Cause(MisfitCause.COPY),), advice=say("odometers", "advice"))
    if found.ratio is None:
        return not_checked(what, say("odometers", "too_short"))
    return fits(what, say("odometers", "own_noise", found.ratio))


def sensors_of(run: RunLog) -> list[tuple[str, pl.DataFrame]]:
    """The odometers of a cleaned run by name, that of the LDS first."""
    frames = [frame for frame in (run.odometer, *run.other_odometers) if frame is not None and frame.height]
    return [(frame["sensor"][0] if "sensor" in frame.columns else "primary", frame) for frame in frames]


def follows_checks(run: RunLog, solution: str, config: Configuration) -> list[Check]:
    """Each odometer against the positions of one solution of a cleaned run."""
    fixes = run.gnss.filter(pl.col("solution") == solution)
    return [
        follows_check(name, follows_positions(frame, fixes, config), config.evidence) for name, frame in sensors_of(run)
    ]


def origins_table(run: RunLog, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """One row per odometer of a cleaned run: where it comes from, who says so, and what to write where nobody does."""
    return pl.DataFrame(list(_rows(run, vehicle, config)), schema=dict.fromkeys(COLUMNS, pl.String), orient="row")


def _rows(run: RunLog, vehicle: Vehicle, config: Configuration) -> Iterator[tuple[str, ...]]:
    for number, (name, frame) in enumerate(sensors_of(run)):
        # The vehicle file speaks of the odometer that the LDS uses.
        of_vehicle = Vehicle() if number else vehicle
        origin = declared_origin(frame, of_vehicle)
        by_stream = declared_origin(frame, Vehicle()) is not Origin.UNKNOWN
        by = "by_stream" if by_stream else "by_nobody" if origin is Origin.UNKNOWN else "by_vehicle"
        found = [follows_positions(frame, fixes, config) for fixes in run.gnss.partition_by("solution")]
        follows = any(one.found(config.evidence) for one in found)
        yield name, origin.value, say("odometers", by), _use(origin, follows, used=not number)


def _use(origin: Origin, follows: bool, used: bool) -> str:
    if follows:
        return say("odometers", "follows")
    if origin.independent:
        return say("odometers", "independent")
    if origin is Origin.UNKNOWN:
        return say("odometers", "unknown", say("odometers", "line_used" if used else "line_other"))
    return say("odometers", "of_gnss")


def undeclared(table: pl.DataFrame) -> Sequence[str]:
    """The same as sentences, of odometers that are not declared to be independent, or are not."""
    rows = table.filter(pl.col("what_it_is_good_for") != say("odometers", "independent"))
    return [
        say("odometers", "sentence", row["sensor"], say("origins", row["origin"]), row["what_it_is_good_for"])
        for row in rows.iter_rows(named=True)
    ]
