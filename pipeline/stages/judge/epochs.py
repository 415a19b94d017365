"""Epochs and offers of one solution against the evidence: judgement, direction, movement, time in use, state."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns, nominal_period_s, periods_before_s, reactions_ns
from pipeline.stages.epochs.verdicts import MonitoredEpochs
from pipeline.stages.evidence import TrainEvidence, true_places
from pipeline.stages.evidence.evidence import Span, inside_spans
from pipeline.stages.judge.judged import REFERENCE, RIGHT, WRONG, JudgedEpochs, JudgedOffers, Judgements
from pipeline.stages.judge.judgement import (
    JudgeInput,
    MatchedPositions,
    judge_positions,
    judge_with_odometer,
    valid_at_ns,
)
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.path import TravelledPath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints, runs_of, spans_of, times_ns, truths
from schemas.config import Configuration, HazardConfig, LdsConfig, Vehicle
from schemas.enums import LdsState
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs

# An axis of the position, the position itself, a constellation or a satellite; any other target is no fault of GNSS.
_GNSS = r"(?i)^(along|cross|up|east|north|position|velocity|gnss|satellites?|gps|galileo|glonass|beidou|[A-Z][0-9]{2})$"


def injected_at(t_ns: Ints, faults: pl.DataFrame | None, recovery_s: float) -> Bools:
    """Instants at which an injected fault of GNSS acts: from its begin to `recovery_s` after its end, if it has one."""
    under = np.zeros(t_ns.size, dtype=np.bool_)
    if faults is None:
        return under
    of_gnss = faults.filter(pl.col("target").str.contains(_GNSS))
    spans = of_gnss.select(pl.col("t_start", "t_end").dt.timestamp("ns")).iter_rows()
    for begin_ns, end_ns in spans:
        under |= (t_ns >= begin_ns) & (end_ns is None or t_ns <= (end_ns or 0) + round(recovery_s * NS_PER_S))
    return under


def cross_errors_m(given: JudgeInput, heading_deg: Floats) -> Floats:
    """Position minus reference, left of growing path and upwards [m]; shape (2, epochs).

    NaN where the reference is silent, and where the position is farther ahead or behind than the failure limit: over
    such a distance a curve alone is metres aside, and a slope metres up.
    """
    at_ns = given.epochs_valid_at_ns()
    errors_m = np.full((2, at_ns.size), np.nan)
    reference = given.reference
    if reference is not None and reference.height >= 2:
        stamps = times_ns(reference)
        since_s = (stamps - stamps[0]) / NS_PER_S
        at_s = (at_ns - stamps[0]) / NS_PER_S
        after = np.searchsorted(since_s, at_s).clip(1, since_s.size - 1)
        covered = (at_s >= since_s[0]) & (at_s <= since_s[-1])
        covered &= since_s[after] - since_s[after - 1] <= given.config.hazards.reference_gap_s
        columns = ("latitude_deg", "longitude_deg", "height_m")
        latitude, longitude, height_m = (floats(given.solution.fixes, name) for name in columns)
        rows = np.flatnonzero(covered & np.isfinite(latitude))
        there = [np.interp(at_s[rows], since_s, floats(reference, name)) for name in columns]
        points = points_of(latitude[rows], longitude[rows])
        away = points.surface - points_of(there[0], there[1]).surface
        east = np.einsum("ij,ij->i", away, points.east)
        north = np.einsum("ij,ij->i", away, points.north)
        heading = np.radians(heading_deg[rows])
        # The vector from reference to position, turned from east and north to along and left of the heading.
        along_m = east * np.sin(heading) + north * np.cos(heading)
        left_m = north * np.sin(heading) - east * np.cos(heading)
        near = np.abs(along_m) <= given.config.hazards.limits.abreast_m
        errors_m[:, rows] = np.where(near, [left_m, height_m[rows] - there[2]], np.nan)
    return errors_m


@frozen
class OdometerSteps:
    """From each epoch to the next: `counts`, the odometer has no gap there; `moves`, it shows movement.

    `standstills`: times [ns] in which it shows none while positions leave their place by more than the failure limit.
    """

    moves: Bools
    counts: Bools
    standstills: tuple[Span, ...] = ()


def odometer_steps(given: JudgeInput) -> OdometerSteps:
    """Movement from epoch to epoch by the odometer; without one, or of unknown origin, no motion is known."""
    at_ns = given.epochs_valid_at_ns()
    odometry = given.odometry
    # One that may be made of the positions tells no motion (DOMAIN section 5.0).
    if odometry is None or not odometry.independent:
        return OdometerSteps(*np.zeros((2, at_ns.size), dtype=np.bool_))
    moves = _steps_by_epoch(odometry.moved(at_ns), at_ns.size)
    counts = _steps_by_epoch(np.isfinite(odometry.steps_m(at_ns)), at_ns.size)
    path_m = given.solution.epochs.path_m
    standstills: list[Span] = []
    for first, last in spans_of(counts & ~moves):
        rows = slice(first, min(last + 2, at_ns.size))
        places_m = path_m[rows][np.isfinite(path_m[rows])]
        if np.abs(places_m - places_m[:1]).max(initial=0.0) > given.config.hazards.limits.stand_m:
            standstills.append((int(at_ns[rows][0]), int(at_ns[rows][-1])))
    return OdometerSteps(moves, counts, tuple(standstills))


def travel_direction(
    direction: Ints, along: Judgements, at_ns: Ints, path_m: Floats, has_odometer: bool, config: HazardConfig
) -> Ints:
    """Direction of travel along growing path, 1 or -1, per epoch; `direction`: as the LDS knew it.

    Without an odometer the evidence decides, as a position that jumps back does not turn the train. With one the
    odometer does, unless the reference shows that it counts up in reverse.
    """
    train_m = path_m - along.known_error_m(config.known_error_m)
    moved_m, noise_m, _ = _movement_ahead(at_ns, train_m, along.half_m, config.turn_s)
    sure = np.abs(moved_m) > noise_m
    by_reference = along.kind == REFERENCE
    if has_odometer:
        # Not over a turn: the odometer knows best when that was.
        turned_by, _, _ = _movement_ahead(at_ns, direction.astype(np.float64), along.half_m, config.turn_s)
        sure &= by_reference & (turned_by == 0.0)
    rows = np.flatnonzero(sure)
    if rows.size == 0:
        return direction
    last = rows[np.maximum(np.searchsorted(rows, np.arange(at_ns.size), side="right") - 1, 0)]
    sense = np.sign(moved_m[last]).astype(np.int64)
    if not has_odometer:
        return sense
    # Until the reference says otherwise, the odometer agrees with it, or contradicts it, as at the last sure epoch.
    return direction * np.where(by_reference, sense * direction[last], 1)


def moves_and_may_move(
    at_ns: Ints, reference_m: Floats, half_m: Floats, steps: OdometerSteps, standing: Bools, config: Configuration
) -> tuple[Bools, Bools]:
    """Whether the train is known to move from each epoch to the next, and whether it may move; shapes (epochs,).

    It may also move where neither reference nor odometer knows. By the reference (`reference_m` +- `half_m`) it moves
    where its movement over a second exceeds dead band and noise. `standing`: the odometer shows none, positions do.
    """
    moved_m, noise_m, elapsed_s = _movement_ahead(at_ns, reference_m, half_m, config.align.speed_window_s)
    by_reference = np.abs(moved_m) > config.matching.deadband_mps * elapsed_s + noise_m
    moves = by_reference | (steps.moves & steps.counts)
    sure = np.isfinite(moved_m) | (steps.counts & ~standing)
    moves, sure = (_steps_by_epoch(steps_of[:-1], at_ns.size) for steps_of in (moves, sure))
    return moves & sure, moves | ~sure


def _movement_ahead(at_ns: Ints, place_m: Floats, half_m: Floats, window_s: float) -> tuple[Floats, Floats, Floats]:
    """Movement from each epoch to the one `window_s` later: distance [m], sum of both half intervals [m], time [s]."""
    ahead = np.searchsorted(at_ns, at_ns + round(window_s * NS_PER_S)).clip(0, at_ns.size - 1)
    return place_m[ahead] - place_m, half_m + half_m[ahead], (at_ns[ahead] - at_ns) / NS_PER_S


def _steps_by_epoch(steps: Bools, size: int) -> Bools:
    """Steps as a column of `size` epochs: each has that of the step after it, the last one that of the step before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]


