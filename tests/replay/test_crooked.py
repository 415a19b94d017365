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

# Each family loses another of what it has.
NAMES = list(WEAKER)
LOSSES = {family: NAMES[at % len(NAMES)] for at, family in enumerate(FAMILIES)}


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


def test_honest_witnesses_are_believed() -> None:
    """Else the test above could not fail."""
    world = world_of("honest", 0)
    tables = replayed(world)
    assert verdict_of(tables) == "safe"
    at_s = (tables.epochs["t"].dt.timestamp("ns").to_numpy() - START_NS) / 1e9
    healthy = np.interp(at_s, world.t_s, np.abs(world.fault_m)) == 0.0
    assert healthy.sum() > 300
    assert (tables.epochs.filter(pl.Series(healthy))["judgement"] == "right").mean() > 0.99  # type: ignore[operator]


def test_danger_and_gain_are_seen_by_the_oracle() -> None:
    """Every epoch and balise called right, in a run called safe."""
    world = world_of("honest", 0)
    tables = replayed(world)
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
