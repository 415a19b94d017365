"""How sure the path is: at each step, as stretches of doubt, and which other net elements are possible."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.matching.fixes import Fixes
from pipeline.stages.matching.search import Beliefs
from pipeline.stages.matching.trellis import Trellis
from pipeline.stages.track.leg import Leg
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import TravelledPath, routes_of
from schemas.arrays import Bools, Floats, Ints, ints, spans_of
from schemas.config import MatchingConfig

# What ended a stretch of doubt: a balise read, a switch taken, positions (tracks that part, offsets), or nothing.
RESOLVED_BY = ("read", "switch", "positions", "nothing")
AMBIGUOUS_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
    "netelement_id": pl.String,
    "other_netelement_id": pl.String,
    "gate_probability": pl.Float64,
    "path_probability": pl.Float64,
    "resolved_by": pl.Enum(RESOLVED_BY),
}


@dataclass(frozen=True)
class Doubt:
    """Per step: how probable the path is, by all and by earlier steps, and the best other element (-1: none)."""

    posterior: Floats
    gate: Floats
    other: Ints


def doubt_of(trellis: Trellis, beliefs: Beliefs, legs: Sequence[Leg], leg: Ints, at_m: Floats) -> Doubt:
    """Probability of all states that are on the path where the path is; `leg`, `at_m`: where that is at each step."""
    count = np.diff(trellis.first)
    step = np.repeat(np.arange(len(count)), count)
    on_path = _on_path(trellis, legs, leg, at_m, step)
    rival = np.where(on_path, -1.0, beliefs.forward + beliefs.posterior)
    worst = np.lexsort((rival, step))[trellis.first[1:] - 1]
    return Doubt(
        posterior=_share(beliefs.posterior * on_path, trellis.first),
        gate=_share(beliefs.forward * on_path, trellis.first),
        other=np.where(rival[worst] >= 0, trellis.oriented[worst] // 2, -1),
    )


def stretches(
    fixes: Fixes, trellis: Trellis, beliefs: Beliefs, doubt: Doubt, pinned: Ints, config: MatchingConfig
) -> pl.DataFrame:
    """Stretches where the path is doubtful: believed at the time, or in hindsight, less than configured.

    Both stand in the row, each the least of the stretch.

    `pinned`: per epoch the element that a balise read proves, -1 without one.
    """
    probability = np.minimum(doubt.posterior, doubt.gate)
    epoch = trellis.steps.epoch
    ids = trellis.network.track.ids
    rows = []
    for begin, last in spans_of(probability < config.ambiguity_probability):
        end = last + 1
        worst = begin + int(np.argmin(probability[begin:end]))
        rival = int(doubt.other[worst])
        until = int(epoch[end]) - 1 if end < len(trellis) else len(fixes) - 1
        here = ids[int(trellis.oriented[beliefs.best[worst]]) // 2]
        there = ids[rival] if rival >= 0 else None
        span = int(fixes.t_ns[epoch[begin]]), int(fixes.t_ns[until])
        least = float(doubt.gate[begin:end].min()), float(doubt.posterior[begin:end].min())
        rows.append((*span, here, there, *least, _resolved_by(trellis, beliefs, pinned, begin, end)))
    return pl.DataFrame(rows, schema=AMBIGUOUS_COLUMNS, orient="row")


def _resolved_by(trellis: Trellis, beliefs: Beliefs, pinned: Ints, begin: int, end: int) -> str:
    """What ended the doubt of steps `begin : end`; a switch is taken where the path had more than one way on."""
    if end >= len(trellis):
        return "nothing"
    epoch = trellis.steps.epoch
    if (pinned[int(epoch[end - 1]) + 1 : int(epoch[end]) + 1] >= 0).any():
        return "read"
    way = trellis.oriented[beliefs.best[max(begin - 1, 0) : end + 1]]
    passed = [(here, there) for here, there in itertools.pairwise(way.tolist()) if here != there]
    return "switch" if any(_over_switch(trellis.network, here, there) for here, there in passed) else "positions"


def _over_switch(network: Network, here: int, there: int) -> bool:
    """Whether more than one way leads on from one oriented element towards another, or from there back."""
    forward = any(edge.to == there for edge in network.successors[here])
    ends = (here, there ^ 1) if forward else (here ^ 1, there)
    return any(len(network.successors[end]) > 1 for end in ends)


def _on_path(trellis: Trellis, legs: Sequence[Leg], leg: Ints, at_m: Floats, step: Ints) -> Bools:
    """States that lie on the path within reach of where the path is at their step, however it is cut into elements.

    Where a leg ends, also those on the leg beyond.
    """
    track = trellis.network.track
    element, backward = np.divmod(trellis.oriented, 2)
    measure_m = np.where(
        backward == 1, track.end_m[element] - trellis.place_m, track.begin_m[element] + trellis.place_m
    )
    on_path = np.zeros(len(step), dtype=bool)
    border = np.flatnonzero(np.diff(leg))
    for number, route in enumerate(routes_of(track, legs)):
        on_leg = leg == number
        on_leg[border] |= leg[border + 1] == number
        on_leg[border + 1] |= leg[border] == number
        rows = np.flatnonzero(on_leg[step])
        coordinate, _ = route.coordinate(element[rows], measure_m[rows], at_m[step[rows]])
        on_path[rows] |= np.abs(coordinate - at_m[step[rows]]) <= trellis.config.reach_m
    return on_path


def _share(values: Floats, first: Ints) -> Floats:
    return np.clip(np.add.reduceat(values, first[:-1]), 0.0, 1.0)


@dataclass(frozen=True)
class Posterior:
    """Per step of the search its net elements in order, and how probable each is by the whole run.

    `epoch[k]` is the row of step k; `first[k] : first[k + 1]` are its elements, as numbers of the path's track.
    """

    epoch: Ints
    first: Ints
    element: Ints
    probability: Floats


def posterior_of(trellis: Trellis, beliefs: Beliefs) -> Posterior:
    """Probability of each element at each step: of all its states together."""
    step = np.repeat(np.arange(len(trellis)), np.diff(trellis.first))
    count = trellis.network.count
    keys, inverse = np.unique(step * count + trellis.oriented // 2, return_inverse=True)
    probability = np.asarray(np.bincount(inverse, beliefs.posterior, len(keys)), dtype=np.float64)
    first = np.searchsorted(keys // count, np.arange(len(trellis) + 1))
    return Posterior(trellis.steps.epoch, first, (keys % count).astype(np.int64), probability)


def rivals_of(
    posterior: Posterior, epochs: pl.DataFrame, path: TravelledPath, index: dict[str, int], limit: float
) -> tuple[Ints, Ints]:
    """Pairs of epoch and net element (numbers by `index`): of at least `limit` at the steps about it, and its own."""
    path_element = epochs["netelement_id"].replace_strict(index, default=None, return_dtype=pl.Int64)
    number = np.array([index[name] for name in path.track.ids], dtype=np.int64)
    likely = np.flatnonzero(posterior.probability >= limit)
    step = np.searchsorted(posterior.first, likely, side="right") - 1
    elements = pl.DataFrame({"step": step, "element": number[posterior.element[likely]]})
    row = np.arange(epochs.height)
    before = np.searchsorted(posterior.epoch, row, side="right") - 1
    after = np.searchsorted(posterior.epoch, row, side="left")
    about = [np.maximum(before, 0), np.minimum(after, len(posterior.epoch) - 1)]
    pairs = [pl.DataFrame({"row": row, "step": side}).join(elements, on="step").drop("step") for side in about]
    pairs.append(pl.DataFrame({"row": row, "element": path_element}).drop_nulls())
    rivals = pl.concat(pairs).unique().sort("row", "element")
    return ints(rivals["row"]), ints(rivals["element"])
