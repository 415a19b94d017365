"""What passes between the stages of one run: each frame's columns with unit and meaning (docs/architecture.md).

Between stages columns are numpy arrays, so that the type checker follows each from its maker to its readers. What is
not known is NaN in numbers, false in flags and -1 in numbers of words. `table` makes the polars frame of them, once,
for what reads tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any, Self

import dataframely as dy
import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, Ints, flags, floats, ints, times_ns, truths
from schemas.columns import flag, instant, one_of, real, text
from schemas.enums import BaliseKind, Evidence, Judgement, LdsMode, LdsState, NotEvaluated, PassageStatus, SigmaSource
from schemas.frozen import frozen

# Confidence where one track is left of the set of those that the positions do not reject (DOMAIN section 2).
ONE_TRACK_LEFT = 0.99

INSTANT = pl.Datetime("ns", "UTC")
SIGMA_SOURCES = tuple(source.value for source in SigmaSource)
REASONS = tuple(NotEvaluated)
NO_REASON = -1
_REASON_WORDS = pl.Series([reason.value for reason in REASONS] + [None], dtype=pl.String)
_SOURCE_WORDS = pl.Series([*SIGMA_SOURCES, None], dtype=pl.Enum(SIGMA_SOURCES))


def reason_words(reason: Ints) -> pl.Series:
    """Numbers of reasons as words, null for `NO_REASON`.

    Args:
        reason: numbers in `REASONS`, shape (n,).

    Returns:
        Words of n rows.
    """
    return _gathered(_REASON_WORDS, reason)


@frozen
class MatchedEpochs:
    """One row per GNSS epoch of a solution, in order of time: the position on the track network, by matching.

    Arrays of shape (epochs,). Positions are those of the balise antenna. Only a valid fix has a path position, only a
    path position is near or on the track, and only on the track the path has a probability: later stages rest on that
    and do not ask again.
    """

    t_ns: Ints
    """Stamp of the epoch [ns since 1970, UTC]."""
    solution: str
    """Name of the solution of the run."""
    leg: Ints
    """Leg of the path, on which path positions are one to one; -1 without a valid fix."""
    element: Ints
    """Matched net element by its number in `elements`, -1 for none."""
    elements: Sequence[str]
    """Names of the net elements of the survey."""
    measure_m: Floats
    """Measure on the net element [m]."""
    path_m: Floats
    """Path position, raw: never smoothed [m]."""
    cross_track_m: Floats
    """Position left of growing path [m]."""
    vertical_m: Floats
    """Position above the track [m]; not known without a height in position or survey."""
    on_track: Bools
    """A net element of the path is within what the position's errors allow."""
    near_track: Bools
    """A net element of the path is within `reach_m`: the monitors can compare the position with it."""
    path_probability: Floats
    """Confidence in the track in hindsight [1]: 0.99 where one is left, 1 alone."""
    gate_probability: Floats
    """The same by what was known then [1]; not known off the network."""
    heading_deg: Floats
    """Azimuth of growing path at the GNSS antenna, clockwise from north [deg]."""
    slope: Floats
    """Rise over run of growing path [1]."""
    curvature_per_m: Floats
    """Curvature of the track, positive to the left [1/m]."""
    interpolation_error_m: Floats
    """Chord error of the survey's polyline at that place [m]."""
    survey_sigma_m: Floats
    """Standard deviation of the survey [m]; not known where not stated."""
    sigma_along_m: Floats
    """Standard deviation of the position along the track, as stated [m]."""
    sigma_cross_m: Floats
    """The same across the track [m]."""
    sigma_up_m: Floats
    """The same of the height [m]."""
    sigma_source: Ints
    """Where the deviations come from, by number in `SIGMA_SOURCES`; -1 without a valid fix."""
    fix_valid: Bools
    """The receiver has a fix and a position."""
    velocity_along_mps: Floats
    """GNSS velocity along growing path [m/s]."""
    hpl_m: Floats
    """Horizontal protection level of the receiver [m]."""
    digits_along_m: Floats
    """Deviation by the step in which positions are written down, along the track [m]."""
    digits_cross_m: Floats
    """The same across the track [m]."""
    digits_up_m: Floats
    """The same of the height [m]."""

    def columns(self) -> dict[str, Any]:
        """The attributes by name, for a frame that has more of them."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @property
    def height(self) -> int:
        """Number of epochs."""
        return self.t_ns.size

    @property
    def positioned(self) -> Bools:
        """Epochs with a path position."""
        return np.isfinite(self.path_m)

    @property
    def usable(self) -> Bools:
        """Epochs with a position on the track."""
        return self.positioned & self.on_track

    @property
    def unambiguous(self) -> Bools:
        """One track is left for the position by what the train knew then."""
        return np.asarray(self.gate_probability >= ONE_TRACK_LEFT)

    @cached_property
    def netelement_id(self) -> pl.Series:
        """Names of the matched net elements, null for none."""
        return _gathered(pl.Series([*self.elements, None], dtype=pl.String), self.element)

    @cached_property
    def table(self) -> pl.DataFrame:
        """The columns as a frame: names of net elements for their numbers, null where not known."""
        return pl.DataFrame([_series(self, field.name) for field in fields(self) if field.name != "elements"])

    @classmethod
    def of_table(cls, table: pl.DataFrame) -> Self:
        """The arrays of a frame with these columns; what it lacks is not known."""
        elements: list[str] = []
        if "netelement_id" in table.columns:
            elements = table["netelement_id"].drop_nulls().unique(maintain_order=True).to_list()
        arrays = {
            one.name: _array(one.name, str(one.type), table, elements) for one in fields(cls) if one.name != "elements"
        }
        return cls(elements=elements, **arrays)


@frozen
class AlignedEpochs(MatchedEpochs):
    """`MatchedEpochs` with the odometer at each epoch's time of validity, and what tests along the track allow for.

    Scale and latency are those in use at the epoch: of the vehicle file, or learned from earlier epochs only.
    """

    position_sigma_m: Floats
    """Deviation that every test along the track counts with: calibrated, and the digits [m]."""
    calibrated_along_m: Floats
    """a + b `sigma_along_m`, as `calibrate` found: of errors with memory [m]."""
    calibrated_cross_m: Floats
    """The same across the track [m]."""
    calibrated_up_m: Floats
    """The same of the height [m]."""
    confidence_m: Floats
    """Half-width of the confidence interval along the track [m]."""
    along_m: Floats
    """Path position without the way that a curve adds beside the track: for increments [m]."""
    odometer_m: Floats
    """Odometer distance along growing path, scale corrected, 0 at the first epoch [m]."""
    travelled_m: Floats
    """Distance driven since the first epoch by the odometer, turns included, scale corrected [m]."""
    odometer_reason: Ints
    """Why there is no odometer, by number in `REASONS`; `NO_REASON` where there is one."""
    odometer_slips: Bools
    """The odometer says itself that it slips here."""
    odometer_doubt_m: Floats
    """By how much slip, pauses and losses (1e6 m each) may have falsified the distance since the first row [m]:
    distances compare where it is the same.
    """
    odometer_white_m2_per_s: Floats
    """Variance that the odometer's distance gathers in a second [m2/s]."""
    odometer_rows_m: Floats
    """Quantisation noise of the odometer's rows as shown so far, as far as thresholds allow for it [m]."""
    odometer_period_s: Floats
    """Time between rows of the odometer [s]."""
    stamp_jitter_s: Floats
    """Deviation of the stamps about the receiver's clock [s]."""
    speed_mps: Floats
    """Speed along growing path by the odometer, by GNSS where there is none [m/s]."""
    direction: Ints
    """Direction of travel along growing path, 1 or -1, held in the dead band."""
    odometer_scale: Floats
    """True over odometer distance [1]."""
    scale_sigma: Floats
    """Standard deviation of the scale [1]."""
    latency_s: Floats
    """By how much the position is older than its stamp [s]."""
    latency_sigma_s: Floats
    """Standard deviation of the latency [s]."""


