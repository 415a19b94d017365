"""Positions on a track that the survey lacks: where, and how far aside."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from schemas.words import say
from tests.stages.matching.builders import line, matched, odometer, run, site


@pytest.mark.parametrize("turned", [False, True])
def test_a_siding_that_the_survey_lacks_is_named_with_place_and_offset(turned: bool) -> None:
    """From 800 m on the train bends away to a siding 4.5 m left, and comes back at 1800 m; surveyed to 0.3 m.

    Another track lies 12 m right: along one alone only offsets are tested, and 4.5 m may be the antenna's.
    """
    ends = ((3000.0, 0.0), (0.0, 0.0)) if turned else ((0.0, 0.0), (3000.0, 0.0))
    place = site({"a": line(*ends), "b": line((0.0, -12.0), (3000.0, -12.0))}, sigma_m=0.3)
    x = np.arange(20.0, 2980.0, 10.0)
    y = np.interp(x, [800.0, 880.0, 1800.0, 1880.0], [0.0, 4.5, 4.5, 0.0])
    found = matched(run(x, y, sigma_m=0.3), place, odometer(x))
    (row,) = found.off.to_dicts()
    assert row["netelement_id"] == "a"
    assert row["offset_m"] == pytest.approx(-4.5 if turned else 4.5, abs=0.2)
    begin, end = (row["from_m"], row["to_m"]) if not turned else (3000.0 - row["to_m"], 3000.0 - row["from_m"])
    assert 840.0 < begin < 1000.0
    assert 1780.0 < end < 2050.0
    # Nothing is claimed meanwhile, and positions stay projected.
    away = (x > 1000.0) & (x < 1780.0)
    assert found.epochs.table["gate_probability"].is_null().to_numpy()[away].all()
    assert np.allclose(found.epochs.table["path_m"], x, atol=0.1)


@pytest.mark.parametrize(("rate_mps", "moved_m"), [(0.5, -5.2), (0.05, -8.0), (1.0, 5.2)])
def test_a_movement_onto_another_track_is_no_way_back(rate_mps: float, moved_m: float) -> None:
    """A fault across the track, two exact tracks 5.2 m apart: beside the other one positions lie as they did before."""
    place = site({"a": line((0.0, 0.0), (6000.0, 0.0)), "b": line((0.0, 5.2), (6000.0, 5.2))})
    t_s = np.arange(400.0)
    x = 20.0 + 12.0 * t_s
    y = 5.2 + np.sign(moved_m) * np.clip(rate_mps * (t_s - 100.0), 0.0, abs(moved_m))
    gate = matched(run(x, y, sigma_m=0.05), place, odometer(x)).epochs.table["gate_probability"]
    assert gate[60:100].min() >= 0.99
    off = int(gate.is_null().arg_max() or 0)
    assert 100 < off < 150
    assert gate[off:].null_count() == gate[off:].len()


def test_a_movement_back_of_equal_size_is_one_with_a_bias_too() -> None:
    """2 m left by the antenna, a fault of 5 m to the right for 60 s: 3 m right of the track is not where it was."""
    place = site({"a": line((0.0, 0.0), (6000.0, 0.0)), "b": line((0.0, 15.0), (6000.0, 15.0))}, sigma_m=0.1)
    t_s = np.arange(400.0)
    x = 20.0 + 12.0 * t_s
    fault_m = np.interp(t_s, [150.0, 155.0, 215.0, 220.0], [0.0, -5.0, -5.0, 0.0])
    gate = matched(run(x, 2.0 + fault_m, sigma_m=0.1), place, odometer(x)).epochs.table["gate_probability"]
    assert gate[165:218].null_count() == 53
    assert gate[260:].min() >= 0.99


@pytest.mark.parametrize("turn_deg", [20.0, 60.0, 90.0])
@pytest.mark.parametrize("bias_m", [(0.0, 1.5), (1.5, 0.0), (1.0, -1.0)])
def test_a_bias_that_turns_with_the_heading_in_a_curve_refutes_no_path(
    turn_deg: float, bias_m: tuple[float, float]
) -> None:
    """One sigma of it, with exact positions and survey; the curve lies within the windows of the movements."""
    turn = np.radians(turn_deg)
    bent = round(700.0 * turn)
    heading = np.interp(np.arange(1500), [600, 600 + bent], [0.0, turn])
    points = np.vstack([np.zeros(2), np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)])
    normal = np.column_stack([-np.sin(np.append(heading, heading[-1])), np.cos(np.append(heading, heading[-1]))])
    place = site({"a": points[::5], "b": (points + 5.0 * normal)[::5]}, sigma_m=0.05)
    way = np.arange(20.0, 1480.0, 10.0)
    x, y = (np.interp(way, np.arange(1501), points[:, axis]) + bias_m[axis] for axis in (0, 1))
    gate = matched(run(x, y, sigma_m=0.05), place, odometer(way)).epochs.table["gate_probability"]
    assert gate.null_count() == 0


def test_what_refutes_all_tracks_in_the_first_minute_claims_none_for_a_minute() -> None:
    """9 m aside of a stated 1 m after 20 s, on a line beside another: errors are larger than stated."""
    place = site({"a": line((0.0, 0.0), (6000.0, 0.0)), "b": line((0.0, 9.0), (6000.0, 9.0))}, sigma_m=0.3)
    t_s = np.arange(300.0)
    x = 20.0 + 12.0 * t_s
    y = np.where(t_s < 20.0, 0.0, np.minimum(3.0 * (t_s - 20.0), 9.0))
    gate = matched(run(x, y, sigma_m=1.0), place, odometer(x)).epochs.table["gate_probability"].to_numpy()
    assert np.isnan(gate[:60]).any()
    assert (np.nan_to_num(gate[28:80]) < 0.99).all()


def test_on_the_network_nothing_is_named() -> None:
    x = np.arange(20.0, 2980.0, 10.0)
    found = matched(run(x, np.full(x.size, 1.0), sigma_m=0.5), site({"a": line((0, 0), (3000, 0))}), odometer(x))
    assert found.off.is_empty()


def test_the_note_says_how_far_on_which_side_and_where() -> None:
    begin = datetime(2025, 3, 1, 10, 2, 3, tzinfo=UTC)
    row = {"netelement_id": "a", "from_m": 871.6, "to_m": 1850.2, "t_start": begin, "t_end": begin}
    assert (
        say("off_network", "left", **row, offset_m=4.52) == "4.5 m left of a from 872 to 1850 m, 10:02:03 to 10:02:03"
    )
