"""One fault of the largest kind, as a profile that can be injected into the same run: the proof anyone can repeat."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.monitored import MonitoredSolution
from pipeline.studies.undetected.columns import rows_of, rows_of_passages, windows_of
from pipeline.studies.undetected.error import largest_errors
from pipeline.studies.undetected.exact import MARGIN, largest_profile
from pipeline.studies.undetected.steps_and_ramps import largest_of_shape
from schemas.arrays import NS_PER_S, ints, times_ns
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.monitors import SCALES


@frozen
class FaultProfile:
    """`fault`: `t_s` after the first epoch and `size_m` along growing path; `t`: stamps of where it begins and ends.

    `error_m`: its size at the end, as the linear program finds it; `bound_m`: as the tables have it; `step_m` and
    `ramp_m`: what a step and a ramp could have become there. `monitors`: those whose thresholds the profile reaches,
    the most often reached first.
    """

    fault: pl.DataFrame
    t: pl.Series
    error_m: float
    bound_m: float
    step_m: float
    ramp_m: float
    monitors: tuple[str, ...]


def profile_at(monitored: MonitoredSolution, epoch: int, behind: bool) -> FaultProfile:
    """The largest unnoticed fault at an epoch, ahead or behind in the direction of travel there."""
    epochs = monitored.solution.epochs.table
    rows = rows_of(monitored)
    row = int(np.searchsorted(rows.epoch, epoch))
    window = next((part for part in windows_of(monitored, rows) if part.start < row <= part.end), None)
    if window is None or row >= rows.rows or rows.epoch[row] != epoch:
        raise UsageError(
            "has no fault to look for",
            place=f"epoch {epoch}",
            expected="an epoch with a position and an odometer, not negated, after the last independent fix",
        )
    against = behind != bool(ints(epochs["direction"], unknown=1)[epoch] < 0)
    part = rows.since(window.start, row, window.since_s)
    travel = part.mirrored() if against else part
    optimum = largest_profile(travel, MARGIN)
    enabled = monitored.bank.along().enabled
    names = [name for name, on in zip(SCALES, enabled, strict=True) if on or name == "raw"]
    return FaultProfile(
        fault=pl.DataFrame(
            {"t_s": [window.since_s, *part.t_s[1:]], "size_m": -optimum.fault_m if against else optimum.fault_m}
        ),
        t=pl.Series("t", [window.since_ns, int(times_ns(epochs)[epoch])]).cast(pl.Datetime("ns", "UTC")),
        error_m=optimum.error_m,
        bound_m=float(largest_errors(travel, monitored.prepared.config.undetected).most_m[-1]),
        step_m=largest_of_shape(travel, "step"),
        ramp_m=largest_of_shape(travel, "ramp"),
        monitors=tuple(f"along_{names[which]}" if which >= 0 else "channel" for which in optimum.binding),
    )


def epoch_of(monitored: MonitoredSolution, balise: str | None, at_s: float | None) -> int:
    """The epoch that is asked for: of the first passage of a balise, the last one up to a time, or the last one."""
    rows = rows_of(monitored)
    passages = monitored.lds.passages
    if balise is None:
        t_ns = monitored.solution.epochs.t_ns
        stamps = t_ns[rows.epoch]
        latest = stamps[-1:].sum() if at_s is None else t_ns[0] + round(at_s * NS_PER_S)
        row = int(np.searchsorted(stamps, latest, side="right")) - 1
        return int(rows.epoch[row]) if row >= 0 else 0
    at = rows_of_passages(monitored, rows)
    watched = at >= 0
    of_balise = (passages["balise_id"] == balise).to_numpy()
    if not (of_balise & watched).any():
        known = passages.filter(watched)["balise_id"].unique(maintain_order=True).to_list()
        why = "was passed, but not with a position in use after the last independent fix" if of_balise.any() else None
        raise UsageError(
            why or "was not passed in this run",
            place=f"--balise {balise}",
            expected=", ".join(known) or "none of this run: leave --balise out",
        )
    return int(rows.epoch[at[of_balise & watched][0]])
