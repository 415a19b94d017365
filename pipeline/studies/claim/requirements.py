"""Each requirement of a profile: its words, how it is counted on one solution of one run, what the counts show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import polars as pl

from pipeline.studies.claim.areas import AREA_TYPES, NO_AREA
from pipeline.studies.claim.front import FrontEnd, SpeedErrors, speed_errors
from pipeline.studies.claim.profile import KMH_PER_MPS, AreaLimits, RequirementProfile
from pipeline.studies.claim.tally import (
    ALWAYS,
    BROKEN,
    NOT_KNOWN,
    Demand,
    Kind,
    Tally,
    codes,
    count_claims,
)
from pipeline.studies.tally import S_PER_H
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags
from schemas.enums import AreaType, BaliseKind, PassageStatus
from schemas.frozen import frozen

ALL = "all"


@frozen
class ClaimJourney:
    """One solution of one run: its front end, and the tables that the requirements ask for besides."""

    name: str
    front: FrontEnd
    epochs: pl.DataFrame
    passages: pl.DataFrame
    profile: RequirementProfile

    def tally_epochs(self, code: Ints, where: Bools, size: Floats | None = None) -> Tally:
        """Tally of the epochs `where` a requirement applies, and of the gaps of the log that begin or end there."""
        clock = self.front.clock
        without_data_s = self.front.gap_after_s
        rows = np.flatnonzero(where | ((without_data_s > 0) & np.append(where[1:], False)))
        here = where[rows]
        held = np.where(here, clock.held_s[rows], 0.0)
        codes = np.where(here, code[rows], NOT_KNOWN)
        sizes = None if size is None else np.where(here, size[rows], np.nan)
        return count_claims(
            self.name, clock.t_ns[rows], held, codes, self.profile.method.event_gap_s, sizes, without_data_s[rows]
        )

    def inside_area(self, kind: AreaType) -> Bools:
        """Epochs with an estimated front end in areas of this type."""
        inside: Bools = self.front.has_output & (self.front.where.area == AREA_TYPES.index(kind))
        return inside

    @cached_property
    def limit_m(self) -> Floats:
        """MAPO and MAPU at each epoch; NaN outside all areas."""
        limits = np.full(self.front.front_m.size, np.nan)
        for kind, demanded in self.profile.areas.items():
            here = self.front.where.area == AREA_TYPES.index(kind)
            limits[here] = demanded.limits_m(self.front.where.track_speed_mps[here])
        return limits

    @cached_property
    def beyond_limits(self) -> dict[str, tuple[Ints, Floats]]:
        """The intervals claimed, and the errors known, against MAPO and MAPU: codes and sizes."""
        front = self.front
        limit_m = self.limit_m
        none = np.inf
        with np.errstate(invalid="ignore"):
            claimed = [codes(width <= limit_m, width > limit_m) for width in (front.over_m, front.under_m)]
        return {
            "mapo_claimed": (claimed[0], front.over_m),
            "mapu_claimed": (claimed[1], front.under_m),
            "mapo": (_codes_where_demanded(front.codes_within_m(limit_m, none), limit_m), front.low_m),
            "mapu": (_codes_where_demanded(front.codes_within_m(none, limit_m), limit_m), -front.high_m),
        }

    @cached_property
    def speeds(self) -> SpeedErrors:
        """Errors of the speed, window by window."""
        return speed_errors(self.front, self.profile.method.speed_window_s)

    @cached_property
    def safe_codes(self) -> Ints:
        """Codes per epoch: is the train between min and max safe front end?"""
        return self.front.codes_within_m(self.front.over_m, self.front.under_m)

    def tally_outside(self) -> Tally:
        """Time with an estimated front end outside all areas."""
        nowhere = self.front.has_output & (self.front.where.area == NO_AREA)
        return self.tally_epochs(np.full(nowhere.size, NOT_KNOWN), nowhere)


Key = tuple[str, str]
Tallies = dict[Key, Tally]


@frozen
class Requirement:
    """One requirement: its limit in words, what is demanded, and how a run counts."""

    name: str
    applies_to: str
    limit: str
    demand: Demand
    clause: str
    count: Callable[[ClaimJourney], Tally] = lambda _: Tally()

    @property
    def key(self) -> Key:
        """Name, and what it applies to."""
        return self.name, self.applies_to


def tallies(journey: ClaimJourney) -> Tallies:
    """Every requirement on one journey."""
    return {requirement.key: requirement.count(journey) for requirement in requirements(journey.profile)}


def requirements(profile: RequirementProfile) -> list[Requirement]:
    """The requirements of a profile in their order."""
    rate = profile.failure_rate
    return [
        *(
            requirement
            for kind, area in profile.areas.items()
            for requirement in _area_requirements(kind, area, profile)
        ),
        Requirement("safe_front_end", ALL, "own CI", Demand(Kind.RATE, rate.aim_per_h), rate.clause, _tally_safe),
        Requirement(
            "safe_front_end_bound", ALL, "own CI", Demand(Kind.RATE, rate.bound_per_h), rate.clause, _tally_safe
        ),
        *(requirement for kind in profile.slow.area_types for requirement in _slow_requirements(kind, profile)),
        *_balise_requirements(profile),
        *_speed_requirements(profile),
        *_start_requirements(profile),
        *_operation_requirements(profile),
    ]


def _tally_safe(journey: ClaimJourney, kind: AreaType | None = None) -> Tally:
    """Tally of the train between min and max safe front end, in areas of one type or wherever it is."""
    where = journey.front.has_output if kind is None else journey.inside_area(kind)
    return journey.tally_epochs(journey.safe_codes, where, journey.front.least_error_m)


def _codes_where_demanded(code: Ints, limit: Floats) -> Ints:
    """The codes, not known where nothing is demanded (NaN)."""
    return np.where(np.isfinite(limit), code, NOT_KNOWN)


def _area_requirements(kind: AreaType, area: AreaLimits, profile: RequirementProfile) -> list[Requirement]:
    """What is demanded in areas of one type: MAPO and MAPU, safe front end, accuracy."""

    def tally_exceeded(journey: ClaimJourney, name: str) -> Tally:
        """Tally of the limit of one name, claimed or known."""
        code, size = journey.beyond_limits[name]
        return journey.tally_epochs(code, journey.inside_area(kind), size)

    def tally_accuracy(journey: ClaimJourney) -> Tally:
        """Tally of the accuracy of the estimated front end."""
        code = journey.front.codes_within_m(area.accuracy_m, area.accuracy_m)
        return journey.tally_epochs(code, journey.inside_area(kind), journey.front.least_error_m)

    of = kind.value
    rate = profile.failure_rate
    aim = Demand(Kind.RATE, rate.aim_per_h)
    limit = f"{area.limit_m:g} m" if not area.way_s else f"{area.limit_m:g} m/{area.way_s:g} s"
    near = f"{area.accuracy_m:g} m"
    often = Demand(Kind.SHARE, area.accuracy_share)
    return [
        *(
            Requirement(name, of, limit, ALWAYS, area.limit_clause, partial(tally_exceeded, name=name))
            for name in ("mapo_claimed", "mapu_claimed", "mapo", "mapu")
        ),
        Requirement("safe_front_end", of, "own CI", aim, rate.clause, partial(_tally_safe, kind=kind)),
        Requirement("front_accuracy", of, near, often, area.accuracy_clause, tally_accuracy),
    ]


def _slow_requirements(kind: AreaType, profile: RequirementProfile) -> list[Requirement]:
    """Safe and precise operation at low speed: tally_claimed and tally_known."""
    slow = profile.slow
    of = kind.value

    def are_slow_inside(journey: ClaimJourney) -> Bools:
        """Epochs in such an area, below the speed."""
        return journey.inside_area(kind) & (np.abs(journey.front.speed_mps) * KMH_PER_MPS < slow.below_kmh)

    def tally_claimed(journey: ClaimJourney) -> Tally:
        """Tally of the interval that is tally_claimed."""
        width = np.maximum(journey.front.over_m, journey.front.under_m)
        return journey.tally_epochs(codes(width <= slow.limit_m, width > slow.limit_m), are_slow_inside(journey), width)

    def tally_known(journey: ClaimJourney, limit_m: float) -> Tally:
        """Tally of the error that is tally_known."""
        return journey.tally_epochs(journey.front.codes_within_m(limit_m, limit_m), are_slow_inside(journey))

    limit = f"{slow.limit_m:g} m"
    close = f"{slow.accuracy_m:g} m"
    safe, accurate = (partial(tally_known, limit_m=limit_m) for limit_m in (slow.limit_m, slow.accuracy_m))
    return [
        Requirement("slow_claimed", of, limit, ALWAYS, slow.clause, tally_claimed),
        Requirement("slow_front_end", of, limit, ALWAYS, slow.clause, safe),
        Requirement("slow_accuracy", of, close, Demand(Kind.SHARE, slow.accuracy_share), slow.clause, accurate),
    ]


def _balise_requirements(profile: RequirementProfile) -> list[Requirement]:
    """The first estimate after each balise accepted; physical ones, and virtual ones as if they were.

    Where it comes late or not at all nobody knows what it would have been.
    """
    after = profile.after_balise

    def tally_balises(journey: ClaimJourney, kind: BaliseKind) -> Tally:
        """The balises of one kind on one journey, those passed faster than the requirement reaches left out."""
        front = journey.front
        limit = after.limit_m(journey.front.speed_mps)
        # One more row: no epoch after the balise.
        code = np.append(_codes_where_demanded(front.codes_within_m(limit, limit), limit), NOT_KNOWN)
        faster = np.append(np.abs(front.speed_mps) * KMH_PER_MPS > after.to_kmh, False)
        at_ns = _passings_ns(journey.passages, kind)
        rows = _first_epochs_after(front, at_ns)
        at_ns = at_ns[~faster[rows]]
        rows = rows[~faster[rows]]
        # Each balise weighs the same, whatever time its epoch holds.
        counts = count_claims(journey.name, at_ns, np.zeros(rows.size), code[rows], profile.method.event_gap_s)
        held = np.append(front.clock.held_s, 0.0)[rows]
        known = code[rows] != NOT_KNOWN
        return replace(counts, held_s=float(held.sum()), known_s=float(held[known].sum()))

    near = f"{after.fixed_m:g} m, from {after.below_kmh:g} km/h {after.offset_m:g} m + {after.per_mps_s:g} s·v"
    often = Demand(Kind.SHARE, after.share)
    kinds = (BaliseKind.PHYSICAL, BaliseKind.VIRTUAL)
    return [
        Requirement("after_balise", kind.value, near, often, after.clause, partial(tally_balises, kind=kind))
        for kind in kinds
    ]


def _passings_ns(passages: pl.DataFrame, kind: BaliseKind) -> Ints:
    """When each accepted balise of a kind was passed as far as known [ns], in order."""
    status, kinds = (pl.col(name).cast(pl.String) for name in ("status", "kind"))
    accepted = passages.filter((status == PassageStatus.ACCEPTED.value) & (kinds == kind.value))
    at = accepted.select(t=pl.coalesce("t_offered", "t_true")).drop_nulls()
    return np.sort(at["t"].dt.timestamp("ns").to_numpy())


def _first_epochs_after(front: FrontEnd, at_ns: Ints) -> Ints:
    """The epoch at or right after each instant; one beyond the last where there is none, or a gap lies between."""
    t_ns = front.clock.t_ns
    row = np.searchsorted(t_ns, at_ns)
    late = np.append(t_ns, np.iinfo(np.int64).max)[row] - at_ns > front.clock.limit_s * NS_PER_S
    return np.where(late, t_ns.size, row)


def _speed_requirements(profile: RequirementProfile) -> list[Requirement]:
    """What is demanded of the speed: MASO and MASU, accuracy."""
    safe = profile.safe_speed
    speed = profile.speed

    def tally_speed(
        journey: ClaimJourney, limit_kmh: Callable[[Floats], Floats], over: bool = True, under: bool = True
    ) -> Tally:
        """Tally of the speed against a limit, over or under it or both."""
        limit = limit_kmh(journey.speeds.fastest_kmh)
        code = journey.speeds.codes_within_kmh(limit if over else np.inf, limit if under else np.inf)
        return _tally_windows(journey, code, np.isfinite(limit))

    margin = f"{safe.low_kmh:g} km/h to {safe.below_kmh:g}, {safe.high_kmh:g} at {safe.at_kmh:g} km/h"
    near = f"{speed.fixed_kmh:g} km/h to {speed.to_kmh:g} km/h, {speed.above_share:.0%} above"
    ahead = partial(tally_speed, limit_kmh=safe.limit_kmh, under=False)
    behind = partial(tally_speed, limit_kmh=safe.limit_kmh, over=False)
    close = partial(tally_speed, limit_kmh=speed.limit_kmh)
    return [
        Requirement("maso", ALL, margin, ALWAYS, safe.clause, ahead),
        Requirement("masu", ALL, margin, ALWAYS, safe.clause, behind),
        Requirement("speed_accuracy", ALL, near, Demand(Kind.SHARE, speed.share, by_means=True), speed.clause, close),
    ]


def _tally_windows(journey: ClaimJourney, code: Ints, where: Bools) -> Tally:
    """Tally of windows of speed, and of the gaps of the log between them, in order of time."""
    speeds = journey.speeds
    gaps = np.flatnonzero(journey.front.gap_after_s > 0)
    gap_s = journey.front.gap_after_s[gaps]
    nothing = np.zeros(gaps.size)
    t_ns = np.concatenate((speeds.t_ns, journey.front.clock.t_ns[gaps]))
    held_s = np.concatenate((speeds.length_s, nothing))
    without_data_s = np.concatenate((np.zeros(speeds.t_ns.size), gap_s))
    codes = np.concatenate((code, np.full(gaps.size, NOT_KNOWN)))
    order = np.argsort(t_ns, kind="stable")
    rows = order[np.concatenate((where, gap_s > 0))[order]]
    gap = journey.profile.method.event_gap_s
    return count_claims(journey.name, t_ns[rows], held_s[rows], codes[rows], gap, without_data_s=without_data_s[rows])


def _start_requirements(profile: RequirementProfile) -> list[Requirement]:
    """Start of mission: times from the log's begin, which is no switch-on."""
    start = profile.start

    def tally_first_use(journey: ClaimJourney) -> Tally:
        """Tally of the time to the tally_first_use position in use."""
        return Tally(trials=1, worst=_first_s(journey, flags(journey.epochs, "in_use")))

    def tally_no_output(journey: ClaimJourney) -> Tally:
        """Tally of the time to the tally_first_use output."""
        worst = _first_s(journey, flags(journey.epochs, "tvb") | journey.epochs["lrvb_id"].is_not_null().to_numpy())
        waited = (journey.front.clock.duration_s or 0.0) if worst is None else worst
        return replace(_tally_run(broken=waited > start.nothing_s), worst=worst)

    moved = profile.cold_movement
    return [
        Requirement("start", "last position", f"{start.last_position_s:g} s", ALWAYS, start.clause, tally_first_use),
        Requirement("start", "cold movement", f"{start.cold_movement_s:g} s", ALWAYS, start.clause),
        Requirement("start", "nothing known", f"{start.nothing_s:g} s", ALWAYS, start.clause, tally_no_output),
        Requirement("cold_movement", ALL, f"{moved.detected_h:g} h", ALWAYS, moved.clause),
    ]