def _gathered(words: pl.Series, number: Ints) -> pl.Series:
    """Words by their number, the last of them for -1."""
    return words[pl.Series(np.where(number < 0, len(words) - 1, number).astype(np.uint32))]


def _series(epochs: MatchedEpochs, name: str) -> pl.Series:
    """One column of the frame."""
    values = getattr(epochs, name)
    match name:
        case "t_ns":
            return pl.Series("t", values, dtype=pl.Int64).cast(INSTANT)
        case "solution":
            return pl.Series(name, [values], dtype=pl.String).new_from_index(0, epochs.height)
        case "element":
            return epochs.netelement_id.alias("netelement_id")
        case "leg":
            return pl.Series(name, np.where(values < 0, np.nan, values), nan_to_null=True).cast(pl.Int32)
        case "sigma_source":
            return _gathered(_SOURCE_WORDS, values).alias(name)
        case "odometer_reason":
            return reason_words(values).alias(name)
        case "direction":
            return pl.Series(name, values.astype(np.int8))
    return pl.Series(name, values, nan_to_null=values.dtype == np.float64)


def _array(name: str, kind: str, table: pl.DataFrame, elements: Sequence[str]) -> Any:
    """One column of a frame as an array; not known where the frame lacks it."""
    column = {"t_ns": "t", "element": "netelement_id"}.get(name, name)
    known = column in table.columns
    if name == "t_ns":
        return times_ns(table)
    if name == "solution":
        return str(table[column][0]) if known and table.height else "primary"
    if kind == "Floats":
        return floats(table, column) if known else np.full(table.height, np.nan)
    if kind == "Bools":
        return truths(table[column]) if known else np.zeros(table.height, dtype=np.bool_)
    if not known:
        return np.full(table.height, {"leg": 0, "direction": 1}.get(name, -1))
    words = {"element": elements, "sigma_source": SIGMA_SOURCES, "odometer_reason": [one.value for one in REASONS]}
    if name in words:
        numbers = {word: number for number, word in enumerate(words[name])}
        return ints(table[column].cast(pl.String).replace_strict(numbers, default=None, return_dtype=pl.Int64))
    return ints(table[column])


