"""The LDS stage: matched, aligned epochs of one solution in; LDS columns, crossings and passages out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import passings
from pipeline.stages.epochs.verdicts import Verdicts
from pipeline.stages.lds.crossings import (
    PLACE,
    Balise,
    Crossing,
    Journey,
    Passage,
    arrays_of_crossings,
    find_crossings,
    in_order_of_time,
    telegrams_on_path,
)
from pipeline.stages.lds.link_monitors import Held
from pipeline.stages.lds.linking import LrvbChange
from pipeline.stages.lds.machine import LocationSystem
from pipeline.stages.monitors.bank import MonitorBank
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, LdsConfig
from schemas.conform import dtypes
from schemas.enums import BaliseKind, Cause, Direction, FailureMode, LdsMode, LostTo, Reaction
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs, Crossings, LdsEpochs
from schemas.tables import Passages


@frozen
class LdsResult:
    """What the LDS made of one solution.

    `linking`: verdicts of the linking monitors by name. `passages`: as in the
    contract, what needs a truth null or `none`, and `t_reckoned`: when LRVB and odometer say that the train passes a
    balise that was not offered. `unknown_reads`: of balises not on the path. `held`: re-links that held.
    """

    epochs: LdsEpochs
    linking: Mapping[str, Verdicts]
    crossings: Crossings
    passages: pl.DataFrame
    unknown_reads: pl.DataFrame
    held: tuple[Held, ...]


def run_lds(
    epochs: AlignedEpochs,
    bank: MonitorBank,
    balises: pl.DataFrame,
    balise_reads: pl.DataFrame | None,
    scale_sigma: float | None,
    config: Configuration,
    solution: str = "primary",
) -> LdsResult:
    """Detect virtual balises, keep the TVB chain, negate and return.

    Args:
        epochs: aligned epochs of the solution, in order of time.
        bank: its monitors; the LDS freezes and restarts it.
        balises: those of the travelled path, by leg, with path position, accuracy and linking.
        balise_reads: telegrams (`t`, `balise_id`, `odometer_m` [m]); None: physical balises have no passages.
        scale_sigma: deviation of the odometer's scale by a vehicle file [1], else None.
        config: the configuration; used are `lds`, `align` and `monitors`.
        solution: its name, as it stands in the passages.

    Returns:
        What the LDS says of each epoch, crossing and passage; at an epoch it knows nothing of later ones.

    Source:
        DOMAIN section 4; SUBSET-026 3.4.4 and 3.6.4; TVB section 3.
    """
    journey = Journey(epochs, scale_sigma, config)
    on_path = {kind: balises_of_kind(balises, kind) for kind in BaliseKind}
    reads, unknown = telegrams_on_path(balise_reads, on_path[BaliseKind.PHYSICAL], journey)
    crossings = in_order_of_time([*find_crossings(journey, on_path[BaliseKind.VIRTUAL]), *reads])
    system = LocationSystem(journey, bank, on_path, crossings, config)
    system.run()
    passages = system.balises.virtual.passages + system.balises.physical.passages
    return LdsResult(
        epochs=_lds_epochs(system, journey, config.lds),
        linking={"link_order": system.balises.order.verdicts(), "link_distance": system.distance.verdicts()},
        crossings=arrays_of_crossings(crossings),
        passages=passages_table(passages, crossings, journey, solution),
        unknown_reads=unknown,
        held=tuple(system.held),
    )


def balises_of_kind(frame: pl.DataFrame, kind: BaliseKind) -> list[Balise]:
    """The balises of one kind, in order of leg and path position."""
    return [
        Balise(
            kind=kind,
            accuracy_m=row["location_accuracy_m"],
            reaction=Reaction(row["link_reaction"]),
            **{name: row[name] for name in ("leg", "linked", "valid_direction", *PLACE)},
        )
        for row in frame.sort("leg", "path_m", "balise_id").iter_rows(named=True)
        if row["kind"] == kind.value
    ]


def _lds_epochs(system: LocationSystem, journey: Journey, config: LdsConfig) -> LdsEpochs:
    """What the walk left of each epoch, as columns."""
    changes = system.lrvb_changes
    starts = np.array([change.epoch for change in changes])
    index = np.searchsorted(starts, np.arange(journey.t_ns.size), side="right") - 1
    names = [None if change.lrvb is None else change.lrvb.balise.balise_id for change in changes]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(name for name in names if name is not None))}
    distance_m, doubt_m = _reported_distances_m(changes, index, journey, config)
    withheld_for = np.full(journey.t_ns.size, -1)
    for epoch, cause in enumerate(system.withheld_for):
        if cause is not None:
            withheld_for[epoch] = _LOST_TO[cause]
    withheld = withheld_for >= 0
    return LdsEpochs(
        lds_mode=_lds_modes(system, index, journey, withheld),
        tvb=np.array(system.tvb, dtype=np.bool_),
        lrvb=np.array([-1 if name is None else numbers[name] for name in names], dtype=np.int64)[index],
        lrvb_ids=list(numbers),
        distance_from_lrvb_m=distance_m,
        # The allowance of 5 m + 5 % is the same to both sides.
        doubt_over_m=doubt_m,
        doubt_under_m=doubt_m,
        exposure_s=_exposure_s(system, journey),
        negated=np.array(system.negated, dtype=np.bool_),
        withheld_for=withheld_for,
        diagnosis_faulty=_diagnosis_faulty(system, journey, withheld),
        alarm=np.array(system.alarm, dtype=np.bool_),
    )


_LOST_TO = {cause: number for number, cause in enumerate(LostTo)}


def _diagnosis_faulty(system: LocationSystem, journey: Journey, withheld: Bools) -> Bools:
    """P3 (DOMAIN section 4): `along_raw` has no verdict, and the position is not withheld."""
    undiagnosed = ~np.array(system.evaluated, dtype=bool)
    faulty: Bools = undiagnosed & ~withheld if journey.has_odometer else undiagnosed
    return faulty


def _lds_modes(system: LocationSystem, index: Ints, journey: Journey, withheld: Bools) -> Ints:
    """Mode of the LDS at each epoch, by number in `LdsMode`; `index`: the change of LRVB in force there."""
    linked = np.array(
        [
            (change.lrvb is not None and change.lrvb.odometer_m is not None)
            or (change.chain_begun and journey.has_odometer)
            for change in system.lrvb_changes
        ]
    )[index]
    modes = list(LdsMode)
    in_use = np.where(journey.usable & ~withheld, modes.index(LdsMode.LINKED), modes.index(LdsMode.ODOMETRY))
    mode = np.where(linked, in_use, modes.index(LdsMode.INITIALISING))
    return np.where(system.negated, modes.index(LdsMode.FAIL_SAFE), mode)


def _reported_distances_m(
    changes: list[LrvbChange], index: Ints, journey: Journey, config: LdsConfig
) -> tuple[Floats, Floats]:
    """Odometer distance since the LRVB [m], and by how much it may over- or under-read (SUBSET-026 3.6.4)."""
    values = [
        (np.nan, np.nan, np.nan)
        if (lrvb := change.lrvb) is None
        else (
            np.nan if lrvb.odometer_m is None else lrvb.odometer_m,
            lrvb.travelled_m,
            lrvb.balise.accuracy_m,
        )
        for change in changes
    ]
    odometer_m, travelled_m, accuracy_m = np.array(values)[index].T
    distance_m = np.abs(journey.odometer_m - odometer_m)
    driven_m = np.maximum(np.abs(journey.travelled_m - travelled_m), distance_m)
    return distance_m, accuracy_m + config.odometer_fixed_m + config.odometer_share * driven_m


def _exposure_s(system: LocationSystem, journey: Journey) -> Floats:
    """Time since the last TVB or accepted VB before each epoch's own [s] (TVB eq. 7); an outage shows."""
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


