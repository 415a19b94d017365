"""The LDS stage: matched, aligned epochs of one solution in; LDS columns, crossings and passages out."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.lds.bank_protocol import Bank
from pipeline.lds.columns import epoch_columns
from pipeline.lds.crossings import balises_of, crossing_rows, find_crossings, in_order_of_time, reads_of
from pipeline.lds.journey import journey_of
from pipeline.lds.machine import LocationSystem
from pipeline.lds.passage import passage_rows
from pipeline.lds.relink import Held
from schemas.config import Configuration
from schemas.enums import BaliseKind


@dataclass(frozen=True)
class LdsResult:
    """What the LDS made of one solution.

    `epochs`: `t` and the LDS columns, row for row with the input. `crossings`: as in `schemas.stages.Crossings`, each
    balise crossed or read. `passages`: as in the contract, in order of time, joined to crossings by `crossing_id`;
    what needs a truth is null or `none`; beside it `t_reckoned`: when the train passes a balise that was not offered,
    by LRVB and odometer. `unknown_reads`: telegrams of balises not on the path. `held`: re-links that held.
    """

    epochs: pl.DataFrame
    crossings: pl.DataFrame
    passages: pl.DataFrame
    unknown_reads: pl.DataFrame
    held: tuple[Held, ...]


def run_lds(
    epochs: pl.DataFrame,
    bank: Bank,
    balises: pl.DataFrame,
    balise_reads: pl.DataFrame | None,
    scale_sigma: float | None,
    config: Configuration,
    solution: str = "primary",
) -> LdsResult:
    """Detect virtual balises, keep the TVB chain, negate and return (DOMAIN section 4).

    `epochs`: in order of time, one row per GNSS epoch: `t, leg, path_m, on_track, fix_valid,
    gate_probability, position_sigma_m, confidence_m, odometer_m` (along growing path, cumulative; null
    where unknown)`, travelled_m, odometer_segment, direction` (+1/-1, used where there is no odometer).
    `balises`: those of the travelled path. `balise_reads`: `t, balise_id`, `odometer_m` at the read where the run has
    an odometer. A run without that stream has no reader, so its physical balises have no passages. `scale_sigma`: of
    the odometer, None unless a vehicle file gives it with the scale.
    """
    journey = journey_of(epochs, scale_sigma, config)
    on_path = {kind: balises_of(balises, kind) for kind in BaliseKind}
    reads, unknown = reads_of(balise_reads, on_path[BaliseKind.PHYSICAL], journey)
    found = [*find_crossings(journey, on_path[BaliseKind.VIRTUAL]), *reads]
    system = LocationSystem(journey, bank, on_path, found, config)
    system.run()
    crossings = in_order_of_time(found)
    passages = system.balises.virtual.passages + system.balises.physical.passages
    return LdsResult(
        epochs=epoch_columns(epochs["t"], system, journey, config.lds),
        crossings=crossing_rows(crossings, journey),
        passages=passage_rows(passages, crossings, journey, solution),
        unknown_reads=unknown,
        held=tuple(system.held),
    )
