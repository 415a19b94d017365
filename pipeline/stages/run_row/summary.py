"""The `runs` row of one solution, and the notes for its reader."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock
from pipeline.stages.epochs.verdicts import NUMBER, Verdicts
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.failures import Failure, failures_of_part
from pipeline.stages.judge.judge import Judged
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.matching.epochs import count_contradictory_covariances
from pipeline.stages.monitored import MonitoredSolution
from pipeline.stages.odometry import Odometry
from pipeline.stages.prepare import Provenance
from pipeline.stages.run_row.lost_time import LostColumns, LostTime, lost_time, moving_in_use, remedies
from pipeline.stages.run_row.run_figures import (
    accuracy_figures,
    alarm_figures,
    availability_figures,
    balise_counts,
    exposure_figures,
    failure_figures,
    hazard_counts,
    proof_margin_m,
    reasons_of,
    service_level_columns,
    stanford_counts,
    stanford_counts_of_receiver,
    state_shares,
    time_in_use,
    verdict_of,
)
from schemas.arrays import NS_PER_S, ints, times_ns, truths
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.enums import (
    NO_RELINK,
    BaliseKind,
    Note,
    NotEvaluated,
    PassageStatus,
    Reason,
    RunStatus,
    VehicleFigures,
)
from schemas.frozen import frozen
from schemas.run import IngestNotes, RunLog
from schemas.tables import CONTRACT_VERSION, Runs
from schemas.words import EVIDENCE_LIMITS, Remark, notes_text, remarks, remedy_words, say

# So many names stand in one note.
_NAMED = 5
_WITHOUT_ODOMETER = (NotEvaluated.NO_ODOMETER, NotEvaluated.BEYOND_SPAN, NotEvaluated.INTERRUPTED)


def ingest_notes(ingest: IngestNotes) -> list[Remark]:
    """Notes on what reading the log showed."""
    corrected = [Remark(Note.CORRECTED, (made.stream, made.changes)) for made in ingest.corrections]
    return corrected + remarks(
        {
            Note.CHUNKS_WITHOUT_CRC: ingest.chunks_without_crc,
            Note.FILES_WITHOUT_CRC: ", ".join(ingest.files_without_crc),
            Note.TOPICS_NOT_USED: ", ".join(ingest.skipped_topics),
        }
    )


def replay_notes(monitored: MonitoredSolution, evidence: TrainEvidence) -> list[Remark]:
    """Notes on the inputs, and on what matching, alignment and the LDS made of them."""
    prepared = monitored.prepared
    run = prepared.run
    counts = prepared.counts.solutions[monitored.solution.name]
    doubtful = monitored.match.ambiguous.iter_rows(named=True)
    return remarks(
        {
            Note.FAULTS_INJECTED: "" if run.faults is None else ", ".join(sorted(set(run.faults["kind"]))),
            Note.BALISES_OFF: _listed(prepared.site.balises_off()),
            Note.FAR_OFF: counts.far_off,
            Note.PLACEHOLDERS: counts.placeholders,
            Note.HELD: counts.held,
            Note.CONTRADICTING: counts.contradicting,
            Note.SPANS_DIFFER: _span_differences_s(run),
            **_odometer_notes(prepared.odometry, prepared.config.align.straight_s),
            Note.ODOMETER_REVERSED: monitored.match.odometer_sign < 0 and prepared.vehicle.gnss_antenna_ahead_m,
            Note.COVARIANCE: count_contradictory_covariances(monitored.solution.fixes),
            Note.AMBIGUOUS: ", ".join(say("ambiguity", "stretch", **row) for row in doubtful),
            Note.OFF_NETWORK: _listed([_off_network_words(row) for row in monitored.match.off.iter_rows(named=True)]),
            Note.UNLINKED: _count_unlinked(monitored.lds.linking["link_distance"]),
            Note.UNKNOWN_TELEGRAMS: ", ".join(sorted(set(monitored.lds.unknown_reads["balise_id"]))),
            Note.READS_DISPUTED: evidence.count_disputed_reads,
            Note.READS_UNREACHABLE: evidence.count_unreachable,
        }
    )


def _off_network_words(stretch: Mapping[str, Any]) -> str:
    """One stretch off the network, with its place and how far aside."""
    side = "left" if stretch["offset_m"] > 0.0 else "right"
    return say("off_network", side, **{**stretch, "offset_m": abs(stretch["offset_m"])})


def _listed(names: list[str]) -> str:
    """The first names of a list, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _span_differences_s(run: RunLog) -> tuple[float, float] | None:
    """By how much the odometer begins and ends after the GNSS [s], where that is more than a second."""
    if run.odometer is None:
        return None
    gnss_ns, odometer_ns = (times_ns(stream)[[0, -1]] for stream in (run.gnss, run.odometer))
    begin_s, end_s = ((odometer_ns - gnss_ns) / NS_PER_S).tolist()
    return (begin_s, end_s) if max(abs(begin_s), abs(end_s)) > 1.0 else None


