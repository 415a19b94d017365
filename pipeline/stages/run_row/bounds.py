"""How certain a figure from few events is: exact bounds on rates and shares, and both as columns of tables.

Rates are of a Poisson process; shares are of independent trials (events, passages, runs), never of epochs, whose errors
are correlated. The bounds are exact in the sense of Garwood and of Clopper and Pearson: they hold at least as often as
they claim, because events are whole numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

import polars as pl
from scipy.special import betaincinv, gammaincinv

from schemas.enums import TRUTH
from schemas.frozen import frozen

CONFIDENCE = 0.95
CONTINUITY_S = 15.0
"""Most critical phase of an APV-I/LPV-200 operation (LOC section VI); part of the column names `continuity_15s`."""


@frozen
class Estimate:
    """A measured figure with its bounds; a part is None where the data cannot say it."""

    value: float | None
    low: float | None
    high: float | None


UNKNOWN = Estimate(None, None, None)


def poisson_rate(events: int, exposure_h: float, confidence: float = CONFIDENCE) -> Estimate:
    """Rate [1/h] with exact two-sided bounds (Garwood 1936): zero events in T h give 0 to 3.69/T.

    Without exposure nothing is known.
    """
    _require_valid(events, confidence)
    if not exposure_h > 0:
        return UNKNOWN
    tail = (1.0 - confidence) / 2.0
    low = float(gammaincinv(events, tail)) if events else 0.0
    high = float(gammaincinv(events + 1, 1.0 - tail))
    return Estimate(events / exposure_h, low / exposure_h, high / exposure_h)


def poisson_rate_upper(events: int, exposure_h: float) -> float | None:
    """One-sided upper bound of a rate [1/h], the one a THR claim needs: zero events give 3.00/T."""
    _require_valid(events)
    return float(gammaincinv(events + 1, CONFIDENCE)) / exposure_h if exposure_h > 0 else None


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Estimate:
    """Share of independent trials with exact two-sided bounds (Clopper and Pearson 1934)."""
    _require_valid(successes, confidence)
    if trials < successes:
        raise ValueError(f"{successes} successes out of {trials} trials")
    if trials == 0:
        return UNKNOWN
    tail = (1.0 - confidence) / 2.0
    failures = trials - successes
    low = float(betaincinv(successes, failures + 1, tail)) if successes else 0.0
    high = float(betaincinv(successes + 1, failures, 1.0 - tail)) if failures else 1.0
    return Estimate(successes / trials, low, high)


def hours_to_substantiate(rate_per_h: float, events: int = 0) -> float:
    """Total hours [h] with no more than `events` events that show a rate below `rate_per_h`.

    One-sided: 0.67e-9/h needs 4.47e9 h without any event.
    """
    _require_valid(events)
    if not rate_per_h > 0:
        raise ValueError(f"a rate of {rate_per_h} 1/h cannot be substantiated")
    return float(gammaincinv(events + 1, CONFIDENCE)) / rate_per_h


def hours_still_needed(rate_per_h: float, events: int, exposure_h: float) -> float:
    """Hours [h] still to be run without a further event, after `events` in `exposure_h`."""
    return max(0.0, hours_to_substantiate(rate_per_h, events) - exposure_h)


def _require_valid(events: int, confidence: float = CONFIDENCE) -> None:
    """Refuse negative counts, and confidences that are no probability."""
    if events < 0:
        raise ValueError(f"{events} events")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence {confidence} is no probability between 0 and 1")


Estimator = tuple[str, str, Callable[[int, float], Estimate] | Callable[[int, int], Estimate], str, str]
"""Name, ending with the unit, what estimates, and the columns of its events and of what they are held against."""


def columns_of(name: str, estimate: Estimate, unit: str = "") -> dict[str, object]:
    """An estimate as three columns `name`, `name_low`, `name_high`, with their unit at the end."""
    parts = {"": estimate.value, "_low": estimate.low, "_high": estimate.high}
    return {f"{name}{part}{unit}": value for part, value in parts.items()}


def with_estimates(frame: pl.DataFrame, *estimates: Estimator) -> pl.DataFrame:
    """The table with the columns of each estimate, row by row; not known where its events are not."""
    series = []
    for name, unit, estimate, events, against in estimates:
        pairs = zip(frame[events].to_list(), frame[against].to_list(), strict=True)
        rows = [columns_of(name, UNKNOWN if None in pair else estimate(*pair), unit) for pair in pairs]
        schema = dict.fromkeys(columns_of(name, UNKNOWN, unit), pl.Float64)
        series += pl.DataFrame(rows, schema=schema).get_columns()
    return frame.with_columns(series)


def bound_columns(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """The columns of the bounds of each figure that has some: `mtbf_low_h` and `mtbf_high_h` of `mtbf_h`."""
    parts = [(low.rpartition("_low"), low) for low in names if "_low" in low]
    pairs = {head + unit: (low, f"{head}_high{unit}") for (head, _, unit), low in parts}
    return {figure: pair for figure, pair in pairs.items() if {figure, *pair} <= set(names)}


def continuity_over(t_s: float, mtbf_h: float) -> float:
    """Probability of working through `t_s` [s], having worked at its beginning (LOC eq. 8)."""
    return math.exp(-t_s / 3600.0 / mtbf_h)


def mtbf_estimate(losses: int, up_h: float) -> Estimate:
    """MTBF [h] from the losses counted in `up_h`; without a loss not known, but with a lower bound."""
    rate = poisson_rate(losses, up_h)
    return Estimate(*(1.0 / per_h if per_h else None for per_h in (rate.value, rate.high, rate.low)))


def continuity_estimate(losses: int, up_h: float) -> Estimate:
    """Continuity over 15 s at the MTBF of so many losses in `up_h`."""
    hours = mtbf_estimate(losses, up_h)
    parts = (hours.value, hours.low, hours.high)
    return Estimate(*(None if part is None else continuity_over(CONTINUITY_S, part) for part in parts))


DETECTION_TIMES = ("time_to_detect_s", "time_since_failure_s", "time_since_failure_may_s")


def without_repeated_runs(runs: pl.DataFrame) -> pl.DataFrame:
    """Rows of `runs` with every recording once, that of the worst verdict: a log under two names has one content.

    The content alone (`input_digest`) is not known of runs that came from no file.
    """
    content = pl.struct("solution", "input_digest", "t_start", "t_end", "epochs", "distance_m")
    worst = ("unsafe", "unproven", "safe")
    order = pl.col("verdict").cast(pl.String).replace_strict(worst, range(3), default=3)
    return runs.sort("solution", order, "run_id").filter(content.is_first_distinct() | pl.col("input_digest").is_null())


def missed_detection() -> pl.Expr:
    """Expression on hazards: no monitor failed within the budget (DIAG's Pmd; DOMAIN 5.3); null without a failure.

    Missed for certain counts from `t_failure`, found for certain from `t_failure_may`; between them null.
    """
    budget = (pl.col("budget_s") * 1e9).round().cast(pl.Int64).cast(pl.Duration("ns"))

    def is_late(since: str) -> pl.Expr:
        """Not detected within the budget since this instant."""
        undetected = pl.col("t_detected").is_null() | (pl.col("t_detected") > pl.col(since) + budget)
        return pl.col(since).is_not_null() & undetected

    in_time = pl.col("t_failure_may").is_not_null() & ~is_late("t_failure_may")
    return pl.when(is_late("t_failure")).then(True).when(in_time).then(False)


def earliest_failure() -> pl.Expr:
    """Expression on hazards: earliest begin of a failure; null where the evidence is silent for one that failed."""
    without_evidence = pl.col("t_failure").is_not_null() & pl.col("t_failure_may").is_null()
    return pl.when(~without_evidence.any()).then(pl.col("t_failure_may").min())


def independent_episodes(hazards: pl.DataFrame) -> pl.DataFrame:
    """One row per fault: `solution, begin, t_failure, t_failure_may, t_end, budget_s, failed, missed, with_truth,
    detected`, `DETECTION_TIMES`, and `run_id` where the hazards have one.

    A fault may stand in several rows of `hazards` (one per class, and the jump back as a row `caused_by` the first);
    counted one by one they would make the bounds too narrow. Shares are of faults `with_truth` (reference or balise
    reads): the odometer alone mostly sees what was detected.
    """
    failed = pl.col("t_failure").is_not_null()
    t_end = pl.col("t_end")
    keys = [*(name for name in ("run_id", "solution") if name in hazards.columns), "begin"]
    rows = hazards.filter(pl.col("caused_by").is_null())
    rows = rows.with_columns(begin=pl.coalesce("t_onset", "t_hazard"), missed=missed_detection())
    episodes = rows.group_by(keys).agg(
        t_failure=pl.col("t_failure").min(),
        t_failure_may=earliest_failure(),
        t_end=pl.when(t_end.null_count() == 0).then(t_end.max()),
        budget_s=pl.col("budget_s").first(),
        failed=failed.any(),
        missed=pl.when(failed.any()).then(pl.col("missed").filter(failed).any(ignore_nulls=False)),
        with_truth=pl.col("evidence").is_in(TRUTH).all(),
        detected=pl.col("detected").any(),
        **{name: pl.col(name).max() for name in DETECTION_TIMES},
    )
    return episodes.sort(keys)
