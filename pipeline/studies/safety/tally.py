"""What architectures did, as counts that add up over runs, and the figures that the counts come to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import polars as pl

from pipeline.stages.run_row.bounds import (
    clopper_pearson,
    continuity_estimate,
    mtbf_estimate,
    poisson_rate,
    with_estimates,
)

REACTIVE = "reactive 1oo1"
COMPOSITE = "composite 2oo2"
REDUNDANT = "reactive 1oo2"

_KEYS = ("architecture", "solution", "other")
_WHOLE = (
    *("hazards", "failures", "missed", "failures_judged", "missed_judged", "common_failures", "common_missed"),
    *("alarms", "false_alarms", "open_alarms", "losses"),
)
_TIMES = ("judged_s", "moving_s", "working_s", "up_s", "truth_s", "wrong_s")
COUNTS: Mapping[str, pl.DataType] = {
    **{name: pl.String() for name in _KEYS},
    **{name: pl.Int64() for name in _WHOLE},
    **{name: pl.Float64() for name in _TIMES},
    "delays_s": pl.List(pl.Float64),
}
"""Per architecture and solution (`other`: of a pair, which has one row).

Faults of the position and what became of them (of a pair: of either solution, those that overlap as one; `common`: both
failed at the same time; `judged`: by a reference or balise reads; `delays_s`: T_D of those detected). Alarms (`open`:
nobody can tell whether false) in the time in work that a truth judged. Moving time of the run, gaps included (null
where it is never known to have moved), and of this in work; how often work was lost after it had gone on, moving or
not, for `up_s`; time judged by a truth, and of this in work and judged wrong, whether it hit a virtual balise or not
(the architecture's P1). Null what an architecture is not judged by.
"""


def add_counts(parts: Iterable[pl.DataFrame]) -> pl.DataFrame:
    """Counts over several runs; `runs`: how many hold the solutions concerned."""
    sums = [pl.when(pl.col(name).count() > 0).then(pl.col(name).sum()) for name in (*_WHOLE, *_TIMES)]
    groups = pl.concat([pl.DataFrame(schema=COUNTS), *parts]).group_by(_KEYS, maintain_order=True)
    return groups.agg(pl.len().cast(pl.Int64).alias("runs"), *sums, pl.col("delays_s").explode().drop_nulls())


def architecture_figures(counts: pl.DataFrame) -> pl.DataFrame:
    """Figures with exact 95 % bounds, one row per architecture and solution or pair."""
    delays = pl.col("delays_s")
    moving = pl.col("moving_s")
    truth = pl.col("truth_s")
    order = {name: number for number, name in enumerate((REACTIVE, COMPOSITE, REDUNDANT))}
    table = counts.with_columns(
        detected=pl.when(pl.col("hazards").is_not_null()).then(delays.list.len().cast(pl.Int64)),
        time_to_detect_median_s=delays.list.median(),
        time_to_detect_max_s=delays.list.max(),
        judged_h=pl.col("judged_s") / 3600.0,
        up_h=pl.col("up_s") / 3600.0,
        false_where_all_known=pl.when(pl.col("open_alarms") == 0).then(pl.col("false_alarms")),
        availability=pl.when(moving > 0.0).then(pl.min_horizontal(pl.col("working_s") / moving, 1.0)),
        wrong_in_use_s=pl.when(truth > 0.0).then(pl.col("wrong_s")),
        wrong_in_use_share=pl.when(truth > 0.0).then(pl.col("wrong_s") / truth),
    )
    table = with_estimates(
        table,
        ("missed_share", "", clopper_pearson, "missed_judged", "failures_judged"),
        ("false_alarm_rate", "_per_h", poisson_rate, "false_where_all_known", "judged_h"),
        ("mtbf", "_h", mtbf_estimate, "losses", "up_h"),
        ("continuity_15s", "", continuity_estimate, "losses", "up_h"),
    )
    ordered = table.sort(pl.col("architecture").replace_strict(order, return_dtype=pl.Int64), "solution", "other")
    return ordered.select(*_KEYS, *(name for name in ("runs",) if name in counts.columns), *_SHOWN)


_SHOWN = (
    *("hazards", "detected", "failures", "missed", "failures_judged", "missed_judged", "missed_share"),
    *("missed_share_low", "missed_share_high", "common_failures", "common_missed", "time_to_detect_median_s"),
    *("time_to_detect_max_s", "alarms", "false_alarms", "false_alarm_rate_per_h", "false_alarm_rate_low_per_h"),
    *("false_alarm_rate_high_per_h", "judged_h", "availability", "wrong_in_use_s", "wrong_in_use_share", "mtbf_h"),
    *("mtbf_low_h", "mtbf_high_h", "continuity_15s", "continuity_15s_low", "continuity_15s_high"),
)
