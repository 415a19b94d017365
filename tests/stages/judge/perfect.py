"""A judge that knows the truth: the tables of a replay with all that is judged written anew from it.

It holds the findings themselves to account: on these tables they find nothing, on tables made worse they find it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from tests.stages.judge.accounts import BUDGET_S, longest_s
from tests.stages.judge.findings import LIMIT_M, Judgements, Rung


def perfect(rung: Rung, blur_m: float) -> Rung:
    """The rung as a judge would leave it that knows every position to `blur_m`."""
    frame = rung.tables.epochs
    error = rung.epochs.error_m
    low, high = error - blur_m, error + blur_m
    epochs = frame.with_columns(
        pl.Series("error_low_m", low, nan_to_null=True),
        pl.Series("error_high_m", high, nan_to_null=True),
        pl.Series("error_along_m", error if blur_m <= 5.0 else np.full(len(error), np.nan), nan_to_null=True),
        _said(rung.epochs, blur_m),
    )
    offers = rung.offers.with_columns(_said(rung.passages, blur_m))
    judged = replace(rung, tables=replace(rung.tables, epochs=_with_states(epochs), passages=offers))
    return replace(judged, tables=replace(judged.tables, runs=_row(judged)))


def _said(kind: Judgements, blur_m: float) -> pl.Series:
    beyond = (kind.error_m - blur_m > LIMIT_M) | (kind.error_m + blur_m < -LIMIT_M)
    within = (np.abs(kind.error_m) + blur_m <= LIMIT_M) & ~kind.beside
    wrong = beyond | (kind.beside & kind.sure & (kind.apart_m > 0.5))
    return pl.Series("judgement", np.where(wrong, "wrong", np.where(within, "right", "unknown")))


def _with_states(epochs: pl.DataFrame) -> pl.DataFrame:
    named = {"right": "P0", "wrong": "P1"}
    state = pl.col("judgement").replace_strict(named, default=None)
    return epochs.with_columns(
        pl.when(pl.col("lds_mode").cast(pl.String) != "fail_safe").then(state).alias("lds_state")
    )


def _row(rung: Rung) -> pl.DataFrame:
    surely, _ = rung.in_use
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy()
    wrong = (rung.epochs.judgement == "wrong") & surely
    unsafe = int((accepted & (rung.passages.judgement == "wrong")).sum())
    unproven = int((accepted & (rung.passages.judgement == "unknown")).sum())
    hazardous, share = longest_s(rung, wrong), _share(rung)
    moving = rung.tables.epochs["moving"].fill_null(True).to_numpy()
    unknown_s = longest_s(rung, surely & moving & (rung.epochs.judgement == "unknown"))
    bad = unsafe > 0 or hazardous > BUDGET_S
    doubtful = unproven > 0 or unknown_s > BUDGET_S or not accepted.any()
    return rung.tables.runs.with_columns(
        verdict=pl.lit("unsafe" if bad else "unproven" if doubtful else "safe"),
        unsafe_accepted=pl.lit(unsafe),
        unproven_accepted=pl.lit(unproven),
        failures=pl.lit(int(wrong.any())),
        hazardous_max_s=pl.lit(hazardous),
        hazardous_s=pl.lit(float(rung.counted_s(wrong).sum())),
        share_p1=pl.lit(None, pl.Float64),
        share_unknown=pl.lit(share),
    )


def _share(rung: Rung) -> float:
    surely, _ = rung.in_use
    used = surely & rung.tables.epochs["moving"].fill_null(True).to_numpy()
    unknown = rung.counted_s(used & (rung.epochs.judgement == "unknown"))
    return float(unknown.sum() / max(rung.counted_s(used).sum(), 1e-9))
