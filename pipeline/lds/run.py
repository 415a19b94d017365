"""The LDS stage: matched, aligned epochs of one solution in, LDS columns and passages out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.crossings import Balise, balises_of
from pipeline.lds.journey import Journey, journey_of
from pipeline.lds.linking import Passage
from pipeline.lds.machine import LocationSystem, Negation, Read
from schemas.config import LdsConfig
from schemas.enums import BaliseKind, Cause, Direction, FailureMode
from schemas.tables import Epochs, Passages


@dataclass(frozen=True)
class LdsResult:
    """What the LDS made of one solution.

    `epochs`: `t` and the LDS columns, row for row with the input. `passages`: as in the contract,
    in order of time; what needs a truth is null or `none`; beside it `t_reckoned`: when the train
    passes a balise that was not offered, by LRVB and odometer. `restarts`: epochs at which
    the bank was restarted after the first. `unknown_reads`: telegrams of balises not on the path.
    """

    epochs: pl.DataFrame
    passages: pl.DataFrame
    restarts: list[int]
    negations: list[Negation]
    unknown_reads: pl.DataFrame


def run_lds(
    epochs: pl.DataFrame,
    bank: Bank,
    balises: pl.DataFrame,
    balise_reads: pl.DataFrame | None,
    config: LdsConfig,
    limits: LdsLimits,
    solution: str = "primary",
) -> LdsResult:
    """Detect virtual balises, keep the TVB chain, negate and return (DOMAIN section 4).

    `epochs`: in order of time, one row per GNSS epoch: `t, leg, path_m, on_track, fix_valid,
    gate_probability, sigma_along_m, confidence_m, odometer_m` (along growing path, cumulative; null
    where unknown)`, direction` (+1/-1, used where there is no odometer)`, scale_sigma`.
    `balises`: those of the travelled path. `balise_reads`: `t, balise_id`, optionally `odometer_m`
    at the read; without it the odometer is interpolated between near epochs. A run without that
    stream has no reader, so its physical balises have no passages.
    """
    journey = journey_of(epochs, config, limits)
    physical = balises_of(balises, BaliseKind.PHYSICAL)
    reads, unknown = _reads(balise_reads, physical, journey)
    system = LocationSystem(
        journey, bank, balises_of(balises, BaliseKind.VIRTUAL), physical, reads, config, limits
    )
    system.run()
    return LdsResult(
        epochs=_epoch_columns(epochs, system, journey, config),
        passages=_passages(system.passages, journey, solution),
        restarts=system.restarts,
        negations=system.negations,
        unknown_reads=unknown,
    )


def _reads(
    frame: pl.DataFrame | None, balises: list[Balise], journey: Journey
) -> tuple[list[Read], pl.DataFrame]:
    """Telegrams in order of time; those of a balise on several legs belong to the train's leg."""
    if frame is None:
        return [], pl.DataFrame(schema={"t": pl.Datetime("ns", "UTC"), "balise_id": pl.String})
    known = frame["balise_id"].is_in([balise.balise_id for balise in balises])
    reads = []
    for row in frame.filter(known).sort("t", "balise_id").with_columns(pl.col("t").dt.epoch("ns")).to_dicts():
        t_ns = int(row["t"])
        epoch = min(int(np.searchsorted(journey.t_ns, t_ns)), journey.t_ns.size - 1)
        named = [balise for balise in balises if balise.balise_id == row["balise_id"]]
        balise = next((here for here in named if here.leg == journey.leg[epoch]), named[0])
        odometer_m = row["odometer_m"] if "odometer_m" in row else _odometer_at(journey, t_ns, epoch)
        reads.append(Read(balise, t_ns, epoch, odometer_m))
    return reads, frame.filter(~known).select("t", "balise_id")


def _odometer_at(journey: Journey, t_ns: int, epoch: int) -> float | None:
    """Odometer between the two epochs around a time, `None` where they are too far apart."""
    before = max(epoch - 1, 0)
    t_0, t_1 = int(journey.t_ns[before]), int(journey.t_ns[epoch])
    if not (t_0 <= t_ns <= t_1 and t_1 - t_0 <= journey.gap_ns):
        return None
    ends_m = journey.odometer_m[[before, epoch]]
    if not np.isfinite(ends_m).all():
        return None
    return float(np.interp(t_ns - t_0, [0, max(t_1 - t_0, 1)], ends_m))