def _odometer_notes(odometry: Odometry | None, straight_s: float) -> dict[Note, object]:
    """Notes on what the odometer's rows cannot tell."""
    if odometry is None:
        return {}
    first = "".join(f"{datetime.fromtimestamp(t_ns // NS_PER_S, UTC):%H:%M:%S}" for t_ns in odometry.leaps_ns[:1])
    return {
        Note.ODOMETER_LEAPS: (len(odometry.leaps_ns), first) if first else None,
        Note.ODOMETER_SLOW: odometry.period_s if odometry.period_s > straight_s else None,
    }


def _count_unlinked(distance: Verdicts) -> tuple[int, str] | None:
    """How many positions after outages could not be re-linked, and why not; None where all could."""
    counts = {reason.value: int((distance.reason == NUMBER[reason]).sum()) for reason in NO_RELINK}
    why = sorted(reason for reason, count in counts.items() if count)
    return (sum(counts.values()), ", ".join(why)) if why else None


def judgement_notes(run: Mapping[str, Any]) -> list[Remark]:
    """Notes on what stands behind the judgements of a `runs` row (DOMAIN sections 5.1 and 5.4)."""
    evidence = run["evidence"]
    return remarks(
        {
            Note.NO_EVIDENCE: evidence is None,
            Note.EVIDENCE: evidence and EVIDENCE_LIMITS[evidence],
            Note.UNKNOWN_SHARE: run["share_unknown"] if Reason.UNKNOWN_IN_USE in run["reasons"] else None,
            Note.ODOMETER_CONTRADICTED: run["odometer_contradicted"],
            Note.LEARNED: run["vehicle"] is VehicleFigures.LEARNED,
        }
    )


def undiagnosed_notes(epochs: JudgedEpochs, passages: pl.DataFrame) -> list[Remark]:
    """Notes on virtual balises that were accepted while no odometer could contradict the position."""
    virtual = truths(passages["kind"] == BaliseKind.VIRTUAL.value)
    accepted = virtual & truths(passages["status"] == PassageStatus.ACCEPTED.value)
    # The first epoch at or after each offer.
    epoch = np.searchsorted(epochs.t_ns, ints(passages["t_offered"].cast(pl.Int64))[accepted])
    reasons = epochs.verdicts["along_raw"].reason[epoch[epoch < epochs.height]]
    counts = {reason: int((reasons == NUMBER[reason]).sum()) for reason in _WITHOUT_ODOMETER}
    return [Remark(Note.UNDIAGNOSED, (count, reason.value)) for reason, count in counts.items() if count]


def unbounded_notes(epochs: JudgedEpochs, undetected: pl.DataFrame) -> list[Remark]:
    """Notes on epochs in use at which no figure bounds a fault still in use.

    `undetected`: columns of `epochs`, null where nothing was computed.
    """
    ahead_m = undetected["undetected_ahead_m"]
    if ahead_m.null_count() == len(ahead_m):
        return []
    used = epochs.in_use & ahead_m.is_not_null().to_numpy()
    unbounded = int((used & undetected["undetected_ahead_in_use_m"].is_null().to_numpy()).sum())
    return remarks({Note.IN_USE_UNBOUNDED: (unbounded, int(used.sum())) if unbounded else None})


