"""What the evidence of a run cannot see, said in words beside its figures."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.alignment.align import BEYOND_SPAN, INTERRUPTED, NO_ODOMETER
from pipeline.monitors.along import most_scatter_m
from pipeline.motion import Motion
from schemas.arrays import NS_PER_S, times_ns
from schemas.config import Configuration
from schemas.enums import BaliseKind, Evidence, PassageStatus

_BALISE = (
    "evidence balise: reads carried on by the odometer; unless Doppler velocity sides with the position, a slip or "
    "slide between two reads hides errors up to its own size, and one before the first or after the last read looks "
    "like an error of the position"
)
_CONTRADICTED = (
    "balise reads contradict the odometer between them by up to {slip_m:.0f} m: there, for {share:.0%} of the "
    "positions, errors and jumps up to that size are neither seen nor excluded"
)
_ODOMETER = (
    "evidence odometer: errors within 5 m + 5 % of the way since the last accepted balise are not seen (here up to "
    "{bound_m:.0f} m), nor is what a balise accepted in the wrong place hides"
)
_SMOOTHED = "evidence odometer, smoothed from the position itself: slow errors that raise no alarm are not seen"
_NOTHING = "no evidence for {share:.0%} of the positions: their errors are not known"
_DRIFT = "a slow drift of the position and a change of the odometer's scale look alike"
_NO_DOPPLER = "without GNSS velocity nothing tells a fault of the position from one of the odometer"
_UNDIAGNOSED = (
    "virtual balises accepted without diagnosis along the track: {count} ({reason}); a jump or drift along it is not "
    "seen there"
)

_READING = (
    "the odometer's rows scatter by {sigma_m:.2f} m (coarse counts, or stamps on receipt): the thresholds along the "
    "track allow for it"
)
_SCATTERED = (
    "the odometer's rows scatter by more than {most_m:.1f} m (coarse counts, or stamps on receipt): alarms along the "
    "track may be its own, for thresholds that allow for it all would let failures pass"
)
_DIGITS = (
    "positions are written down so coarsely that they scatter by {sigma_m:.2f} m (few decimals, single precision): the "
    "thresholds allow for it"
)
_FROZEN = (
    "the odometer stood still for {s:.0f} s in which the train drove {way_m:.0f} m, first at {first:%H:%M:%S}: it was "
    "frozen; that time counts as moving, and the way as driven by the positions"
)
_UNDECIDED = (
    "for {s:.0f} s, first at {first:%H:%M:%S}, the odometer stood still while positions moved on, {way_m:.0f} m in "
    "all, and nothing tells which is right: availability counts that time as moving without a TVB"
)
_UNTOLD = (
    "for {s:.0f} s neither odometer nor positions tell whether the train moved: availability counts that time as "
    "moving without a TVB"
)
# Less than the positions themselves scatter is not worth a word.
_WORTH_M = 0.1


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


def evidence_notes(epochs: pl.DataFrame, truth: pl.DataFrame, failure_limit_m: float) -> tuple[str, ...]:
    """Notes on what stands behind the errors of one solution; none where the reference covers all positions.

    `epochs`: matched and aligned; `truth`: from `establish_truth`, row by row.
    """
    seen = truth.select("evidence", "truth_bound_m", "truth_slip_m", "truth_smoothed")
    seen = seen.filter(epochs["fix_valid"] & epochs["path_m"].is_not_null())
    if seen.is_empty():
        return ()
    notes = []
    without = seen["evidence"].null_count() / seen.height
    if without > 0.01:
        notes.append(_NOTHING.format(share=without))
    weak = seen.filter((seen["evidence"] == Evidence.BALISE.value) | (seen["evidence"] == Evidence.ODOMETER.value))
    if weak.height <= 0.01 * seen.height:
        return tuple(notes)
    notes += _weak_evidence(weak, failure_limit_m)
    notes.append(_DRIFT)
    if not epochs["velocity_along_mps"].is_not_null().any():
        notes.append(_NO_DOPPLER)
    return tuple(notes)


def _weak_evidence(weak: pl.DataFrame, failure_limit_m: float) -> list[str]:
    by_odometer = weak.filter(pl.col("evidence") == Evidence.ODOMETER.value)
    plain = by_odometer.filter(~pl.col("truth_smoothed"))
    notes = [_BALISE] if (weak["evidence"] == Evidence.BALISE.value).any() else []
    slips = weak["truth_slip_m"].abs()
    hiding = slips > failure_limit_m
    if hiding.any():
        notes.append(_CONTRADICTED.format(slip_m=slips.max(), share=hiding.mean()))
    if plain.height:
        bound_m = plain.select(pl.col("truth_bound_m").max()).item()
        notes.append(_ODOMETER.format(bound_m=bound_m or 0.0))
    if by_odometer["truth_smoothed"].any():
        notes.append(_SMOOTHED)
    return notes


def return_notes(epochs: pl.DataFrame, hazards: pl.DataFrame, failure_limit_m: float) -> tuple[str, ...]:
    """Hazards that were detected, but during which the position came back into use beyond the limit.

    Their T_D and hazardous time count to the first detection (DOMAIN section 5); this says that it was not the end.
    `epochs`: with `negated` and `error_along_m`.
    """
    notes = []
    for row in hazards.filter(pl.col("detected") & pl.col("caused_by").is_null()).iter_rows(named=True):
        again = epochs.filter(
            pl.col("t").is_between(row["t_detected"], row["t_end"], closed="right")
            & ~pl.col("negated")
            & (pl.col("error_along_m").abs() > failure_limit_m)
        )
        if again.height:
            largest_m = again.select(pl.col("error_along_m").abs().max()).item()
            notes.append(
                f"hazard {row['hazard_id']}: after its detection the position was taken up again while it lasted, "
                f"{again.height} epochs beyond {failure_limit_m:.0f} m, up to {largest_m:.0f} m"
            )
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


def motion_notes(motion: Motion, epochs: pl.DataFrame) -> tuple[str, ...]:
    """Where the odometer stood and positions moved on, and where nobody knows whether the train moved.

    `epochs`: in order of time.
    """
    t_ns = times_ns(epochs)
    notes = []
    untold = ~motion.known[:-1]
    for text, moved in ((_FROZEN, True), (_UNDECIDED, None)):
        found = [one for one in motion.contradicted if one.moved is moved]
        if found:
            seconds = sum(float(t_ns[one.last + 1] - t_ns[one.first]) for one in found) / NS_PER_S
            way_m = sum(abs(one.way_m) for one in found)
            notes.append(text.format(s=seconds, way_m=way_m, first=epochs["t"][found[0].first]))
        for one in found:
            untold[one.first : one.last + 1] = False
    if untold.any():
        notes.append(_UNTOLD.format(s=float(np.diff(t_ns)[untold].sum()) / NS_PER_S))
    return tuple(notes)
