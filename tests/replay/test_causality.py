"""What a train did at an instant does not depend on what the log holds after it (DOMAIN sections 2 and 4).

Random worlds on one line, so that no path is found in hindsight: rates that change, of positions and odometers, holes,
two solutions with stamps of their own, two odometers, by counts, with rows that scatter, with speeds alone, resets,
slip, faults. Each log is cut at random instants and replayed: whatever is not the judge's is the same up to the cut, to
the digit. A balise that is not found by the end of its window is known as missed only then; a telegram or crossing
behind the last epoch belongs to the next one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from schemas.arrays import Floats
from schemas.config import Configuration, Vehicle
from schemas.inputs import BaliseReads, Gnss, Odometer
from schemas.run import RunLog, RunTables, Site
from tests.replay.journeys import replay
from tests.replay.test_in_use import KNOWN, balises
from tests.replay.test_shunting import stream
from tests.stages.matching import builders
from tests.stages.matching.builders import line

LENGTH_M = 12_000.0
GROUND = builders.site({"a": line((0, 0), (LENGTH_M, 0))}, sigma_m=0.1)
SITE = Site(
    GROUND.track,
    GROUND.links,
    balises=balises(
        *((f"V{k}", "a", 600.0 * k, "virtual") for k in range(1, 20)),
        *((f"P{k}", "a", 2_500.0 * k, "physical") for k in range(1, 5)),
    ),
)
LASTS_S = 420.0


@dataclass(frozen=True)
class World:
    """One log, and with what it is replayed."""

    run: RunLog
    vehicle: Vehicle
    config: Configuration


def chainage_m(dice: np.random.Generator) -> tuple[Floats, Floats]:
    """Times and places: stretches at random speeds with stands between them."""
    t_s = np.arange(0.0, LASTS_S, 0.05)
    knots_s = np.sort(dice.uniform(0.0, LASTS_S, 8))
    speeds = dice.choice([0.0, 8.0, 20.0, 35.0], 8)
    speeds[:2] = 20.0, 30.0
    wanted = np.interp(t_s, [0.0, 5.0, *knots_s + 10.0], [0.0, 0.0, *speeds])
    return t_s, 200.0 + np.cumsum(wanted) * 0.05


def stamps_s(dice: np.random.Generator) -> Floats:
    """Stretches of different rates with holes between some of them, and stamps that scatter."""
    parts: list[Floats] = []
    at_s = float(dice.uniform(0.0, 0.4))
    while at_s < LASTS_S - 1.0:
        rate_hz = float(dice.choice([1.0, 2.0, 5.0]))
        lasts_s = float(dice.uniform(20.0, 150.0))
        part = np.arange(at_s, min(at_s + lasts_s, LASTS_S - 1.0), 1.0 / rate_hz)
        parts.append(part)
        at_s = part[-1] + float(dice.choice([1.0 / rate_hz, 1.3, 2.6, 70.0], p=[0.4, 0.2, 0.3, 0.1]))
    every = np.concatenate(parts)
    scatter_s = dice.uniform(-0.02, 0.02, every.size) * float(dice.integers(2))
    return np.round(every + scatter_s, 3)


def instants(t_s: Floats) -> pl.Series:
    return pl.Series("t", np.round(1e9 * t_s).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def gnss_of(dice: np.random.Generator, name: str, t_s: Floats, place_m: Floats) -> pl.DataFrame:
    at_s = stamps_s(dice)
    walk_m = np.cumsum(dice.normal(0.0, 0.02, (2, at_s.size)), axis=1) + dice.normal(0.0, 0.05, (2, at_s.size))
    begin_s, size_m = dice.uniform(100.0, 380.0), dice.choice([0.0, 35.0, -60.0])
    fault_m = np.where((at_s > begin_s) & (at_s < begin_s + 40.0), size_m, 0.0)
    frame = builders.run(np.interp(at_s, t_s, place_m) + walk_m[0] + fault_m, walk_m[1], 1.0)
    lost = pl.Series(dice.uniform(size=at_s.size) < 0.01)
    fix = pl.when(lost).then(pl.lit("none")).otherwise(pl.col("fix").cast(pl.String))
    return frame.with_columns(instants(at_s), solution=pl.lit(name), fix=fix)


def rows_s(dice: np.random.Generator) -> Floats:
    """Rows of an odometer: stretches of different periods, with a hole between some of them."""
    parts: list[Floats] = []
    at_s = 0.0
    while at_s < LASTS_S:
        period_s = float(dice.choice([0.1, 0.125, 0.25, 0.5]))
        parts.append(np.arange(at_s, min(at_s + dice.uniform(30.0, 400.0), LASTS_S), period_s))
        at_s = parts[-1][-1] + float(dice.choice([period_s, 0.8]))
    return np.concatenate(parts)


def odometer_of(dice: np.random.Generator, name: str, t_s: Floats, place_m: Floats) -> pl.DataFrame:
    at_s = rows_s(dice)
    place = np.interp(at_s, t_s, place_m)
    reset = at_s > dice.uniform(60.0, 2.0 * LASTS_S)
    distance_m = place + np.cumsum(dice.normal(0.0, 0.01, at_s.size)) + 5_000.0 * ~reset
    kind = str(dice.choice(["smooth", "counts", "scatter", "speeds"], p=[0.3, 0.3, 0.2, 0.2]))
    if kind == "counts":
        count_m = float(dice.choice([0.2, 0.5, 1.0]))
        distance_m = np.floor(distance_m / count_m) * count_m
    if kind == "scatter":
        distance_m = distance_m + dice.normal(0.0, 0.1, at_s.size)
    slips_s = dice.uniform(60.0, 2.0 * LASTS_S)
    frame = builders.odometer(distance_m, 1.0).with_columns(instants(at_s), sensor=pl.lit(name))
    if kind == "speeds":
        frame = frame.with_columns(distance_m=pl.lit(None, pl.Float64))
    speed = pl.Series("speed_mps", np.gradient(place, at_s))
    declared = pl.Series("sigma_speed_mps", dice.choice([0.02, 0.05], at_s.size))
    return frame.with_columns(speed, declared, slip=pl.Series((at_s > slips_s) & (at_s < slips_s + 3.0)))


def world(seed: int) -> World:
    dice = np.random.default_rng(seed)
    t_s, place_m = chainage_m(dice)
    solutions = [gnss_of(dice, name, t_s, place_m) for name in ("primary", "other")]
    sensors = [odometer_of(dice, name, t_s, place_m) for name in ("primary", "second")[: dice.integers(1, 3)]]
    passed = [(f"P{k}", float(np.interp(2_500.0 * k, place_m, t_s))) for k in range(1, 5) if place_m[-1] > 2_500.0 * k]
    reads = pl.DataFrame([instants(np.array([at for _, at in passed])), pl.Series("balise_id", [p for p, _ in passed])])
    run = RunLog(
        "causal",
        stream(Gnss, pl.concat(solutions).sort("t", "solution")),
        odometer=stream(Odometer, pl.concat(sensors).sort("t", "sensor")),
        balise_reads=stream(BaliseReads, reads),
    )
    config = Configuration.model_validate({"monitors": {"channel_reference": "other"}})
    return World(run, KNOWN if seed % 2 else Vehicle(), config)


@cache
def whole(seed: int) -> RunTables:
    """The tables of a world whose log is not cut."""
    made = world(seed)
    return replay(made.run, SITE, made.vehicle, made.config)


def cut(run: RunLog, cut_s: float) -> RunLog:
    """Up to an instant; of the odometer a second more: between two rows it is known only once the second is there."""
    ends_s = {"gnss": cut_s, "balise_reads": cut_s, "odometer": cut_s + 1.0}
    frames = {name: run.stream(name) for name in ends_s}
    ends = {name: instants(np.array([end_s]))[0] for name, end_s in ends_s.items()}
    return run.with_streams(
        **{name: frame.filter(pl.col("t") <= ends[name]) for name, frame in frames.items() if frame is not None}
    )


OF_THE_JUDGE = {
    *("error_along_m", "error_low_m", "error_high_m", "error_cross_m", "error_up_m", "judgement", "evidence"),
    *("true_netelement_ids", "true_measure_low_m", "true_measure_high_m", "lds_state", "suspect_after_the_fact"),
    *("moving", "in_use", "verdict", "suspect", "hazard_id", "t_true", "location_error_m", "proof_margin_m"),
    *("step_s", "gap", "moving_s", "lost_s", "lost_to"),
    *("failure_mode", "cause", "crossing_id"),
}


def complete_rows(tables: RunTables, name: str, last: pl.DataFrame) -> pl.DataFrame:
    """Rows that are complete at the last epochs of a cut log, without what the judge says of them."""
    frame: pl.DataFrame = getattr(tables, name)
    rows = frame.join(last, on="solution", how="left", maintain_order="left")
    lasting = pl.duration(seconds=30)  # fails closer to each other are one alarm
    complete = {"epochs": pl.col("t"), "passages": pl.col("t_offered"), "alarms": pl.col("t_end") + lasting}[name]
    return rows.filter(complete <= pl.col("last")).drop("last").select(pl.all().exclude(OF_THE_JUDGE))


def unsettled(passages: pl.DataFrame) -> pl.DataFrame:
    """Without what only the end of a window tells."""
    at_the_end = pl.col("linking_error").cast(pl.String) == "missed"
    settled = (pl.when(~at_the_end).then(pl.col(name).cast(pl.String)).alias(name) for name in ("linking_error",))
    return passages.drop("reaction").with_columns(*settled).with_columns(pl.col("linking_error").fill_null("none"))


@pytest.mark.parametrize("seed", range(6))
def test_what_comes_later_changes_nothing_that_was_before(seed: int) -> None:
    made = world(seed)
    compared = 0
    for cut_s in np.random.default_rng(1000 + seed).uniform(120.0, 400.0, 2):
        part = replay(cut(made.run, float(cut_s)), SITE, made.vehicle, made.config)
        last = part.epochs.group_by("solution").agg(last=pl.col("t").max())
        for name in ("epochs", "passages", "alarms"):
            found, expected = complete_rows(part, name, last), complete_rows(whole(seed), name, last)
            if name == "passages":
                found, expected = unsettled(found), unsettled(expected)
            assert_frame_equal(found, expected, check_exact=True)
            compared += found.height
    assert compared > 500


def test_the_worlds_hold_what_a_train_meets() -> None:
    """Else the property above would be of nothing."""
    tables = [whole(seed) for seed in (1, 2)]
    reasons = {reason for table in tables for reason in table.epochs["withheld_for"].cast(pl.String).unique()}
    assert {"noise", "slip", "relink"} <= reasons
    assert all(table.alarms.height > 0 for table in tables)
    assert {"accepted", "rejected_monitor"} <= {s for table in tables for s in table.passages["status"].cast(pl.String)}
    assert "pass" in tables[0].epochs["channel_state"].cast(pl.String).to_list()
