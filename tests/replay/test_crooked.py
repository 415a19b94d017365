"""Whatever witnesses do, nothing beyond the limit is called right; and less evidence makes nothing right or safe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipeline.one_run import replay
from schemas.run import RunTables
from tests.replay.crooked import CLOCKS_DIFFER, FAMILIES, START_NS, WEAKER, World, danger_of, verdict_of, world_of
from tests.replay.weaker import better_by_less

# Each family loses something that it has, and whatever can be lost some family loses.
LOSSES = {
    "honest": "thinned",
    "by_reads": "cut_odometer",
    "lag_of_reference": "frozen_reference",
    "one_bus": "undeclared",
    "shared_step": "cut_odometer",
    "freeze": "frozen_odometer",
    "shared_drift": "fewer_reads",
    "counter_set": "no_reads",
    "stall": "open_survey",
    "slow_part": "cut_out",
    "aside": "no_reference",
    "copied": "thinned_odometer",
    "late_reads": "fewer_reads",
    "ends_early": "thinned",
    "wrong_scale": "frozen_odometer",
}


def replayed(world: World) -> RunTables:
    return replay(world.run(), world.site(), world.vehicle, world.config())


@pytest.mark.parametrize("family", FAMILIES)
def test_no_witness_makes_danger_health(family: str) -> None:
    world = world_of(family, 1)
    tables = replayed(world)
    danger = danger_of(world, tables)
    assert not danger.any, danger
    loss = LOSSES[family]
    weaker = WEAKER[loss](world_of(family, 1))
    less = replayed(weaker)
    assert better_by_less(tables, less, loss, weaker.read_ns, family in CLOCKS_DIFFER) == []
    danger = danger_of(world, less)
    assert not danger.any, (loss, danger)


def test_every_family_loses_and_every_loss_is_tried() -> None:
    assert (set(LOSSES), set(LOSSES.values())) == (set(FAMILIES), set(WEAKER))


@pytest.fixture(scope="module")
def honest() -> tuple[World, RunTables]:
    world = world_of("honest", 0)
    return world, replayed(world)


def test_honest_witnesses_are_believed(honest: tuple[World, RunTables]) -> None:
    """Else the test above could not fail."""
    world, tables = honest
    assert verdict_of(tables) == "safe"
    at_s = (tables.epochs["t"].dt.timestamp("ns").to_numpy() - START_NS) / 1e9
    healthy = np.interp(at_s, world.t_s, np.abs(world.fault_m)) == 0.0
    assert healthy.sum() > 300
    assert (tables.epochs.filter(pl.Series(healthy))["judgement"] == "right").mean() > 0.99  # type: ignore[operator]


def test_danger_and_gain_are_seen_by_the_oracle(honest: tuple[World, RunTables]) -> None:
    """Every epoch and balise called right, in a run called safe."""
    world, tables = honest
    praised = replace(
        tables,
        epochs=tables.epochs.with_columns(judgement=pl.lit("right")),
        passages=tables.passages.with_columns(judgement=pl.lit("right"), status=pl.lit("accepted")),
    )
    danger = danger_of(world, praised)
    assert danger.right_epochs > 0
    assert danger.right_balises > 0
    assert danger.accepted_while_safe > 0
    assert better_by_less(tables, praised, "thinned", world.read_ns)