@frozen
class EpochFigures:
    """The judged epochs of a solution, as far as the figures of a run are made of them; arrays of shape (epochs,)."""

    t_ns: Ints
    """Stamp of the epoch [ns since 1970, UTC]."""
    at_ns: Ints
    """The instant at which the position is judged [ns]: its stamp less the latency of the vehicle file."""
    path_m: Floats
    """Path position [m]."""
    on_track: Bools
    """As in `MatchedEpochs`."""
    path_probability: Floats
    """Confidence in the track in hindsight [1]."""
    gate_probability: Floats
    """The same by what was known then [1]."""
    confidence_m: Floats
    """Half-width of the confidence interval along the track [m]."""
    hpl_m: Floats
    """Horizontal protection level of the receiver [m]."""
    speed_mps: Floats
    """Speed along growing path [m/s]."""
    without_odometer: Bools
    """There is no odometer here."""
    tvb: Bools
    """The position is a train-borne virtual balise (TVB)."""
    negated: Bools
    """The LDS negated the position."""
    alarm: Bools
    """A monitor fails."""
    fail_safe: Bools
    """Mode of the LDS."""
    withheld_for: Ints
    """What the position is withheld for, by number in `LostTo`; -1 where it is not."""
    exposure_s: Floats
    """Time since the last validated position before this one [s]."""
    judgement: Ints
    """What the evidence says of the position, by number in `Judgement`."""
    error_low_m: Floats
    """Least error in the direction of travel that the evidence leaves [m]."""
    error_high_m: Floats
    """Largest error in the direction of travel that the evidence leaves [m]."""
    error_along_m: Floats
    """Error where reference or reads give it to `known_error_m` [m]."""
    moves: Bools
    """The train moves from here to the next epoch, as is known."""
    may_move: Bools
    """It does, or nobody knows (DOMAIN section 5.5)."""
    undiagnosed: Bools
    """State P3: no verdict of `along_raw`, by the LDS, or the odometer is wrong."""
    in_use: Bools
    """Fix valid, unambiguous, confident, not negated, not withheld."""
    used_s: Floats
    """Time in use that the epoch stands for [s]."""
    counted_s: Floats
    """Time that the epoch stands for in shares of time [s]."""
    lds_state: Ints
    """State of the reactive LDS by number in `LdsState`; -1 where it needs a truth that is missing."""
    table: pl.DataFrame
    """All columns of the epochs, for what reads few of them, or names them."""

    @classmethod
    def of_table(cls, table: pl.DataFrame) -> EpochFigures:
        """The arrays of judged epochs."""
        moving = table["moving"]
        moves = truths(moving)
        return cls(
            t_ns=times_ns(table),
            at_ns=times_ns(table, "at") if "at" in table.columns else times_ns(table),
            on_track=flags(table, "on_track"),
            without_odometer=table["odometer_reason"].is_not_null().to_numpy(),
            tvb=flags(table, "tvb"),
            negated=flags(table, "negated"),
            alarm=flags(table, "alarm"),
            fail_safe=_numbers(table["lds_mode"]) == tuple(LdsMode).index(LdsMode.FAIL_SAFE),
            withheld_for=_numbers(table["withheld_for"]),
            judgement=_numbers(table["judgement"]),
            moves=moves,
            may_move=moves | moving.is_null().to_numpy(),
            undiagnosed=flags(table, "undiagnosed"),
            in_use=flags(table, "in_use"),
            lds_state=_numbers(table["lds_state"]),
            table=table,
            **{name: floats(table, name) for name in _FIGURES},
        )

    def where(self, chosen: Bools) -> EpochFigures:
        """Some of the epochs."""
        return EpochFigures.of_table(self.table.filter(pl.Series(chosen)))

    @property
    def height(self) -> int:
        """Number of epochs."""
        return self.t_ns.size

    @property
    def usable(self) -> Bools:
        """Epochs with a position on the track."""
        return np.isfinite(self.path_m) & self.on_track

    @property
    def unambiguous(self) -> Bools:
        """One track is left for the position by what the train knew then."""
        return np.asarray(self.gate_probability >= ONE_TRACK_LEFT)

    @property
    def valid(self) -> Bools:
        """TVBs while it is known whether the train moves: a TVB where nobody knows counts for no availability."""
        return self.tvb & (self.moves | ~self.may_move)

    @property
    def judged(self) -> Bools:
        """The evidence calls the position right or wrong (DOMAIN section 5.2)."""
        return self.is_judged(Judgement.RIGHT) | self.is_judged(Judgement.WRONG)

    def is_judged(self, judgement: Judgement) -> Bools:
        """Epochs with this judgement."""
        return np.asarray(self.judgement == tuple(Judgement).index(judgement))

    def confident(self, limit_m: float) -> Bools:
        """The confidence interval along the track is within its limit."""
        return np.asarray(self.confidence_m <= limit_m)


