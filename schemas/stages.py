"""What passes between the stages of one run: each frame's columns with unit and meaning (docs/architecture.md).

Between stages columns are numpy arrays, so that the type checker follows each from its maker to its readers. What is
not known is NaN in numbers, false in flags and -1 in numbers of words. `table` makes the polars frame of them, once,
for what reads tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, Ints
from schemas.enums import Evidence, Judgement, LdsMode, LdsState, LostTo, NotEvaluated, PassageStatus, SigmaSource
from schemas.frozen import frozen

# Confidence where one track is left of the set of those that the positions do not reject (DOMAIN section 2).
ONE_TRACK_LEFT = 0.99

INSTANT = pl.Datetime("ns", "UTC")
SIGMA_SOURCES = tuple(source.value for source in SigmaSource)
REASONS = tuple(NotEvaluated)
NO_REASON = -1
_REASON_WORDS = pl.Series([reason.value for reason in REASONS] + [None], dtype=pl.String)


def reason_words(reason: Ints) -> pl.Series:
    """Numbers of reasons as words, null for `NO_REASON`.

    Args:
        reason: numbers in `REASONS`, shape (n,).

    Returns:
        Words of n rows.
    """
    return gathered(_REASON_WORDS, reason)


def arrays_of(columns: type[Any]) -> tuple[str, ...]:
    """The names of the arrays of such a class, in their order.

    Args:
        columns: a frozen class with arrays.

    Returns:
        Names of attributes.
    """
    return tuple(one.name for one in fields(columns) if one.type in ("Ints", "Floats", "Bools"))


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
        """The attributes by name, for epochs that have more of them."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @property
    def height(self) -> int:
        """Number of epochs."""
        return self.t_ns.size

    def element_by(self, numbers: Mapping[str, int]) -> Ints:
        """The net element of each epoch by another numbering (name to number), -1 for none, shape (epochs,)."""
        return np.array([*(numbers.get(name, -1) for name in self.elements), -1])[self.element]

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
    def table(self) -> pl.DataFrame:
        """The columns as a frame: names of net elements for their numbers, null where not known."""
        return pl.DataFrame(self.series())

    def series(self) -> list[pl.Series]:
        """The columns of `table`."""
        t, *others = (series_of(self, name) for name in arrays_of(type(self)))
        return [t, self.solution_series(), *others]

    def solution_series(self) -> pl.Series:
        """The name of the solution at each epoch."""
        return pl.Series("solution", [self.solution], dtype=pl.String).new_from_index(0, self.height)


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


_ENUMERATIONS: Mapping[str, type[StrEnum]] = {
    "sigma_source": SigmaSource,
    "lds_mode": LdsMode,
    "withheld_for": LostTo,
    "judgement": Judgement,
    "evidence": Evidence,
    "lds_state": LdsState,
}
"""Columns that hold words of an enumeration, in arrays by their number in it."""


def words_of(enumeration: type[StrEnum]) -> pl.Series:
    """The words of an enumeration, for `gathered`.

    Args:
        enumeration: an enumeration of words.

    Returns:
        Its words in their order, and null behind them, for numbers of -1.
    """
    values = [one.value for one in enumeration]
    return pl.Series([*values, None], dtype=pl.Enum(values))


# Made once: an enumeration takes longer to make than to index.
_WORDS = {name: words_of(enumeration) for name, enumeration in _ENUMERATIONS.items()}


def gathered(words: pl.Series, number: Ints) -> pl.Series:
    """Words by their number.

    Args:
        words: as `words_of` makes them; the last stands for -1.
        number: numbers of words, shape (n,).

    Returns:
        Words of n rows.
    """
    if number.size and (number == number[0]).all():
        return words.new_from_index(int(number[0]) % len(words), number.size)
    return words[pl.Series(np.where(number < 0, len(words) - 1, number).astype(np.uint32))]


def instants(name: str, t_ns: Ints) -> pl.Series:
    """Times as a column.

    Args:
        name: of the column.
        t_ns: times [ns since 1970, UTC], shape (n,).

    Returns:
        Times of n rows.
    """
    return pl.Series(name, t_ns, dtype=pl.Int64).cast(INSTANT)


