"""What the reader of a `runs` row should know beside its figures: notes, and what makes each of them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime

import polars as pl

from pipeline.stages.epochs.clock import Clock, met
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.lds.run import LdsResult
from pipeline.stages.matching import Match
from pipeline.stages.matching.fixes import contradictory_covariances
from pipeline.stages.monitors.axis import most_scatter_m
from pipeline.stages.odometry import Odometry
from pipeline.stages.ride import Ride
from pipeline.stages.run_row.lost_time import LostTime
from pipeline.stages.run_row.noise import widened_by_noise
from schemas.arrays import NS_PER_S, times_ns
from schemas.config import Configuration
from schemas.enums import NO_RELINK, BaliseKind, Evidence, LostTo, Note, NotEvaluated, PassageStatus, VehicleFigures
from schemas.run import IngestNotes, RunLog
from schemas.words import Remark, noise_words, remarks, say

# How much a note says, no figure: so many names stand in one, and neither a scatter of less than the positions
# themselves have nor thresholds wider by less than this are worth a word.
_NAMED = 5
_WORTH_M = 0.1
_WORTH_RATIO = 1.05
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
    config = prepared.config
    counts = prepared.counts.solutions[ride.solution.name]
    telegrams = sorted(set(ride.lds.unknown_reads["balise_id"].to_list()))
    reverses = ride.match.odometer_sign < 0 and prepared.vehicle.gnss_antenna_ahead_m
    return remarks(
        {
            Note.FAULTS_INJECTED: "" if run.faults is None else ", ".join(sorted(set(run.faults["kind"]))),
            Note.BALISES_OFF: _few(prepared.site.balises_off()),
            Note.FAR_OFF: counts.far_off,
            Note.PLACEHOLDERS: counts.placeholders,
            Note.CONTRADICTING: counts.contradicting,
            **_extents(run),
            **_of_odometer(prepared.odometry, config.align.straight_s),
            Note.ODOMETER_REVERSED: reverses,
            Note.COVARIANCE: contradictory_covariances(ride.solution.fixes),
            Note.AMBIGUOUS: _ambiguous(ride.match),
            Note.UNLINKED: _unlinked(ride.lds),
            Note.UNKNOWN_TELEGRAMS: ", ".join(telegrams),
            **_scatter(ride.aligned, config),
            Note.READS_DISPUTED: evidence.disputed,
            Note.READS_UNREACHABLE: evidence.unreachable,
        }
    )


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _extents(run: RunLog) -> dict[Note, object]:
    """Where GNSS and odometer do not cover the same time."""
    if run.odometer is None:
        return {}
    (gnss_begin, gnss_end), (begin, end) = (times_ns(stream)[[0, -1]].tolist() for stream in (run.gnss, run.odometer))
    return {
        Note.ODOMETER_ENDS_FIRST: gnss_end - end > NS_PER_S,
        Note.ODOMETER_BEGINS_LATE: begin - gnss_begin > NS_PER_S,
        Note.GNSS_ENDS_FIRST: end - gnss_end > NS_PER_S,
        Note.GNSS_BEGINS_LATE: gnss_begin - begin > NS_PER_S,
    }


def _of_odometer(odometry: Odometry | None, straight_s: float) -> dict[Note, object]:
    """What the odometer's rows cannot tell."""
    if odometry is None:
        return {}
    first = "".join(f"{datetime.fromtimestamp(t_ns // NS_PER_S, UTC):%H:%M:%S}" for t_ns in odometry.leaps_ns[:1])
    return {
        Note.ODOMETER_LEAPS: (len(odometry.leaps_ns), first) if first else None,
        Note.ODOMETER_SLOW: odometry.period_s if odometry.period_s > straight_s else None,
    }


def _ambiguous(match: Match) -> str:
    """Parts of the run where another path is nearly as likely."""
    return ", ".join(say("ambiguity", "stretch", **row) for row in match.ambiguous.iter_rows(named=True))


def _unlinked(lds: LdsResult) -> tuple[int, str] | None:
    """How many positions after outages could not be re-linked, and why not."""
    reasons = lds.epochs["link_distance_reason"].drop_nulls()
    not_relinked = reasons.filter(reasons.is_in([reason.value for reason in NO_RELINK]))
    return (not_relinked.len(), ", ".join(sorted(set(not_relinked)))) if not_relinked.len() else None


