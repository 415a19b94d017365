"""From the state machine's walk to the columns of the contract."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.lds.journey import Journey
from pipeline.lds.machine import LocationSystem
from pipeline.lds.passage import Passage
from pipeline.lds.standing import Standing
from schemas.arrays import Floats
from schemas.config import LdsConfig
from schemas.enums import Cause, Direction, FailureMode, LdsMode
from schemas.tables import Epochs, Passages


def epoch_columns(t: pl.Series, system: LocationSystem, journey: Journey, config: LdsConfig) -> pl.DataFrame:
    """`t` and the LDS columns, row for row with the journey."""
    names = [standing.reference and standing.reference.balise.balise_id for standing in system.standings]
    index = _standing_index(system.standings, journey.t_ns.size)
    distance_m, doubt_m = _reported_m(system.standings, index, journey, config)
    columns = [
        t,
        _modes(system, index, journey),
        pl.Series("tvb", system.tvb, dtype=pl.Boolean),
        pl.Series("lrvb_id", names, dtype=pl.String).gather(index),
        pl.Series("distance_from_lrvb_m", distance_m).fill_nan(None),
        pl.Series("doubt_over_m", doubt_m).fill_nan(None),
        pl.Series("doubt_under_m", doubt_m).fill_nan(None),
        pl.Series("exposure_s", _exposure_s(system, journey)).fill_nan(None),
        pl.Series("negated", system.negated, dtype=pl.Boolean),
        pl.Series("diagnosis_faulty", ~np.array(system.evaluated, dtype=bool)),
        pl.Series("alarm", system.alarm, dtype=pl.Boolean),
    ]
    return pl.DataFrame(columns).with_columns(
        *system.balises.order.columns().values(), *system.distance.columns().values()
    )


def _standing_index(standings: list[Standing], size: int) -> np.ndarray:
    """Index of the standing in force at each epoch: the last one from it or before."""
    starts = np.array([standing.epoch for standing in standings])
    return np.searchsorted(starts, np.arange(size), side="right") - 1


def _modes(system: LocationSystem, index: np.ndarray, journey: Journey) -> pl.Series:
    linked = np.array(
        [
            (standing.reference is not None and standing.reference.odometer_m is not None)
            or (standing.chain_begun and journey.has_odometer)
            for standing in system.standings
        ]
    )[index]
    modes = [mode.value for mode in LdsMode]
    in_use = np.where(journey.usable, modes.index(LdsMode.LINKED), modes.index(LdsMode.ODOMETRY))
    mode = np.where(linked, in_use, modes.index(LdsMode.INITIALISING))
    mode = np.where(system.negated, modes.index(LdsMode.FAIL_SAFE), mode)
    return pl.Series("lds_mode", modes, dtype=Epochs.columns()["lds_mode"].dtype).gather(mode)


def _reported_m(
    standings: list[Standing], index: np.ndarray, journey: Journey, config: LdsConfig
) -> tuple[Floats, Floats]:
    """Odometer distance since the LRVB, and the over- and under-reading amount of that report.

    SUBSET-026 3.6.4: location accuracy of the reference plus the odometer's confidence on the way run.
    """
    values = [
        (np.nan, np.nan, np.nan)
        if (reference := standing.reference) is None
        else (
            np.nan if reference.odometer_m is None else reference.odometer_m,
            reference.travelled_m,
            reference.balise.accuracy_m,
        )
        for standing in standings
    ]
    odometer_m, travelled_m, accuracy_m = np.array(values)[index].T
    distance_m = np.abs(journey.odometer_m - odometer_m)
    way_m = np.maximum(np.abs(journey.travelled_m - travelled_m), distance_m)
    return distance_m, accuracy_m + config.odometer_fixed_m + config.odometer_share * way_m


def _exposure_s(system: LocationSystem, journey: Journey) -> Floats:
    """Time since the last linked TVB or accepted VB before this epoch's own validation.

    That is the interval of TVB eq. 7; measured after validation it would hide an outage without epochs.
    """
    never = np.iinfo(np.int64).min
    validated_ns = np.where(system.tvb, journey.t_ns, never)
    before_ns = np.concatenate(([never], validated_ns[:-1]))[: journey.t_ns.size]
    for epoch, t_ns in system.accepted_at_ns.items():
        before_ns[epoch] = max(before_ns[epoch], t_ns)
    last_ns = np.maximum.accumulate(before_ns)
    known = last_ns != never
    exposure_s = np.full(last_ns.size, np.nan)
    exposure_s[known] = (journey.t_ns[known] - last_ns[known]) * 1e-9
    return exposure_s


def passage_rows(passages: list[Passage], journey: Journey, solution: str) -> pl.DataFrame:
    """Passages in order of time, as in the contract, and `t_reckoned`."""
    rows = [_row(passage, journey, solution) for passage in passages]
    when = [row["t_offered"] or row["t_reckoned"] or passage.t_ns for row, passage in zip(rows, passages, strict=True)]
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
        "location_accuracy_m": balise.accuracy_m,
        "t_reckoned": _reckoned_ns(passage, journey),
    }


def _direction(passage: Passage, journey: Journey) -> Direction:
    heading = passage.heading
    if journey.has_odometer:
        before = max(int(np.searchsorted(journey.t_ns, passage.t_ns)) - 1, 0)
        heading = int(journey.travel[before])
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
