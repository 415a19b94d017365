"""The evidence as columns: net elements on which the train may have been, and where on a single one."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.evidence.evidence import Alternative, EvidenceSet
from pipeline.stages.track.survey import SurveyedTrack


def true_places(evidence: EvidenceSet, track: SurveyedTrack) -> pl.DataFrame:
    """Per instant `true_netelement_ids`, in the order of the survey, `true_measure_low_m` and `true_measure_high_m`.

    Null where nothing is known; the measures also where there are several net elements.
    """
    parts = [_touched(alternative) for alternative in evidence.alternatives]
    touched = pl.concat([pl.DataFrame(schema=_TOUCHED), *parts])
    places = touched.group_by("row").agg(
        pl.col("element").unique().sort(), low=pl.col("low").min(), high=pl.col("high").max()
    )
    alone = pl.col("element").list.len() == 1
    names = pl.Series(track.ids, dtype=pl.String)
    rows = pl.DataFrame({"row": np.arange(evidence.kind.size)})
    return rows.join(places, on="row", how="left", maintain_order="left").select(
        true_netelement_ids=pl.col("element").list.eval(pl.element().replace_strict(_numbers(names), names)),
        true_measure_low_m=pl.when(alone).then("low"),
        true_measure_high_m=pl.when(alone).then("high"),
    )


_TOUCHED = {"row": pl.Int64, "element": pl.Int64, "low": pl.Float64, "high": pl.Float64}


def _numbers(names: pl.Series) -> pl.Series:
    return pl.Series(range(len(names)), dtype=pl.Int64)


def _touched(alternative: Alternative) -> pl.DataFrame:
    """Every net element that the interval touches, with the measures on it: one row per instant and visit."""
    route = alternative.route
    first = np.searchsorted(route.entry_m, alternative.low_m, side="right") - 1
    last = np.searchsorted(route.entry_m, alternative.high_m, side="right") - 1
    first = np.maximum(first, 0)
    last = np.maximum(last, 0)
    count = last - first + 1
    numbers = np.repeat(np.arange(alternative.rows.size), count)
    visit = np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())
    entry = route.entry_m[visit]
    low = route.low_m[visit]
    high = route.high_m[visit]
    begin = np.clip(alternative.low_m[numbers] - entry, 0.0, high - low)
    end = np.clip(alternative.high_m[numbers] - entry, 0.0, high - low)
    forward = route.forward[visit]
    return pl.DataFrame(
        {
            "row": alternative.rows[numbers],
            "element": route.element[visit],
            "low": np.where(forward, low + begin, high - end),
            "high": np.where(forward, low + end, high - begin),
        },
        schema=_TOUCHED,
    )