def _scatter(aligned: pl.DataFrame, config: Configuration) -> dict[Note, object]:
    """What the recorder's digits and the odometer's rows add to the thresholds, where that is much."""
    most_m = most_scatter_m(config)
    digits = pl.max_horizontal(pl.col(r"^digits_(along|cross|up)_m$").max())
    rows_m, digits_m = aligned.select(pl.max("odometer_rows_m").fill_null(0.0), digits.fill_null(0.0)).row(0)
    return {
        Note.ROWS_SCATTER: rows_m if _WORTH_M < rows_m < most_m else None,
        Note.ROWS_SCATTER_TOO_MUCH: most_m if rows_m > _WORTH_M and rows_m >= most_m else None,
        Note.DIGITS: digits_m if digits_m > _WORTH_M else None,
    }


def judged_notes(
    evidence: Evidence | None,
    share_unknown: float | None,
    vehicle: VehicleFigures,
    odometer_contradicted: int,
) -> list[Remark]:
    """What stands behind the judgements of one solution (DOMAIN sections 5.1 and 5.4).

    `share_unknown`: where that keeps the run from being proved.
    """
    return remarks(
        {
            Note.NO_EVIDENCE: evidence is None,
            Note.EVIDENCE_BALISE: evidence is Evidence.BALISE,
            Note.EVIDENCE_ODOMETER: evidence is Evidence.ODOMETER,
            Note.UNKNOWN_SHARE: share_unknown,
            Note.ODOMETER_CONTRADICTED: odometer_contradicted,
            Note.LEARNED: vehicle is VehicleFigures.LEARNED,
        }
    )


def undiagnosed_notes(epochs: pl.DataFrame, passages: pl.DataFrame) -> list[Remark]:
    """Virtual balises that were accepted while no odometer could contradict the position.

    `epochs`: monitored, in order of time; `passages`: of the same solution.
    """
    accepted = (pl.col("kind") == BaliseKind.VIRTUAL.value) & (pl.col("status") == PassageStatus.ACCEPTED.value)
    offers = passages.filter(accepted).select(pl.col("t_offered").drop_nulls().sort())
    reasons = offers.join_asof(
        epochs.select("t", "along_raw_reason"), left_on="t_offered", right_on="t", strategy="forward"
    )["along_raw_reason"]
    counts = {reason: (reasons == reason.value).sum() for reason in _WITHOUT_ODOMETER}
    return [Remark(Note.UNDIAGNOSED, (count, reason.value)) for reason, count in counts.items() if count]


def in_use_notes(epochs: pl.DataFrame) -> list[Remark]:
    """Epochs in use at which no figure bounds a fault still in use; nothing where none was computed."""
    used = epochs.filter(pl.col("in_use") & pl.col("undetected_ahead_m").is_not_null())
    unbounded = used["undetected_ahead_in_use_m"].null_count()
    return remarks({Note.IN_USE_UNBOUNDED: (unbounded, used.height) if unbounded else None})


def noise_notes(epochs: pl.DataFrame, white_noise: Mapping[str, float | None], config: Configuration) -> list[Remark]:
    """By how much measured noise widens the thresholds, where that is worth a word."""
    widened = widened_by_noise(epochs, white_noise, config)
    worth = {axis: figures for axis, figures in widened.items() if figures[0] >= _WORTH_RATIO}
    return remarks({Note.WHITE_NOISE: noise_words(worth)})


def time_notes(epochs: pl.DataFrame, clock: Clock, lost: LostTime, config: Configuration) -> list[Remark]:
    """For how long nobody knows whether the train moved, and what the moving time without a valid TVB was lost to.

    `epochs`: monitored and judged, in order of time.
    """
    unknown_s = float(clock.held_s[met(epochs, pl.col("moving").is_null())].sum())
    low = lost.share is not None and 1.0 - lost.share < config.advice.low_availability
    aside = lost.causes.get(LostTo.NO_POSITION, 0.0) >= config.advice.lost_share
    poor = lost.causes.get(LostTo.CONFIDENCE, 0.0)
    aside_m = epochs.filter(~pl.col("on_track"))["cross_track_m"].abs().median()
    return remarks(
        {
            Note.MOVING_UNKNOWN: unknown_s if round(unknown_s) > 0 else None,
            Note.AVAILABLE: (1.0 - lost.share, lost.words) if low and lost.share is not None else None,
            Note.POOR_POSITIONS: poor if low and poor >= config.advice.lost_share else None,
            Note.OFF_TRACK: aside_m if low and aside else None,
        }
    )
