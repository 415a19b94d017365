"""NMEA of two receivers in one log, and dates that turn at another moment than midnight."""

from __future__ import annotations

import pytest

from schemas.errors import InputError
from tests.make.receivers.messages import sentence


def position(second: float, aside_min: float = 0.0, talker: str = "GP", fix: int = 2) -> bytes:
    """A GGA at noon and some seconds; `aside_min`: minutes of latitude beside the other receiver."""
    place = f"{5030.0 + aside_min:.6f},N,00430.000000,E" if fix else ",,,"
    return sentence(f"{talker}GGA,1200{second:05.2f},{place},{fix},11,0.8,80.0,M,45.0,M,,")


def motion(second: float, aside_min: float = 0.0, talker: str = "GP") -> bytes:
    return sentence(f"{talker}RMC,1200{second:05.2f},A,{5030.0 + aside_min:.4f},N,00430.0000,E,10.0,0.0,010625,,,D")


@pytest.mark.parametrize("other", ["GN", "GP"])
def test_two_places_of_one_time_are_two_receivers(converted, other: str) -> None:
    messages = [
        message
        for number in range(20)
        for message in (
            position(0.1 * number),
            motion(0.1 * number),
            position(0.1 * number, 0.03, other),
            motion(0.1 * number, 0.03, other),
        )
    ]
    with pytest.raises(InputError, match="two receivers") as refused:
        converted(*messages)
    assert "--solution" in str(refused.value.remedy)


def test_a_velocity_of_another_receiver_is_not_merged(converted) -> None:
    """A GGA of one and an RMC of the other, 55 m beside it."""
    messages = [message for k in range(20) for message in (position(0.1 * k), motion(0.1 * k, 0.03, "GN"))]
    with pytest.raises(InputError, match="two receivers"):
        converted(motion(0.0), *messages)


def test_a_receiver_without_a_fix_refuses_nobody_elses(converted) -> None:
    messages = [
        message
        for k in range(20)
        for message in (position(0.1 * k), motion(0.1 * k), position(0.1 * k, talker="GN", fix=0))
    ]
    found = converted(*messages).run.gnss
    assert found.height == 20
    assert set(found["fix"]) == {"differential"}
    assert found["latitude_deg"].null_count() == 0


def test_two_talkers_of_one_receiver_are_one_row(converted) -> None:
    messages = [message for k in range(20) for message in (position(0.1 * k, talker="GN"), motion(0.1 * k))]
    found = converted(*messages).run.gnss
    assert found.height == 20
    assert found["vel_n_mps"].null_count() == 0


def test_positions_of_one_receiver_with_coarse_stamps_are_kept_apart(converted) -> None:
    """Ten positions with the stamp of one second: what the logger wrote, and no second receiver."""
    messages = [position(float(k // 10), 0.0001 * k) for k in range(40)]
    assert converted(motion(0.0), *messages).run.gnss.height >= 40


def test_a_date_that_turns_a_second_late_is_put_right(converted) -> None:
    def at(hhmmss: str, date: str) -> list[bytes]:
        place = "5030.0000,N,00430.0000,E"
        return [
            sentence(f"GPGGA,{hhmmss}.00,{place},2,11,0.8,80.0,M,45.0,M,,"),
            sentence(f"GPRMC,{hhmmss}.00,A,{place},10.0,0.0,{date},,,D"),
        ]

    messages = at("235958", "010625") + at("235959", "010625") + at("000000", "010625") + at("000001", "020625")
    log = converted(*messages)
    assert log.run.gnss["t"].dt.to_string("%d %H:%M:%S").to_list() == [
        "01 23:59:58", "01 23:59:59", "02 00:00:00", "02 00:00:01",
    ]  # fmt: skip
    assert list(log.dropped.values()) == [1]