def _epoch_columns(
    epochs: pl.DataFrame, system: LocationSystem, journey: Journey, config: LdsConfig
) -> pl.DataFrame:
    kinds = {name: column.dtype for name, column in Epochs.columns().items()}
    references = system.references
    odometer_m = np.array([_odometer_of(reference) for reference in references])
    travelled_m = np.array([r.travelled_m if r is not None else np.nan for r in references])
    accuracy_m = np.array([r.balise.accuracy_m if r is not None else np.nan for r in references])
    distance_m = np.abs(journey.odometer_m - odometer_m)
    way_m = np.maximum(np.abs(journey.travelled_m - travelled_m), distance_m)
    # SUBSET-026 3.6.4: location accuracy of the reference plus the odometer's confidence.
    doubt_m = accuracy_m + config.odometer_fixed_m + config.odometer_share * way_m
    columns = [
        epochs["t"],
        pl.Series("lds_mode", [mode.value for mode in system.mode], dtype=kinds["lds_mode"]),
        pl.Series("tvb", system.tvb, dtype=pl.Boolean),
        pl.Series("lrvb_id", [r and r.balise.balise_id for r in references], dtype=pl.String),
        pl.Series("distance_from_lrvb_m", distance_m).fill_nan(None),
        pl.Series("doubt_over_m", doubt_m).fill_nan(None),
        pl.Series("doubt_under_m", doubt_m).fill_nan(None),
        pl.Series("exposure_s", system.exposure_s, dtype=pl.Float64).fill_nan(None),
        pl.Series("negated", system.negated, dtype=pl.Boolean),
        pl.Series("diagnosis_faulty", [not seen for seen in system.evaluated], dtype=pl.Boolean),
        pl.Series("alarm", system.alarm, dtype=pl.Boolean),
    ]
    return pl.DataFrame(columns).with_columns(system.links.columns().values())


def _odometer_of(reference: object) -> float:
    value = getattr(reference, "odometer_m", None)
    return np.nan if value is None else float(value)


def _passages(passages: list[Passage], journey: Journey, solution: str) -> pl.DataFrame:
    rows = [_row(passage, journey, solution) for passage in passages]
    when = [
        row["t_offered"] or row["t_reckoned"] or passage.t_ns
        for row, passage in zip(rows, passages, strict=True)
    ]
    order = sorted(range(len(rows)), key=lambda i: (when[i], passages[i].balise.balise_id))
    kinds = {name: column.dtype for name, column in Passages.columns().items()}
    schema = kinds | {"t_reckoned": pl.Datetime("ns", "UTC")}
    plain = {name: pl.String if isinstance(kind, pl.Enum) else kind for name, kind in schema.items()}
    instants = {name: pl.Int64 if kind == pl.Datetime else kind for name, kind in plain.items()}
    frame = pl.DataFrame([rows[i] for i in order], schema=instants, orient="row")
    return frame.cast(pl.Schema(schema))


def _row(passage: Passage, journey: Journey, solution: str) -> dict[str, object]:
    balise, window = passage.balise, passage.window
    return {
        "solution": solution,
        "balise_id": balise.balise_id,
        "kind": balise.kind.value,
        "netelement_id": balise.netelement_id,
        "measure_m": balise.measure_m,
        "path_m": balise.path_m,
        "direction": _direction(passage, journey).value,
        "status": passage.status.value,
        "t_offered": passage.t_offered_ns,
        "window_open_m": window and window.open_m,
        "window_close_m": window and window.close_m,
        "odometer_distance_m": passage.odometer_distance_m,
        "confidence_m": passage.confidence_m,
        "linking_error": passage.linking_error.value,
        "reaction": passage.reaction.value,
        "failure_mode": FailureMode.NONE.value,
        "cause": Cause.NONE.value,
        "suspect_after_the_fact": False,
        "t_reckoned": _reckoned_ns(passage, journey),
    }


def _direction(passage: Passage, journey: Journey) -> Direction:
    heading = passage.heading
    if journey.has_odometer:
        epoch = min(int(np.searchsorted(journey.t_ns, passage.t_ns)), journey.t_ns.size - 1)
        heading = int(journey.travel[epoch])
    return Direction.GROWING if heading > 0 else Direction.FALLING


def _reckoned_ns(passage: Passage, journey: Journey) -> int | None:
    """When the odometer last passed the announced place before the passage was settled."""
    if passage.t_offered_ns is not None or passage.reckoned_odometer_m is None:
        return None
    known = np.flatnonzero(np.isfinite(journey.odometer_m) & (journey.t_ns <= passage.t_ns))
    beyond = (journey.odometer_m[known] - passage.reckoned_odometer_m) >= 0
    steps = np.flatnonzero(beyond[1:] != beyond[:-1])
    if not steps.size:
        return None
    i, j = known[steps[-1]], known[steps[-1] + 1]
    part_m = passage.reckoned_odometer_m - journey.odometer_m[i]
    share = float(part_m / (journey.odometer_m[j] - journey.odometer_m[i]))
    return int(journey.t_ns[i]) + round(share * int(journey.t_ns[j] - journey.t_ns[i]))
