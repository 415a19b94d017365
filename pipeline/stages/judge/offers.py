"""Every offer of a virtual balise, and every telegram, judged against where the train was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.judge.case import Case
from pipeline.stages.judge.judgement import JUDGEMENTS, UNKNOWN, WRONG, Judgements, MatchedPositions, judgements_of
from schemas.arrays import Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.enums import Judgement


def judged_offers(case: Case, epochs: pl.DataFrame) -> pl.DataFrame:
    """The offers of the LDS as `schemas.stages.JudgedOffers`; `epochs`: judged.

    Judged is the place of the balise: at the time of the telegram, or of the crossing less the GNSS latency.
    """
    offers = case.solution.offers
    limits = case.config.hazards
    t_ns = times_ns(offers)
    before = ints(offers["before"])
    sure = flags(epochs, "unambiguous")
    positions = MatchedPositions.of(case, offers, sure[before] & sure[ints(offers["epoch"])])
    at_ns = np.where(flags(offers, "virtual"), case.instants(t_ns), t_ns)
    along = judgements_of(case, positions, at_ns, case.evidence.at(at_ns))
    judged = along.turned(ints(epochs["direction"])[before])
    margin_m = np.where(judged.is_right, limits.failure_limit_m - judged.largest_m, np.nan)
    late = case.solution.passages.filter(pl.col("odometer_distance_m") > pl.col("window_close_m"))["crossing_id"]
    return offers.select(
        *("crossing_id", "balise_id", "t", "epoch", "path_m", "virtual", "accepted"),
        offered=pl.col("virtual") & pl.col("offered"),
        beyond_window=pl.col("crossing_id").is_in(late.drop_nulls().implode()),
    ).with_columns(
        *judged.columns(),
        pl.Series("location_error_m", judged.known_m(limits.known_error_m), nan_to_null=True),
        pl.Series("proof_margin_m", margin_m, nan_to_null=True),
    )


@dataclass(frozen=True)
class Offers:
    """Judged offers in arrays; `number`: the position, by its row, that completes each."""

    balise_id: list[str]
    number: Ints
    t_ns: Ints
    path_m: Floats
    judged: Judgements
    virtual: Bools
    offered: Bools
    accepted: Bools
    beyond_window: Bools

    @classmethod
    def of(cls, offers: pl.DataFrame, positions: pl.DataFrame) -> Offers:
        number = np.searchsorted(ints(positions["epoch"]), ints(offers["epoch"]))
        return cls(
            balise_id=offers["balise_id"].to_list(),
            number=number.clip(0, max(positions.height - 1, 0)),
            t_ns=times_ns(offers),
            path_m=floats(offers, "path_m"),
            judged=Judgements.of(offers),
            virtual=flags(offers, "virtual"),
            offered=flags(offers, "offered"),
            accepted=flags(offers, "accepted"),
            beyond_window=flags(offers, "beyond_window"),
        )

    def between(self, begin: int, end: int) -> Bools:
        """Those that positions `begin` to `end` complete."""
        inside: Bools = (self.number >= begin) & (self.number < end)
        return inside

    def worst_accepted(self, begin: int, end: int) -> Judgement:
        """The worst judgement of the VBs accepted at positions `begin` to `end`; right where none was."""
        codes = self.judged.code[self.accepted & self.between(begin, end)]
        return next((JUDGEMENTS[code] for code in (WRONG, UNKNOWN) if (codes == code).any()), Judgement.RIGHT)
