"""Map errors over several runs."""

from __future__ import annotations

import polars as pl

from pipeline.results.figures.map_errors import map_places, map_suspects
from schemas.config import HazardConfig
from tests.tables import NS, alarms

REACH_M = HazardConfig().map_reach_m


def alarms_of(run_id: str, at_s: float, monitors: tuple[str, ...] = ("cross_raw",)) -> pl.DataFrame:
    """One alarm that nothing judges, of a train that runs 20 m/s from the start of net element A."""
    return alarms(
        1, t_start=[round(at_s * NS)], t_end=[round((at_s + 1.0) * NS)], monitors=[list(monitors)], verdict="unknown",
        suspect="unknown", netelement_id="A", measure_m=20.0 * at_s,
    ).with_columns(run_id=pl.lit(run_id))  # fmt: skip


def suspects(*frames: pl.DataFrame) -> list[str]:
    return map_suspects(pl.concat(frames), REACH_M)["suspect"].to_list()


def test_same_place_in_two_runs_is_the_map() -> None:
    assert suspects(alarms_of("a", 50.0), alarms_of("b", 52.0)) == ["map", "map"]  # 1000 m and 1040 m


def test_one_run_or_places_apart_say_nothing() -> None:
    assert suspects(alarms_of("a", 50.0)) == ["unknown"]
    assert suspects(alarms_of("a", 50.0), alarms_of("a", 52.0)) == ["unknown", "unknown"]
    assert suspects(alarms_of("a", 10.0), alarms_of("b", 52.0)) == ["unknown", "unknown"]


def test_the_other_run_need_not_be_the_neighbour() -> None:
    """At 1000, 1010 and 1020 m, the first two of one run: all three are within reach of the other run."""
    assert suspects(alarms_of("a", 50.0), alarms_of("a", 50.5), alarms_of("b", 51.0)) == ["map"] * 3
    # At 900, 1000 and 1040 m: the first is 140 m from the other run.
    assert suspects(alarms_of("a", 45.0), alarms_of("a", 50.0), alarms_of("b", 52.0)) == ["unknown", "map", "map"]


def test_along_track_monitors_speak_against_the_map() -> None:
    both = alarms_of("b", 52.0, ("cross_raw", "along_raw"))
    assert suspects(alarms_of("a", 50.0), both) == ["unknown", "unknown"]


def test_order_and_other_columns_are_kept() -> None:
    frames = pl.concat([alarms_of("b", 52.0), alarms_of("a", 50.0)])
    found = map_suspects(frames, REACH_M)
    assert found.drop("suspect").equals(frames.drop("suspect"))
    assert alarms_of("a", 50.0)["measure_m"].to_list() == [1000.0]


def test_places_gather_what_is_near() -> None:
    frames = [alarms_of("a", 50.0), alarms_of("b", 52.0, ("up_raw",)), alarms_of("c", 53.0)]
    far = [alarms_of("a", 80.0), alarms_of("c", 81.0), alarms_of("b", 20.0)]
    found = map_places(pl.concat([*far, *frames]), REACH_M)
    assert found.select("netelement_id", "from_m", "to_m", "axis", "runs", "alarms").rows() == [
        ("A", 1000.0, 1060.0, "cross up", 3, 3),
        ("A", 1600.0, 1620.0, "cross", 2, 2),
    ]
    assert found["run_ids"].to_list() == [["a", "b", "c"], ["a", "c"]]


def test_no_alarms_no_places() -> None:
    assert map_places(alarms_of("a", 50.0).clear(), REACH_M).is_empty()