def passages_table(
    passages: Sequence[Passage], crossings: Sequence[Crossing], journey: Journey, solution: str
) -> pl.DataFrame:
    """The passages as rows of the contract, in order of time."""
    ids = {id(crossing): number for number, crossing in enumerate(crossings)}
    rows = [_passage_row(passage, ids, journey, solution) for passage in passages]
    when = [row["t_offered"] or row["t_reckoned"] or passage.t_ns for row, passage in zip(rows, passages, strict=True)]
    order = sorted(range(len(rows)), key=lambda number: (when[number], passages[number].balise.balise_id))
    schema = dtypes(Passages) | {"t_reckoned": pl.Datetime("ns", "UTC")}
    return pl.DataFrame([rows[number] for number in order], schema=schema)


def _passage_row(passage: Passage, ids: dict[int, int], journey: Journey, solution: str) -> dict[str, object]:
    """One passage as a row; `ids`: number of each crossing by its identity."""
    balise = passage.balise
    window = passage.window
    crossing = passage.crossing
    return {
        "solution": solution,
        **{name: getattr(balise, name) for name in PLACE},
        "kind": balise.kind.value,
        "direction": (Direction.GROWING if passage.direction > 0 else Direction.FALLING).value,
        "status": passage.status.value,
        "t_offered": crossing and crossing.t_ns,
        "window_open_m": window and window.open_m,
        "window_close_m": window and window.close_m,
        "odometer_distance_m": passage.odometer_distance_m,
        "confidence_m": crossing and crossing.confidence_m,
        "linking_error": passage.linking_error.value,
        "reaction": passage.reaction.value,
        "failure_mode": FailureMode.NONE.value,
        "cause": Cause.NONE.value,
        "suspect_after_the_fact": False,
        "initialising": crossing is not None and crossing.initialising,
        "location_accuracy_m": balise.accuracy_m,
        "crossing_id": crossing and ids[id(crossing)],
        "t_reckoned": _reckoned_passing_ns(passage, journey),
    }


def _reckoned_passing_ns(passage: Passage, journey: Journey) -> int | None:
    """When the odometer last passed the announced place before the passage was settled [ns]; None if offered."""
    if passage.crossing is not None or passage.announced_odometer_m is None:
        return None
    known = journey.with_odometer
    rows = known[: int(np.searchsorted(journey.t_ns[known], passage.t_ns, side="right"))]
    passed = passings(journey.odometer_m[rows], [passage.announced_odometer_m])
    if not passed:
        return None
    before_ns, after_ns = journey.t_ns[rows[passed[-1].after - 1 : passed[-1].after + 1]].tolist()
    return passed[-1].instant_ns(before_ns, after_ns)
