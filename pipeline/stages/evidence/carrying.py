"""Carrying a known place along the track by the odometer, and the clocks of recorders (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.odometry import OdometerDistance
from pipeline.stages.odometry.regression import ScaleLag
from pipeline.stages.odometry.scale_lag import CounterRows, possible_lags, scale_and_lag
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, runs_of
from schemas.config import Configuration, HazardConfig
from schemas.enums import Evidence
from schemas.frozen import frozen

Interval = tuple[Floats, Floats]
"""Least and largest coordinate [m], NaN where nothing is known."""


@frozen
class TrueAnchor:
    """At an instant of the odometer's clock the train was at one of `places`.

    `clock_m`: what is not known of the recorder's clock, `delta_s`, may add at the speed there, and `open_m`, what a
    step left open [m]. `proved`: it shows that the track is one of the survey (DOMAIN section 5.0).
    """

    t_ns: int
    places: tuple[Place, ...]
    sigma_m: float
    kind: Evidence
    clock_m: float = 0.0
    proved: bool = True
    delta_s: float = 0.0
    open_m: float = 0.0


@frozen
class SignedOdometer:
    """An odometer as evidence, that carries nothing where its distance is in doubt by more than `doubt_limit_m`.

    Without a sign (not `signed`: it counts up when the train goes back) also over a stand, which may hide a turn.
    """

    odometer: Odometry
    doubt_limit_m: float = 0.0
    signed: bool = True

    def without_sign(self) -> SignedOdometer:
        """The same odometer, taken to count up in both directions."""
        return replace(self, signed=False)

    @cached_property
    def _breaks_ns(self) -> Ints:
        """Instants at which an odometer without sign may have changed its sense."""
        return np.zeros(0, dtype=np.int64) if self.signed else _stand_middles_ns(self.odometer)

    @property
    def has_known_scale(self) -> bool:
        """Whether scale and its sigma are those of a vehicle file."""
        return self.odometer.scale is not None

    def distance_and_variance(self, begin_ns: Ints | int, end_ns: Ints) -> OdometerDistance:
        """True distance between instants, its variance and bound; NaN over a break.

        Args:
            begin_ns: instants from which, one or as many as `end_ns` [ns].
            end_ns: instants to which [ns], shape (n,).
        """
        counted = self.odometer.distance_and_variance(begin_ns, end_ns)
        known = self._are_unbroken(begin_ns, end_ns) & (counted.bound_m <= self.doubt_limit_m)
        return counted._replace(distance_m=np.where(known, counted.distance_m, np.nan))

    def undoubted_distance_m(self, begin_ns: Ints | int, end_ns: Ints) -> Floats:
        """Distance between instants where nothing of it is in doubt [m]; NaN over slip, pauses and resets too."""
        return np.where(
            self._are_unbroken(begin_ns, end_ns), self.odometer.proved_distance_between(begin_ns, end_ns), np.nan
        )

    @cached_property
    def counter_rows(self) -> CounterRows:
        """Rows of the odometer for measuring its lag; a step of which anything is in doubt gives no distance."""
        odometer = self.odometer
        t_ns = odometer.epoch_ns + np.round(odometer.t_s * NS_PER_S).astype(np.int64)
        whole = self._are_unbroken(t_ns[:-1], t_ns[1:]) & np.isfinite(odometer.steps_m(t_ns))
        doubtful = np.concatenate([[0.0], np.cumsum(~whole)])
        noise_m = float(np.sqrt(odometer.noise.quantisation.still_m2))
        return CounterRows(odometer.t_s, (odometer.scale or 1.0) * odometer.distance_m, doubtful, noise_m)

    def hold_to_recording(self, t_ns: Ints, beyond_s: float) -> tuple[Ints, Floats]:
        """The instants, those up to `beyond_s` off its recording put at its ends; how far the train drives [m]."""
        begin_ns, end_ns = self.odometer.begin_ns, self.odometer.end_ns
        held_ns = np.clip(t_ns, begin_ns, end_ns)
        off_s = np.abs(t_ns - held_ns) / NS_PER_S
        near = (off_s > 0.0) & (off_s <= beyond_s)
        if not near.any():
            return t_ns, np.zeros(t_ns.size)
        beyond_m = (
            np.abs(self.odometer.speed_about(held_ns)) * off_s + 0.5 * self.odometer.config.braking_mps2 * off_s**2
        )
        return np.where(near, held_ns, t_ns), np.where(near, beyond_m, 0.0)

    def _are_unbroken(self, begin_ns: Ints | int, end_ns: Ints) -> Bools:
        """Whether no break lies between the instants."""
        breaks = [np.searchsorted(self._breaks_ns, t_ns, side="right") for t_ns in (begin_ns, end_ns)]
        return np.asarray(breaks[0] == breaks[1])

    def driven_between_m(self, since_ns: Ints | int, t_ns: Ints) -> Floats:
        """Distance driven between instants [m], turns included."""
        travelled_at = self.odometer.travelled_at
        return np.asarray(np.abs(travelled_at(t_ns) - travelled_at(np.atleast_1d(since_ns))))


def _stand_middles_ns(odometer: Odometry) -> Ints:
    """The middle of each stand [ns], looked at second by second."""
    t_ns = np.arange(odometer.begin_ns, odometer.end_ns, NS_PER_S, dtype=np.int64)
    first, last = runs_of(~odometer.moved(t_ns))
    return np.array((t_ns[first] + t_ns[np.minimum(last + 1, t_ns.size - 1)]) // 2, dtype=np.int64)


def odometer_confidence_m(driven_m: Floats, known_m: float, config: Configuration) -> Floats:
    """Half the interval away from a place known to `known_m`: 5 m + 5 % of the distance run (SUBSET-041 5.3.1.1)."""
    return np.asarray(max(config.lds.odometer_fixed_m, known_m) + config.lds.odometer_share * driven_m)


def _anchor_doubt_m(counter: SignedOdometer, anchor: TrueAnchor, t_ns: Ints) -> Floats:
    """What the anchor's clock, and steps, may add at some instants [m]: by the speed there or at the anchor."""
    if anchor.delta_s == 0.0:
        return np.full(t_ns.size, anchor.clock_m)
    there_m = anchor.open_m + anchor.delta_s * np.abs(counter.odometer.speed_about(t_ns))
    return np.asarray(np.maximum(there_m, anchor.clock_m))


