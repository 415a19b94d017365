"""What messages of known content become: values, units, times, kinds of fix, and what is damaged."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.trial import write_run_as
from pipeline.make.receivers import convert
from pipeline.make.receivers.frames import Protocol, whole_messages
from pipeline.read.ingest import read_run
from schemas.config import IngestConfig
from schemas.errors import InputError
from tests.make.receivers.messages import (
    DO_NOT_USE,
    dop,
    gga,
    nav_cov,
    nav_hpposllh,
    nav_pvt,
    pos_cov_geodetic,
    pvt_geodetic,
    rmc,
    sentence,
    ubx,
)


def iso(fixes):
    return fixes["t"].dt.to_string("%Y-%m-%dT%H:%M:%S%.f").to_list()


@pytest.mark.parametrize(
    ("fix", "flags", "kind"),
    [
        (0, 1, "none"), (1, 1, "estimated"), (2, 1, "autonomous"), (3, 1, "autonomous"), (3, 3, "differential"),
        (3, 0x43, "rtk_float"), (3, 0x83, "rtk_fixed"), (4, 1, "autonomous"), (5, 1, "none"), (3, 0, "none"),
    ],
)  # fmt: skip
def test_ubx_kinds_of_fix(converted, fix, flags, kind):
    row = converted(nav_pvt(1000), nav_pvt(2000, (2025, 6, 1, 12, 0, 1), fix=fix, flags=flags)).run.gnss.row(
        1, named=True
    )
    assert row["fix"] == kind
    assert (row["latitude_deg"] is None) == (kind == "none")
    assert (row["cov_ee_m2"] is None) == (kind == "none")


def test_a_time_beyond_all_calendars_is_no_time(converted):
    """A year of 9999 does not fit into nanoseconds: the table was refused by an error of polars."""
    log = converted(nav_pvt(1000), nav_pvt(2000, (9999, 6, 1, 12, 0, 1)), nav_pvt(3000, (1950, 6, 1, 12, 0, 2)))
    assert (log.run.gnss.height, log.dropped) == (1, {"time not valid": 2})


def test_ubx_units_and_negative_nanoseconds(converted):
    row = converted(nav_pvt(1000, nano=-500)).run.gnss.row(0, named=True)
    assert iso(converted(nav_pvt(1000, nano=-500)).run.gnss) == ["2025-06-01T11:59:59.999999500"]
    assert (row["latitude_deg"], row["longitude_deg"], row["height_m"]) == (50.5, 4.5, 100.0)
    assert (row["vel_e_mps"], row["vel_n_mps"], row["vel_u_mps"]) == (2.0, 1.0, 0.3)
    assert (row["cov_ee_m2"], row["cov_nn_m2"], row["cov_uu_m2"]) == pytest.approx((1.125, 1.125, 6.25))


def test_ubx_high_precision_and_covariance_of_the_epoch_count_in_any_order(converted):
    for parts in (
        [nav_pvt(1000), nav_hpposllh(1000), nav_cov(1000)],
        [nav_cov(1000), nav_hpposllh(1000), nav_pvt(1000)],
    ):
        row = converted(*parts).run.gnss.row(0, named=True)
        assert row["latitude_deg"] == pytest.approx(50.5 - 42e-9, abs=1e-12)
        assert row["longitude_deg"] == pytest.approx(4.5 + 37e-9, abs=1e-12)
        assert row["height_m"] == pytest.approx(100.1235)
        names = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
        assert [row[name] for name in names] == [1.0, 0.5, 0.125, 4.0, -0.25, 9.0]
    invalid = converted(nav_pvt(1000), nav_hpposllh(1000, invalid=True)).run.gnss.row(0, named=True)
    assert (invalid["latitude_deg"], invalid["height_m"]) == (50.5, 100.0)


def test_a_position_marked_invalid_is_no_fix(converted):
    row = converted(nav_pvt(1000), nav_pvt(2000, (2025, 6, 1, 12, 0, 1), flags3=1)).run.gnss.row(1, named=True)
    assert (row["fix"], row["latitude_deg"]) == ("none", None)


def test_ubx_times_that_are_not_valid_are_left_out(converted):
    found = converted(nav_pvt(1000, valid=1), nav_pvt(2000, (2025, 13, 1, 12, 0, 0)), nav_pvt(3000))
    assert (found.run.gnss.height, found.dropped) == (1, {"time not valid": 2})


def test_the_same_time_of_another_week_is_another_epoch(converted):
    week_later = [
        nav_pvt(604_799_000, (2025, 5, 31, 23, 59, 41)),
        nav_pvt(0, (2025, 5, 31, 23, 59, 42)),
        nav_pvt(604_799_000, (2025, 6, 7, 23, 59, 41)),
    ]
    assert iso(converted(*week_later).run.gnss) == [
        "2025-05-31T23:59:41", "2025-05-31T23:59:42", "2025-06-07T23:59:41",
    ]  # fmt: skip


def test_a_damaged_length_hides_nothing_of_what_follows(converted):
    whole = [nav_pvt(1000 * number, (2025, 6, 1, 12, 0, number)) for number in range(12)]
    damaged = bytearray(whole[1])
    damaged[4:6] = b"\xff\x01"
    found = converted(whole[0], bytes(damaged), *whole[2:])
    assert (found.run.gnss.height, found.dropped) == (11, {"damaged message": 1})


def test_every_protocol_is_framed_and_damage_is_counted_once():
    block = pvt_geodetic(0)
    whole = [nav_pvt(1000), block, gga("120000.00")]
    assert list(whole_messages(b"".join(whole), pytest.fail)) == list(
        zip((Protocol.UBX, Protocol.SBF, Protocol.NMEA), whole, strict=True)
    )
    broken = []
    spoiled = [part[:20] + bytes([part[20] ^ 1]) + part[21:] for part in whole] + [whole[0][:-1]]
    assert list(whole_messages(b"".join(spoiled), lambda: broken.append(1))) == []
    assert len(broken) == 4


def test_nmea_beside_ubx_does_not_double_the_epochs(converted):
    parts = [
        part
        for number in range(3)
        for part in (
            nav_pvt(1000 * number, (2025, 6, 1, 12, 0, number)),
            gga(f"12000{number}.00", talker="GN"),
            rmc(f"12000{number}.00", talker="GN"),
        )
    ]
    found = converted(*parts)
    assert found.run.gnss.height == 3
    assert found.dropped == {"NMEA position beside those of UBX": 3}
    assert found.run.gnss["cov_ee_m2"].null_count() == 0


def test_a_lonely_binary_position_does_not_replace_a_log_of_nmea(converted):
    parts = [part for number in range(9) for part in (rmc(f"12000{number}.00"), gga(f"12000{number}.00"))]
    found = converted(nav_pvt(1000), *parts)
    assert (found.run.gnss.height, found.dropped) == (9, {"UBX position beside those of NMEA": 1})


@pytest.mark.parametrize(
    ("modes", "kind"),
    [("AN", "autonomous"), ("DA", "differential"), ("FN", "rtk_float"), ("RN", "rtk_fixed"), ("EE", "estimated"),
     ("NN", "none"), ("SN", "none")],
)  # fmt: skip
def test_gns_is_a_position_of_several_systems(converted, modes, kind):
    gns = sentence(f"GNGNS,120001.00,5030.00000,N,00430.00000,E,{modes},09,0.9,55.0,45.0,,,V")
    row = converted(rmc("120000.00"), gns).run.gnss.row(1, named=True)
    assert row["fix"] == kind
    assert row["height_m"] == (None if kind == "none" else 100.0)


@pytest.mark.parametrize(
    ("status", "mode", "kind"),
    [("A", "A", "autonomous"), ("A", "D", "differential"), ("A", "E", "estimated"), ("V", "N", "none"),
     ("A", "R", "rtk_fixed"), ("A", "S", "none")],
)  # fmt: skip
def test_rmc_alone_is_a_position_without_height(converted, status, mode, kind):
    row = converted(rmc("120000.00", status=status, mode=mode), rmc("120001.00")).run.gnss.row(0, named=True)
    assert (row["fix"], row["height_m"]) == (kind, None)
    assert row["latitude_deg"] == (None if kind == "none" else 50.5)


@pytest.mark.parametrize(
    ("quality", "kind"),
    [("0", "none"), ("1", "autonomous"), ("2", "differential"), ("3", "autonomous"), ("4", "rtk_fixed"),
     ("5", "rtk_float"), ("6", "estimated"), ("7", "none"), ("8", "none")],
)  # fmt: skip
def test_gga_goes_before_rmc_in_either_order(converted, quality, kind):
    for order in (1, -1):
        pair = [gga("120001.00", quality=quality), rmc("120001.00", mode="D")][::order]
        assert converted(rmc("120000.00"), *pair).run.gnss["fix"].to_list()[-1] == kind


def test_the_first_gga_before_any_date_belongs_to_its_rmc(converted):
    row = converted(gga("120000.00", quality="2", tail="3.0,0036"), rmc("120000.00", mode="D")).run.gnss.row(
        0, named=True
    )
    assert (row["fix"], row["sbas_prn"], row["sbas_age_s"], row["height_m"]) == ("sbas", 123, 3.0, 100.0)


def test_positions_before_the_first_date_get_their_day(converted):
    before = [gga("235958.00"), gga("235959.00", quality="0"), gga("000000.00"), gga("000001.00")]
    found = converted(*before, sentence("GPZDA,000002.00,01,06,2025,00,00"), gga("000002.00"))
    assert iso(found.run.gnss) == [
        "2025-05-31T23:59:58", "2025-06-01T00:00:00", "2025-06-01T00:00:01", "2025-06-01T00:00:02",
    ]  # fmt: skip
    assert found.dropped == {"time without a date": 1}


def test_a_clock_that_goes_back_mixes_no_epochs_and_loses_none(converted):
    def at(second: int, minute: str) -> list[bytes]:
        place = [part.replace(b"5030.", f"{minute}.".encode()) for part in (rmc(f"1200{second:02d}.00"),
                                                                           gga(f"1200{second:02d}.00"))]  # fmt: skip
        return [sentence(part[1:].split(b"*")[0].decode()) for part in place]

    forth = [part for second in range(40) for part in at(second, "5030")]
    again = [part for second in (38, 39, 2, 3) for part in at(second, "5031")]
    fixes = converted(*forth, *again).run.gnss
    assert fixes.height == 44
    assert fixes["latitude_deg"].round(6).to_list() == [50.5] * 40 + [round(50 + 31 / 60, 6)] * 4


def test_the_same_message_twice_is_one_epoch_and_another_of_its_time_is_not(converted):
    assert converted(rmc("120000.00"), gga("120000.00"), gga("120000.00")).run.gnss.height == 1
    other = nav_pvt(1000, fix=2)
    assert converted(nav_pvt(1000), nav_pvt(1000), other).run.gnss.height == 2
    assert converted(pvt_geodetic(0), pvt_geodetic(0), pvt_geodetic(0, 4)).run.gnss["fix"].to_list() == [
        "sbas", "rtk_fixed",
    ]  # fmt: skip


def test_any_talker_is_read(converted):
    assert converted(rmc("120000.00", talker="BD"), gga("120000.00", talker="BD")).run.gnss.height == 1


def test_sentences_that_make_no_position_make_no_epoch(converted, tmp_path):
    found = converted(rmc("120000.00"), gga("120000.00"), sentence("GPGST,120000.50,1.0,2.0,1.0,90.0,1.0,2.0,3.0"))
    assert (found.run.gnss.height, found.dropped) == (1, {"epoch without its position message": 1})


def test_an_error_ellipse_that_contradicts_its_axes_gives_no_correlation(converted):
    def covariances(gst: str) -> tuple[float, ...]:
        fixes = converted(rmc("120000.00"), gga("120000.00"), sentence(f"GPGST,120000.00,1.0,{gst}")).run.gnss
        return fixes.select("cov_ee_m2", "cov_nn_m2", "cov_en_m2").row(0)

    assert covariances("2.0,1.0,45.0,1.5811,1.5811,3.0") == pytest.approx((2.5, 2.5, 1.5), abs=1e-3)
    assert covariances("9.0,1.0,45.0,1.0,1.0,3.0") == (1.0, 1.0, 0.0)


def test_half_lines_and_stray_signs_are_damage_and_nothing_more(converted):
    whole = [rmc("120000.00"), gga("120000.00")]
    found = converted(whole[1][:30], b"\r\n", *whole, whole[1].replace(b"5030", b"5130"), b"$@GPGGA,junk\r\n")
    assert (found.run.gnss["latitude_deg"].to_list(), found.dropped) == ([50.5], {"damaged message": 3})


def test_a_sentence_with_the_right_checksum_and_wrong_content_is_counted(converted):
    bad = [sentence("GPGGA,120001.00,5030.0,N,00430.0,E,X,09,0.9,55.0,M,45.0,M,,"), gga("250000.00")]
    found = converted(rmc("120000.00"), gga("120000.00"), *bad, sentence("GPZDA,120002.00,32,13,2025,00,00"))
    assert found.run.gnss.height == 1
    assert found.dropped == {"message that does not fit its definition": 1, "time not valid": 1}


def test_messages_that_end_before_their_fields_do_are_counted(converted):
    short = [sentence("GPGGA,120001.00,5030.0"), sentence("GPRMC,120001.00,A"), sentence("GPGST,120001.00,1.0")]
    found = converted(rmc("120000.00"), gga("120000.00"), *short)
    assert (found.run.gnss.height, found.dropped["message that does not fit its definition"]) == (1, 3)
    found = converted(nav_pvt(1000), ubx(b"\x01\x07", b""))
    assert (found.run.gnss.height, found.dropped["message that does not fit its definition"]) == (1, 1)
    found = converted(pvt_geodetic(0), pvt_geodetic(0, week=65534))
    assert (found.run.gnss.height, found.dropped["message that does not fit its definition"]) == (1, 1)


def test_a_receiver_without_a_position_does_not_know_the_day(converted):
    unset = [sentence(f"GPRMC,1200{second:02d}.00,V,,,,,,,060180,,,N") for second in (0, 1)]
    fixes = converted(*unset, gga("120002.00"), rmc("120002.00"), gga("120003.00", quality="9")).run.gnss
    assert iso(fixes) == ["2025-06-01T12:00:02", "2025-06-01T12:00:03"]
    assert fixes["fix"].to_list() == ["autonomous", "sbas"]


def test_a_log_without_a_date_says_why(converted):
    with pytest.raises(InputError, match=r"no epoch with a time and a position.*time without a date \(1\)"):
        converted(gga("120000.00"))


@pytest.mark.parametrize(
    ("mode", "kind"),
    [(0, "none"), (1, "autonomous"), (2, "differential"), (3, "none"), (4, "rtk_fixed"), (5, "rtk_float"),
     (6, "sbas"), (7, "rtk_fixed"), (8, "rtk_float"), (10, "differential"), (0x86, "sbas"), (9, "none")],
)  # fmt: skip
def test_sbf_kinds_of_fix(converted, mode, kind):
    row = converted(pvt_geodetic(0), pvt_geodetic(1000, mode)).run.gnss.row(1, named=True)
    assert row["fix"] == kind
    assert (row["latitude_deg"] is None) == (kind == "none")
    assert row["sbas_prn"] == (123 if kind == "sbas" else None)


def test_sbf_units_and_gps_time(converted):
    found = converted(pvt_geodetic(500), pos_cov_geodetic(500), dop(500, 12.5, 20.0)).run.gnss
    row = found.row(0, named=True)
    # Week 2368 starts on 2025-05-25; UTC is 18 s behind GPS time.
    assert iso(found) == ["2025-05-24T23:59:42.500"]
    assert row["latitude_deg"] == pytest.approx(np.degrees(0.88))
    assert (row["height_m"], row["vel_e_mps"], row["vel_n_mps"]) == (100.0, 2.0, 1.0)
    assert row["vel_u_mps"] == pytest.approx(0.3)
    names = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
    assert [row[name] for name in names] == [1.0, 0.5, -0.125, 4.0, 0.25, 9.0]
    assert (row["hpl_m"], row["vpl_m"], row["sbas_age_s"], row["satellites"]) == (12.5, 20.0, 2.5, 12)


def test_what_sbf_marks_as_unknown_is_null(converted):
    nothing = (DO_NOT_USE,) * 3
    parts = [
        pvt_geodetic(0),
        pvt_geodetic(1000, place=(0.88, 0.08, DO_NOT_USE), velocity=nothing, age=65535),
        pos_cov_geodetic(1000, unknown=True),
        dop(1000, DO_NOT_USE, DO_NOT_USE),
        pvt_geodetic(2000, place=nothing),
        pvt_geodetic(3000, error=1),
    ]
    fixes = converted(*parts).run.gnss
    known = [name for name, value in fixes.row(1, named=True).items() if value is not None]
    assert known == ["t", "solution", "latitude_deg", "longitude_deg", "fix", "satellites", "sbas_prn"]
    assert fixes["latitude_deg"].is_null().to_list() == [False, False, True, True]
    assert fixes["fix"].to_list() == ["sbas", "sbas", "sbas", "none"]


def test_a_base_station_is_no_sbas_satellite(converted):
    assert converted(pvt_geodetic(0, 4, reference=123)).run.gnss["sbas_prn"].to_list() == [None]


def test_blocks_of_an_epoch_without_position_make_no_epoch(converted):
    found = converted(pvt_geodetic(0), dop(1000, 5.0, 8.0))
    assert (found.run.gnss.height, found.dropped) == (1, {"epoch without its position message": 1})


def test_damaged_sbf_blocks_are_left_out(converted):
    damaged = bytearray(pvt_geodetic(1000))
    damaged[30] ^= 1
    found = converted(pvt_geodetic(0), bytes(damaged), pvt_geodetic(2000), pvt_geodetic(3000)[:-4])
    assert (found.run.gnss.height, found.dropped) == (2, {"damaged message": 2})


def test_two_receivers_are_not_read_as_one(tmp_path):
    paths = [tmp_path / "a.ubx", tmp_path / "b.ubx", tmp_path / "c.ubx"]
    for path, minutes in zip(paths, ((0, 2), (1, 3), (3, 5)), strict=True):
        path.write_bytes(b"".join(nav_pvt(60_000 * m, (2025, 6, 1, 12, m, 0)) for m in range(*minutes, 1)))
    paths[1].write_bytes(b"".join(nav_pvt(30_000 * m, (2025, 6, 1, 12, 0, m)) for m in range(30)))
    with pytest.raises(InputError, match="two logs hold positions of the same time"):
        convert(paths[:2], "r")
    assert convert([paths[0], paths[2]], "r").run.gnss.height == 4


def test_what_is_converted_can_be_read_again(tmp_path, converted):
    other = ubx(b"\x0a\x04", bytes(40))
    found = converted(nav_pvt(1000, fix=0), other, nav_pvt(2000, (2025, 6, 1, 12, 0, 1)), dop(0, 1.0, 2.0))
    write_run_as(found.run, tmp_path / "run")
    assert read_run(tmp_path / "run", IngestConfig()).gnss.equals(found.run.gnss)
