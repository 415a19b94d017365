"""What the evidence of a run cannot see, said in words beside its figures."""

from __future__ import annotations

import polars as pl

from pipeline.alignment.align import BEYOND_SPAN, INTERRUPTED
from pipeline.epochs.clock import Clock, met
from pipeline.epochs.verdicts import NO_ODOMETER
from pipeline.monitors.axis import most_scatter_m
from schemas.config import Configuration
from schemas.enums import BaliseKind, Evidence, PassageStatus, VehicleFigures

_BALISE = (
    "evidence balise: the true position comes from balise reads, and from the odometer between them. Slip, slide and "
    "scale errors that cancel each other between two reads are not seen, and after the last read the odometer is "
    "trusted to 5 m + 5 %"
)
_ODOMETER = (
    "evidence odometer: the distance from the last accepted balise can show that a position was wrong, never that it "
    "was right"
)
_NOTHING = "no evidence: no stream can show whether a position was right or wrong"
_UNKNOWN = "{share:.1%} of the moving time in use could not be judged: to judge more, record {proof}"
_PROOF = (
    "a reference, or balise reads every 2 km and within {end_m:.0f} m of both ends of the run, and give the odometer's "
    "scale in the vehicle file"
)
_CONTRADICTED = (
    "the odometer's distance does not fit {count} gaps between known places: odometer or vehicle file is wrong there"
)
_DISPUTED = "balise reads contradict the reference {count} times: the true position is unknown there. Check both clocks"
_LEARNED = (
    "no odometer scale in a vehicle file: scale and latency are learned in the run and widen the thresholds, so that a "
    "drift at its beginning may not be seen"
)
_UNDIAGNOSED = (
    "{count} virtual balises accepted without a monitor along the track ({reason}): a jump or drift along it is not "
    "seen there"
)

_READING = (
    "the odometer's rows scatter by {sigma_m:.2f} m (coarse counter, or times stamped on receipt): the thresholds "
    "along the track allow for it"
)
_SCATTERED = (
    "the odometer's rows scatter by more than {most_m:.1f} m (coarse counter, or times stamped on receipt): thresholds "
    "wide enough for that would miss failures, so alarms along the track may come from the odometer"
)
_DIGITS = (
    "positions are rounded so much that they scatter by {sigma_m:.2f} m (few decimals, or single precision): the "
    "thresholds allow for it"
)
_UNTOLD = "for {s:.0f} s it is not known whether the train moved: availability counts this time as moving without a TVB"
# When a note is made, no figure: less than the positions themselves scatter is not worth a word.
_WORTH_M = 0.1


def reference_notes(disputed: int) -> tuple[str, ...]:
    """Reads that contradict the reference (DOMAIN section 5.1)."""
    return (_DISPUTED.format(count=disputed),) if disputed else ()


def reading_notes(epochs: pl.DataFrame, config: Configuration) -> tuple[str, ...]:
    """What the recorder's digits and the odometer's rows add to the thresholds, where that is much.

    `epochs`: aligned.
    """
    most_m = most_scatter_m(config)
    digits_m = epochs.select(pl.max_horizontal(pl.col(r"^digits_(along|cross|up)_m$").max())).item()
    texts = {_READING: epochs["odometer_rows_m"].max(), _DIGITS: digits_m}
    notes = []
    for text, sigma_m in texts.items():
        if isinstance(sigma_m, float) and sigma_m > _WORTH_M:
            beyond = text is _READING and sigma_m >= most_m
            notes.append(_SCATTERED.format(most_m=most_m) if beyond else text.format(sigma_m=sigma_m))
    return tuple(notes)


def evidence_notes(
    evidence: Evidence | None,
    share_unknown: float | None,
    vehicle: VehicleFigures,
    odometer_contradicted: int,
    config: Configuration,
) -> tuple[str, ...]:
    """What stands behind the judgements of one solution, and what would prove more (DOMAIN sections 5.1 and 5.4)."""
    by_evidence = {None: _NOTHING, Evidence.BALISE: _BALISE, Evidence.ODOMETER: _ODOMETER}
    notes = [by_evidence[evidence]] if evidence in by_evidence else []
    if share_unknown is not None and share_unknown > config.hazards.unknown_share_limit:
        # On one side of an anchor the odometer's confidence reaches the failure limit there (SUBSET-041 5.3.1.1).
        end_m = (config.hazards.failure_limit_m - config.lds.odometer_fixed_m) / config.lds.odometer_share
        notes.append(_UNKNOWN.format(share=share_unknown, proof=_PROOF.format(end_m=end_m)))
    if odometer_contradicted:
        notes.append(_CONTRADICTED.format(count=odometer_contradicted))
    if vehicle is VehicleFigures.LEARNED:
        notes.append(_LEARNED)
    return tuple(notes)


def undiagnosed_notes(epochs: pl.DataFrame, passages: pl.DataFrame) -> tuple[str, ...]:
    """Virtual balises that were accepted while no odometer could contradict the position.

    `epochs`: monitored, in order of time; `passages`: of the same solution.
    """
    accepted = passages.filter(
        (pl.col("kind") == BaliseKind.VIRTUAL.value) & (pl.col("status") == PassageStatus.ACCEPTED.value)
    )
    offers = accepted.select(pl.col("t_offered").drop_nulls().sort())
    judged = offers.join_asof(
        epochs.select("t", "along_raw_reason"), left_on="t_offered", right_on="t", strategy="forward"
    )
    reasons = judged["along_raw_reason"]
    counts = [(reason, (reasons == reason).sum()) for reason in (NO_ODOMETER, BEYOND_SPAN, INTERRUPTED)]
    return tuple(_UNDIAGNOSED.format(reason=reason, count=count) for reason, count in counts if count)


def motion_notes(epochs: pl.DataFrame, clock: Clock) -> tuple[str, ...]:
    """For how long nobody knows whether the train moved."""
    untold_s = float(clock.held_s[met(epochs, pl.col("moving").is_null())].sum())
    return (_UNTOLD.format(s=untold_s),) if round(untold_s) > 0 else ()