def carry_from_anchor(
    counter: SignedOdometer, anchor: TrueAnchor, at_m: float, t_ns: Ints, config: Configuration
) -> Interval:
    """Coordinates that the train may have at some instants, carried on one side from an anchor at `at_m`.

    The fixed 5 m hold what may be off at the anchor itself.
    """
    known_m = config.hazards.evidence_factor * anchor.sigma_m + _anchor_doubt_m(counter, anchor, t_ns)
    return _carry_from(counter, anchor.t_ns, at_m, t_ns, np.maximum(known_m, config.lds.odometer_fixed_m), config)


def _carry_from(
    counter: SignedOdometer,
    since_ns: Ints | int,
    at_m: Floats | float,
    t_ns: Ints,
    known_m: Floats | float,
    config: Configuration,
) -> Interval:
    """The interval of a place known to `known_m`, plus the distance since `since_ns`, +- (5 % + bound)."""
    distance = counter.distance_and_variance(since_ns, t_ns)
    centre = at_m + distance.distance_m
    half = known_m + config.lds.odometer_share * counter.driven_between_m(since_ns, t_ns) + distance.bound_m
    return centre - half, centre + half


def carry_between_anchors(
    counter: SignedOdometer,
    anchors: tuple[TrueAnchor, TrueAnchor],
    at_m: tuple[float, float],
    t_ns: Ints,
    config: Configuration,
) -> Interval:
    """Coordinates that the train may have at instants between two anchors at `at_m` (DOMAIN section 5.1, carrying).

    Where the odometer of a vehicle file closes, the inverse-variance mean of both +- (k sigmas + closing error), as the
    whole closing error may have arisen at one place. Else the hull of both. Each is wider by its own bound; where the
    gap closes with it and the less doubtful anchor alone is narrower, that counts.
    """
    factor = config.hazards.evidence_factor
    clock_m = [_anchor_doubt_m(counter, anchor, t_ns) for anchor in anchors]
    distances = [counter.distance_and_variance(anchor.t_ns, t_ns) for anchor in anchors]
    places = [at + distance.distance_m for at, distance in zip(at_m, distances, strict=True)]
    variances = [anchor.sigma_m**2 + distance.variance_m2 for anchor, distance in zip(anchors, distances, strict=True)]
    closed = odometer_closes(counter, anchors, at_m[1] - at_m[0], config)
    if counter.has_known_scale and closed:
        weights = [1.0 / variance for variance in variances]
        share = weights[0] / (weights[0] + weights[1])
        centre = share * places[0] + (1.0 - share) * places[1]
        # The two places differ by the closing error at every instant.
        half = factor / np.sqrt(weights[0] + weights[1]) + np.abs(places[0] - places[1])
        half += share * (clock_m[0] + distances[0].bound_m) + (1.0 - share) * (clock_m[1] + distances[1].bound_m)
        together = centre - half, centre + half
        return _narrower_interval(together, counter, anchors, at_m, t_ns, distances, config)
    halves = [
        factor * np.sqrt(variance) + added_m + distance.bound_m
        for variance, added_m, distance in zip(variances, clock_m, distances, strict=True)
    ]
    low = np.minimum(places[0] - halves[0], places[1] - halves[1])
    hull = low, np.maximum(places[0] + halves[0], places[1] + halves[1])
    # What does not close is not explained by the known doubts: it may have been lost anywhere between.
    return _narrower_interval(hull, counter, anchors, at_m, t_ns, distances, config) if closed else hull


