"""How long epochs hold and what of them counts, on seven epochs worked out by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.epochs.clock import (
    Clock,
    availability,
    crossing_gaps_ns,
    gap_limit_s,
    held_s,
    holds_at_rows,
    least_belief,
    nominal_period_s,
    outages_s,
    periods_before_s,
    reactions_ns,
    share_of_time,
    trusted,
    uptime,
    usable,
)
from schemas.arrays import NS_PER_S, Bools, Ints
from schemas.config import Configuration, LdsConfig

CONFIG = Configuration()


def seconds(*t_s: float) -> Ints:
    return np.array([round(t * NS_PER_S) for t in t_s], dtype=np.int64)


def flags(word: str) -> Bools:
    """`+` where it holds."""
    return np.array([letter == "+" for letter in word], dtype=np.bool_)


def test_a_share_of_time_is_at_most_one_also_by_rounding() -> None:
    """Twenty times 0.1 s: without the epochs of no time between them the sum is rounded to a little more."""
    held = np.ravel([[0.1, 0.0]] * 20)
    assert held[held > 0.0].sum() > held.sum()
    assert share_of_time(held, held > 0.0) == 1.0
    assert share_of_time(held, np.arange(40) < 10) == pytest.approx(0.25)
    assert share_of_time(held[:0], held[:0] > 0.0) is None


# Once a second, and 5 s of nothing after the fourth.
T_NS = seconds(0, 1, 2, 3, 8, 9, 10)


def test_a_state_holds_to_the_next_epoch_and_not_over_a_gap() -> None:
    assert held_s(T_NS, 1.5).tolist() == [1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0]
    assert held_s(T_NS[:0], 1.5).tolist() == []


@pytest.mark.parametrize(
    ("valid", "moving", "share"),
    [
        ("+++++++", "+++++++", 0.5),  # 5 s held of 10 s, the gap included
        ("++-++++", "+++++++", 0.4),
        ("+++++++", "+++-+++", 1.0),  # the train stood during the gap
        ("+++++++", "----++-", 1.0),
        ("-------", "+++++++", 0.0),
        ("+++++++", "------+", None),  # nothing follows the last epoch
    ],
)
def test_availability_is_of_the_moving_time_with_its_gaps(valid: str, moving: str, share: float | None) -> None:
    assert availability(T_NS, flags(valid), flags(moving), 1.5) == share


def test_two_epochs_are_a_time_and_one_is_none() -> None:
    both = flags("++")
    assert availability(T_NS[:2], both, both, 1.5) == 1.0
    assert availability(T_NS[:1], both[:1], both[:1], 1.5) is None
    assert nominal_period_s(T_NS[:2]) == 1.0
    assert nominal_period_s(T_NS[:1]) is None


@pytest.mark.parametrize(
    ("good", "outages", "up_s", "losses"),
    [
        ("+++++++", [5.0], 5.0, 1),
        ("++--+++", [7.0], 3.0, 1),
        ("--+++++", [2.0, 5.0], 3.0, 1),
        ("+++++--", [5.0, 2.0], 3.0, 2),
        ("+-+++++", [2.0, 5.0], 3.0, 2),
        ("-------", [10.0], 0.0, 0),
    ],
)
def test_outages_at_the_ends_count_and_only_what_was_held_can_be_lost(
    good: str, outages: list[float], up_s: float, losses: int
) -> None:
    assert outages_s(T_NS, flags(good), 1.5).tolist() == outages
    held = uptime(T_NS, flags(good), 1.5)
    assert held == (up_s, losses)


@pytest.mark.parametrize(
    ("period_s", "limit_s"), [(None, 1.0), (0.1, 1.0), (1.0, 1.5), (2.0, 3.0), (60.0, CONFIG.align.gap_reset_s)]
)
def test_a_gap_is_longer_than_a_second_and_a_half_period(period_s: float | None, limit_s: float) -> None:
    assert gap_limit_s(period_s, CONFIG.align.gap_reset_s) == limit_s


def test_a_movement_is_interpolated_over_one_and_a_half_periods_as_known_before_or_as_configured() -> None:
    """Every 3 s, and 15 s of nothing after the fourth; before the first step no period is known."""
    gaps_ns = crossing_gaps_ns(3 * T_NS, LdsConfig(crossing_gap_s=2.0))
    assert (gaps_ns / NS_PER_S).tolist() == [2.0, 2.0, 4.5, 4.5, 4.5, 4.5, 4.5]
    assert crossing_gaps_ns(T_NS[:1], LdsConfig(crossing_gap_s=2.0)).tolist() == [2 * NS_PER_S]


def test_the_period_of_a_log_is_the_median_of_the_last_100_steps_before() -> None:
    """200 epochs at 10 Hz, then at 1 Hz: the 50th of the slow steps is the first behind which the median is theirs."""
    t_ns = seconds(*np.cumsum([0.0, *[0.1] * 199, *[1.0] * 60]))
    periods_s = periods_before_s(t_ns)
    assert periods_s[:2].tolist() == [0.0, 0.0]
    assert periods_s[2:250] == pytest.approx(0.1)
    assert periods_s[250] == pytest.approx(0.55)
    assert periods_s[251:] == pytest.approx(1.0)
    # What comes later changes nothing.
    assert periods_before_s(t_ns[:230]).tolist() == periods_s[:230].tolist()
    assert periods_before_s(t_ns[:0]).tolist() == []


def test_a_negation_takes_until_the_next_position() -> None:
    """At 3 s the next one comes in 5 s: no longer than a step that is no gap; behind the last one there is none."""
    found = reactions_ns(T_NS[[1, 3, 6]], T_NS, CONFIG) / NS_PER_S
    assert found.tolist() == [1.0, 1.5, 1.0]
    fixed = CONFIG.model_copy(update={"hazards": CONFIG.hazards.model_copy(update={"reaction_s": 0.25})})
    assert (reactions_ns(T_NS, T_NS, fixed) / NS_PER_S).tolist() == [0.25] * 7


POSITIONS = pl.DataFrame(
    {
        "t": pl.Series(T_NS).cast(pl.Datetime("ns", "UTC")),
        "path_m": [0.0, 10.0, None, 30.0, 80.0, 90.0, 100.0],
        "on_track": [True, False, True, True, True, True, None],
        "confidence_m": [5.0, 5.0, 5.0, 500.0, 5.0, None, 5.0],
        "gate_probability": [1.0, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0],
        "path_probability": [0.6, 1.0, 1.0, 1.0, 0.9, None, 1.0],
    }
)


def test_a_position_is_trusted_on_a_track_that_is_sure_and_within_its_limit() -> None:
    assert holds_at_rows(POSITIONS, usable()).tolist() == flags("+--+++-").tolist()
    assert holds_at_rows(POSITIONS, trusted(CONFIG)).tolist() == flags("+------").tolist()
    assert POSITIONS.select(least_belief()).to_series().to_list() == [0.6, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0]


def test_the_clock_of_a_run_asks_positions_for_the_period_and_all_epochs_for_the_time() -> None:
    """Another message each second between positions every two seconds."""
    t_ns = seconds(0, 1, 2, 3, 4, 5, 6, 10)
    frame = pl.DataFrame({"t": t_ns, "path_m": [0.0, None, 2.0, None, 4.0, None, 6.0, 10.0]})
    clock = Clock.of(frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC"))), CONFIG)
    assert (clock.period_s, clock.limit_s, clock.duration_s) == (2.0, 3.0, 10.0)
    assert clock.held_s.tolist() == [1.0] * 6 + [0.0, 0.0]
    assert Clock.of(frame.clear().cast({"t": pl.Datetime("ns", "UTC")}), CONFIG).duration_s is None
