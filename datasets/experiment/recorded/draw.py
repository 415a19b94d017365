"""At which instants faults begin: drawn where nothing was wrong, the same for every bank."""

from __future__ import annotations

import zlib
from bisect import bisect_left, insort
from collections.abc import Mapping, Sequence

import numpy as np

from datasets.experiment.recorded.baseline import Baseline
from datasets.experiment.recorded.plan import Cell, RecordedPlan
from datasets.experiment.workers import generator
from schemas.arrays import NS_PER_S, Bools, Ints
from schemas.enums import LeftOut
from schemas.frozen import frozen

_REASONS = tuple(LeftOut)


@frozen
class Room:
    """Where faults may begin in one run, by all banks; arrays per epoch.

    `left_out`: number of the reason in `LeftOut`, -1 where a fault may begin; `free_ns`: before the next alarm or
    negation, or the last epoch.
    """

    run_id: str
    first_ns: int
    t_ns: Ints
    held_s: np.ndarray
    left_out: Ints
    free_ns: Ints
    has_ranges: bool

    def takes(self, cell: Cell) -> bool:
        """The run records what the fault needs."""
        return self.has_ranges or not cell.hits_satellite

    def eligible(self, cell: Cell) -> Bools:
        """Epochs at which a fault of this cell may begin and be watched to its end."""
        watched: Bools = self.t_ns + round(cell.watch_s * NS_PER_S) <= self.free_ns
        return watched & (self.left_out < 0) & self.takes(cell)

    def longest_s(self) -> float:
        """The longest watch that some epoch allows [s]."""
        allowed = (self.free_ns - self.t_ns)[self.left_out < 0]
        return float(allowed.max(initial=0)) / NS_PER_S

    def seconds_left_out(self) -> dict[str, float]:
        """Time in which no fault begins, by reason, and the rest [s]."""
        by_reason = {
            f"{why.value}_s": float(self.held_s[self.left_out == number].sum()) for number, why in enumerate(_REASONS)
        }
        return {**by_reason, "usable_s": float(self.held_s[self.left_out < 0].sum())}


def room_of(baselines: Sequence[Baseline], quiet_s: float) -> Room:
    """What all banks leave of a run: an epoch that one of them leaves out is left out for all."""
    first = baselines[0]
    left_out = np.max([base.left_out(quiet_s) for base in baselines], axis=0)
    alarming = np.logical_or.reduce([base.alarming for base in baselines])
    # An alarm at the very end of a watch would be taken for one of the fault.
    ends_ns = np.where(alarming, first.t_ns - 1, first.t_ns[-1])
    return Room(
        run_id=first.run.run_id,
        first_ns=first.recording.first_ns,
        t_ns=first.t_ns,
        held_s=first.clock.held_s,
        left_out=left_out,
        free_ns=np.minimum.accumulate(ends_ns[::-1])[::-1],
        has_ranges=first.has_ranges,
    )


@frozen
class Onset:
    """One fault to put in: of this cell, into this run, at this epoch; `lot`: what a satellite is drawn by, [0, 1)."""

    number: int
    cell: Cell
    run_id: str
    t_ns: int
    lot: float


def onsets_of(
    rooms: Sequence[Room], cells: Sequence[Cell], plan: RecordedPlan
) -> dict[str, list[tuple[str, int, float]]]:
    """Per cell the runs, epochs and lots drawn: at most `cell.count`, fewer where there is no room for more."""
    return {cell.name: _drawn(rooms, cell, plan) for cell in cells}


def numbered(cells: Sequence[Cell], drawn: Mapping[str, list[tuple[str, int, float]]]) -> list[Onset]:
    """All onsets, cell by cell, in order of run and time."""
    rows = [(cell, *place) for cell in cells for place in sorted(drawn[cell.name])]
    return [Onset(number, *row) for number, row in enumerate(rows)]


def _drawn(rooms: Sequence[Room], cell: Cell, plan: RecordedPlan) -> list[tuple[str, int, float]]:
    """Epochs of all runs in random order, each taken unless it is too near to one of its run that was taken before."""
    rng = generator(plan.seed, zlib.crc32(cell.name.encode()))
    places = [np.flatnonzero(room.eligible(cell)) for room in rooms]
    owner = np.repeat(np.arange(len(rooms)), [rows.size for rows in places])
    rows = np.concatenate(places) if places else np.zeros(0, dtype=np.int64)
    apart_ns = round(plan.apart_s * NS_PER_S)
    taken_ns: list[list[int]] = [[] for _ in rooms]
    drawn: list[tuple[str, int, float]] = []
    for place in rng.permutation(rows.size).tolist():
        room = rooms[int(owner[place])]
        t_ns = int(room.t_ns[rows[place]])
        if len(drawn) == cell.count:
            break
        if _is_apart(taken_ns[int(owner[place])], t_ns, apart_ns):
            insort(taken_ns[int(owner[place])], t_ns)
            drawn.append((room.run_id, t_ns, float(rng.random())))
    return drawn


def _is_apart(taken_ns: list[int], t_ns: int, apart_ns: int) -> bool:
    at = bisect_left(taken_ns, t_ns)
    neighbours = taken_ns[max(at - 1, 0) : at + 1]
    return all(abs(t_ns - other) >= apart_ns for other in neighbours)