def exceeds_odometer_confidence(
    t_ns: Ints, odometer_m: Floats, train_m: Floats, half_m: Floats, accepted_ns: Ints, lds: LdsConfig
) -> Bools:
    """Epochs at which the distance since the last accepted VB is wrong by more than 5 m + 5 % (SUBSET-041 5.3.1.1).

    `train_m` +- `half_m`: path position of the train [m], NaN where not known; the error counts where it exceeds the
    allowance and the half intervals of both places.
    """
    beyond = np.zeros(t_ns.size, dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(odometer_m) & np.isfinite(train_m))
    last = np.searchsorted(accepted_ns, t_ns[rows], side="right") - 1
    rows = rows[last >= 0]
    if rows.size == 0:
        return beyond
    since_ns = (t_ns[rows] - t_ns[rows[0]]).astype(np.float64)
    accepted = (accepted_ns[last[last >= 0]] - t_ns[rows[0]]).astype(np.float64)
    odometer_then_m, train_then_m, half_then_m = (
        np.interp(accepted, since_ns, values[rows]) for values in (odometer_m, train_m, half_m)
    )
    counted_m = odometer_m[rows] - odometer_then_m
    driven_m = train_m[rows] - train_then_m
    allowed_m = lds.odometer_fixed_m + lds.odometer_share * np.abs(counted_m) + half_m[rows] + half_then_m
    beyond[rows] = np.abs(counted_m - driven_m) > allowed_m
    return beyond


