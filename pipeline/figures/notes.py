"""What the reader of a `runs` row should know beside its figures: sentences, and what makes each of them said."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime

import polars as pl

from pipeline.alignment.align import BEYOND_SPAN, INTERRUPTED
from pipeline.epochs.clock import Clock, met
from pipeline.epochs.verdicts import NO_ODOMETER
from pipeline.evidence import Evidence as TrainEvidence
from pipeline.figures.lost_time import availability_words
from pipeline.ingest.clean import StreamCounts
from pipeline.lds.relink import UNLINKED
from pipeline.lds.run import LdsResult
from pipeline.matching import Match
from pipeline.matching.fixes import contradictory_covariances
from pipeline.monitors.axis import most_scatter_m
from pipeline.odometry import Odometry
from pipeline.plausibility.fit import Fit
from pipeline.site.checks import BALISE_PLACE
from schemas.arrays import NS_PER_S, times_ns
from schemas.config import Configuration, Vehicle
from schemas.enums import BaliseKind, Evidence, PassageStatus, VehicleFigures
from schemas.run import IngestNotes, RunLog, Site

# How much a note says, no figure: so many names stand in one, and a scatter of less than the positions themselves have
# is not worth a word.
_NAMED = 5
_WORTH_M = 0.1


def said(found: Mapping[str, object]) -> list[str]:
    """The sentences of what there is, each with its figure or names in the place of `{}`."""
    return [text.format(value) for text, value in found.items() if value]


def ingest_notes(ingest: IngestNotes) -> list[str]:
    """What reading the log found out about it."""
    remarks = said(
        {
            "{} chunks without a checksum": ingest.chunks_without_crc,
            "without checksums: {}": ", ".join(ingest.files_without_crc),
            "topics not used: {}": ", ".join(ingest.skipped_topics),
        }
    )
    return [*ingest.corrections, *remarks]


def ride_notes(
    run: RunLog,
    site: Site,
    counts: StreamCounts,
    fixes: pl.DataFrame,
    found: Match,
    aligned: pl.DataFrame,
    lds: LdsResult,
    vehicle: Vehicle,
    odometry: Odometry | None,
    fit: Fit,
    evidence: TrainEvidence,
    config: Configuration,
) -> list[str]:
    """What went in, and what matching, alignment and the LDS made of it.

    `counts`, `fixes`: the GNSS of this solution; `evidence`: what is known of where the train was.
    """
    off_the_track = [item.place.removeprefix(BALISE_PLACE) for item in site.findings if item.severity == "error"]
    telegrams = sorted(set(lds.unknown_reads["balise_id"].to_list()))
    return _misfits(fit) + said(
        {
            "faults were injected: {}": "" if run.faults is None else ", ".join(sorted(set(run.faults["kind"]))),
            "balises off their net element, so that no run passes them (`balise inspect SITE` says why): {}": _few(
                off_the_track
            ),
            "{} positions left out: their time is more than a day from the others": counts.far_off,
            "{} positions are placeholders (0/0, a default place, or before the first fix): epochs without a fix": (
                counts.placeholders
            ),
            "{} positions left out: another position with the same time lies elsewhere, and the first recorded one is "
            "used. Record two receivers of one topic as two solutions": counts.contradicting,
            **_extents(run),
            **_of_odometer(odometry, config.align.straight_s),
            "the odometer counts down at first, so the train reverses: the sign of gnss_antenna_ahead_m is changed": (
                found.odometer_sign < 0 and vehicle.gnss_antenna_ahead_m
            ),
            "cov_en_m2 is impossible with its variances at {} epochs and is not used there": contradictory_covariances(
                fixes
            ),
            "net element ambiguous: {}": _ambiguous(found),
            "after {}": _unlinked(lds),
            "telegrams read from balises that are not on the train's path: {}": ", ".join(telegrams),
            **_scatter(aligned, config),
            "balise reads contradict the reference {} times: the true position is unknown there. Check both clocks": (
                evidence.disputed
            ),
            "no train can have come from one balise read (or end of the reference) to the next {} times: the true "
            "position is unknown before, between and after them. Check the reads, and the links of the site": (
                evidence.unreachable
            ),
        }
    )


def _misfits(fit: Fit) -> list[str]:
    """What of the run does not fit, the impossible first."""
    mended = "; `balise inspect RUN --site SITE` prints the lines that correct it"
    return [f"does not fit: {check.sentence}{mended if check.lines else ''}" for check in fit.misfits]


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _extents(run: RunLog) -> dict[str, bool]:
    """Where GNSS and odometer do not cover the same time."""
    if run.odometer is None:
        return {}
    (gnss_begin, gnss_end), (begin, end) = (times_ns(stream)[[0, -1]].tolist() for stream in (run.gnss, run.odometer))
    return {
        "the odometer ends before the GNSS": gnss_end - end > NS_PER_S,
        "the odometer begins after the GNSS": begin - gnss_begin > NS_PER_S,
        "the GNSS ends before the odometer": end - gnss_end > NS_PER_S,
        "the GNSS begins after the odometer": gnss_begin - begin > NS_PER_S,
    }


def _of_odometer(odometry: Odometry | None, straight_s: float) -> dict[str, object]:
    """What the odometer's rows cannot tell."""
    if odometry is None:
        return {}
    first = "".join(f"{datetime.fromtimestamp(t_ns // NS_PER_S, UTC):%H:%M:%S}" for t_ns in odometry.leaps_ns[:1])
    return {
        f"the odometer's distance jumps by more than a train can drive, {{}} times, first at {first}: its speed is "
        "used there, and without an agreeing speed the distance is unknown": len(odometry.leaps_ns),
        "the odometer has only one row every {:.3g} s: where the speed changes between rows, alarms along the track "
        "may come from the odometer": odometry.period_s if odometry.period_s > straight_s else None,
    }


