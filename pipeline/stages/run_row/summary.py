"""The `runs` row: what one solution of one run comes to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock
from pipeline.stages.judge.failures import failures_within
from pipeline.stages.judge.judge import Judged
from pipeline.stages.provenance import Provenance
from pipeline.stages.run_row import notes
from pipeline.stages.run_row import run_figures as figures
from pipeline.stages.run_row.lost_time import LostColumns, lost_time
from pipeline.stages.run_row.remedies import remedies, time_in_use
from pipeline.stages.run_row.verdict import reasons_of, verdict_of
from schemas.arrays import NS_PER_S
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.enums import Note, Reason, RunStatus
from schemas.frozen import frozen
from schemas.run import IngestNotes
from schemas.stages import EpochFigures
from schemas.tables import CONTRACT_VERSION, Runs
from schemas.words import Remark, notes_text, remedy_words

Row = dict[str, Any]


@frozen
class SolutionResults:
    """What the stages say of one solution; `lost`: of each of `epochs`, `columns` of `runs` as they stand there.

    `reasons`: those that no figure holds; `anchored_ns`: first and last instant at which a read or the reference says
    where the train was; `clock_open_s`: over how long the clocks of the recorders leave the instant open.
    """

    solution: str
    epochs: EpochFigures
    lost: LostColumns
    judged: Judged
    columns: Mapping[str, object]
    ingest: IngestNotes = field(default_factory=IngestNotes)
    notes: Sequence[Remark] = ()
    reasons: Sequence[Reason] = ()
    anchored_ns: tuple[int, int] | None = None
    clock_open_s: float = 0.0


def summarise(results: SolutionResults, config: Configuration, provenance: Provenance) -> pl.DataFrame:
    """One row of the `runs` table (CONTRACT section 3)."""
    epochs = results.epochs
    clock = Clock.at(epochs.t_ns, epochs.t_ns[np.isfinite(epochs.path_m)], config)
    judged = results.judged
    lost = lost_time(epochs, results.lost, judged.alarms, config)
    row = (
        _identity(results)
        | _decisive(epochs, judged.passages, judged.failures, config)
        | ({} if judged.evidence else {"hazardous_s": None, "hazardous_natural_s": None})
        | lost.columns()
        | _extent(epochs, clock, results.lost)
        | figures.positions(epochs, clock, config)
        | figures.accuracy(epochs)
        | figures.hazard_counts(judged.hazards)
        | figures.alarm_counts(judged.alarms, epochs, judged.evidence)
        | figures.exposure(epochs)
        | figures.state_shares(epochs)
        | figures.stanford_counts(epochs, epochs.confidence_m, config.lds.ci_limit_m)
        | figures.stanford_of_receiver(epochs, config.lds.ci_limit_m)
        | _provenance(provenance)
    )
    row |= _part(results, row, config) | figures.service_levels(row, config) | _verdict(row, config)
    stated = bool(epochs.table["survey_sigma_m"].count())
    clock_open_m = results.clock_open_s * float(np.abs(np.nan_to_num(epochs.speed_mps)).max(initial=0.0))
    cures = remedies(row, lost, time_in_use(epochs, float(results.lost.moving_s.sum())), stated, config, clock_open_m)
    noted = (
        *notes.ingest_notes(results.ingest),
        *results.notes,
        *notes.judged_notes(row),
        *notes.undiagnosed_notes(epochs, judged.passages),
        *notes.in_use_notes(epochs),
        *notes.time_notes(epochs, clock, lost, config),
        *(Remark(Note.REMEDY, (remedy_words(cure, gain),)) for cure, gain in cures.items()),
    )
    advice = {"remedies": list(cures), "remedies_gain": list(cures.values())}
    return _frame(row | advice | {"notes": notes_text(noted)})


def _identity(results: SolutionResults) -> Row:
    ingest = results.ingest
    damaged = ingest.partial_until_ns is not None or ingest.damage is not None
    return {
        **results.columns,
        "solution": results.solution,
        "status": RunStatus.PARTIAL if damaged else RunStatus.OK,
        "error": ingest.damage,
        "partial_until": ingest.partial_until_ns,
        "evidence": results.judged.evidence,
        "distance_m": results.judged.distance_m,
        "reasons": results.reasons,
    }


def _decisive(epochs: EpochFigures, passages: pl.DataFrame, failures: pl.DataFrame, config: Configuration) -> Row:
    """What decides the verdict of a run, or of a part of it (`reasons_of`)."""
    return {
        **figures.time_in_use(epochs, config.lds.recovery_s),
        **figures.balise_counts(passages),
        **figures.failure_counts(failures),
        "proof_margin_m": figures.proof_margin_m(epochs, passages, config.hazards.limits.failure_m),
    }


def _verdict(row: Row, config: Configuration) -> Row:
    reasons = reasons_of(row, config.budget_s, config.hazards.undiagnosed_share)
    return {"verdict": verdict_of(reasons), "reasons": reasons}


def _part(results: SolutionResults, row: Row, config: Configuration) -> Row:
    """The verdict of the part from the first to the last anchor, where the run goes on beyond it."""
    if results.anchored_ns is None:
        return {}
    from_ns, to_ns = results.anchored_ns
    epochs = results.epochs
    inside = (epochs.at_ns >= from_ns) & (epochs.at_ns <= to_ns)
    whole_s = float(pl.Series(epochs.counted_s[epochs.may_move]).sum())
    share = float(pl.Series(epochs.counted_s[epochs.may_move & inside]).sum()) / whole_s if whole_s else 0.0
    if not 0.0 < share < 1.0:
        return {}
    part = epochs.where(inside)
    rows = np.flatnonzero(inside)
    offers = results.judged.offers.filter(pl.col("epoch").is_between(int(rows[0]), int(rows[-1])))
    passages = results.judged.passages.join(offers.select("crossing_id"), on="crossing_id", how="semi")
    decisive = _decisive(part, passages, failures_within(part.table, offers, config), config)
    verdict = _verdict(row | decisive | {"duration_s": (to_ns - from_ns) / NS_PER_S}, config)["verdict"]
    return {"part_verdict": verdict, "part_from": from_ns, "part_to": to_ns, "part_share": share}


def failed_row(error: str, provenance: Provenance, solution: str = "") -> pl.DataFrame:
    """The `runs` row of a run that could not be replayed: counts are zero, the rest is not known."""
    columns = Runs.columns().items()
    zeros: Row = {name: 0 for name, column in columns if column.dtype == pl.Int64 and not column.nullable}
    return _frame(zeros | {"solution": solution, "status": RunStatus.FAILED, "error": error} | _provenance(provenance))


def _frame(row: Mapping[str, object]) -> pl.DataFrame:
    """The row as a table, where nothing is NaN or infinite."""
    schema = dtypes(Runs)
    unknown = {name for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
    values = {name: None if name in unknown else row.get(name) for name in schema}
    # By rows: a table made of lists by column infers each column on its own, which takes five times as long.
    return pl.DataFrame([values], schema=schema)


def _extent(epochs: EpochFigures, clock: Clock, lost: LostColumns) -> Row:
    begin_ns, end_ns = epochs.t_ns[[0, -1]].tolist() if epochs.height else (None, None)
    return {
        "t_start": begin_ns,
        "t_end": end_ns,
        "duration_s": clock.duration_s,
        "moving_s": float(pl.Series(lost.moving_s).sum()) if epochs.height else None,
        "epochs": epochs.height,
        "gnss_rate_hz": 1.0 / clock.period_s if clock.period_s else None,
    }


def _provenance(provenance: Provenance) -> Row:
    calibrated_by = list(provenance.calibrated_by)
    return {**vars(provenance), "calibrated_by": calibrated_by, "contract": CONTRACT_VERSION}