def _narrower_interval(
    together: Interval,
    counter: SignedOdometer,
    anchors: tuple[TrueAnchor, TrueAnchor],
    at_m: tuple[float, float],
    t_ns: Ints,
    distances: list[OdometerDistance],
    config: Configuration,
) -> Interval:
    """The interval of both anchors together, or that of the less doubtful one, whichever is narrower."""
    doubtful = (distances[0].bound_m > 0.0) | (distances[1].bound_m > 0.0)
    if not doubtful.any():
        return together
    first, second = (
        carry_from_anchor(counter, anchor, at, t_ns, config) for anchor, at in zip(anchors, at_m, strict=True)
    )
    by_first = distances[0].bound_m <= distances[1].bound_m
    low_m, high_m = (np.where(by_first, *pair) for pair in zip(first, second, strict=True))
    alone = doubtful & ~(together[1] - together[0] <= high_m - low_m)
    return np.where(alone, low_m, together[0]), np.where(alone, high_m, together[1])


def odometer_closes(
    counter: SignedOdometer, anchors: tuple[TrueAnchor, TrueAnchor], apart_m: float, config: Configuration
) -> bool:
    """Whether the odometer's distance is that of the anchors: within k combined sigmas, without a file 5 m + 5 %."""
    begin, end = anchors
    end_ns = np.array([end.t_ns])
    distance = counter.distance_and_variance(begin.t_ns, end_ns)
    root = np.sqrt(begin.sigma_m**2 + end.sigma_m**2 + distance.variance_m2)
    limit = config.hazards.evidence_factor * root
    if not counter.has_known_scale:
        limit = odometer_confidence_m(counter.driven_between_m(begin.t_ns, end_ns), 0.0, config)
    return bool((np.abs(apart_m - distance.distance_m) <= limit + distance.bound_m)[0])


def carry_from_accepted(
    accepted_ns: Ints,
    path_m: Floats,
    t_ns: Ints,
    odometer: Odometry,
    standstills: Sequence[tuple[int, int]],
    config: Configuration,
) -> Interval:
    """Path positions that the train may have: the last accepted balise, plus the distance since, +- (5 m + 5 %).

    NaN before the first balise, over a break and over a stand of `standstills`. `accepted_ns` in order, at `path_m` of
    the solution's own path, with which the odometer grows.
    """
    counter = SignedOdometer(odometer, config.hazards.limits.doubt_m)
    used = _consistent_with_odometer(accepted_ns, path_m, counter, config)
    low, high = np.full((2, t_ns.size), np.nan)
    if used.size:
        last = np.searchsorted(accepted_ns[used], t_ns, side="right") - 1
        rows = np.flatnonzero(last >= 0)
        since = used[last[rows]]
        # A stand between balise and instant: the wheel may have stood still while the train ran.
        over_stand = np.zeros(rows.size, dtype=np.bool_)
        for begin_ns, end_ns in standstills:
            over_stand |= (t_ns[rows] >= begin_ns) & (accepted_ns[since] <= end_ns)
        fixed_m = config.lds.odometer_fixed_m
        interval = _carry_from(counter, accepted_ns[since], path_m[since], t_ns[rows], fixed_m, config)
        low[rows], high[rows] = np.where(over_stand, np.nan, interval)
    return low, high