_FIGURES = (
    *("path_m", "path_probability", "gate_probability", "confidence_m", "hpl_m", "speed_mps", "exposure_s"),
    *("error_low_m", "error_high_m", "error_along_m", "used_s", "counted_s"),
)


def _numbers(words: pl.Series) -> Ints:
    """Words of an enumeration by their number in it, -1 for null."""
    return ints(words.to_physical())


class Crossings(dy.Schema):
    """One row per crossing of a balise by the raw matched position, or per telegram read, in order of time.

    The LDS finds each crossing once and says what became of it; who needs it later joins by `crossing_id`.
    """

    crossing_id = dy.Int64(min=0, description="0, 1, ... in order of time within the solution")
    balise_id = text("balise")
    kind = one_of(BaliseKind, "virtual: crossed by the position; physical: read")
    netelement_id = text("net element of the balise")
    measure_m = real("m", "measure of the balise", nullable=False)
    leg = dy.Int32(description="leg of the path")
    path_m = real("m", "path position of the balise", nullable=False)
    before = dy.Int64(min=0, description="row of the last epoch before the crossing with a position; of a telegram any")
    epoch = dy.Int64(min=0, description="row of the first epoch at or after the crossing")
    t = instant("the crossing, interpolated; of a telegram its own time; after a gap that of `epoch`")
    sense = dy.Int8(description="+1 passed along growing path, -1 against it")
    direction = dy.Int8(description="direction of travel at the crossing, +1 or -1 along growing path")
    odometer_m = real("m", "odometer distance at the crossing")
    offered = flag("offered to the train; false: inside a gap, or crossed again before the balise was re-armed")
    status = one_of(
        PassageStatus, "what became of it; null where crossed again before the balise was re-armed", nullable=True
    )


