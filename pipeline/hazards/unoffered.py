"""Virtual balises that the train passed by the evidence and that the LDS knows nothing of.

The LDS follows the position: before the first one, or where a wrong position is ahead at the start of a run or
behind at its end, it passes no balise, and no expectation window has closed yet. They are deletions all the same.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.epochs.timeline import linking_gap_s, nominal_period_s
from pipeline.hazards.passages import positions_at
from pipeline.hazards.passing import TruePassings, legs_of, true_passings
from pipeline.hazards.truth import valid_ns
from schemas.arrays import Floats, floats
from schemas.config import LdsConfig
from schemas.enums import BaliseKind, Cause, Direction, FailureMode, LinkingError, PassageStatus, Reaction

# Confidence at which a true position lies beyond a balise.
_SIGMAS = 3.0


def with_unoffered(
    passages: pl.DataFrame,
    epochs: pl.DataFrame,
    truth: pl.DataFrame,
    balises: pl.DataFrame,
    lds: LdsConfig,
    solution: str,
    between: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """Passages of the LDS, and one more for each true passage of a virtual balise that has none (CONTRACT section 3).

    `missed` where there were positions, `not_available` where not. The true position has to come from
    farther than the re-arming distance, three sigma of the position and what the evidence can resolve, and go
    as far beyond: where a train only stands beside a balise, noise decides which of the two passes it.
    """
    virtual = balises.filter(pl.col("kind") == BaliseKind.VIRTUAL.value)
    passings = true_passings(epochs, truth, virtual, between)
    given = set(zip(passages["balise_id"].to_list(), passings.assign(passages), strict=True))
    lacking = {
        balise: [t_ns for t_ns in instants if (balise, t_ns) not in given]
        for balise, instants in passings.by_balise.items()
    }
    if not any(lacking.values()):
        return passages
    stamps = valid_ns(epochs)
    gap_s = linking_gap_s(nominal_period_s(stamps), lds.crossing_gap_s)
    doubt_m = _doubt_m(epochs, truth, lds)
    legs = legs_of(epochs)
    rows = []
    for balise in virtual.iter_rows(named=True):
        for t_ns in lacking.get(balise["balise_id"], []):
            near = min(int(np.searchsorted(stamps, t_ns)), stamps.size - 1)
            direction = _direction(passings, balise["balise_id"], t_ns, balise["path_m"], float(doubt_m[near]))
            if direction is not None and legs[near] == balise["leg"]:
                positioned = bool(positions_at(epochs, [t_ns], gap_s)[0])
                rows.append(_row(balise, t_ns, direction, positioned, solution))
    return _inserted(passages, rows)


def _doubt_m(epochs: pl.DataFrame, truth: pl.DataFrame, lds: LdsConfig) -> Floats:
    """How far beyond a balise the true position has to be seen on both sides [m]."""
    known = floats(epochs, "sigma_along_m")
    sigma_m = np.where(np.isfinite(known), known, np.nanmax(known, initial=0.0))
    bound_m, slip_m = np.nan_to_num(floats(truth, "truth_bound_m")), np.nan_to_num(floats(truth, "truth_slip_m"))
    return np.maximum(lds.rearm_m, np.maximum(_SIGMAS * sigma_m, np.maximum(bound_m, np.abs(slip_m))))


def _direction(passings: TruePassings, balise: str, t_ns: int, balise_m: float, doubt_m: float) -> Direction | None:
    """Direction of a passage that is beyond doubt, `None` of another.

    Looked at from the true passage of the balise before to the one after: a train may turn behind it.
    """
    instants = passings.by_balise[balise]
    number = instants.index(t_ns)
    first = np.searchsorted(passings.at_ns, instants[number - 1]) if number else 0
    last = np.searchsorted(passings.at_ns, instants[number + 1]) if number + 1 < len(instants) else passings.at_ns.size
    here = np.searchsorted(passings.at_ns, t_ns)
    before, after = passings.path_m[first:here] - balise_m, passings.path_m[here:last] - balise_m
    if before.size and after.size:
        if before.min() < -doubt_m and after.max() > doubt_m:
            return Direction.GROWING
        if before.max() > doubt_m and after.min() < -doubt_m:
            return Direction.FALLING
    return None


def _row(
    balise: dict[str, object], t_ns: int, direction: Direction, positioned: bool, solution: str
) -> dict[str, object]:
    status = PassageStatus.MISSED if positioned else PassageStatus.NOT_AVAILABLE
    of_the_balise = ("balise_id", "kind", "netelement_id", "measure_m", "path_m", "location_accuracy_m")
    return {name: balise[name] for name in of_the_balise} | {
        "solution": solution,
        "direction": direction.value,
        "status": status.value,
        "linking_error": LinkingError.NONE.value,
        "reaction": Reaction.NONE.value,
        "failure_mode": FailureMode.DELETION.value,
        "cause": (Cause.POSITION if positioned else Cause.NO_POSITION).value,
        "suspect_after_the_fact": False,
        "t_reckoned": t_ns,
    }


def _inserted(passages: pl.DataFrame, rows: list[dict[str, object]]) -> pl.DataFrame:
    """The rows in order of time among the passages, whose own order stays."""
    if not rows:
        return passages
    when = pl.coalesce("t_offered", "t_reckoned")
    plain = {name: pl.String if isinstance(kind, pl.Enum) else kind for name, kind in passages.schema.items()}
    instants = {name: pl.Int64 if kind == pl.Datetime else kind for name, kind in plain.items()}
    added = pl.DataFrame(rows, schema=instants).cast(passages.schema).with_columns(_when=when)
    ordered = passages.with_columns(_when=when.forward_fill().backward_fill())
    return pl.concat([ordered, added]).sort("_when", maintain_order=True).drop("_when")
