"""The epochs of one solution as columns that the state machine walks along."""

from __future__ import annotations

from functools import cached_property
from typing import TypeVar

import numpy as np

from pipeline.stages.epochs.clock import crossing_gaps_ns
from pipeline.stages.odometry.bound import is_lost
from pipeline.stages.odometry.driven import turns_of
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration, LdsConfig
from schemas.enums import PassageStatus
from schemas.stages import AlignedEpochs

AnyArray = TypeVar("AnyArray", Floats, Ints)


class Journey:
    """Epochs in order of time; NaN is not known. Names are those of `schemas.stages.AlignedEpochs`, but:

    `refusal`: why a detection here would not count, None where it would. `direction` of travel (+1/-1 along growing
    path) as known at that epoch. `doubt_m`: in the odometer's distance, a sum; the epochs between which it stays the
    same compare; `rows_m`: noise of its rows. `gap_ns`: the longest step to the epoch that a crossing is interpolated
    over; `blind`: no position for longer.
    """

    def __init__(self, epochs: AlignedEpochs, scale_sigma: float | None, config: Configuration) -> None:
        """The only place where the LDS reads columns of aligned epochs."""
        self.t_ns = epochs.t_ns
        self.leg: Ints = _held(epochs.leg, epochs.leg >= 0, 0)
        self.path_m = epochs.path_m
        self.positioned: Bools = epochs.positioned
        self.placed_nowhere: Bools = epochs.fix_valid & ~self.positioned
        self.refusal = _refusals(epochs, config)
        self.sigma_m: Floats = _held(epochs.position_sigma_m, np.isfinite(epochs.position_sigma_m), np.nan)
        self.confidence_m = epochs.confidence_m
        self.odometer_m = epochs.odometer_m
        self.doubt_m = epochs.odometer_doubt_m
        self.slips = epochs.odometer_slips
        self.rows_m = np.nan_to_num(epochs.odometer_rows_m)
        self.scale_sigma = scale_sigma
        self.direction = _direction(self.odometer_m, epochs.direction, config.lds.odometer_fixed_m)
        self.travelled_m = epochs.travelled_m
        self.gap_ns = crossing_gaps_ns(self.t_ns, config.lds)
        self.blind = _blind(self.t_ns, self.positioned, self.gap_ns)

    @cached_property
    def usable(self) -> Bools:
        return np.array([refusal is None for refusal in self.refusal], dtype=bool)

    @cached_property
    def comparable(self) -> Bools:
        """Usable, and with an odometer and a sigma to compare with."""
        known: Bools = np.isfinite(self.odometer_m) & np.isfinite(self.sigma_m)
        return self.usable & known

    @cached_property
    def ambiguous(self) -> Bools:
        return np.array([refusal is PassageStatus.REJECTED_AMBIGUOUS for refusal in self.refusal], dtype=bool)

    @cached_property
    def on_odometer(self) -> Ints:
        return np.flatnonzero(np.isfinite(self.odometer_m))

    @property
    def has_odometer(self) -> bool:
        return self.on_odometer.size > 0

    def absence(self, epochs: slice) -> PassageStatus:
        """The status of a balise passed without a position on the path: fixes off all track, or no fix."""
        unplaced = self.placed_nowhere[epochs].any()
        return PassageStatus.REJECTED_AMBIGUOUS if unplaced else PassageStatus.NOT_AVAILABLE


def _blind(t_ns: Ints, positioned: Bools, gap_ns: Ints) -> Bools:
    """Epochs longer than a crossing is interpolated over after the last position, and all before the first one."""
    last_ns = np.maximum.accumulate(np.where(positioned, t_ns, np.iinfo(np.int64).min))
    first = np.argmax(positioned) if positioned.any() else t_ns.size
    blind: Bools = t_ns - np.maximum(last_ns, t_ns[0] - gap_ns) > gap_ns
    blind[:first] = True
    return blind


def _held(values: AnyArray, known: Bools, first: float) -> AnyArray:
    """Each value that is not known as the last one that is; before any of them `first`."""
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(last >= 0, values[last], first).astype(values.dtype)


def _refusals(epochs: AlignedEpochs, config: Configuration) -> list[PassageStatus | None]:
    """Ambiguity before confidence; what is not known is never taken as good."""
    refusals = np.full(epochs.height, None)
    refusals[~(epochs.confidence_m <= config.lds.ci_limit_m)] = PassageStatus.REJECTED_CONFIDENCE
    refusals[~epochs.unambiguous] = PassageStatus.REJECTED_AMBIGUOUS
    refusals[~epochs.positioned] = PassageStatus.NOT_AVAILABLE
    return list(refusals)


def _direction(odometer_m: Floats, matched: Ints, turn_m: float) -> Ints:
    """Direction of travel along growing path, as known at each epoch.

    With an odometer the train has turned once it came back by `turn_m`: a wheel's jitter at a stand is no turn.
    """
    if not np.isfinite(odometer_m).any():
        return _held(matched, matched != 0, 1)
    known = np.flatnonzero(np.isfinite(odometer_m))
    direction = np.ones(odometer_m.size, dtype=np.int64)
    for _, seen_at, sense in turns_of(odometer_m[known], turn_m):
        direction[known[seen_at] :] = sense
    return direction


def turning_epochs(journey: Journey) -> frozenset[int]:
    """Epochs at which direction or leg change, odometer known."""
    known = journey.on_odometer
    changed = (np.diff(journey.direction[known]) != 0) | (np.diff(journey.leg[known]) != 0)
    return frozenset(known[1:][changed].tolist())


def odometer_epochs(journey: Journey) -> list[int]:
    """Epochs at which the odometer begins to slip, or its distance came into doubt."""
    changes = (np.diff(journey.doubt_m) != 0.0) | (journey.slips[1:] & ~journey.slips[:-1])
    epochs: list[int] = (np.flatnonzero(changes) + 1).tolist()
    return epochs


def mission_epochs(journey: Journey, config: LdsConfig) -> frozenset[int]:
    """The first epochs at or after the configured starts of mission."""
    starts_ns = np.array([round(start.timestamp() * NS_PER_S) for start in config.starts_of_mission], dtype=np.int64)
    inside = starts_ns[(starts_ns > journey.t_ns[:1].sum()) & (starts_ns <= journey.t_ns[-1:].sum())]
    return frozenset(np.searchsorted(journey.t_ns, inside).tolist())


def unwatched_epochs(journey: Journey, watched: Ints, gap_reset_s: float) -> frozenset[int]:
    """The first watched epochs after time over which no monitor can say what became of the position.

    Longer than the bank bridges; or however short, where the odometer lost its distance or guessed it over a pause: no
    increment leads over it. Slip has a test of its own.
    """
    waited_ns = np.diff(journey.t_ns[watched])
    slipped = np.diff(np.cumsum(journey.slips)[watched]) > 0
    doubt_m = np.diff(journey.doubt_m[watched])
    lost = ((doubt_m != 0.0) & ~slipped) | is_lost(doubt_m)
    return frozenset(watched[1:][lost | (waited_ns > gap_reset_s * NS_PER_S)].tolist())
