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
    elements = pl.col("element").unique().sort()
    places = touched.group_by("row").agg(elements, low=pl.col("low").min(), high=pl.col("high").max())
    alone = pl.col("element").list.len() == 1
    names = pl.Series(track.ids, dtype=pl.String)
    numbers = pl.Series(range(names.len()), dtype=pl.Int64)
    rows = pl.DataFrame({"row": np.arange(evidence.kind.size)})
    return rows.join(places, on="row", how="left", maintain_order="left").select(
        true_netelement_ids=pl.col("element").list.eval(pl.element().replace_strict(numbers, names)),
        true_measure_low_m=pl.when(alone).then("low"),
        true_measure_high_m=pl.when(alone).then("high"),
    )


_TOUCHED = {"row": pl.Int64, "element": pl.Int64, "low": pl.Float64, "high": pl.Float64}


def _touched(there: Alternative) -> pl.DataFrame:
    """Every net element that the interval touches, with the measures on it: one row per instant and visit."""
    route = there.route
    first, last = (
        np.maximum(np.searchsorted(route.entry_m, at_m, side="right") - 1, 0) for at_m in (there.low_m, there.high_m)
    )
    count = last - first + 1
    numbers = np.repeat(np.arange(there.rows.size), count)
    visit = np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())
    low = route.low_m[visit]
    high = route.high_m[visit]
    begin, end = (
        np.clip(at_m[numbers] - route.entry_m[visit], 0.0, high - low) for at_m in (there.low_m, there.high_m)
    )
    forward = route.forward[visit]
    columns = {
        "row": there.rows[numbers],
        "element": route.element[visit],
        "low": np.where(forward, low + begin, high - end),
        "high": np.where(forward, low + end, high - begin),
    }
    return pl.DataFrame(columns, schema=_TOUCHED)
