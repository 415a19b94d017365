"""The injections as figures: per cell, Pmd against T_dsf, by place, and bank against bank.

Counting. All injections of a cell are watched for equally long, so the Kaplan-Meier curve is the plain share not yet
noticed, and T_D beyond the watch is only known to be longer: no quantile is given from it. Injections whose watches
overlap share the noise that decides them. So a share is that of all injections, and its bounds are those of Clopper and
Pearson on as many trials as there are passes: watches of one run that neither overlap nor are shorter than `pass_s`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.special import betaincinv

from datasets.experiment.recorded.baseline import FaultFree
from datasets.experiment.recorded.plan import Cell, RecordedPlan
from datasets.experiment.tables import Row
from pipeline.stages.run_row.bounds import CONFIDENCE, UNKNOWN, columns_of, poisson_rate
from schemas.arrays import NS_PER_S, Floats, floats, times_ns
from schemas.conform import conform
from schemas.experiment import ExperimentBanks, ExperimentCells, ExperimentPlaces, ExperimentPmd

_PMD_STEPS = 40
_QUANTILES = {"median": 0.5, "p95": 0.95, "max": 1.0}
# Shares of few passes are whole numbers of them but for rounding.
_ROUNDING = 1e-9


class IndependentPasses(NamedTuple):
    """Independent passes: their number, and the number of passes of equal size that they are worth."""

    number: int
    worth: float


def independent_passes(frame: pl.DataFrame, pass_s: float) -> IndependentPasses:
    """The largest number of watches that share no time, at least `pass_s` each: of those left the first to end.

    Passes of m injections each, with all that overlap, are worth (sum m)^2 / sum m^2 (Kish's effective sample size).
    """
    length_ns = np.maximum(floats(frame, "watched_s"), pass_s) * NS_PER_S
    begin_ns = times_ns(frame, "t_onset")
    end_ns = begin_ns + length_ns.round().astype(np.int64)
    runs = frame["run_id"].to_list()
    free_ns: dict[str, int] = {}
    current: dict[str, int] = {}
    sizes: list[int] = []
    for row in np.argsort(end_ns, kind="stable").tolist():
        run = runs[row]
        if begin_ns[row] >= free_ns.get(run, np.iinfo(np.int64).min):
            free_ns[run] = int(end_ns[row])
            current[run] = len(sizes)
            sizes.append(0)
        sizes[current[run]] += 1
    return IndependentPasses(len(sizes), sum(sizes) ** 2 / sum(size**2 for size in sizes) if sizes else 0.0)


def bounded_share(name: str, hits: int, trials: int, worth: float) -> Row:
    """A share of all trials, with the bounds that as many hits among `worth` independent ones alone would have.

    Clopper and Pearson with a number of trials that need not be whole (Korn and Graubard 1998); hits rounded outwards.
    """
    if not trials or not worth:
        return columns_of(name, UNKNOWN)
    tail = (1.0 - CONFIDENCE) / 2.0
    expected = hits / trials * worth
    least = float(np.floor(expected + _ROUNDING))
    most = float(np.ceil(expected - _ROUNDING))
    low = float(betaincinv(least, worth - least + 1.0, tail)) if least > 0.0 else 0.0
    high = float(betaincinv(most + 1.0, worth - most, 1.0 - tail)) if most < worth else 1.0
    return {name: hits / trials, f"{name}_low": low, f"{name}_high": high}


def cells_table(
    injections: pl.DataFrame, banks: Sequence[str], cells: Sequence[Cell], plan: RecordedPlan, lost: pl.DataFrame
) -> pl.DataFrame:
    """One row per bank and cell; `lost`: `bank, cell, reason` of the instants that could not take the fault."""
    rows = [
        _cell_row(
            cell, bank, injections.filter(bank=bank, cell=cell.name), lost.filter(bank=bank, cell=cell.name), plan
        )
        for bank in banks
        for cell in cells
    ]
    return conform(pl.DataFrame(rows, infer_schema_length=None), ExperimentCells)


def _cell_row(cell: Cell, bank: str, frame: pl.DataFrame, lost: pl.DataFrame, plan: RecordedPlan) -> Row:
    """Figures of one cell by one bank."""
    noticed = int(frame["noticed"].sum())
    independent = independent_passes(frame, plan.pass_s)
    failed = _failed_positions(frame)
    missed = _count_missed(failed, 0.0, "time_since_failure_may_s")
    short = cell.count - frame.height - lost.height
    reason = f"{short} found no room in the runs" if short else None
    return {
        "bank": bank,
        **cell.labels,
        "wanted": cell.count,
        "injections": frame.height,
        "not_possible": lost.height,
        "reason": "; ".join([*lost["reason"].unique().sort().to_list(), *([reason] if reason else [])]) or None,
        "watched_s": cell.watch_s,
        "passes": independent.number,
        "noticed": noticed,
        **bounded_share("noticed_share", noticed, frame.height, independent.worth),
        **_detection_figures(frame, int(independent.worth)),
        "failures": failed.height,
        "missed_at_failure": missed,
        **bounded_share("pmd_at_failure", missed, failed.height, independent_passes(failed, plan.pass_s).worth),
        "stopped": int(frame["stopped"].sum()),
        "noticed_not_stopped": int((~frame["stopped"].drop_nulls()).sum()),
        "accepted_wrong": int(frame["accepted_wrong"].sum()),
        "hazardous_max_s": frame["hazardous_s"].max(),
        "unnoticed_max_m": frame["unnoticed_m"].max(),
        "in_use_max_m": frame["in_use_m"].max(),
        "tvb_lost_median_s": frame["tvb_lost_s"].median(),
    }


def _detection_figures(frame: pl.DataFrame, independent: int) -> Row:
    """Quantiles of T_D; the median's bounds by order statistics of the passes."""
    times_s = np.sort(frame["time_to_detect_s"].fill_null(np.inf).to_numpy())
    bounds = _median_bounds_s(times_s, independent)
    quantiles = {f"time_to_detect_{name}_s": _quantile(times_s, share) for name, share in _QUANTILES.items()}
    return {**quantiles, "time_to_detect_median_low_s": bounds[0], "time_to_detect_median_high_s": bounds[1]}


def _median_bounds_s(times_s: Floats, independent: int) -> tuple[float | None, float | None]:
    """Confidence bounds of the median by order statistics [s]; None of fewer than six passes.

    The least and the largest of five enclose the median with 93.75 % only.
    """
    from scipy.stats import binom  # takes half a second to load

    tail = (1.0 - CONFIDENCE) / 2.0
    order = int(binom.ppf(tail, independent, 0.5)) if independent else 0
    if order < 1:
        return None, None
    below = (order - 1) / independent
    return _quantile(times_s, below), _quantile(times_s, 1.0 - below)


def _quantile(ordered: Floats, share: float) -> float | None:
    """The smallest time by which this share was noticed; None where it was not."""
    if not ordered.size:
        return None
    value = float(ordered[max(int(np.ceil(share * ordered.size - _ROUNDING)) - 1, 0)])
    return value if np.isfinite(value) else None


def _failed_positions(frame: pl.DataFrame) -> pl.DataFrame:
    """Positions that certainly failed, and those that may have and were not noticed by then: none of these vanishes."""
    late = pl.col("time_since_failure_may_s").fill_null(np.inf) > 0.0
    certain = pl.col("time_to_failure_s").is_not_null()
    return frame.filter(certain | (pl.col("time_to_failure_may_s").is_not_null() & late))


def _count_missed(failed: pl.DataFrame, time_s: float, since: str) -> int:
    """Failures not detected so long after they began."""
    return int((failed[since].fill_null(np.inf) > time_s).sum())


def pmd_table(
    injections: pl.DataFrame, banks: Sequence[str], cells: Sequence[Cell], plan: RecordedPlan
) -> pl.DataFrame:
    """Pmd at times since failure, of the cells in which some position failed."""
    rows = [row for bank in banks for cell in cells for row in _pmd_rows(injections, bank, cell, plan)]
    return conform(pl.DataFrame(rows, schema=ExperimentPmd.create_empty().schema), ExperimentPmd)


def _pmd_rows(injections: pl.DataFrame, bank: str, cell: Cell, plan: RecordedPlan) -> Iterator[Row]:
    """Pmd of one cell by one bank, at times since failure."""
    failed = _failed_positions(injections.filter(bank=bank, cell=cell.name))
    if failed.is_empty():
        return
    independent = independent_passes(failed, plan.pass_s)
    for time_s in _times_since_failure_s(failed).tolist():
        missed = _count_missed(failed, time_s, "time_since_failure_may_s")
        yield {
            "bank": bank,
            **cell.labels,
            "time_since_failure_s": time_s,
            "trials": failed.height,
            "passes": independent.number,
            "missed": missed,
            **bounded_share("pmd", missed, failed.height, independent.worth),
            "missed_certain": _count_missed(failed.drop_nulls("time_to_failure_s"), time_s, "time_since_failure_s"),
        }


def _times_since_failure_s(failed: pl.DataFrame) -> Floats:
    """Times since the failure [s] of the Pmd curve, from the onset (by the median) to the end of the first watch."""
    failure_s = failed["time_to_failure_s"].fill_null(failed["time_to_failure_may_s"])
    before_s = float(np.median(failure_s.to_numpy()))
    after_s = float((failed["watched_s"] - failure_s).min())  # type: ignore[arg-type]
    times = np.concatenate(
        [np.linspace(-before_s, 0.0, _PMD_STEPS + 1), np.linspace(0.0, after_s, _PMD_STEPS // 2 + 1)]
    )
    return np.unique(times.round(1))


def places_table(injections: pl.DataFrame, cells: Sequence[Cell], plan: RecordedPlan) -> pl.DataFrame:
    """Pieces of line by bank; a piece without an onset has no row."""
    if injections.is_empty():
        return ExperimentPlaces.create_empty()
    watch_s = {cell.name: cell.watch_s for cell in cells}
    lasting_s = pl.col("time_to_detect_s").fill_null(pl.col("cell").replace_strict(watch_s, return_dtype=pl.Float64))
    usual_s = lasting_s.median().over("bank", "cell")
    piece = (pl.col("measure_m") / plan.place_m).floor()
    whole_s = pl.col("time_to_detect_s").fill_null(np.inf).median()
    return conform(
        injections.drop_nulls(["netelement_id", "measure_m"])
        .with_columns(slowness=pl.when(usual_s > 0.0).then(lasting_s / usual_s), piece=piece)
        .group_by("bank", "netelement_id", "piece")
        .agg(
            injections=pl.len(),
            cells=pl.col("cell").n_unique(),
            noticed=pl.col("noticed").sum(),
            slowness=pl.col("slowness").median(),
            time_to_detect_median_s=pl.when(whole_s.is_finite()).then(whole_s),
            unnoticed_max_m=pl.col("unnoticed_m").max(),
            in_use_max_m=pl.col("in_use_m").max(),
            accepted_wrong=pl.col("accepted_wrong").sum(),
            hazardous_max_s=pl.col("hazardous_s").max(),
            curvature_per_m=pl.col("curvature_per_m").abs().median(),
            speed_mps=pl.col("speed_mps").abs().median(),
        )
        .with_columns(from_m=pl.col("piece") * plan.place_m, to_m=(pl.col("piece") + 1.0) * plan.place_m)
        .sort("bank", "netelement_id", "from_m"),
        ExperimentPlaces,
    )


def banks_table(
    injections: pl.DataFrame, fault_free: Sequence[FaultFree], cells: pl.DataFrame, plan: RecordedPlan
) -> pl.DataFrame:
    """Detection against false alarms, bank by bank."""
    rows = [_bank_row(injections.filter(bank=one.bank), one, cells.filter(bank=one.bank), plan) for one in fault_free]
    return conform(pl.DataFrame(rows, infer_schema_length=None), ExperimentBanks)


def _bank_row(frame: pl.DataFrame, fault_free: FaultFree, cells: pl.DataFrame, plan: RecordedPlan) -> Row:
    """Detection of all cells against false alarms, of one bank."""
    failed = _failed_positions(frame)
    independent = independent_passes(failed, plan.pass_s)
    missed = _count_missed(failed, 0.0, "time_since_failure_may_s")
    slowest = cells.filter(pl.col("injections") > 0).sort(
        pl.col("time_to_detect_median_s").fill_null(np.inf), descending=True, maintain_order=True
    )
    return {
        "bank": fault_free.bank,
        "runs": fault_free.runs,
        "hours": fault_free.hours,
        "alarms": fault_free.alarms,
        **columns_of("alarm_rate", poisson_rate(fault_free.alarms, fault_free.hours), "_per_h"),
        "tvb_share": fault_free.tvb_s / fault_free.recorded_s if fault_free.recorded_s else None,
        "injections": frame.height,
        "passes": independent.number,
        "noticed": int(frame["noticed"].sum()),
        "failures": failed.height,
        "missed_at_failure": missed,
        **bounded_share("pmd_at_failure", missed, failed.height, independent.worth),
        "slowest_cell": slowest["cell"].first() if slowest.height else None,
        "noticed_not_stopped": int((~frame["stopped"].drop_nulls()).sum()),
        "accepted_wrong": int(frame["accepted_wrong"].sum()),
        "hazardous_s": float(frame["hazardous_s"].sum()),
        "in_use_max_m": frame["in_use_m"].max(),
        "tvb_lost_s": float(frame["tvb_lost_s"].sum()),
    }
