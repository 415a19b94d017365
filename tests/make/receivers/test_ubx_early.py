"""u-blox receivers without NAV-PVT: what NAV-SOL, NAV-POSLLH, NAV-VELNED, NAV-STATUS and the time messages tell."""

from __future__ import annotations

import struct
from itertools import permutations

import pytest

from tests.make.receivers.messages import nav_pvt, ubx

# 2025-06-01T12:00:00 UTC is Sunday 12:00:18 of GPS week 2369.
_WEEK, _NOON_MS = 2369, (12 * 3600 + 18) * 1000
_COVARIANCE = ["cov_ee_m2", "cov_en_m2", "cov_nn_m2", "cov_uu_m2"]


def nav_sol(itow_ms: int = _NOON_MS, *, fix: int = 3, flags: int = 0x0D, ns: int = 0, x_cm: int = 637_813_700) -> bytes:
    """At latitude and longitude zero, 0 m high; 0.3 m/s up, 2 m/s east, 1 m/s north."""
    body = (itow_ms, ns, _WEEK, fix, flags, x_cm, 0, 0, 250, 30, 200, 100, 20, 150, 0, 8, 0)
    return ubx(b"\x01\x06", struct.pack("<IihBBiiiIiiiIHBBI", *body))


def nav_posllh(itow_ms: int = _NOON_MS) -> bytes:
    return ubx(b"\x01\x02", struct.pack("<IiiiiII", itow_ms, 45_000_000, 505_000_000, 100_000, 55_000, 1500, 2500))


def nav_velned(itow_ms: int = _NOON_MS) -> bytes:
    return ubx(b"\x01\x12", struct.pack("<IiiiIIiII", itow_ms, 300, 400, -50, 502, 500, 0, 10, 100))


def nav_status(itow_ms: int = _NOON_MS, fix: int = 3, flags: int = 0x0F) -> bytes:
    return ubx(b"\x01\x03", struct.pack("<IBBBBII", itow_ms, fix, flags, 0, 0, 0, 0))


def nav_timeutc(itow_ms: int = _NOON_MS, valid: int = 7, nano: int = 0) -> bytes:
    return ubx(b"\x01\x21", struct.pack("<IIiHBBBBBB", itow_ms, 20, nano, 2025, 6, 1, 12, 0, 0, valid))


def nav_timegps(itow_ms: int = _NOON_MS, valid: int = 7, ns: int = 0) -> bytes:
    return ubx(b"\x01\x20", struct.pack("<IihbBI", itow_ms, ns, _WEEK, 18, valid, 20))


def nav_svinfo(*satellites: tuple[int, int, int, int, int], itow_ms: int = _NOON_MS) -> bytes:
    """Number, used, elevation and azimuth [deg], residual [cm]."""
    head = struct.pack("<IBBH", itow_ms, len(satellites), 4, 0)
    return ubx(
        b"\x01\x30",
        head
        + b"".join(struct.pack("<BBBBBbhi", 0, sv, used, 7, 40, el, az, cm) for sv, used, el, az, cm in satellites),
    )


def moments(found):
    return found.run.gnss["t"].dt.to_string("%Y-%m-%dT%H:%M:%S%.f").to_list()


def test_a_solution_tells_everything_but_its_accuracy(converted):
    found = converted(nav_sol(ns=-250_000), nav_sol(_NOON_MS + 1000, flags=0x0F))
    assert moments(found) == ["2025-06-01T11:59:59.999750", "2025-06-01T12:00:01"]
    row = found.run.gnss.row(0, named=True)
    assert (row["fix"], row["satellites"], row["latitude_deg"], row["longitude_deg"]) == ("autonomous", 8, 0.0, 0.0)
    assert row["height_m"] == pytest.approx(0.0, abs=1e-6)
    assert [row[f"vel_{axis}_mps"] for axis in "enu"] == pytest.approx([2.0, 1.0, 0.3])
    assert [row[name] for name in _COVARIANCE] == [None] * 4
    assert found.run.gnss["fix"].to_list()[1] == "differential"


