"""Positions where the train cannot be: they decide on no track, and nothing is detected by them."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from schemas.run import Site
from tests.stages.matching.builders import line, matched, odometer, run, site
from tests.stages.matching.test_network import SWITCH, SWITCH_LINKS, along, branch

# Two tracks 20 m apart, each in two elements; the far one has a third track 200 m beside it.
TRACKS = site(
    {
        "a": line((0, 0), (1000, 0)),
        "b": line((1000, 0), (2000, 0)),
        "c": line((0, 20), (1000, 20)),
        "d": line((1000, 20), (2000, 20)),
        "e": line((0, 220), (2000, 220)),
    },
    [("a", 1, "b", 0, "both"), ("c", 1, "d", 0, "both")],
)
CHAIN = site({"a": line((0, 0), (2000, 0))})


def test_a_jump_past_the_end_of_a_track_does_not_decide() -> None:
    """The last position lies 60 m behind the buffers and 10 m aside, where the track beside goes on."""
    place = site({"a": line((0, 0), (1000, 0)), "b": line((0, 20), (2000, 20))})
    x = np.concatenate([np.linspace(0.0, 990.0, 100), [995.0, 1060.0]])
    y = np.zeros(len(x))
    y[-1] = 10.0
    found = matched(run(x, y, sigma_m=0.1), place)
    assert found.path.element_names()[0] == "a"
    assert found.epochs.table["path_probability"][50] >= 0.99


@pytest.mark.parametrize("rate_hz", [1.0, 2.5, 10.0])
def test_a_standing_train_does_not_jump_to_another_track(rate_hz: float) -> None:
    """For 2 s the position lies on a track 200 m away; nothing connects that with the train's own."""
    count = int(120 * rate_hz)
    y = np.zeros(count)
    y[count // 4 : count // 4 + int(2 * rate_hz)] = 220.0
    found = matched(run(np.full(count, 500.0), y, rate_hz, sigma_m=0.1), TRACKS)
    assert found.path.element_names() == ["a"]
    away = y > 0
    gate = found.epochs.table["gate_probability"].fill_null(0.0).to_numpy()
    assert (gate[away & np.roll(away, round(rate_hz))] < 0.99).all()
    # It begins anew after the delay of the tests; what refuted all tracks in the first minute may do so again.
    t_s = np.arange(count) / rate_hz
    assert (gate[((t_s >= 1.0) & (t_s < 30.0)) | (t_s > 100.0)] >= 0.99).all()
    assert (gate[(t_s > 37.0) & (t_s < 90.0)] == 0.95).all()


@pytest.mark.parametrize("place", [TRACKS, CHAIN], ids=["network", "chain"])
@pytest.mark.parametrize("measured", [True, False], ids=["odometer", "no odometer"])
def test_a_jump_along_the_track_puts_the_track_in_no_doubt(place: Site, measured: bool) -> None:
    """150 m ahead for 1 s at 15 m/s: for the monitors along the track, and only where there is an odometer."""
    x = 6.0 * np.arange(100) + 20.0
    jumped = x.copy()
    jumped[50:52] += 150.0
    found = matched(run(jumped, np.zeros(100), 2.5, sigma_m=0.1), place, odometer(x, 2.5) if measured else None)
    assert found.epochs.table["gate_probability"][20:].min() >= 0.99
    assert found.epochs.table["path_m"][50] - found.epochs.table["path_m"][49] == pytest.approx(156.0, abs=0.01)


def test_a_train_that_speeds_up_or_lost_its_position_is_believed() -> None:
    """From standstill at 1.5 m/s², then 20 s without a position: no epoch is out of reach."""
    t = np.concatenate([np.arange(0.0, 20.0, 0.4), np.arange(40.0, 50.0, 0.4)])
    x = 0.75 * t**2
    fixes = run(x, np.zeros(len(x)), sigma_m=0.1)
    fixes = fixes.with_columns(t=pl.Series(np.round(t * 1e9).astype(np.int64)).cast(fixes["t"].dtype))
    # The first second ends with the third position.
    assert matched(fixes, CHAIN).epochs.table["gate_probability"][3:].min() == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_a_receiver_without_accuracy_does_not_change_the_track(seed: int) -> None:
    """Standing just behind a switch for two minutes, its fixes called fixed ambiguities, with 0.3 m of noise."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([np.arange(400.0, 520.0, 4.0), np.full(300, 520.0)])
    y = 0.02 * np.clip(x - 500.0, 0.0, None)
    noise = 0.3 * rng.normal(size=(2, len(x)))
    place = site(
        {"s": line((0, 0), (500, 0)), "m": line((500, 0), (1500, 0)), "b": line((500, 0), (1500, 20))},
        [("s", 1, "m", 0, "both"), ("s", 1, "b", 0, "both")],
    )
    found = matched(run(x + noise[0], y + noise[1], 2.5, sigma_m=None, fix=["rtk_fixed"] * len(x)), place)
    wrong = (found.epochs.table["netelement_id"] == "m") & (found.epochs.table["path_probability"] >= 0.99)
    assert wrong.sum() <= 0.01 * len(wrong)


@pytest.mark.parametrize("track_y", [0.0, 20.0])
def test_a_stretch_of_positions_on_another_track_does_not_move_the_run(track_y: float) -> None:
    """For 40 s of 160 s the positions lie along a track 200 m away, to which nothing leads."""
    x = np.arange(20.0, 1980.0, 4.9)
    y = np.full(len(x), track_y)
    y[150:250] = 215.0
    found = matched(run(x, y, 2.5, sigma_m=0.1), TRACKS)
    assert found.path.element_names() == (["a", "b"] if track_y == 0.0 else ["c", "d"])
    before_and_after = np.r_[20:140, 360:400]
    assert found.epochs.table["gate_probability"].fill_null(0.0).to_numpy()[before_and_after].min() >= 0.99
    assert not found.epochs.table["on_track"][150:250].any()


def test_a_track_far_beside_is_paid_for_by_the_time_on_it() -> None:
    """The first 10 s lie on the far track, then the position comes back to where the train has been for 150 s."""
    x = np.arange(20.0, 1980.0, 4.9)
    y = np.where(np.arange(len(x)) < 25, 20.0, 0.0)
    found = matched(run(x, y, 2.5, sigma_m=0.1), TRACKS)
    assert found.path.element_names() == ["a", "b"]
    assert found.epochs.table["path_probability"][200] >= 0.99


@pytest.mark.parametrize("seed", range(6))
def test_how_a_lost_position_moves_does_not_choose_between_parallel_tracks(seed: int) -> None:
    """For a minute the positions are 100 m off and wander as the other track bends, 5 m beside all else of the run."""
    rng = np.random.default_rng(seed)
    x = np.arange(20.0, 1980.0, 4.9)

    def bend(at_m: np.ndarray) -> np.ndarray:
        return 6.0 * np.sin(np.pi * np.clip((at_m - 755.0) / 735.0, 0.0, 1.0)) ** 2

    along = np.linspace(0.0, 2000.0, 201)
    place = site({"a": line((0, 0), (2000, 0)), "b": np.column_stack([along, 5.0 + bend(along)])}, sigma_m=None)
    y = 0.05 * rng.normal(size=len(x))
    y[150:300] += 100.0 + bend(x[150:300])
    found = matched(run(x, y, 2.5, sigma_m=None, fix=["rtk_fixed"] * len(x)), place)
    assert found.path.element_names() == ["a"]
    assert found.epochs.table["gate_probability"].to_numpy()[-8:].min() > 0.5


def test_a_train_that_turns_back_in_a_pause_of_the_odometer_keeps_its_sense() -> None:
    """The odometer falls from 2 s on: the run began by reversing, whatever of its first metres is not known."""
    t = np.arange(0.0, 200.0)
    x = 1000.0 - 10.0 * np.minimum(t, 20.0) + 10.0 * np.clip(t - 40.0, 0.0, None)
    stream = odometer(x).with_columns(slip=pl.Series((t < 2.0) | ((t > 8.0) & (t < 15.0))))
    epochs = matched(run(x, 0.0 * x, sigma_m=0.1), site({"a": line((0, 0), (6000, 0))}), stream).epochs.table
    assert epochs["path_m"][19] > epochs["path_m"][2]
    assert epochs["gate_probability"].min() == 1.0


def test_epochs_before_the_first_position_put_no_claim_forward() -> None:
    """For 40 s the receiver has no fix; at the switch it knows no sooner which way it went than one that had."""
    distance = np.arange(500.0, 1500.0, 5.0)
    x, y = along(branch("d"), distance)
    late = matched(run(x, y, fix=np.where(distance < 700.0, "none", "sbas")), site(SWITCH, SWITCH_LINKS)).epochs.table
    whole = matched(run(x, y)[40:], site(SWITCH, SWITCH_LINKS)).epochs.table
    assert late["gate_probability"][:40].fill_null(0.0).max() == 0.0
    assert late["gate_probability"][40:].to_list() == whole["gate_probability"].to_list()
    assert (whole["gate_probability"] < 0.99).any()