def speed_at_mps(epochs: AlignedEpochs, at_ns: Ints) -> Floats:
    """Speed of the train at each instant, interpolated between epochs [m/s]; NaN where no epoch knows it."""
    known = np.isfinite(epochs.speed_mps)
    if not known.any():
        return np.full(at_ns.size, np.nan)
    at_s, stamps_s = ((values - epochs.t_ns[0]) / NS_PER_S for values in (at_ns, epochs.t_ns[known]))
    return np.asarray(np.interp(at_s, stamps_s, np.abs(epochs.speed_mps[known])))


# Numerics: times shorter than half a nanosecond are rounding.
_LEAST_S = 0.5 / NS_PER_S


@frozen
class TimeInUse:
    """Which positions were in use, and for how long (DOMAIN section 5.3); arrays of shape (epochs,)."""

    in_use: Bools
    """Some of the time before the position was not negated, and it may be relied on."""
    used_s: Floats
    """Of a position in use all time since the position before, up to the longest step that is no gap [s]."""
    wrong_s: Floats
    """Of it where the position was wrong [s]."""
    counted_s: Floats
    """For shares of time, `wrong_s` where there is any [s]. An epoch without a position accounts only for a gap."""


def time_in_use(epochs: MonitoredEpochs, code: Ints, config: Configuration) -> TimeInUse:
    """The time before each epoch that it accounts for.

    Args:
        epochs: of one solution, in order of time.
        code: their judgements by number, shape (epochs,).
        config: the configuration; used are `lds` and `hazards.reaction_s`.

    Returns:
        Whether each was in use, and its times [s].

    Source:
        DOMAIN section 5.3.
    """
    known = epochs.positioned
    steps = _StepTimes.of(epochs, known, config)
    usable = epochs.trusted(config.lds) & ~epochs.withheld
    in_use = np.zeros(known.size, dtype=np.bool_)
    in_use[known] = usable[known] & (steps.left_s(steps.alone_s) > _LEAST_S)
    used_s = np.zeros(known.size)
    used_s[known] = np.where(in_use[known], steps.left_s(steps.near_s), 0.0)
    wrong_s = np.where(code == WRONG, used_s, 0.0)
    counted_s = np.where(wrong_s > 0.0, wrong_s, _accounted_s(epochs.t_ns, known, steps, config))
    return TimeInUse(in_use, used_s, wrong_s, counted_s)