@pytest.mark.parametrize(
    ("fix", "flags", "kind"),
    [(0, 0x0D, "none"), (1, 0x0D, "estimated"), (2, 0x0D, "autonomous"), (5, 0x0D, "none"), (3, 0x0C, "none")],
)
def test_kinds_of_fix(converted, fix, flags, kind):
    for parts in ([nav_sol(fix=fix, flags=flags)], [nav_posllh(), nav_status(fix=fix, flags=flags), nav_timeutc()]):
        row = converted(nav_pvt(0), *parts).run.gnss.row(1, named=True)
        assert row["fix"] == kind
        assert (row["latitude_deg"] is None) == (kind == "none")


def test_a_solution_before_its_time_is_known_is_left_out(converted):
    found = converted(nav_sol(flags=0x05), nav_sol(_NOON_MS + 1000))
    assert (found.run.gnss.height, found.dropped) == (1, {"time not valid": 1})


def test_single_messages_say_it_better_in_any_order(converted):
    for parts in permutations([nav_sol(), nav_posllh(), nav_velned(), nav_status(fix=1)]):
        row = converted(*parts).run.gnss.row(0, named=True)
        assert (row["latitude_deg"], row["longitude_deg"], row["height_m"]) == (50.5, 4.5, 100.0)
        assert [row[f"vel_{axis}_mps"] for axis in "enu"] == pytest.approx([4.0, 3.0, 0.5])
        assert [row[name] for name in _COVARIANCE] == pytest.approx([1.125, 0.0, 1.125, 6.25])
        assert row["fix"] == "autonomous"


def test_a_position_with_its_status_and_a_time_is_an_epoch(converted):
    times = {
        nav_timeutc(nano=7): ["2025-06-01T12:00:00.000000007"],
        nav_timegps(ns=-3): ["2025-06-01T11:59:59.999999997"],
    }
    for time, expected in times.items():
        for parts in permutations([nav_posllh(), nav_status(), time]):
            assert moments(converted(*parts)) == expected


def test_a_time_that_is_not_valid_yet_is_none(converted):
    for time in (nav_timeutc(valid=3), nav_timegps(valid=1)):
        found = converted(nav_pvt(0), nav_posllh(), nav_status(), time)
        assert (found.run.gnss.height, found.dropped) == (1, {"time not valid": 1})


def test_nav_pvt_goes_before_all_of_them(converted):
    parts = [nav_sol(), nav_status(fix=1), nav_timegps(ns=5), nav_velned(), nav_pvt(_NOON_MS)]
    for order in (parts, parts[::-1]):
        found = converted(*order)
        row = found.run.gnss.row(0, named=True)
        assert moments(found) == ["2025-06-01T12:00:00"]
        assert (row["latitude_deg"], row["vel_e_mps"], row["satellites"]) == (50.5, 2.0, 9)


def test_a_status_without_a_position_is_no_epoch_unless_it_says_so(converted):
    found = converted(nav_status(), nav_timeutc(), nav_sol(_NOON_MS + 1000))
    assert (found.run.gnss.height, found.dropped) == (1, {"epoch without its position message": 1})
    assert converted(nav_status(fix=0), nav_timeutc(), nav_sol(_NOON_MS + 1000)).run.gnss["fix"].to_list() == [
        "none", "autonomous",
    ]  # fmt: skip


def test_satellites_by_their_old_numbers(converted):
    numbers = {5: "G05", 33: "C06", 65: "R01", 123: "S23", 159: "C01", 193: "J01", 211: "E01"}
    told = [(sv, 1, 40, 120, -250) for sv in numbers] + [(255, 0, 10, 20, 0), (7, 0, -91, 0, 0), (8, 0, 5, 6, 900)]
    ranges = converted(nav_sol(), nav_svinfo(*told)).run.satellites
    assert ranges["sv"].to_list() == [*numbers.values(), "G08"]
    assert ranges["residual_m"].to_list() == [-2.5] * len(numbers) + [None]
    assert ranges.select("azimuth_deg", "elevation_deg").row(0) == (120.0, 40.0)
