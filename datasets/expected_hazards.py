"""The hazards that a run must show: the definitions applied to its true motion and injected error, without noise."""

from __future__ import annotations

import numpy as np

from datasets.faults import PlacedFault, fault_offset_m
from datasets.motion import build_motion
from datasets.scenario import RunSpec, Scenario
from datasets.trial import place_fault
from schemas.arrays import Floats
from schemas.frozen import frozen

LIMIT_M = 20.0


@frozen
class ExpectedRow:
    """One hazard row; `t_s` is the step after the first epoch, or about when the first VB is hit."""

    hazard: str
    balise_ids: frozenset[str]
    t_s: float
    early: bool | None
    caused_by: int | None


def expected_hazards(scenario: Scenario, spec: RunSpec) -> tuple[ExpectedRow, ...] | None:
    """The rows of the hazard table; `None` where noise could change them."""
    position = [fault for fault in spec.faults if fault.target == "along"]
    if not position:
        return ()
    world = _noiseless_run(scenario, spec, position[0])
    found = _ExpectedRows()
    moves = np.flatnonzero((np.diff(world.error_m) != 0.0) | (np.abs(world.error_m[1:]) > LIMIT_M / 2.0)) + 1
    for k in moves.tolist():
        if not _take_movement(world, k, found):
            return None
    return tuple(found.rows())


@frozen
class _NoiselessRun:
    """Without noise, at the epochs: time [s], distance run, error in the direction of travel, places of the VBs [m]."""

    t_s: Floats
    driven_m: Floats
    error_m: Floats
    names: tuple[str, ...]
    places_m: Floats
    margin_m: float

    def balises_between(self, a_m: float, b_m: float) -> frozenset[str]:
        """Virtual balises between two places."""
        low = min(a_m, b_m)
        high = max(a_m, b_m)
        return frozenset(n for n, at in zip(self.names, self.places_m, strict=True) if low < at <= high)

    def is_near_balise(self, at_m: float) -> bool:
        """Whether a place is so near to a balise that noise leaves the answer uncertain."""
        return bool((np.abs(self.places_m - at_m) <= self.margin_m).any())


def _noiseless_run(scenario: Scenario, spec: RunSpec, fault: PlacedFault) -> _NoiselessRun:
    """What of a scenario decides about hazards, without noise."""
    motion = build_motion(spec.motion)
    t_s = np.arange(0.0, motion.duration_s + 1e-9, 1.0 / spec.gnss.rate_hz)
    exact = place_fault(fault, motion, spec.gnss.rate_hz)
    error_m = fault_offset_m(exact, t_s, np.random.default_rng(0))
    driven_m = motion.distance_m(t_s - spec.gnss.latency_s)
    names = tuple(balise.id for balise in scenario.line.balises)
    at_m = np.array([balise.at_m for balise in scenario.line.balises])
    places_m = (at_m - motion.start_m) * motion.sign
    return _NoiselessRun(t_s, driven_m, error_m, names, places_m, 6.0 * spec.gnss.sigma_east_m + 2.0)


class _ExpectedRows:
    """Jumps and early or late offers in time, sorted into rows."""

    def __init__(self) -> None:
        self.jumps: list[tuple[float, frozenset[str], bool]] = []
        self.hits: list[tuple[float, str, float]] = []

    def rows(self) -> list[ExpectedRow]:
        """An error's first event names its row; a jump back makes one of its own."""
        rows: list[ExpectedRow] = []
        hit = frozenset(name for _, name, _ in self.hits)
        begun = [jump for jump in self.jumps if not jump[2]]
        if begun:
            t_s, ids, _ = begun[0]
            rows.append(ExpectedRow(_jump_class(ids), ids | hit, t_s, None, None))
        elif hit:
            t_s, _, error_m = self.hits[0]
            rows.append(ExpectedRow("VB_SHIFT", hit, t_s, error_m > 0.0, None))
        for t_s, ids, back in self.jumps:
            if back:
                rows.append(ExpectedRow(_jump_class(ids), ids, t_s, None, 0 if rows else None))
        return rows


def _jump_class(ids: frozenset[str]) -> str:
    """Class of a jump over so many balises."""
    return "VB_JUMP_1A" if len(ids) > 1 else "VB_JUMP_1B"


def _take_movement(world: _NoiselessRun, k: int, found: _ExpectedRows) -> bool:
    """Take the movement that leads to epoch `k`; false where it is too close to call."""
    a_m = world.driven_m[k - 1] + world.error_m[k - 1]
    b_m = world.driven_m[k] + world.error_m[k]
    step_m = world.error_m[k] - world.error_m[k - 1]
    t_s = float(world.t_s[k])
    if abs(step_m) > LIMIT_M:
        if any(world.is_near_balise(at_m) for at_m in (a_m, b_m, world.driven_m[k - 1], world.driven_m[k])):
            return False
        ids = world.balises_between(a_m, b_m) - world.balises_between(
            a_m, a_m + world.driven_m[k] - world.driven_m[k - 1]
        )
        if ids:
            found.jumps.append((t_s, ids, abs(world.error_m[k]) < abs(world.error_m[k - 1])))
        return True
    offered = world.balises_between(a_m, b_m)
    size_m = abs(float(world.error_m[k]))
    if offered and abs(size_m - LIMIT_M) < world.margin_m:
        return False
    if size_m > LIMIT_M:
        # A stand near a VB offers it again and again by noise alone.
        if world.is_near_balise(b_m) and world.driven_m[k] == world.driven_m[k - 1]:
            return False
        found.hits += [(t_s, name, float(world.error_m[k])) for name in sorted(offered)]
    return True
