"""The crossings that were offered, judged: joined by their id, found once by the LDS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import polars as pl

from pipeline.judge.bench import Bench
from pipeline.judge.judgement import Judgements
from schemas.arrays import Bools, Floats, Ints, flags, floats, ints, times_ns


@dataclass(frozen=True)
class Offers:
    """Crossings and telegrams, judged; arrays in order of time.

    `number`: the valid position that completes the crossing (`Series`); `beyond_window`: offered after its window
    closed; `accepted`: a virtual one by the LDS; not `offered`: crossed again before it was re-armed, which only a jump
    does.
    """

    crossing_id: Ints
    balise_id: list[str]
    t_ns: Ints
    number: Ints
    path_m: Floats
    judged: Judgements
    virtual: Bools
    offered: Bools
    accepted: Bools
    beyond_window: Bools

    @classmethod
    def of(cls, bench: Bench, row: Ints) -> Self:
        """`row`: the epochs of the valid positions."""
        offers, passages = bench.offers, bench.solution.passages
        late = passages.filter(pl.col("odometer_distance_m") > pl.col("window_close_m"))["crossing_id"]
        return cls(
            crossing_id=ints(offers["crossing_id"]),
            balise_id=offers["balise_id"].to_list(),
            t_ns=times_ns(offers),
            number=np.searchsorted(row, ints(offers["epoch"])).clip(0, max(row.size - 1, 0)),
            path_m=floats(offers, "path_m"),
            judged=bench.offers_judged,
            virtual=flags(offers, "virtual"),
            offered=flags(offers, "virtual") & flags(offers, "offered"),
            accepted=flags(offers, "accepted"),
            beyond_window=offers["crossing_id"].is_in(late.drop_nulls().implode()).to_numpy(),
        )
