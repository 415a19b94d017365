"""How sure the path is: at each step, and as stretches of doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.geodesy import Floats, Ints
from pipeline.matching.decode import Decoded
from pipeline.matching.fixes import Fixes
from pipeline.matching.search import Found
from pipeline.matching.trellis import Trellis
from schemas.config import MatchingConfig

AMBIGUOUS_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
    "netelement_id": pl.String,
    "other_netelement_id": pl.String,
    "probability": pl.Float64,
}
# Elements of the path this many before or after the one in question are the same way, not another.
_NEIGHBOURS = 2


@dataclass(frozen=True)
class Doubt:
    """Per step: how probable the path is, by all and by earlier steps, and the best other element (-1: none)."""

    posterior: Floats
    gate: Floats
    other: Ints


def doubt_of(trellis: Trellis, found: Found, decoded: Decoded) -> Doubt:
    """Probability of all states that are on the path about where the path is."""
    own = np.zeros(len(trellis.oriented), dtype=bool)
    elements, first = (trellis.oriented // 2).tolist(), trellis.first.tolist()
    for step, known in enumerate(_elements_about(decoded)):
        for state in range(first[step], first[step + 1]):
            own[state] = elements[state] in known
    other = np.where(own, -1.0, found.forward + found.posterior)
    count = np.diff(trellis.first)
    worst = np.lexsort((other, np.repeat(np.arange(len(count)), count)))[trellis.first[1:] - 1]
    return Doubt(
        posterior=_share(found.posterior * own, trellis.first),
        gate=_share(found.forward * own, trellis.first),
        other=np.where(other[worst] >= 0, trellis.oriented[worst] // 2, -1),
    )


def stretches(fixes: Fixes, trellis: Trellis, found: Found, doubt: Doubt, config: MatchingConfig) -> pl.DataFrame:
    """Stretches where either probability of the path is below the configured one, each with its least."""
    probability = np.minimum(doubt.posterior, doubt.gate)
    unsure = np.concatenate([[False], probability < config.ambiguity_probability, [False]])
    edges = np.flatnonzero(np.diff(unsure.astype(np.int8)))
    epoch, ids = trellis.steps.epoch, trellis.network.track.ids
    rows = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        worst = begin + int(np.argmin(probability[begin:end]))
        other = int(doubt.other[worst])
        until = int(epoch[end]) - 1 if end < len(trellis) else len(fixes) - 1
        here = ids[int(trellis.oriented[found.best[worst]]) // 2]
        there = ids[other] if other >= 0 else None
        rows.append((int(fixes.t_ns[epoch[begin]]), int(fixes.t_ns[until]), here, there, float(probability[worst])))
    return pl.DataFrame(rows, schema=AMBIGUOUS_COLUMNS, orient="row")


def no_doubt() -> pl.DataFrame:
    """No stretch of doubt."""
    return pl.DataFrame(schema=AMBIGUOUS_COLUMNS)


def _elements_about(decoded: Decoded) -> list[set[int]]:
    """Per step the elements of the path about it; where a leg ends, those of the next one too."""
    around: dict[tuple[int, int], set[int]] = {}
    keys = list(zip(decoded.leg.tolist(), decoded.number.tolist(), strict=True))
    for leg, number in keys:
        if (leg, number) not in around:
            chain = decoded.chains[leg]
            here = number - chain.low
            part = chain.oriented[max(0, here - _NEIGHBOURS) : here + _NEIGHBOURS + 1]
            around[leg, number] = {oriented // 2 for oriented in part}
    about = [around[key] for key in keys]
    for step in np.flatnonzero(np.diff(decoded.leg)).tolist():
        about[step] = about[step + 1] = around[keys[step]] | around[keys[step + 1]]
    return about


def _share(values: Floats, first: Ints) -> Floats:
    return np.clip(np.add.reduceat(values, first[:-1]), 0.0, 1.0)
