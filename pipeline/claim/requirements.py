"""Each requirement of a profile on one solution of one run, as counts that add up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from pipeline.claim.areas import AREA_TYPES, NO_AREA
from pipeline.claim.front import Front
from pipeline.claim.profile import KMH_PER_MPS, Profile
from pipeline.claim.speed import speed_errors
from pipeline.claim.tally import BROKEN, NOT_KNOWN, Tally, codes, tally
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.enums import BaliseKind, PassageStatus

ALL = "all"
Key = tuple[str, str]
Tallies = dict[Key, Tally]


@dataclass(frozen=True)
class Ride:
    """One solution of one run: its front end, and the tables that the requirements ask for beside it."""

    name: str
    front: Front
    epochs: pl.DataFrame
    passages: pl.DataFrame
    profile: Profile

    def tally(self, code: Ints, where: Bools, size: Floats | None = None) -> Tally:
        """Of the epochs `where` a requirement applies, and of the gaps of the log that begin or end there."""
        clock, silent = self.front.clock, self.front.silent_s
        rows = np.flatnonzero(where | ((silent > 0) & np.append(where[1:], False)))
        here = where[rows]
        held, told = np.where(here, clock.held_s[rows], 0.0), np.where(here, code[rows], NOT_KNOWN)
        sizes = None if size is None else np.where(here, size[rows], np.nan)
        return tally(self.name, clock.t_ns[rows], held, told, self.profile.method.event_gap_s, sizes, silent[rows])


def tallies(ride: Ride) -> Tallies:
    """Every requirement that a recording can speak of; keys are requirement and what it applies to."""
    parts: tuple[Callable[[Ride], Tallies], ...] = (_by_area, _slow, _safe, _after_balise, _speed, _rest)
    return {key: found for part in parts for key, found in part(ride).items()}


def limits_m(front: Front, profile: Profile) -> Floats:
    """MAPO and MAPU at each epoch [m]; NaN outside all areas."""
    limits = np.full(front.front_m.size, np.nan)
    for kind, demanded in profile.areas.items():
        here = front.where.area == AREA_TYPES.index(kind)
        limits[here] = demanded.limits_m(front.where.track_speed_mps[here])
    return limits


def _by_area(ride: Ride) -> Tallies:
    front, limit = ride.front, limits_m(ride.front, ride.profile)
    beyond = _beyond(ride, limit)
    safe = front.within(front.over_m, front.under_m)
    found: Tallies = {}
    for kind, demanded in ride.profile.areas.items():
        here = front.output & (front.where.area == AREA_TYPES.index(kind))
        found |= {(name, kind.value): ride.tally(code, here, size) for name, (code, size) in beyond.items()}
        found["safe_front_end", kind.value] = ride.tally(safe, here, front.least_m)
        close = front.within(demanded.accuracy_m, demanded.accuracy_m)
        found["front_accuracy", kind.value] = ride.tally(close, here, front.least_m)
    return found


def _beyond(ride: Ride, limit_m: Floats) -> dict[str, tuple[Ints, Floats]]:
    """The intervals claimed, and the errors known, against MAPO and MAPU: codes and sizes."""
    front, none = ride.front, np.inf
    with np.errstate(invalid="ignore"):
        claimed = [codes(width <= limit_m, width > limit_m) for width in (front.over_m, front.under_m)]
    return {
        "mapo_claimed": (claimed[0], front.over_m),
        "mapu_claimed": (claimed[1], front.under_m),
        "mapo": (_asked(front.within(limit_m, none), limit_m), front.low_m),
        "mapu": (_asked(front.within(none, limit_m), limit_m), -front.high_m),
    }


def _asked(code: Ints, limit_m: Floats) -> Ints:
    return np.where(np.isfinite(limit_m), code, NOT_KNOWN)


def _slow(ride: Ride) -> Tallies:
    """Safe and precise operation at low speed: claimed and known."""
    front, slow = ride.front, ride.profile.slow
    found: Tallies = {}
    for kind in slow.area_types:
        here = front.output & (front.where.area == AREA_TYPES.index(kind))
        here &= np.abs(front.speed_mps) * KMH_PER_MPS < slow.below_kmh
        width = np.maximum(front.over_m, front.under_m)
        found["slow_claimed", kind.value] = ride.tally(codes(width <= slow.limit_m, width > slow.limit_m), here, width)
        found["slow_front_end", kind.value] = ride.tally(front.within(slow.limit_m, slow.limit_m), here)
        found["slow_accuracy", kind.value] = ride.tally(front.within(slow.accuracy_m, slow.accuracy_m), here)
    return found


def _safe(ride: Ride) -> Tallies:
    """The train between min and max safe front end, wherever it is; and time outside all areas."""
    front = ride.front
    code = front.within(front.over_m, front.under_m)
    nowhere = front.output & (front.where.area == NO_AREA)
    return {
        ("safe_front_end", ALL): ride.tally(code, front.output, front.least_m),
        ("safe_front_end_bound", ALL): ride.tally(code, front.output, front.least_m),
        ("no_area", ALL): ride.tally(np.full(code.size, NOT_KNOWN), nowhere),
    }


def _after_balise(ride: Ride) -> Tallies:
    """The first estimate after each balise accepted; physical ones, and virtual ones as if they were.

    Where it comes late or not at all nobody knows what it would have been.
    """
    status, kinds = (ride.passages[name].cast(pl.String) for name in ("status", "kind"))
    front, demanded = ride.front, ride.profile.after_balise
    limit = demanded.limit_m(front.speed_mps)
    code = np.append(_asked(front.within(limit, limit), limit), NOT_KNOWN)
    faster = np.append(np.abs(front.speed_mps) * KMH_PER_MPS > demanded.to_kmh, False)
    found: Tallies = {}
    for kind in (BaliseKind.PHYSICAL.value, BaliseKind.VIRTUAL.value):
        at_ns = _passed(ride.passages.filter((status == PassageStatus.ACCEPTED.value) & (kinds == kind)))
        rows = _first_after(front, at_ns)
        at_ns, rows = at_ns[~faster[rows]], rows[~faster[rows]]
        # Each balise weighs the same, whatever time its epoch holds.
        counts = tally(ride.name, at_ns, np.zeros(rows.size), code[rows], ride.profile.method.event_gap_s)
        held = np.append(front.clock.held_s, 0.0)[rows]
        known = code[rows] != NOT_KNOWN
        found["after_balise", kind] = replace(counts, held_s=float(held.sum()), known_s=float(held[known].sum()))
    return found


def _passed(passages: pl.DataFrame) -> Ints:
    """When each balise was passed as far as known [ns], in order."""
    at = passages.select(t=pl.coalesce("t_offered", "t_true")).drop_nulls()
    return np.sort(at["t"].dt.timestamp("ns").to_numpy())


def _first_after(front: Front, at_ns: Ints) -> Ints:
    """The epoch at or right after each instant; one beyond the last where there is none, or a gap lies between."""
    t_ns = front.clock.t_ns
    row = np.searchsorted(t_ns, at_ns)
    late = np.append(t_ns, np.iinfo(np.int64).max)[row] - at_ns > front.clock.limit_s * NS_PER_S
    return np.where(late, t_ns.size, row)


def _speed(ride: Ride) -> Tallies:
    found, method = speed_errors(ride.front, ride.profile.method.speed_window_s), ride.profile.method
    safe, close = ride.profile.safe_speed.limit_kmh(found.speed_kmh), ride.profile.speed.limit_kmh(found.speed_kmh)
    asked, none = np.isfinite(safe), np.full(safe.size, np.inf)

    # Windows and the gaps of the log between them, in order of time.
    gaps = np.flatnonzero(ride.front.silent_s > 0)
    gap_s, nothing = ride.front.silent_s[gaps], np.zeros(gaps.size)
    t_ns = np.concatenate((found.t_ns, ride.front.clock.t_ns[gaps]))
    held_s = np.concatenate((found.length_s, nothing))
    silent_s = np.concatenate((np.zeros(found.t_ns.size), gap_s))
    order = np.argsort(t_ns, kind="stable")

    def counted(code: Ints, where: Bools) -> Tally:
        rows = order[np.concatenate((where, gap_s > 0))[order]]
        told = np.concatenate((code, np.full(gaps.size, NOT_KNOWN)))[rows]
        return tally(ride.name, t_ns[rows], held_s[rows], told, method.event_gap_s, silent_s=silent_s[rows])

    return {
        ("maso", ALL): counted(found.within(safe, none), asked),
        ("masu", ALL): counted(found.within(none, safe), asked),
        ("speed_accuracy", ALL): counted(found.within(close, close), np.ones(safe.size, dtype=np.bool_)),
    }


def _rest(ride: Ride) -> Tallies:
    """Start of mission, availability, way without physical balises: one trial per run each, none ever proved."""
    front, profile = ride.front, ride.profile
    begun = ride.epochs["in_use"].fill_null(value=False).to_numpy()
    linked = (ride.epochs["tvb"].fill_null(value=False) | ride.epochs["lrvb_id"].is_not_null()).to_numpy()
    at_s = (front.clock.t_ns - front.clock.t_ns[:1]) / NS_PER_S
    nothing_s = _first_s(at_s, linked)
    longest = float(at_s[-1]) if at_s.size else 0.0
    lost = _unavailable(front, limits_m(front, profile))
    worst_s = _most_within_s(front, lost, profile.availability.within_s)
    operating = np.flatnonzero(front.output)
    since = np.arange(lost.size) >= (operating[0] if operating.size else lost.size)
    held, out = front.clock.held_s * since, worst_s >= profile.availability.outside_s
    return {
        ("start", "last position"): Tally(trials=1, worst=_first_s(at_s, begun)),
        ("start", "cold movement"): Tally(),
        ("start", "nothing known"): replace(
            _one(broken=max(nothing_s or 0.0, 0.0 if nothing_s is not None else longest) > profile.start.nothing_s),
            worst=nothing_s,
        ),
        ("cold_movement", ALL): Tally(),
        ("availability", ALL): replace(
            _one(broken=out),
            held_s=float(held.sum()),
            known_s=float(held[~lost].sum()),
            worst=worst_s,
            longest_s=longest,
        ),
        ("way_without_balise", ALL): _ways(ride),
    }


def _one(broken: bool) -> Tally:
    """A run that broke a demand, or of which nobody can say that it kept it."""
    return Tally(trials=1, broken=int(broken), events=int(broken), possible=1)


def _first_s(at_s: Floats, there: Bools) -> float | None:
    return float(at_s[there][0]) if there.any() else None


def _unavailable(front: Front, limit_m: Floats) -> Bools:
    """No output, or an interval wider than MAPCI; gaps of the log, where nobody knows, are left out."""
    with np.errstate(invalid="ignore"):
        wide: Bools = front.over_m + front.under_m > 2.0 * limit_m
    return ~front.output | wide


def _most_within_s(front: Front, lost: Bools, within_s: float) -> float:
    """Most time lost in any window of `within_s`, once there was an output [s]."""
    operating = np.flatnonzero(front.output)
    if not operating.size:
        return 0.0
    rows = slice(operating[0], None)
    t_s = (front.clock.t_ns[rows] - front.clock.t_ns[0]) / NS_PER_S
    held = np.where(lost[rows], front.clock.held_s[rows], 0.0)
    until = np.cumsum(held)
    before = np.searchsorted(t_s, t_s - within_s)
    return float((until - until[before] + held[before]).max())


def _ways(ride: Ride) -> Tally:
    """Ways of at least the demanded length between physical balises; broken where MAPO or MAPU was exceeded on one."""
    odometer = ride.epochs["odometer_m"].cast(pl.Float64).to_numpy()
    way = np.cumsum(np.abs(np.nan_to_num(np.diff(odometer, prepend=odometer[:1]))))
    physical = ride.passages.filter(
        (pl.col("kind").cast(pl.String) == BaliseKind.PHYSICAL.value)
        & (pl.col("status").cast(pl.String) == PassageStatus.ACCEPTED.value)
    )
    cuts = np.searchsorted(ride.front.clock.t_ns, _passed(physical))
    bounds = np.unique(np.concatenate(([0], cuts, [way.size])))
    beyond = [code for code, _ in _beyond(ride, limits_m(ride.front, ride.profile)).values()]
    broken = np.logical_or.reduce([code == BROKEN for code in beyond])
    lengths = [float(way[min(last, way.size - 1)] - way[first]) for first, last in pairwise(bounds)]
    long = [number for number, length in enumerate(lengths) if length >= ride.profile.way.without_balise_m]
    bad = sum(bool(broken[bounds[number] : bounds[number + 1]].any()) for number in long)
    return Tally(trials=len(long), broken=bad, events=bad, possible=len(long), worst=max(lengths, default=None))


def run_name(run: dict[str, Any]) -> str:
    """What draws the trial of a run."""
    return f"{run['run_id']}\n{run['solution']}"
