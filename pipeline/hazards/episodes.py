"""Hazard episodes: which jumps and offered crossings belong together, and when each ends (DOMAIN section 5)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.hazards.arrays import runs_of
from pipeline.hazards.crossings import Beacons, Crossing, crossings_with_error
from pipeline.hazards.jumps import Jump, find_jumps
from pipeline.hazards.series import Series
from schemas.arrays import NS_PER_S, Bools, Ints
from schemas.config import HazardConfig
from schemas.enums import Hazard

_PRECEDENCE = (Hazard.VB_JUMP_1A, Hazard.VB_JUMP_1B, Hazard.VB_SHIFT)


@dataclass
class Draft:
    """One hazard row in the making; epochs are indices of the series.

    `floor` is the last epoch that cannot belong to the episode (-1: none), `end` the first one after
    it (`series.size`: it lasts to the end of the log). `returns`: the jump ends an error that had hit no
    VB before, and the VBs that it crosses are the first ones hit.
    """

    hazard: Hazard
    floor: int
    jump: Jump | None = None
    hits: list[Crossing] = field(default_factory=list)
    end: int = 0
    caused_by: Draft | None = None
    mark: int = -1
    returns: bool = False

    def add(self, hits: tuple[Crossing, ...]) -> None:
        self.hits.extend(hits)

    @property
    def first_epoch(self) -> int:
        """The epoch at or after the hazard itself; `mark` where an error has not hit any VB."""
        if self.jump is not None:
            return self.jump.first
        return self.hits[0].epoch if self.hits else self.mark


@dataclass
class _Episode:
    """Rows of one open episode, at most one per class, and where it ends if no jump back comes first."""

    drafts: list[Draft]
    calm: int

    def row_of(self, hazard: Hazard) -> Draft | None:
        return next((draft for draft in self.drafts if draft.hazard is hazard), None)

    def leading(self) -> Draft:
        return min(self.drafts, key=lambda draft: _PRECEDENCE.index(draft.hazard))

    def close(self, end: int) -> None:
        for draft in self.drafts:
            draft.end = end


def find_episodes(series: Series, beacons: tuple[Beacons, ...], config: HazardConfig) -> tuple[list[Draft], list[Jump]]:
    """All hazards of one solution in order of time, and all jumps, also those that cross no VB."""
    jumps = find_jumps(series, beacons, config)
    limit_m = config.shift_limit_m
    hits = _hits_beside_jumps(crossings_with_error(series, beacons, limit_m), jumps, limit_m)
    if not hits and not any(jump.crossed for jump in jumps):
        return [], jumps
    walk = _Walk(series, Calm.of(series, config.episode_end_s), config)
    for event in _in_order(jumps, hits, limit_m):
        walk.take(event)
    return walk.finish(), jumps


def _in_order(jumps: list[Jump], hits: list[Crossing], limit_m: float) -> list[Jump | Crossing]:
    """By epoch; what is offered on the way of a jump belongs to the error before it, if there was one."""
    returns = {jump.first for jump in jumps if abs(jump.error_before_m) > limit_m}

    def key(event: Jump | Crossing) -> tuple[int, int, int]:
        if isinstance(event, Jump):
            return event.first, 1, 0
        return event.epoch, 0 if event.epoch in returns else 2, event.t_ns

    return sorted([*jumps, *hits], key=key)


def _hits_beside_jumps(hits: list[Crossing], jumps: list[Jump], limit_m: float) -> list[Crossing]:
    """Early and late offers that no jump accounts for.

    A VB that the true movement crosses within the epoch of a jump is offered right but for the
    interpolation, unless the position was wrong already; a jump drawn out over epochs offers it early.
    """
    taken = {(c.epoch, c.balise_id) for jump in jumps for c in jump.crossed}
    fresh = {jump.first for jump in jumps if jump.first == jump.last and abs(jump.error_before_m) <= limit_m}
    return [c for c in hits if c.epoch not in fresh and (c.epoch, c.balise_id) not in taken]


@dataclass(frozen=True)
class Calm:
    """Stretches of at least `hold_ns` in which the error stays within noise; first and last epochs."""

    t_ns: Ints
    begins: Ints
    ends: Ints
    hold_ns: int

    @classmethod
    def of(cls, series: Series, hold_s: float) -> Calm:
        quiet: Bools = np.abs(series.error_m) < series.quiet_m
        begins, ends = runs_of(quiet)
        hold_ns = round(hold_s * NS_PER_S)
        long = series.t_ns[ends] - series.t_ns[begins] >= hold_ns
        return cls(series.t_ns, begins[long], ends[long], hold_ns)

    def first_from(self, epoch: int) -> int:
        """First epoch at or after `epoch` at which a calm of full length begins; the number of epochs if none."""
        for begin, end in zip(self.begins.tolist(), self.ends.tolist(), strict=True):
            start = max(begin, epoch)
            if start <= end and self.t_ns[end] - self.t_ns[start] >= self.hold_ns:
                return int(start)
        return int(self.t_ns.size)

    def last_before(self, epoch: int) -> int:
        """Last epoch of the last calm that began before `epoch`, at most `epoch - 1`; -1 if there is none."""
        index = int(np.searchsorted(self.begins, epoch)) - 1
        return min(int(self.ends[index]), epoch - 1) if index >= 0 else -1


class _Walk:
    """Takes jumps and early or late offers in time and sorts them into episodes."""

    def __init__(self, series: Series, calm: Calm, config: HazardConfig) -> None:
        self._series = series
        self._calm = calm
        self._config = config
        self._open: _Episode | None = None
        self._done: list[Draft] = []
        self._floor = -1

    def take(self, event: Jump | Crossing) -> None:
        epoch = event.first if isinstance(event, Jump) else event.epoch
        if self._open is not None and epoch > self._open.calm:
            self._close(self._open.calm)
        if isinstance(event, Crossing):
            self._offer(event)
        elif self._open is not None and self._is_back(event):
            self._jump_back(self._open, event)
        elif event.crossed:
            self._jump(event)

    def finish(self) -> list[Draft]:
        if self._open is not None:
            self._close(self._open.calm)
        return sorted(self._done, key=lambda draft: (draft.first_epoch, _PRECEDENCE.index(draft.hazard)))

    def _close(self, end: int) -> None:
        if self._open is not None:
            self._open.close(end)
            self._floor = end - 1
        self._open = None

    def _begin(self, draft: Draft, calm_from: int) -> None:
        self._done.append(draft)
        self._open = _Episode([draft], self._calm.first_from(calm_from))

    def _offer(self, hit: Crossing) -> None:
        if self._open is not None:
            self._open.leading().add((hit,))
            return
        floor = max(self._floor, self._calm.last_before(hit.epoch))
        self._begin(Draft(Hazard.VB_SHIFT, floor, hits=[hit]), hit.epoch)

    def _jump(self, jump: Jump) -> None:
        hazard = _class_of(jump)
        if self._open is None:
            returns = self._is_back(jump)
            floor = max(self._floor, self._calm.last_before(jump.first)) if returns else jump.first - 1
            self._begin(Draft(hazard, floor, jump, list(jump.crossed), returns=returns), jump.last)
            return
        row = self._open.row_of(hazard)
        if row is not None:
            row.add(jump.crossed)
        else:
            draft = Draft(hazard, jump.first - 1, jump, list(jump.crossed))
            self._done.append(draft)
            self._open.drafts.append(draft)
        self._open.calm = self._calm.first_from(jump.last)

    def _is_back(self, jump: Jump) -> bool:
        before, after = jump.error_before_m, jump.error_after_m
        noise = float(self._series.quiet_m[jump.first - 1])
        return abs(before) > noise and jump.step_m * before < 0 and abs(after) < abs(before)

    def _jump_back(self, episode: _Episode, jump: Jump) -> None:
        cause = episode.drafts[0]
        over = self._is_over(jump)
        if over:
            self._close(jump.first)
        if not jump.crossed:
            return
        draft = Draft(_class_of(jump), jump.first - 1, jump, list(jump.crossed), caused_by=cause)
        if over:
            self._begin(draft, jump.last)
        else:
            self._done.append(draft)
            draft.end = jump.last + 1

    def _is_over(self, jump: Jump) -> bool:
        """The old error is gone: within noise or limit, or turned to the other side."""
        rest = abs(jump.error_after_m)
        tolerated = max(float(self._series.quiet_m[jump.last]), self._config.failure_limit_m)
        return rest <= tolerated or jump.error_after_m * jump.error_before_m < 0


def _class_of(jump: Jump) -> Hazard:
    distinct = {crossing.balise_id for crossing in jump.crossed}
    return Hazard.VB_JUMP_1A if len(distinct) > 1 else Hazard.VB_JUMP_1B