def _consistent_with_odometer(
    accepted_ns: Ints, path_m: Floats, counter: SignedOdometer, config: Configuration
) -> Ints:
    """Numbers of accepted balises that agree, within the failure limit, with the odometer since the last such."""
    limit_m = config.hazards.limits.agreement_m

    def agrees(before: Ints, here: Ints) -> Bools:
        """Whether each balise `here` lies where the odometer leads from the one `before`, within the limit."""
        fixed_m = config.lds.odometer_fixed_m
        low, high = _carry_from(counter, accepted_ns[before], path_m[before], accepted_ns[here], fixed_m, config)
        at_m = path_m[here]
        # Where the odometer knows nothing it contradicts nothing.
        return np.asarray(~((at_m < low - limit_m) | (at_m > high + limit_m)))

    known = np.flatnonzero(counter.odometer.known_at(accepted_ns))
    # One call for all pairs of neighbours; only after one that disagrees is another pair asked for.
    with_neighbour = agrees(known[:-1], known[1:]).tolist()
    used: list[int] = known[:1].tolist()
    for place in range(1, known.size):
        here = known[place : place + 1]
        next_to = used[-1] == known[place - 1]
        if with_neighbour[place - 1] if next_to else agrees(np.array(used[-1:]), here)[0]:
            used.append(int(here[0]))
    return np.array(used, dtype=np.int64)


# A lag of less than so many of its sigmas may be none.
_SHOWN_SIGMAS = 2.0
# Two lags of one recorder differ beyond so many.
_DIFFER_SIGMAS = 4.0
# Numerics: steps over possible lags [s].
_LAG_STEP_S = 1.0


@frozen
class RecorderClock:
    """How a recorder is put on the odometer's clock: its stamps less `shift_s`, +- `delta_s`.

    `assumed`: that could not be measured.
    """

    shift_s: float
    delta_s: float
    assumed: bool = False


