"""Two receivers in one log are two solutions, and never merged; what a log states of itself is used or named."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest

from pipeline.make.receivers import Purpose, as_run, convert, gather
from schemas.errors import InputError
from tests.make.receivers.messages import gga, nav_pvt, pvt_geodetic, rmc, sentence, ubx


def at(number: int, minute: float, *, talker: str = "GP", quality: str = "1", tail: str = ",") -> bytes:
    """GGA of a second and a latitude of 50 deg and so many minutes."""
    head = f"{talker}GGA,12{number // 60:02d}{number % 60:02d}.00"
    place = f"{5000 + minute:.5f},N,00430.00000,E" if quality != "0" else ",,,"
    return sentence(f"{head},{place},{quality},09,0.9,55.0,M,45.0,M,{tail}")


def log_of(tmp_path, *parts: bytes, name: str = "receiver.log"):
    path = tmp_path / name
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("first", ["GP", "GN"])
def test_talkers_with_different_positions_need_a_choice(tmp_path, first):
    other = {"GP": "GN", "GN": "GP"}[first]
    parts = [
        part
        for second in range(20)
        for part in (
            rmc(f"1200{second:02d}.00", talker=first),
            at(second, 30.0, talker=first),
            at(second, 30.02, talker=other),
        )
    ]
    log = log_of(tmp_path, *parts)
    with pytest.raises(InputError, match="two receivers") as refused:
        convert([log], "r")
    assert "--solution GN" in refused.value.remedy
    chosen = gather([log], solution=first)
    fixes = as_run(chosen, "r", Purpose(solution=first)).run.gnss
    assert fixes["solution"].unique().to_list() == [first]
    assert fixes["latitude_deg"].round(9).unique().to_list() == [50.5]


def test_one_receiver_with_several_talkers_is_one(tmp_path):
    parts = [
        part
        for second in range(20)
        for part in (
            rmc(f"1200{second:02d}.00", talker="GN"),
            gga(f"1200{second:02d}.00"),
            gga(f"1200{second:02d}.00", talker="GN"),
        )
    ]
    assert convert([log_of(tmp_path, *parts)], "r").run.gnss.height == 20


@pytest.mark.parametrize("first", [True, False])
def test_a_receiver_without_a_fix_refuses_nobody_elses(tmp_path, first):
    parts: list[bytes] = []
    for second in range(10):
        blind = [at(second, 0.0, talker="GN", quality="0")]
        seeing = [at(second, 30.0), rmc(f"1200{second:02d}.00")]
        parts += [*blind, *seeing] if first else [*seeing, *blind]
    fixes = convert([log_of(tmp_path, *parts)], "r").run.gnss
    assert (fixes.height, fixes["fix"].unique().to_list()) == (10, ["autonomous"])


def test_receivers_that_have_a_fix_in_turn_are_two(tmp_path):
    parts = [rmc("120000.00", status="A")]
    for second in range(20):
        gp, gn = ("1", "0") if second < 10 else ("0", "1")
        parts += [at(second, 30.0, quality=gp), at(second, 30.02, talker="GN", quality=gn)]
    with pytest.raises(InputError, match="two receivers"):
        convert([log_of(tmp_path, *parts)], "r")


@pytest.mark.parametrize("step", [0.0, 0.01])
def test_two_of_one_talker_are_not_read_as_one(tmp_path, step):
    parts = [
        part
        for second in range(20)
        for part in (
            rmc(f"1200{second:02d}.00"),
            at(second, 30.0 + step * second),
            at(second, 29.98 + step * second),
        )
    ]
    with pytest.raises(InputError, match="two receivers") as refused:
        convert([log_of(tmp_path, *parts)], "r")
    assert "--solution NAME" in refused.value.remedy


def test_stamps_coarser_than_the_rate_are_no_second_receiver(tmp_path):
    """2 Hz under whole seconds, 18.5 m a second along one way."""
    parts = [rmc("120000.00")]
    parts += [at(second, 30.0 + 0.01 * (second + half)) for second in range(20) for half in (0.0, 0.5)]
    assert convert([log_of(tmp_path, *parts)], "r").run.gnss.height == 41 - 1


def test_two_ubx_receivers_of_one_time_are_two(tmp_path):
    def moved(message: bytes) -> bytes:
        payload = bytearray(message[6:-2])
        payload[28:32] = (505_010_000).to_bytes(4, "little")
        return ubx(b"\x01\x07", bytes(payload))

    one = [nav_pvt(1000 * n, (2025, 6, 1, 12, 0, n)) for n in range(10)]
    log = log_of(tmp_path, *(part for message in one for part in (message, moved(message))))
    with pytest.raises(InputError, match="two receivers"):
        convert([log], "r")
    assert (
        convert([log_of(tmp_path, *(part for message in one for part in (message, message)))], "r").run.gnss.height
        == 10
    )


def test_a_checksum_that_is_not_there_is_missing_and_not_damaged(converted):
    whole = [rmc("120000.00"), gga("120000.00")]
    bare = gga("120001.00").split(b"*")[0] + b"\r\n"
    found = converted(*whole, bare, bare[:30] + b"\r\n", b"$GPGGA,1\x00*00\r\n")
    assert found.run.gnss.height == 1
    assert found.dropped == {
        "sentence without a checksum (nothing shows whether it is whole)": 1,
        "damaged message": 2,
    }


@pytest.mark.parametrize(("turns", "wrong"), [(3, 3), (-2, 2), (0, 0)])
def test_a_date_that_turns_beside_midnight_is_put_on_the_day_of_its_neighbours(converted, turns, wrong):
    parts: list[bytes] = []
    for second in range(-10, 20):
        moment = datetime(2025, 6, 2, tzinfo=UTC).timestamp() + second
        day = "020625" if second >= turns else "010625"
        stamp = datetime.fromtimestamp(moment, UTC).strftime("%H%M%S.00")
        parts += [rmc(stamp, day), gga(stamp)]
    found = converted(*parts)
    steps = found.run.gnss["t"].diff().drop_nulls().dt.total_seconds()
    assert steps.to_list() == [1] * 29
    assert found.run.gnss["t"][0].date().isoformat() == "2025-06-01"
    assert sum(found.dropped.values()) == wrong


def test_a_recording_of_the_next_day_stays_there(converted):
    parts = [part for day in ("010625", "020625") for n in range(5) for part in (rmc(f"12000{n}.00", day),)]
    assert converted(*parts).run.gnss["t"].dt.day().to_list() == [1] * 5 + [2] * 5


def test_times_not_resolved_are_carried_by_the_time_of_the_week(converted):
    """Three epochs told 2 s late before the receiver knows the leap seconds."""
    early = [nav_pvt(1000 * n, (2025, 6, 1, 12, 0, n + 2), valid=3) for n in range(3)]
    late = [nav_pvt(1000 * n, (2025, 6, 1, 12, 0, n)) for n in range(3, 6)]
    found = converted(*early, *late)
    assert found.run.gnss["t"].dt.second().to_list() == list(range(6))
    assert found.dropped == {"time not yet resolved (put right by the time of the week)": 3}


def test_a_datum_that_is_stated_counts(converted):
    dtm = sentence("GPDTM,999,,0.08,N,0.07,E,-47.7,W84")
    back = sentence("GPDTM,W84,,0.0,N,0.0,E,0.0,W84")
    found = converted(rmc("120000.00"), gga("120000.00"), dtm, gga("120001.00"), back, gga("120002.00"))
    assert found.run.gnss["t"].dt.second().to_list() == [0, 2]
    assert found.dropped == {"position in another datum than WGS 84 (999)": 1}


@pytest.mark.parametrize(("datum", "kept"), [(0, True), (30, True), (31, False), (250, False)])
def test_the_datum_of_sbf(converted, datum, kept):
    import struct
    from binascii import crc_hqx

    block = bytearray(pvt_geodetic(1000))
    # TOW, week, mode, error, place, undulation, velocity, course, clock, drift, time system: then the datum.
    block[8 + 6 + 2 + 24 + 4 + 12 + 4 + 8 + 4 + 1] = datum
    block[2:4] = struct.pack("<H", crc_hqx(bytes(block[4:]), 0))
    found = converted(pvt_geodetic(0), bytes(block))
    assert found.run.gnss.height == 1 + kept
    assert bool(found.dropped) == (datum != 0)


def tpv(second: int, **more: object) -> bytes:
    said = {"class": "TPV", "device": "/dev/ttyUSB0", "mode": 3, "time": f"2025-03-03T08:00:{second:02d}.500Z"}
    return json.dumps(said | {"lat": 50.5, "lon": 4.5, "altHAE": 251.0} | more).encode() + b"\n"


def test_gpsd(converted):
    sky = {
        "class": "SKY", "device": "/dev/ttyUSB0", "time": "2025-03-03T08:00:01.500Z",
        "satellites": [
            {"PRN": 8, "gnssid": 0, "svid": 8, "az": 10.0, "el": 45.0, "used": True},
            {"PRN": 36, "az": 10.0, "el": 45.0, "used": False},
            {"PRN": 301, "gnssid": 2, "svid": 1, "used": True},
        ],
    }  # fmt: skip
    found = converted(
        b'{"class":"VERSION","release":"3.22"}\n',
        tpv(0, speed=10.0, track=90.0, climb=0.5, status=2),
        json.dumps(sky).encode() + b"\n",
        tpv(1, status=3, velE=1.0, velN=2.0, velD=-0.5),
        tpv(2, mode=1),
        tpv(3, mode=2, status=5),
        b'{"class":"TPV","mode":3,"ti\n',
        b'{"class":"TPV","mode":1}\n',
        b"$GPGSV,1,1,00*79\n",
    )
    fixes = found.run.gnss
    assert fixes["fix"].to_list() == ["differential", "rtk_fixed", "none", "estimated"]
    assert fixes["t"].dt.millisecond().to_list() == [500] * 4
    assert fixes["height_m"].to_list() == [251.0, 251.0, None, None]
    assert fixes["vel_e_mps"].to_list()[:2] == pytest.approx([10.0, 1.0])
    assert fixes["vel_u_mps"].to_list()[:2] == pytest.approx([0.5, 0.5])
    assert found.run.satellites is not None
    assert found.run.satellites["sv"].to_list() == ["G08", "S23"]
    assert found.dropped == {"damaged message": 1, "time not valid": 1}


def test_two_devices_of_gpsd_need_a_choice(tmp_path):
    parts = [part for second in range(5) for part in (tpv(second), tpv(second, device="/dev/ttyACM0", lat=50.501))]
    log = log_of(tmp_path, *parts, name="gpsd.json")
    with pytest.raises(InputError, match="two receivers"):
        gather([log])
    assert gather([log], solution="ttyACM0").streams["gnss"]["latitude_deg"].unique().to_list() == [50.501]