def time_notes(epochs: JudgedEpochs, clock: Clock, lost: LostTime, config: Configuration) -> list[Remark]:
    """Notes on time of unknown movement, and on what the moving time without a valid TVB was lost to."""
    unknown_s = float(clock.held_s[epochs.may_move & ~epochs.moves].sum())
    low = lost.share is not None and 1.0 - lost.share < config.advice.low_availability
    return remarks(
        {
            Note.MOVING_UNKNOWN: unknown_s if round(unknown_s) > 0 else None,
            Note.AVAILABLE: (1.0 - lost.share, lost.words) if low and lost.share is not None else None,
        }
    )


Row = dict[str, Any]


@frozen
class SolutionResults:
    """What the stages say of one solution.

    `lost`, `undetected`: of each epoch; `columns`: of `runs`, as they stand there; `reasons`: those that no figure
    holds; `anchored_ns`: first and last instant at which a read or the reference says where the train was;
    `clock_open_s`: over how long the clocks of the recorders leave the instant open.
    """

    solution: str
    lost: LostColumns
    judged: Judged
    undetected: pl.DataFrame
    columns: Mapping[str, object]
    ingest: IngestNotes = field(default_factory=IngestNotes)
    notes: Sequence[Remark] = ()
    reasons: Sequence[Reason] = ()
    anchored_ns: tuple[int, int] | None = None
    clock_open_s: float = 0.0


def summarise(results: SolutionResults, config: Configuration, provenance: Provenance) -> pl.DataFrame:
    """One row of the `runs` table.

    Args:
        results: what the stages say of one solution.
        config: the configuration; used are limits, service levels and advice.
        provenance: digests and software.

    Returns:
        One row of `schemas.tables.Runs`.

    Source:
        CONTRACT section 3; DOMAIN section 5.4.
    """
    epochs = results.judged.epochs
    clock = Clock.at(epochs.t_ns, epochs.t_ns[np.isfinite(epochs.path_m)], config)
    judged = results.judged
    lost = lost_time(epochs, results.lost, judged.alarms, config)
    row = (
        _identity_columns(results)
        | _decisive(epochs, judged.passages, judged.failures, config)
        | ({} if judged.evidence else {"hazardous_s": None, "hazardous_natural_s": None})
        | lost.columns()
        | _extent_columns(epochs, clock, results.lost)
        | availability_figures(epochs, clock, config)
        | accuracy_figures(epochs)
        | hazard_counts(judged.hazards)
        | alarm_figures(judged.alarms, epochs, judged.evidence)
        | exposure_figures(epochs)
        | state_shares(epochs)
        | stanford_counts(epochs, epochs.confidence_m, config.lds.ci_limit_m)
        | stanford_counts_of_receiver(epochs, config.lds.ci_limit_m)
        | _provenance_columns(provenance)
    )
    row |= _part_columns(results, row, config) | service_level_columns(row, config) | _verdict_columns(row, config)
    stated = bool(np.isfinite(epochs.survey_sigma_m).any())
    clock_open_m = results.clock_open_s * float(np.abs(np.nan_to_num(epochs.speed_mps)).max(initial=0.0))
    cures = remedies(row, lost, moving_in_use(epochs, float(results.lost.moving_s.sum())), stated, config, clock_open_m)
    noted = (
        *ingest_notes(results.ingest),
        *results.notes,
        *judgement_notes(row),
        *undiagnosed_notes(epochs, judged.passages),
        *unbounded_notes(epochs, results.undetected),
        *time_notes(epochs, clock, lost, config),
        *(Remark(Note.REMEDY, (remedy_words(cure, gain),)) for cure, gain in cures.items()),
    )
    advice = {"remedies": list(cures), "remedies_gain": list(cures.values())}
    return _row_as_table(row | advice | {"notes": notes_text(noted)})