@frozen
class Lags:
    """What the movements of a recorder say of its lag behind one odometer: `found`, and the least and largest
    `possible_s`.

    `found`: one of the run, or two where its halves disagree. `possible_s`: what the movements do not refute where none
    is measured and they refute that there is none; None where there may be none, or they say nothing of it.
    """

    found: tuple[ScaleLag, ...] = ()
    possible_s: tuple[float, float] | None = None

    def lag_range_s(self, config: HazardConfig) -> tuple[float, float] | None:
        """Least and largest lag that the recorder may have; None where it is what is assumed of a clock."""
        measured = [lag for lag in self.found if _is_measured(lag, config)]
        if not measured:
            return self._possible_range_s()
        noises_s = [config.evidence_factor * lag.lag_sigma_s for lag in measured]
        lows_s = [lag.lag_s - noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
        highs_s = [lag.lag_s + noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
        return min(lows_s), max(highs_s)

    def _possible_range_s(self) -> tuple[float, float] | None:
        """A range about 0 as wide as the lag may reach; what is not measured moves nothing, it may be a slip."""
        if self.possible_s is None:
            return None
        low_s, high_s = self.possible_s
        reach_s = max(-low_s, high_s)
        return -reach_s, reach_s


def recorder_clock(lags: Sequence[Lags], independent: bool, config: HazardConfig) -> RecorderClock:
    """The clock of a recorder with all lags that it may have, by several odometers (DOMAIN section 5.1).

    By odometers that are not `independent` a lag may widen what is assumed of a clock, and never narrow it.
    """
    ranges_s = [range_s for of_one in lags if (range_s := of_one.lag_range_s(config)) is not None]
    if not ranges_s:
        return RecorderClock(0.0, config.evidence_clock_s, assumed=True)
    low_s, high_s = min(low for low, _ in ranges_s), max(high for _, high in ranges_s)
    least_s = 0.0 if independent else config.evidence_clock_s
    if low_s <= 0.0 <= high_s:
        # There may be none.
        return RecorderClock(0.0, max(-low_s, high_s, least_s), assumed=not independent)
    return RecorderClock(0.5 * (low_s + high_s), max(0.5 * (high_s - low_s), least_s), assumed=not independent)


def recorder_clocks(lags: Sequence[Sequence[Lags]], independent: bool, config: HazardConfig) -> list[RecorderClock]:
    """The clock of each recorder; one that cannot be measured may be the odometer's or that of any other."""
    clocks = [recorder_clock(of_one, independent, config) for of_one in lags]
    return [
        _toward_measured_clocks(clock, [*clocks[:number], *clocks[number + 1 :]], config)
        for number, clock in enumerate(clocks)
    ]


def _toward_measured_clocks(
    clock: RecorderClock, others: Sequence[RecorderClock], config: HazardConfig
) -> RecorderClock:
    """A clock that is assumed, widened so that it may be the odometer's or that of any other recorder."""
    shifts_s = [0.0, *(other.shift_s for other in others)]
    low_s, high_s = min(shifts_s), max(shifts_s)
    if not clock.assumed or low_s == high_s:
        return clock
    middle_s = 0.5 * (low_s + high_s)
    delta_s = abs(clock.shift_s - middle_s) + 0.5 * (high_s - low_s) + config.evidence_clock_s
    return RecorderClock(middle_s, delta_s, assumed=True)


def possible_leads_s(clocks: Sequence[RecorderClock]) -> tuple[float, ...]:
    """How early the odometer's stamps may be, least to largest [s]: a measured lag belongs to nobody.

    If a recorder has it the odometer's own stamps are true, else odometer and GNSS share it, and what the odometer
    stamped one lag before is true: that of any recorder, and all between.
    """
    shifts_s = [0.0, *(clock.shift_s for clock in clocks)]
    low_s, high_s = min(shifts_s), max(shifts_s)
    if low_s == high_s:
        return (low_s,)
    return tuple(float(lag_s) for lag_s in np.linspace(low_s, high_s, 2 + int((high_s - low_s) / _LAG_STEP_S)))


def _is_measured(lag: ScaleLag, config: HazardConfig) -> bool:
    """Whether a lag counts as measured: not where it may be none and is known to no better than what is assumed."""
    noise_s = config.evidence_factor * lag.lag_sigma_s
    return abs(lag.lag_s) >= _SHOWN_SIGMAS * lag.lag_sigma_s or noise_s <= config.evidence_clock_s


def measure_lags(
    begin_ns: Ints, end_ns: Ints, moved_m: Floats, sigma_m: Floats, counter: SignedOdometer, config: Configuration
) -> Lags:
    """The lag of a recorder by the movements that it saw between its stamps, positive as the odometer counts up.

    A clock that changes in the middle of a run, at a stand or after a restart, has no lag of the run. `sigma_m`: of a
    movement by the recorder's own noise.
    """
    order = begin_ns.argsort(kind="stable")
    begin_ns, end_ns = begin_ns[order], end_ns[order]
    moved_m, sigma_m = moved_m[order], sigma_m[order]
    begin_s, end_s = (counter.odometer.seconds(t_ns) for t_ns in (begin_ns, end_ns))
    half = begin_ns.size // 2
    halves = [
        scale_and_lag(begin_s[part], end_s[part], moved_m[part], counter.counter_rows)
        for part in (slice(half), slice(half, None))
    ]
    apart_sigma_s = float(np.hypot(halves[0].lag_sigma_s, halves[1].lag_sigma_s))
    if abs(halves[0].lag_s - halves[1].lag_s) > _DIFFER_SIGMAS * apart_sigma_s:
        return Lags(tuple(halves))
    found = scale_and_lag(begin_s, end_s, moved_m, counter.counter_rows)
    if _is_measured(found, config.hazards):
        return Lags((found,))
    # Movements that follow one another share the noise of the place between them: together as if each had twice its
    # variance.
    variance_m2 = 2.0 * sigma_m**2 + np.nan_to_num(counter.distance_and_variance(begin_ns, end_ns).variance_m2)
    factor = config.hazards.evidence_factor
    scale_off = factor * (counter.odometer.scale_sigma or 0.0) if counter.has_known_scale else config.lds.odometer_share
    movements = (begin_s, end_s, moved_m)
    low_s, high_s = possible_lags(movements, counter.counter_rows, np.sqrt(variance_m2), scale_off, _SHOWN_SIGMAS) or (
        0.0,
        0.0,
    )
    if low_s <= 0.0 <= high_s:
        return Lags((found,))
    return Lags((found,), possible_lags(movements, counter.counter_rows, np.sqrt(variance_m2), scale_off, factor))