def _ambiguous(found: Match) -> str:
    """Parts of the run where another path is nearly as likely."""
    clock = "%H:%M:%S"
    columns = ("netelement_id", "other_netelement_id", "t_start", "t_end", "probability", "told_by")
    return ", ".join(
        f"{one} ({probability:.2f}) or {other} from {start:{clock}} to {end:{clock}} (told apart by {told_by})"
        for one, other, start, end, probability, told_by in found.ambiguous.select(columns).iter_rows()
    )


def _unlinked(lds: LdsResult) -> str:
    reasons = lds.epochs["link_distance_reason"].drop_nulls()
    given = reasons.filter(reasons.str.starts_with(UNLINKED))
    why = ", ".join(sorted(reason.removeprefix(UNLINKED) for reason in set(given)))
    return f"{given.len()} outages the position could not be re-linked and was not used: {why}" if why else ""


def _scatter(aligned: pl.DataFrame, config: Configuration) -> dict[str, object]:
    """What the recorder's digits and the odometer's rows add to the thresholds, where that is much."""
    most_m, digits = most_scatter_m(config), pl.max_horizontal(pl.col(r"^digits_(along|cross|up)_m$").max())
    rows_m, digits_m = aligned.select(pl.max("odometer_rows_m").fill_null(0.0), digits.fill_null(0.0)).row(0)
    coarse = "(coarse counter, or times stamped on receipt)"
    return {
        f"the odometer's rows scatter by {{:.2f}} m {coarse}: the thresholds along the track allow for it": (
            rows_m if _WORTH_M < rows_m < most_m else None
        ),
        f"the odometer's rows scatter by more than {{:.1f}} m {coarse}: thresholds wide enough for that would miss "
        "failures, so alarms along the track may come from the odometer": (
            most_m if rows_m > _WORTH_M and rows_m >= most_m else None
        ),
        "positions are rounded so much that they scatter by {:.2f} m (few decimals, or single precision): the "
        "thresholds allow for it": digits_m if digits_m > _WORTH_M else None,
    }


def judged_notes(
    evidence: Evidence | None,
    share_unknown: float | None,
    vehicle: VehicleFigures,
    odometer_contradicted: int,
    config: Configuration,
) -> list[str]:
    """What stands behind the judgements of one solution, and what would prove more (DOMAIN sections 5.1 and 5.4).

    `share_unknown`: where that keeps the run from being proved.
    """
    # On one side of an anchor the odometer's confidence reaches the failure limit there (SUBSET-041 5.3.1.1).
    end_m = (config.hazards.failure_limit_m - config.lds.odometer_fixed_m) / config.lds.odometer_share
    return said(
        {
            "no evidence: no stream can show whether a position was right or wrong": evidence is None,
            "evidence balise: the true position comes from balise reads, and from the odometer between them. Slip, "
            "slide and scale errors that cancel each other between two reads are not seen, and after the last read the "
            "odometer is trusted to 5 m + 5 %": evidence is Evidence.BALISE,
            "evidence odometer: the distance from the last accepted balise can show that a position was wrong, never "
            "that it was right": evidence is Evidence.ODOMETER,
            "{:.1%} of the moving time in use could not be judged: to judge more, record a reference, or balise reads "
            f"every 2 km and within {end_m:.0f} m of both ends of the run, and give the odometer's scale in the "
            "vehicle file": share_unknown,
            "the odometer's distance does not fit {} gaps between known places: odometer or vehicle file is wrong "
            "there": odometer_contradicted,
            "no odometer scale in a vehicle file: scale and latency are learned in the run and widen the thresholds, "
            "so that a drift at its beginning may not be seen": vehicle is VehicleFigures.LEARNED,
        }
    )


def undiagnosed_notes(epochs: pl.DataFrame, passages: pl.DataFrame) -> list[str]:
    """Virtual balises that were accepted while no odometer could contradict the position.

    `epochs`: monitored, in order of time; `passages`: of the same solution.
    """
    accepted = (pl.col("kind") == BaliseKind.VIRTUAL.value) & (pl.col("status") == PassageStatus.ACCEPTED.value)
    offers = passages.filter(accepted).select(pl.col("t_offered").drop_nulls().sort())
    reasons = offers.join_asof(
        epochs.select("t", "along_raw_reason"), left_on="t_offered", right_on="t", strategy="forward"
    )["along_raw_reason"]
    return said(
        {
            f"{{}} virtual balises accepted without a monitor along the track ({reason}): a jump or drift along it is "
            "not seen there": (reasons == reason).sum()
            for reason in (NO_ODOMETER, BEYOND_SPAN, INTERRUPTED)
        }
    )


def time_notes(epochs: pl.DataFrame, clock: Clock, config: Configuration) -> list[str]:
    """For how long nobody knows whether the train moved, and what the moving time without a valid TVB was lost to.

    `epochs`: monitored and judged, in order of time.
    """
    untold_s = float(clock.held_s[met(epochs, pl.col("moving").is_null())].sum())
    return said(
        {
            "for {:.0f} s it is not known whether the train moved: availability counts this time as moving without a "
            "TVB": untold_s if round(untold_s) > 0 else None,
            "available for {}": availability_words(epochs, clock, config),
        }
    )