def _first_s(journey: ClaimJourney, there: Bools) -> float | None:
    """Time from the first epoch to the first one of these [s]."""
    t_ns = journey.front.clock.t_ns
    return float((t_ns[there][0] - t_ns[0]) / NS_PER_S) if there.any() else None


def _tally_run(broken: bool) -> Tally:
    """A run that broke a demand, or of which nobody can say that it kept it."""
    return Tally(trials=1, broken=int(broken), events=int(broken), possible=1)


def _operation_requirements(profile: RequirementProfile) -> list[Requirement]:
    """Availability, and stretches without physical balises: none is ever proved."""
    asked = profile.availability
    length_m = profile.way.without_balise_m
    outside = f"{asked.outside_s:g} s in {asked.within_s / S_PER_H:g} h"
    demand = Demand(Kind.AVAILABILITY, asked.share, outside_s=asked.outside_s)
    return [
        Requirement("availability", ALL, outside, demand, asked.clause, _tally_availability),
        Requirement(
            "way_without_balise", ALL, f"{length_m / 1000:g} km", ALWAYS, profile.way.clause, _tally_without_balises
        ),
    ]


def _tally_availability(journey: ClaimJourney) -> Tally:
    """Time lost once there was an output; broken where so much of it lies within so long.

    Lost is no output, or an interval wider than MAPCI; gaps of the log, where nobody knows, are left out.
    """
    front = journey.front
    asked = journey.profile.availability
    with np.errstate(invalid="ignore"):
        lost: Bools = ~front.has_output | (front.over_m + front.under_m > 2.0 * journey.limit_m)
    held = front.clock.held_s * (np.cumsum(front.has_output) > 0)
    t_s = (front.clock.t_ns - front.clock.t_ns[:1]) / NS_PER_S
    until = np.cumsum(np.where(lost, held, 0.0))
    # Time lost up to the begin of the window that ends at each epoch.
    before = np.concatenate(([0.0], until))[np.searchsorted(t_s, t_s - asked.within_s)]
    worst_s = float((until - before).max(initial=0.0))
    return replace(
        _tally_run(broken=worst_s >= asked.outside_s),
        held_s=float(held.sum()),
        known_s=float(held[~lost].sum()),
        worst=worst_s,
        longest_s=front.clock.duration_s or 0.0,
    )


def _tally_without_balises(journey: ClaimJourney) -> Tally:
    """Stretches of at least the demanded length between physical balises; broken where MAPO or MAPU was exceeded on
    one.
    """
    odometer = journey.epochs["odometer_m"].cast(pl.Float64).to_numpy()
    driven_m = np.cumsum(np.abs(np.nan_to_num(np.diff(odometer, prepend=odometer[:1]))))
    cuts = np.searchsorted(journey.front.clock.t_ns, _passings_ns(journey.passages, BaliseKind.PHYSICAL))
    bounds = np.unique(np.concatenate(([0], cuts, [driven_m.size])))
    broken = np.logical_or.reduce([code == BROKEN for code, _ in journey.beyond_limits.values()])
    lengths = [float(driven_m[min(last, driven_m.size - 1)] - driven_m[first]) for first, last in pairwise(bounds)]
    long = [number for number, length in enumerate(lengths) if length >= journey.profile.way.without_balise_m]
    bad = sum(bool(broken[bounds[number] : bounds[number + 1]].any()) for number in long)
    return Tally(trials=len(long), broken=bad, events=bad, possible=len(long), worst=max(lengths, default=None))
