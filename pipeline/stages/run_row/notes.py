"""What the reader of a `runs` row should know beside its figures: notes, and what makes each of them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock
from pipeline.stages.epochs.verdicts import NUMBER, Verdicts
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.matching.fixes import contradictory_covariances
from pipeline.stages.odometry import Odometry
from pipeline.stages.ride import Ride
from pipeline.stages.run_row.lost_time import LostTime
from schemas.arrays import NS_PER_S, times_ns
from schemas.config import Configuration
from schemas.enums import NO_RELINK, BaliseKind, Evidence, Note, NotEvaluated, PassageStatus, Reason, VehicleFigures
from schemas.run import IngestNotes, RunLog
from schemas.stages import EpochFigures
from schemas.words import Remark, remarks, say

# So many names stand in one note.
_NAMED = 5
_WITHOUT_ODOMETER = (NotEvaluated.NO_ODOMETER, NotEvaluated.BEYOND_SPAN, NotEvaluated.INTERRUPTED)


def ingest_notes(ingest: IngestNotes) -> list[Remark]:
    """What reading the log showed of it."""
    corrected = [Remark(Note.CORRECTED, (made.stream, made.changes)) for made in ingest.corrections]
    return corrected + remarks(
        {
            Note.CHUNKS_WITHOUT_CRC: ingest.chunks_without_crc,
            Note.FILES_WITHOUT_CRC: ", ".join(ingest.files_without_crc),
            Note.TOPICS_NOT_USED: ", ".join(ingest.skipped_topics),
        }
    )


def ride_notes(ride: Ride, evidence: TrainEvidence) -> list[Remark]:
    """What went in, and what matching, alignment and the LDS made of it."""
    prepared = ride.prepared
    run = prepared.run
    counts = prepared.counts.solutions[ride.solution.name]
    doubtful = ride.match.ambiguous.iter_rows(named=True)
    return remarks(
        {
            Note.FAULTS_INJECTED: "" if run.faults is None else ", ".join(sorted(set(run.faults["kind"]))),
            Note.BALISES_OFF: _few(prepared.site.balises_off()),
            Note.FAR_OFF: counts.far_off,
            Note.PLACEHOLDERS: counts.placeholders,
            Note.HELD: counts.held,
            Note.CONTRADICTING: counts.contradicting,
            Note.SPANS_DIFFER: _spans_differ(run),
            **_of_odometer(prepared.odometry, prepared.config.align.straight_s),
            Note.ODOMETER_REVERSED: ride.match.odometer_sign < 0 and prepared.vehicle.gnss_antenna_ahead_m,
            Note.COVARIANCE: contradictory_covariances(ride.solution.fixes),
            Note.AMBIGUOUS: ", ".join(say("ambiguity", "stretch", **row) for row in doubtful),
            Note.OFF_NETWORK: _few([_off(row) for row in ride.match.off.iter_rows(named=True)]),
            Note.UNLINKED: _unlinked(ride.lds.linking["link_distance"]),
            Note.UNKNOWN_TELEGRAMS: ", ".join(sorted(set(ride.lds.unknown_reads["balise_id"]))),
            Note.READS_DISPUTED: evidence.disputed,
            Note.READS_UNREACHABLE: evidence.unreachable,
        }
    )


def _off(stretch: Mapping[str, Any]) -> str:
    """One stretch off the network, with its place and how far aside."""
    side = "left" if stretch["offset_m"] > 0.0 else "right"
    return say("off_network", side, **{**stretch, "offset_m": abs(stretch["offset_m"])})


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _spans_differ(run: RunLog) -> tuple[float, float] | None:
    """By how much the odometer begins and ends after the GNSS [s], where that is more than a second."""
    if run.odometer is None:
        return None
    gnss_ns, odometer_ns = (times_ns(stream)[[0, -1]] for stream in (run.gnss, run.odometer))
    begin_s, end_s = ((odometer_ns - gnss_ns) / NS_PER_S).tolist()
    return (begin_s, end_s) if max(abs(begin_s), abs(end_s)) > 1.0 else None


def _of_odometer(odometry: Odometry | None, straight_s: float) -> dict[Note, object]:
    """What the odometer's rows cannot tell."""
    if odometry is None:
        return {}
    first = "".join(f"{datetime.fromtimestamp(t_ns // NS_PER_S, UTC):%H:%M:%S}" for t_ns in odometry.leaps_ns[:1])
    return {
        Note.ODOMETER_LEAPS: (len(odometry.leaps_ns), first) if first else None,
        Note.ODOMETER_SLOW: odometry.period_s if odometry.period_s > straight_s else None,
    }