class JudgedEpochs(dy.Schema):
    """What the judge adds to the epochs of a solution, row for row (DOMAIN sections 5.2 and 5.3)."""

    epoch = dy.Int64(min=0, description="row among the epochs of the solution")
    at = instant("the instant at which the position is judged: its stamp less the latency of the vehicle file")
    direction = dy.Int8(
        description="direction of travel along growing path, 1 or -1; without an odometer the evidence's"
    )
    judgement = one_of(Judgement, "what the evidence says of the position")
    error_low_m = real("m", "least error in the direction of travel that the evidence leaves")
    error_high_m = real("m", "largest error in the direction of travel that the evidence leaves")
    error_along_m = real("m", "error where reference or reads give it to `known_error_m`")
    evidence = one_of(Evidence, "what the judgement rests on; null where nothing is known", nullable=True)
    wrong_track = flag("judged wrong for its net element, wherever along it")
    track_assumed = flag("right if the survey holds the train's track, which nothing shows")
    train_m = real("m", "path position of the train where reference or reads give it to `known_error_m`")
    reference_m = real("m", "the same where the reference gives it")
    unambiguous = flag("the track of the position was not in doubt by what the train knew then")
    moving = flag("the train moves from here to the next epoch; null where not known", nullable=True)
    stood = flag("the odometer stood while positions left their place by more than the failure limit")
    odometer_wrong = flag("the distance since the last accepted VB is beyond 5 m + 5 % by the evidence")
    undiagnosed = flag("state P3: no verdict of `along_raw`, by the LDS, or `odometer_wrong`")
    in_use = flag("fix valid, unambiguous, confident, not negated, not withheld")
    used_s = real("s", "time in use that the epoch stands for", nullable=False, min=0)
    wrong_s = real("s", "the same where it was wrong", nullable=False, min=0)
    natural_s = real("s", "of it what no injected fault of GNSS explains", nullable=False, min=0)
    counted_s = real("s", "time that the epoch stands for in shares of time", nullable=False, min=0)
    lds_state = one_of(
        LdsState, "state of the reactive LDS; null where it needs a truth that is missing", nullable=True
    )


class JudgedOffers(dy.Schema):
    """One row per crossing of a virtual balise or telegram, judged against where the train was; joined by its id."""

    crossing_id = dy.Int64(min=0, description="as in `Crossings`")
    balise_id = text("balise")
    t = instant("the crossing, interpolated")
    epoch = dy.Int64(min=0, description="row of the first epoch at or after the crossing")
    path_m = real("m", "path position of the balise", nullable=False)
    virtual = flag("a virtual balise; else a telegram")
    accepted = flag("a virtual balise that the LDS accepted")
    offered = flag("a virtual balise offered; false where crossed again before it was re-armed, which only a jump does")
    beyond_window = flag("offered after its window closed")
    location_error_m = real("m", "error where reference or reads give it to `known_error_m`")
    judgement = one_of(Judgement, "what the evidence says of the offer")
    error_low_m = real("m", "least error in the direction of travel that the evidence leaves")
    error_high_m = real("m", "largest error in the direction of travel that the evidence leaves")
    evidence = one_of(Evidence, "what the judgement rests on; null where nothing is known", nullable=True)
    wrong_track = flag("judged wrong for its net element, wherever along it")
    track_assumed = flag("right if the survey holds the train's track, which nothing shows")
    proof_margin_m = real("m", "by how much the evidence may be wrong before what is right is no longer", min=0)


class Failures(dy.Schema):
    """One row per failure: judged wrong in use, over pulses, whether it crosses a VB or not (DOMAIN section 5.3)."""

    t_start = instant("first position that may belong to it")
    t_end = instant("first position that no longer does")
    hazardous_s = real("s", "time judged wrong in use, over the whole failure", nullable=False, min=0)
    natural_s = real("s", "of it what no injected fault of GNSS explains", nullable=False, min=0)
    hazardous_may_s = real("s", "the same with the time that is unknown", nullable=False, min=0)
    accepted = one_of(Judgement, "worst judgement of the virtual balises accepted in it; right where none was")
    within_budget = flag("hazardous time within the budget; null where it cannot be said", nullable=True)
