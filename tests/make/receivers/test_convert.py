"""Receiver logs against what the decoding packages give, damaged ones included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from pysbf2 import SBFReader
from pyubx2 import UBXReader

from pipeline.make.receivers import convert
from schemas.config import Configuration, settings_from
from schemas.errors import InputError
from schemas.inputs import Gnss, Satellites

SAMPLES = Path(__file__).parents[4] / "shared" / "data" / "receivers"
INFRABEL = SAMPLES.parent / "infrabel"
needs_samples = pytest.mark.skipif(not SAMPLES.exists(), reason="the sample recordings are not here")


def messages(reader, path, identity):
    with path.open("rb") as stream:
        return [m for _, m in reader(stream, quitonerror=0, protfilter=7) if m is not None and m.identity == identity]


@needs_samples
def test_ubx_positions_are_those_of_the_decoder():
    path = SAMPLES / "pygpsdata-MIXED.log"
    fixes = convert([path], "r").run.gnss
    decoded = [m for m in messages(UBXReader, path, "NAV-PVT") if m.validDate and m.validTime]
    assert fixes.height == len(decoded) > 30
    good = [m for m in decoded if m.gnssFixOk]
    known = fixes.drop_nulls("latitude_deg")
    np.testing.assert_array_equal(known["latitude_deg"], [m.lat for m in good])
    np.testing.assert_array_equal(known["longitude_deg"], [m.lon for m in good])
    np.testing.assert_allclose(known["height_m"], [m.height / 1e3 for m in good])
    np.testing.assert_allclose(known["vel_u_mps"], [-m.velD / 1e3 for m in good])
    Gnss.validate(fixes)


@needs_samples
def test_ubx_covariance_satellites_and_an_invalid_protection_level():
    path = SAMPLES / "pygpsdata-NAV-ZED-X20P.log"
    converted = convert([path], "r")
    at = messages(UBXReader, path, "NAV-PVT")[0].iTOW
    covariance = next(m for m in messages(UBXReader, path, "NAV-COV") if m.iTOW == at)
    first = converted.run.gnss.row(0, named=True)
    assert first["cov_ee_m2"] == pytest.approx(covariance.posCovEE)
    assert first["cov_nu_m2"] == pytest.approx(-covariance.posCovND)
    assert first["hpl_m"] is None
    assert converted.dropped["protection level not valid"] == 2
    satellites = converted.run.satellites
    assert satellites is not None
    Satellites.validate(satellites)
    sent = next(m for m in messages(UBXReader, path, "NAV-SAT") if m.iTOW == at)
    row = satellites.filter(pl.col("t") == satellites["t"][0], pl.col("sv") == "G10").row(0, named=True)
    assert (row["azimuth_deg"], row["elevation_deg"], row["residual_m"]) == (sent.azim_02, sent.elev_02, sent.prRes_02)
    assert row["used"] is True


@needs_samples
def test_fused_solutions_of_high_precision_receivers_are_read():
    converted = convert([SAMPLES / "pygpsdata-SF-calibration.log"], "r")
    assert converted.run.gnss.height > 500
    assert converted.run.gnss["fix"].unique().to_list() == ["differential"]


@needs_samples
def test_sbf_geodetic_with_egnos():
    path = SAMPLES / "pygpsdata_x5_pvtgeod.log"
    row = convert([path], "r").run.gnss.row(0, named=True)
    block = messages(SBFReader, path, "PVTGeodetic")[0]
    assert row["latitude_deg"] == pytest.approx(np.degrees(block.Latitude), abs=1e-12)
    assert (row["fix"], row["sbas_prn"], row["sbas_age_s"]) == ("sbas", 123, 2.78)
    covariance = messages(SBFReader, path, "PosCovGeodetic")[0]
    assert row["cov_en_m2"] == pytest.approx(covariance.Cov_latlon)
    # 482,847 s of the GPS week are Friday 14:07:27; UTC is 18 s behind.
    assert block.TOW == 482_847_000
    assert str(row["t"])[:19] == "2025-05-23 14:07:09"


@needs_samples
def test_sbf_cartesian_is_turned_into_the_local_frame():
    path = SAMPLES / "sbfdata.log"
    fixes = convert([path], "r").run.gnss
    assert fixes.height == len(messages(SBFReader, path, "PVTCartesian")) == 58
    block = messages(SBFReader, path, "PosCovCartesian")[0]
    first = fixes.row(0, named=True)
    trace = first["cov_ee_m2"] + first["cov_nn_m2"] + first["cov_uu_m2"]
    assert trace == pytest.approx(block.Cov_xx + block.Cov_yy + block.Cov_zz)
    assert first["latitude_deg"] == pytest.approx(53.35, abs=0.2)


@needs_samples
@pytest.mark.parametrize("name", ["pygpsdata-BADCK2.log", "pygpsdata-MIXED3BADCK.log", "pygpsdata-BADEOF1.log"])
def test_damaged_logs_give_what_is_whole(name):
    path = SAMPLES / name
    whole = [m for m in messages(UBXReader, path, "NAV-PVT") if m.validDate and m.validTime]
    if whole:
        converted = convert([path], "r")
        assert converted.run.gnss.height >= len(whole)
    else:
        with pytest.raises(InputError, match="no epoch with a time and a position"):
            convert([path], "r")


@needs_samples
@pytest.mark.parametrize("name", ["pygpsdata-ESF.log", "pygpsdata-RXMRAWX.log", "pygpsdata_x5_rawnav.log"])
def test_a_log_without_positions_is_one_error(name):
    with pytest.raises(InputError, match="no epoch with a time and a position"):
        convert([SAMPLES / name], "r")


def test_something_else_is_one_error(tmp_path):
    path = tmp_path / "x.log"
    path.write_bytes(b"hello world" * 30)
    with pytest.raises(InputError, match="no message of a known receiver"):
        convert([path], "r")
    with pytest.raises(InputError, match="does not exist"):
        convert([tmp_path / "none.log"], "r")


def sentence(body: str) -> bytes:
    checksum = 0
    for character in body.encode():
        checksum ^= character
    return f"${body}*{checksum:02X}\r\n".encode()


def test_nmea_takes_date_from_rmc_across_midnight(tmp_path):
    path = tmp_path / "night.nmea"
    path.write_bytes(
        sentence("GPGGA,235959.00,5000.000,N,01400.000,E,2,09,0.9,200.0,M,45.0,M,3.0,0036")
        + sentence("GPRMC,235959.00,A,5000.000,N,01400.000,E,40.0,090.0,310125,,,D")
        + sentence("GPGST,235959.00,1.0,2.0,1.0,90.0,1.0,2.0,3.0")
        + sentence("GPGGA,000000.50,5000.000,N,01400.010,E,1,09,0.9,200.0,M,45.0,M,,")
    )
    fixes = convert([path], "r").run.gnss
    assert [str(t)[:21] for t in fixes["t"]] == [
        "2025-01-31 23:59:59+0",
        "2025-02-01 00:00:00.5",
    ]
    first = fixes.row(0, named=True)
    assert (first["fix"], first["sbas_prn"], first["height_m"]) == ("sbas", 123, 245.0)
    assert first["vel_e_mps"] == pytest.approx(40.0 * 1852 / 3600)
    assert (first["cov_ee_m2"], first["cov_nn_m2"], first["cov_uu_m2"]) == (4.0, 1.0, 9.0)
    assert fixes["fix"].to_list() == ["sbas", "autonomous"]


@pytest.mark.skipif(not INFRABEL.exists(), reason="the sample recordings are not here")
def test_csv_with_a_mapping():
    path = next(INFRABEL.glob("log_28876*.csv"))
    mapping = {
        "topic": path.name,
        "fields": {"latitude_deg": "latitude", "longitude_deg": "longitude"},
        "constants": {"fix": "rtk_fixed"},
        "time": "field:timestamp",
    }
    config = settings_from({"ingest": {"gnss": mapping}}, Configuration, "x")
    fixes = convert([path], "r", config.ingest).run.gnss
    table = pl.read_csv(path)
    assert fixes["latitude_deg"].to_list() == table["latitude"].to_list()
    assert str(fixes["t"][0]).startswith("2022-02-25 09:32:54.4")
    with pytest.raises(InputError, match="no mapping for this file"):
        convert([path], "r")
