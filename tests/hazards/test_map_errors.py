"""Map errors over several runs."""

from __future__ import annotations

import polars as pl

from pipeline.hazards.map_errors import alarm_places, map_suspects
from tests.hazards.synthetic import Journey, judge


def alarms_of(run_id, at_s, monitors=("cross_raw",), **changes):
    journey = Journey(reference=False, fails=dict.fromkeys(monitors, ((at_s, at_s + 1.0),)), **changes)
    result = judge(journey)
    epochs = journey.epochs().with_columns(solution=pl.lit("primary"))
    return alarm_places(result.alarms, epochs).with_columns(run_id=pl.lit(run_id))


def suspects(*frames):
    return map_suspects(pl.concat(frames))["suspect"].to_list()


def test_same_place_in_two_runs_is_the_map():
    assert suspects(alarms_of("a", 50.0), alarms_of("b", 52.0)) == ["map", "map"]  # 1000 m and 1040 m


def test_one_run_or_places_apart_say_nothing():
    assert suspects(alarms_of("a", 50.0)) == ["unknown"]
    assert suspects(alarms_of("a", 10.0), alarms_of("b", 52.0)) == ["unknown", "unknown"]


def test_along_track_monitors_speak_against_the_map():
    both = alarms_of("b", 52.0, ("cross_raw", "along_raw"))
    assert suspects(alarms_of("a", 50.0), both) == ["unknown", "unknown"]


def test_order_and_other_columns_are_kept():
    frames = pl.concat([alarms_of("b", 52.0), alarms_of("a", 50.0)])
    found = map_suspects(frames)
    assert found.drop("suspect").equals(frames.drop("suspect"))
    assert alarms_of("a", 50.0)["measure_m"].to_list() == [1000.0]