@frozen
class _StepTimes:
    """The time from the position before to each, ending at `end_s`; `is_gap`: longer than a movement is interpolated.

    `near_s`: up to the longest step that is no gap (the fault may be that old); `alone_s`: up to one period.
    `blocked_s`: total time negated up to each of `edge_s`, the begins and ends of the negations; linear between them.
    """

    end_s: Floats
    near_s: Floats
    alone_s: Floats
    is_gap: Bools
    edge_s: Floats
    blocked_s: Floats

    @classmethod
    def of(cls, epochs: MonitoredEpochs, known: Bools, config: Configuration) -> _StepTimes:
        """Times of the steps between positions; `known`: epochs with a position."""
        all_ns = epochs.t_ns
        t_ns = all_ns[known]
        all_s = (all_ns - all_ns[:1]) / NS_PER_S
        # Before the first position there is none: it accounts for one period of the run, as far as that is known.
        step_s = np.diff(all_s[known], prepend=all_s[known][:1] - (nominal_period_s(t_ns) or 0.0))
        gap_s = crossing_gaps_ns(t_ns, config.lds) / NS_PER_S
        period_s = periods_before_s(t_ns)
        near_s = np.minimum(step_s, gap_s)
        alone_s = np.where(period_s > 0.0, np.minimum(near_s, period_s), near_s)
        reaction_s = reactions_ns(all_ns, t_ns, config) / NS_PER_S
        negated = _negated_spans(all_s, epochs.negated, epochs.withheld, reaction_s)
        blocked_s = np.cumsum(np.diff(negated, axis=1, prepend=negated[:, :1]).ravel())
        return cls(all_s[known], near_s, alone_s, step_s > gap_s, negated.ravel(), blocked_s)

    def left_s(self, length_s: Floats) -> Floats:
        """The last `length_s` before each position, less the negated part of it [s]."""
        if self.edge_s.size == 0:
            return length_s
        until_s, since_s = (np.interp(t_s, self.edge_s, self.blocked_s) for t_s in (self.end_s, self.end_s - length_s))
        left_s = length_s - (until_s - since_s)
        return np.where(left_s > _LEAST_S, left_s, 0.0)


def _negated_spans(t_s: Floats, negated: Bools, withheld: Bools, reaction_s: Floats) -> Floats:
    """Begin and end of each negation [s]: a reaction after it, or at once where already withheld, to the return."""
    firsts, lasts = runs_of(negated)
    until_s = np.append(t_s, t_s[-1:])[lasts + 1]
    from_s = t_s[firsts] + np.where(withheld[firsts], 0.0, reaction_s[firsts])
    return np.column_stack([np.minimum(from_s, until_s), until_s])


def _accounted_s(t_ns: Ints, known: Bools, steps: _StepTimes, config: Configuration) -> Floats:
    """Time that each epoch accounts for [s]: since the epoch before, of a gap no more than is interpolated over.

    Of epochs between two near positions the later position accounts for all, the others for none.
    """
    longest_s = crossing_gaps_ns(t_ns, config.lds) / NS_PER_S
    since_s = np.minimum(np.diff(t_ns, prepend=t_ns[:1]) / NS_PER_S, longest_s)
    rows = np.flatnonzero(known)
    after = np.searchsorted(rows, np.arange(t_ns.size))
    since_s[(after > 0) & np.append(~steps.is_gap, False)[after]] = 0.0
    since_s[rows] = np.where(steps.is_gap, since_s[rows], steps.near_s)
    return since_s


def lds_states(negated: Bools, code: Ints, in_use: Bools, undiagnosed: Bools) -> Ints:
    """P1 wrong in use, P2 negated, P3 not diagnosed, P0 right, the first that applies (DOMAIN section 4).

    By number in `LdsState`; -1 where the evidence cannot say, and where a wrong position was not in use.
    """
    applies = {
        LdsState.P1: (code == WRONG) & in_use,
        LdsState.P2: negated,
        LdsState.P3: undiagnosed,
        LdsState.P0: code == RIGHT,
    }
    numbers = [tuple(LdsState).index(state) for state in applies]
    return np.select(list(applies.values()), numbers, default=-1)