def series_of(epochs: Any, name: str) -> pl.Series:
    """One array of epochs as a column: words for numbers of words, null for what is not known.

    Args:
        epochs: a class of epochs in arrays, n of them.
        name: of the array.

    Returns:
        The column of n rows, by the name that it has in tables.
    """
    values = getattr(epochs, name)
    match name:
        case "t_ns":
            return instants("t", values)
        case "at_ns":
            return instants("at", values)
        case "element":
            return gathered(pl.Series([*epochs.elements, None], dtype=pl.String), values).alias("netelement_id")
        case "lrvb":
            return gathered(pl.Series([*epochs.lrvb_ids, None], dtype=pl.String), values).alias("lrvb_id")
        case "leg":
            return pl.Series(name, np.where(values < 0, np.nan, values), nan_to_null=True).cast(pl.Int32)
        case "odometer_reason":
            return reason_words(values).alias(name)
        case "direction":
            return pl.Series(name, values.astype(np.int8))
    if name in _WORDS:
        return gathered(_WORDS[name], values).alias(name)
    return pl.Series(name, values, nan_to_null=values.dtype == np.float64)


@frozen
class LdsEpochs:
    """What the LDS says of each epoch; arrays of shape (epochs,)."""

    lds_mode: Ints
    """Mode of the location determination system, by number in `LdsMode`."""
    tvb: Bools
    """The position is a travelling virtual balise (TVB): validated, in use, usable."""
    lrvb: Ints
    """Last relevant virtual balise by its number in `lrvb_ids`; -1 before the first."""
    lrvb_ids: Sequence[str]
    """Names of balises."""
    distance_from_lrvb_m: Floats
    """Odometer distance since the LRVB [m]."""
    doubt_over_m: Floats
    """By how much the odometer may over-read since then (SUBSET-026 3.6.4) [m]."""
    doubt_under_m: Floats
    """By how much it may under-read [m]."""
    exposure_s: Floats
    """Time since the last validated position before this one [s]: TVB eq. 7."""
    negated: Bools
    """The LDS negated the position."""
    withheld_for: Ints
    """What the position is withheld for, by number in `LostTo`; -1 where it is not."""
    diagnosis_faulty: Bools
    """P3 (DOMAIN section 4): `along_raw` has no verdict, and the position is not withheld."""
    alarm: Bools
    """A monitor fails."""

    def columns(self) -> dict[str, Any]:
        """The attributes by name, for epochs that have more of them."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def table(self) -> pl.DataFrame:
        """The columns as a frame, with `withheld`."""
        columns = [series_of(self, name) for name in arrays_of(type(self))]
        return pl.DataFrame([*columns, pl.Series("withheld", self.withheld)])

    @property
    def withheld(self) -> Bools:
        """The train does not use the position, though no monitor failed."""
        return np.greater_equal(self.withheld_for, 0)


@frozen
class Crossings:
    """Crossings of balises by the raw matched position, and telegrams read; arrays of shape (crossings,).

    In order of time; the place of a crossing among them is its `crossing_id` in the tables.
    """

    balise_id: Sequence[str]
    """Balise."""
    netelement_id: Sequence[str]
    """Net element of the balise."""
    measure_m: Floats
    """Its measure there [m]."""
    leg: Ints
    """Leg of the path."""
    path_m: Floats
    """Path position of the balise [m]."""
    virtual: Bools
    """A virtual balise, crossed by the position; else a physical one, read."""
    before: Ints
    """Row of the last epoch before the crossing with a position; of a telegram any."""
    epoch: Ints
    """Row of the first epoch at or after the crossing."""
    t_ns: Ints
    """The crossing, interpolated; of a telegram its own time; after a gap that of `epoch` [ns since 1970, UTC]."""
    sense: Ints
    """+1 passed along growing path, -1 against it."""
    direction: Ints
    """Direction of travel at the crossing, +1 or -1 along growing path."""
    odometer_m: Floats
    """Odometer distance at the crossing [m]."""
    offered: Bools
    """Offered to the train; false: inside a gap, or crossed again before the balise was re-armed."""
    status: Ints
    """What became of it, by number in `PassageStatus`; -1 where crossed again before the balise was re-armed."""

    @property
    def size(self) -> int:
        """Number of crossings."""
        return self.t_ns.size

    @property
    def accepted(self) -> Bools:
        """Virtual balises that the LDS accepted."""
        return np.asarray(self.virtual & (self.status == tuple(PassageStatus).index(PassageStatus.ACCEPTED)))