def _identity_columns(results: SolutionResults) -> Row:
    """Columns of which solution it is, its status, evidence and distance."""
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


def _decisive(epochs: JudgedEpochs, passages: pl.DataFrame, failures: Sequence[Failure], config: Configuration) -> Row:
    """The columns that decide the verdict of a run, or of a part of it (`reasons_of`)."""
    return {
        **time_in_use(epochs, config.lds.recovery_s),
        **balise_counts(passages),
        **failure_figures(failures),
        "proof_margin_m": proof_margin_m(epochs, passages),
    }


def _verdict_columns(row: Row, config: Configuration) -> Row:
    """Columns of verdict and reasons."""
    reasons = reasons_of(row, config.budget_s, config.hazards)
    return {"verdict": verdict_of(reasons), "reasons": reasons}


def _part_columns(results: SolutionResults, row: Row, config: Configuration) -> Row:
    """Columns of the verdict from the first to the last anchor, where the run goes on beyond them."""
    if results.anchored_ns is None:
        return {}
    from_ns, to_ns = results.anchored_ns
    epochs = results.judged.epochs
    inside = (epochs.at_ns >= from_ns) & (epochs.at_ns <= to_ns)
    whole_s = float(pl.Series(epochs.counted_s[epochs.may_move]).sum())
    share = float(pl.Series(epochs.counted_s[epochs.may_move & inside]).sum()) / whole_s if whole_s else 0.0
    if not 0.0 < share < 1.0:
        return {}
    rows = np.flatnonzero(inside)
    part = epochs.where(rows)
    of_part = (results.judged.offers.epoch >= rows[0]) & (results.judged.offers.epoch <= rows[-1])
    offers = results.judged.offers.where(np.flatnonzero(of_part))
    passages = results.judged.passages.filter(pl.col("crossing_id").is_in(offers.crossing_id.tolist()))
    decisive = _decisive(part, passages, failures_of_part(part, offers, config), config)
    verdict = _verdict_columns(row | decisive | {"duration_s": (to_ns - from_ns) / NS_PER_S}, config)["verdict"]
    return {"part_verdict": verdict, "part_from": from_ns, "part_to": to_ns, "part_share": share}


def failed_row(error: str, provenance: Provenance, solution: str = "") -> pl.DataFrame:
    """The `runs` row of a run that could not be replayed: counts are zero, the rest is not known."""
    columns = Runs.columns().items()
    zeros: Row = {name: 0 for name, column in columns if column.dtype == pl.Int64 and not column.nullable}
    return _row_as_table(
        zeros | {"solution": solution, "status": RunStatus.FAILED, "error": error} | _provenance_columns(provenance)
    )


def _row_as_table(row: Mapping[str, object]) -> pl.DataFrame:
    """The row as a table, where nothing is NaN or infinite."""
    schema = dtypes(Runs)
    if strange := row.keys() - schema.keys():
        raise ValueError(f"table Runs: the contract has no column {', '.join(sorted(strange))}")
    unknown = {name for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
    values = {name: None if name in unknown else row.get(name) for name in schema}
    # By rows: a table made of lists by column infers each column on its own, which takes five times as long.
    return pl.DataFrame([values], schema=schema)


def _extent_columns(epochs: JudgedEpochs, clock: Clock, lost: LostColumns) -> Row:
    """Columns of begin, end, duration, moving time and epochs."""
    begin_ns, end_ns = epochs.t_ns[[0, -1]].tolist() if epochs.height else (None, None)
    return {
        "t_start": begin_ns,
        "t_end": end_ns,
        "duration_s": clock.duration_s,
        "moving_s": float(pl.Series(lost.moving_s).sum()) if epochs.height else None,
        "epochs": epochs.height,
        "gnss_rate_hz": 1.0 / clock.period_s if clock.period_s else None,
    }


def _provenance_columns(provenance: Provenance) -> Row:
    """Columns of the inputs, settings and software."""
    calibrated_by = list(provenance.calibrated_by)
    return {**vars(provenance), "calibrated_by": calibrated_by, "contract": CONTRACT_VERSION}