def judged_epochs(given: JudgeInput, steps: OdometerSteps) -> JudgedEpochs:
    """The epochs of the solution with evidence, judgement, direction, movement, time in use and state of the LDS.

    Args:
        given: the solution and its evidence.
        steps: what the odometer says of the steps between its epochs.

    Returns:
        The epochs in their order; errors in the direction of travel.

    Source:
        DOMAIN sections 5.2 and 5.3.
    """
    epochs = given.solution.epochs
    config = given.config
    at_ns = given.epochs_valid_at_ns()
    positions = MatchedPositions.of_epochs(epochs, given.evidence.network.track.index)
    evidence = given.evidence_at(at_ns)
    along = judge_with_odometer(given, positions, at_ns, evidence)
    has_odometer = given.odometry is not None
    direction = travel_direction(epochs.direction, along, at_ns, epochs.path_m, has_odometer, config.hazards)
    judged = along.turned(direction)
    train_m = positions.path_m - along.known_error_m(config.hazards.known_error_m)
    reference_m = np.where(along.kind == REFERENCE, train_m, np.nan)
    standing = inside_spans(at_ns, given.evidence.standstills)
    accepted_ns = given.solution.crossings.t_ns[given.solution.crossings.accepted]
    odometer_wrong = exceeds_odometer_confidence(
        epochs.t_ns, epochs.odometer_m, train_m, along.half_m, accepted_ns, config.lds
    )
    undiagnosed = epochs.diagnosis_faulty | odometer_wrong
    use = time_in_use(epochs, along.code, config)
    injected = injected_at(epochs.t_ns, given.faults, config.lds.recovery_s)
    error_cross_m, error_up_m = cross_errors_m(given, epochs.heading_deg)
    moves, may_move = moves_and_may_move(at_ns, reference_m, along.half_m, steps, standing, config)
    return JudgedEpochs(
        **epochs.columns() | {"direction": direction},
        epoch=np.arange(epochs.height),
        at_ns=at_ns,
        judgements=judged,
        true_places=true_places(evidence, given.evidence.network.track),
        error_along_m=judged.known_error_m(config.hazards.known_error_m),
        error_cross_m=error_cross_m,
        error_up_m=error_up_m,
        train_m=train_m,
        reference_m=reference_m,
        moves=moves,
        may_move=may_move,
        odometer_standing=standing,
        odometer_wrong=odometer_wrong,
        undiagnosed=undiagnosed,
        in_use=use.in_use,
        used_s=use.used_s,
        wrong_s=use.wrong_s,
        natural_s=use.wrong_s * ~injected,
        counted_s=use.counted_s,
        lds_state=lds_states(epochs.negated, along.code, use.in_use, undiagnosed),
    )


def direction_by_evidence(
    epochs: AlignedEpochs, path: TravelledPath, evidence: TrainEvidence, vehicle: Vehicle, config: Configuration
) -> Ints:
    """Direction of travel of a run without an odometer, before anything is judged; shape (epochs,)."""
    at_ns = valid_at_ns(epochs.t_ns, vehicle)
    index = evidence.network.track.index
    positions = MatchedPositions.of_epochs(epochs, index)
    # Of a judgement the direction takes the interval of the error, which no limit changes.
    limit_m = np.full(at_ns.size, config.hazards.limits.failure_m)
    along = judge_positions(positions, evidence.at(at_ns), path.routes_by_leg(index), limit_m)
    return travel_direction(epochs.direction, along, at_ns, epochs.path_m, has_odometer=False, config=config.hazards)


def judged_offers(given: JudgeInput, epochs: JudgedEpochs) -> JudgedOffers:
    """The offers of the LDS, every telegram among them.

    Judged is the place of the balise: at the time of the telegram, or of the crossing less the GNSS latency.

    Args:
        given: the solution and its evidence.
        epochs: its epochs as judged.

    Returns:
        The offers in order of time.

    Source:
        DOMAIN section 5.2.
    """
    crossings = given.solution.crossings
    rows = given.solution.offers
    before, epoch, t_ns = (values[rows] for values in (crossings.before, crossings.epoch, crossings.t_ns))
    hazards = given.config.hazards
    sure = epochs.unambiguous
    index = given.evidence.network.track.index
    positions = MatchedPositions.of_balises(crossings, rows, index, sure[before] & sure[epoch])
    at_ns = np.where(crossings.virtual[rows], given.instants(t_ns), t_ns)
    along = judge_with_odometer(given, positions, at_ns, given.evidence_at(at_ns))
    judged = along.turned(epochs.direction[before])
    passages = given.solution.passages
    late = truths(passages["odometer_distance_m"] > passages["window_close_m"])
    return JudgedOffers.of_crossings(
        crossings,
        rows,
        beyond_window=np.isin(rows, ints(passages["crossing_id"])[late]),
        judged=judged,
        location_error_m=judged.known_error_m(hazards.known_error_m),
        proof_margin_m=np.where(judged.is_right, judged.limit_m - judged.largest_m, np.nan),
    )