def _unlinked(distance: Verdicts) -> tuple[int, str] | None:
    """How many positions after outages could not be re-linked, and why not."""
    counts = {reason.value: int((distance.reason == NUMBER[reason]).sum()) for reason in NO_RELINK}
    why = sorted(reason for reason, count in counts.items() if count)
    return (sum(counts.values()), ", ".join(why)) if why else None


def judged_notes(run: Mapping[str, Any]) -> list[Remark]:
    """What stands behind the judgements of a `runs` row (DOMAIN sections 5.1 and 5.4)."""
    evidence = run["evidence"]
    return remarks(
        {
            Note.NO_EVIDENCE: evidence is None,
            Note.EVIDENCE_BALISE: evidence is Evidence.BALISE,
            Note.EVIDENCE_ODOMETER: evidence is Evidence.ODOMETER,
            Note.UNKNOWN_SHARE: run["share_unknown"] if Reason.UNKNOWN_IN_USE in run["reasons"] else None,
            Note.ODOMETER_CONTRADICTED: run["odometer_contradicted"],
            Note.LEARNED: run["vehicle"] is VehicleFigures.LEARNED,
        }
    )


def undiagnosed_notes(epochs: EpochFigures, passages: pl.DataFrame) -> list[Remark]:
    """Virtual balises that were accepted while no odometer could contradict the position."""
    accepted = (pl.col("kind") == BaliseKind.VIRTUAL.value) & (pl.col("status") == PassageStatus.ACCEPTED.value)
    offers = passages.filter(accepted).drop_nulls("t_offered")
    # The first epoch at or after each offer.
    epoch = np.searchsorted(epochs.t_ns, times_ns(offers, "t_offered"))
    reasons = epochs.table["along_raw_reason"].gather(epoch[epoch < epochs.height])
    counts = {reason: (reasons == reason.value).sum() for reason in _WITHOUT_ODOMETER}
    return [Remark(Note.UNDIAGNOSED, (count, reason.value)) for reason, count in counts.items() if count]


def in_use_notes(epochs: EpochFigures) -> list[Remark]:
    """Epochs in use at which no figure bounds a fault still in use; nothing where none was computed."""
    used = epochs.in_use & epochs.table["undetected_ahead_m"].is_not_null().to_numpy()
    unbounded = int((used & epochs.table["undetected_ahead_in_use_m"].is_null().to_numpy()).sum())
    return remarks({Note.IN_USE_UNBOUNDED: (unbounded, int(used.sum())) if unbounded else None})


def time_notes(epochs: EpochFigures, clock: Clock, lost: LostTime, config: Configuration) -> list[Remark]:
    """For how long nobody knows whether the train moved, and what the moving time without a valid TVB was lost to."""
    unknown_s = float(clock.held_s[epochs.may_move & ~epochs.moves].sum())
    low = lost.share is not None and 1.0 - lost.share < config.advice.low_availability
    return remarks(
        {
            Note.MOVING_UNKNOWN: unknown_s if round(unknown_s) > 0 else None,
            Note.AVAILABLE: (1.0 - lost.share, lost.words) if low and lost.share is not None else None,
        }
    )
