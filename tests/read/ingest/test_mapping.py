"""Logs of other recorders: configured topics, drivers' messages, time scales, several solutions."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime

import polars as pl
import pytest
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic

from pipeline.read.ingest import read_run
from pipeline.read.ingest.describe import describe_log
from pipeline.read.ingest.timescale import utc_from_gps
from pipeline.show.export.messages import descriptor, message_class
from pipeline.show.export.position_messages import LOCATION_FIELDS, LOCATION_FIX
from pipeline.stages.clean.clean import clean
from schemas.config import IngestConfig, settings_from
from schemas.errors import ConfigError, InputError
from tests.read.ingest import samples

STAMP = {"sec": 1_700_000_000, "nanosec": 250_000_000}
STAMP_NS = 1_700_000_000_250_000_000
# Logged later than stamped: a wrong path of a stamp, for which the log time stands in, does not pass.
LOG_NS = STAMP_NS + 7_000_000_000
HEADER_TEXT = (
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    "================\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


def config(**streams: object) -> IngestConfig:
    return settings_from(streams, IngestConfig, "test")


def json_log(tmp_path, topics: dict[str, list[dict]], schema: str = "acme.Thing", of: Mapping[str, str] | None = None):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for topic, messages in topics.items():
        schema_id = writer.register_schema((of or {}).get(topic, schema), "jsonschema", b"{}")
        channel_id = writer.register_channel(topic, "json", schema_id)
        for number, message in enumerate(messages):
            writer.add_message(channel_id, LOG_NS + number, json.dumps(message).encode(), LOG_NS + 1000 + number)
    writer.finish()
    return samples.save(tmp_path, stream.getvalue())


def ros_log(tmp_path, *topics: tuple[str, str, str, list[dict]]):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for topic, name, text, messages in topics:
        schema_id = writer.register_schema(name, "ros2msg", text.encode())
        channel_id = writer.register_channel(topic, "cdr", schema_id)
        encode = serialize_dynamic(name, text)[name]
        for number, message in enumerate(messages):
            writer.add_message(channel_id, LOG_NS + number, encode(message), LOG_NS)
    writer.finish()
    return samples.save(tmp_path, stream.getvalue())


def row(path, settings: IngestConfig | None = None, index: int = 0) -> dict[str, object]:
    log = read_run(path, settings or IngestConfig())
    return log.gnss.with_columns(pl.col("t").to_physical()).row(index, named=True)


MESSAGES = [{"lat": 50.5, "lon": 4.5, "alt_cm": 12_300, "q": 4, "at": 1_400_000_000_500, "v": 36.0}]


def test_fields_factors_codes_and_gps_time(tmp_path):
    path = json_log(tmp_path, {"/acme": MESSAGES})
    gnss = {
        "topic": "/acme",
        "fields": {"latitude_deg": "lat", "longitude_deg": "lon", "height_m": "alt_cm", "fix": "q"},
        "factors": {"height_m": 0.01, "t": 1e-3},
        "fix_codes": {"4": "rtk_fixed"},
        "time": "field:at",
        "time_scale": "gps",
        "time_epoch": "gps",
        "constants": {"satellites": 9},
    }
    speed = {"topic": "/acme", "fields": {"speed_mps": "v"}, "factors": {"speed_mps": 1 / 3.6}, "time": "publish"}
    found = row(path, config(gnss=gnss, odometer=speed))
    assert (found["latitude_deg"], found["height_m"], found["fix"], found["satellites"]) == (
        50.5,
        123.0,
        "rtk_fixed",
        9,
    )
    since_1980 = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
    assert found["t"] == round((since_1980 + 1_400_000_000.5 - 18) * 1e9)
    odometer = read_run(path, config(gnss=gnss, odometer=speed)).odometer
    assert odometer["speed_mps"].to_list() == [36.0 * (1 / 3.6)]
    assert odometer["t"].to_physical().to_list() == [LOG_NS + 1000]


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        ({"sec": 5, "nsec": 7}, 5_000_000_007),
        ({"sec": 5, "nanosec": 7}, 5_000_000_007),
        ({"seconds": 5, "nanos": 7}, 5_000_000_007),
        (5_000_000_007, 5_000_000_007),
        (5.25, 5_250_000_000),
        ("1970-01-01T00:00:05.000000007Z", 5_000_000_007),
        ("1970-01-01T01:00:05+01:00", 5_000_000_000),
    ],
)
def test_forms_of_stamps(tmp_path, stamp, expected):
    path = json_log(tmp_path, {"/acme": [{"lat": 50.5, "lon": 4.5, "when": stamp}]})
    fields = {"latitude_deg": "lat", "longitude_deg": "lon"}
    assert row(path, config(gnss={"topic": "/acme", "fields": fields, "time": "field:when"}))["t"] == expected
    assert row(path, config(gnss={"topic": "/acme", "fields": fields}))["t"] == LOG_NS
    assert row(path, config(gnss={"topic": "/acme", "fields": {**fields, "t": "when"}}))["t"] == expected


@pytest.mark.parametrize(("stamp", "kind"), [(True, "flag"), ({"sec": None, "nsec": 7}, "null")])
def test_what_is_no_stamp_is_no_time(tmp_path, stamp, kind):
    place = {"lat": 50.5, "lon": 4.5}
    path = json_log(tmp_path, {"/acme": [{**place, "stamp": stamp}, {**place, "stamp": stamp}]})
    gnss = {"topic": "/acme", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}}
    assert row(path, config(gnss=gnss))["t"] == LOG_NS
    with pytest.raises(InputError, match=f"/acme: field stamp: is not a time; found {kind}"):
        read_run(path, config(gnss={**gnss, "time": "field:stamp"}))


def test_own_topics_without_own_schema(tmp_path):
    message = {"t": {"sec": 5, "nsec": 7}, "latitude_deg": 50, "longitude_deg": 4.0, "fix": "sbas", "solution": "x"}
    path = json_log(tmp_path, {"/gnss": [message], "/odometer": [{"t": 5, "distance_m": 3}]}, schema="whatever")
    assert (row(path)["t"], row(path)["latitude_deg"], row(path)["solution"]) == (5_000_000_007, 50.0, "x")
    assert read_run(path, IngestConfig()).odometer["distance_m"].to_list() == [3.0]


def test_what_the_first_message_lacks_is_read_of_the_others(tmp_path):
    place = {"latitude_deg": 50.0, "longitude_deg": 4.0, "fix": "sbas"}
    full = {"t": {"sec": 6, "nsec": 0}, **place, "solution": "b", "hpl_m": 7.5, "satellites": 9}
    path = json_log(tmp_path, {"/gnss": [{"t": {"sec": 5, "nsec": 0}, **place}, full]}, schema="balise.Gnss")
    columns = ("t", "solution", "hpl_m", "satellites")
    assert [row(path)[name] for name in columns] == [5_000_000_000, "primary", None, None]
    assert [row(path, index=1)[name] for name in columns] == [6_000_000_000, "b", 7.5, 9]
    path = json_log(tmp_path, {"/gnss": [{**place, "t": None}, full]}, schema="balise.Gnss")
    with pytest.raises(InputError, match="column t: has missing values; found null in row 0"):  # not the log time
        read_run(path, IngestConfig())


def test_a_covariance_that_the_first_messages_lack(tmp_path):
    kind = message_class(LOCATION_FIX, LOCATION_FIELDS)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema(LOCATION_FIX, "protobuf", descriptor(LOCATION_FIX, LOCATION_FIELDS))
    channel = writer.register_channel("/fix", "protobuf", schema)
    for number, covariance in enumerate(([], [4.0], [float(place) for place in range(9)])):
        message = kind(latitude=50.0, longitude=4.0, position_covariance=covariance, position_covariance_type=3)
        message.timestamp.seconds = 5 + number
        writer.add_message(channel, STAMP_NS + number, message.SerializeToString(), STAMP_NS)
    writer.finish()
    gnss = read_run(samples.save(tmp_path, stream.getvalue()), IngestConfig()).gnss
    assert gnss["cov_ee_m2"].to_list() == [None, 4.0, 0.0]
    assert gnss["cov_nu_m2"].to_list() == [None, None, 5.0]


def test_elements_of_a_sequence_that_the_first_message_lacks(tmp_path):
    definition = "float64 lat\nfloat64 lon\nfloat64[] sigma\nfloat64[2] rest\n"
    messages = [{"lat": 50.5, "lon": 4.5, "sigma": sigma, "rest": [1.0, 2.0]} for sigma in ([], [0.1, 0.2])]
    path = ros_log(tmp_path, ("/acme", "acme/msg/Fix", definition, messages))
    fields = {"latitude_deg": "lat", "longitude_deg": "lon"}
    mapped = config(gnss={"topic": "/acme", "fields": fields | {"hpl_m": "sigma[1]", "vpl_m": "rest[0]"}})
    assert [(row(path, mapped, index)["hpl_m"], row(path, mapped, index)["vpl_m"]) for index in (0, 1)] == [
        (None, 1.0),
        (0.2, 1.0),
    ]
    for absent in ("sigma", "sigma[1].x", "rest", "rest[2]", "lat[0]"):
        wrong = config(gnss={"topic": "/acme", "fields": fields | {"hpl_m": absent}})
        with pytest.raises(InputError, match="has no field"):
            read_run(path, wrong)


def test_mistakes_in_the_configuration(tmp_path):
    path = json_log(tmp_path, {"/acme": MESSAGES})
    fields = {"latitude_deg": "lat", "longitude_deg": "lon"}
    with pytest.raises(InputError, match="/other: is configured for gnss but has no messages; found /acme"):
        read_run(path, config(gnss={"topic": "/other", "fields": fields}))
    with pytest.raises(InputError, match="has no field latitude"):
        read_run(path, config(gnss={"topic": "/acme", "fields": {**fields, "latitude_deg": "latitude"}}))
    with pytest.raises(InputError, match="has no field when for column t"):
        read_run(path, config(gnss={"topic": "/acme", "fields": fields, "time": "field:when"}))
    with pytest.raises(ConfigError, match="found hpl"):
        read_run(path, config(gnss={"topic": "/acme", "fields": {**fields, "hpl": "q"}}))
    with pytest.raises(InputError, match="/acme"):
        read_run(path, config(gnss={"topic": "/acme", "fields": {**fields, "fix": "q"}}))
    both = [{"topic": topic, "fields": fields} for topic in ("/a", "/b")]
    two = json_log(tmp_path, {"/a": MESSAGES, "/b": MESSAGES})
    with pytest.raises(ConfigError, match="same solution"):
        read_run(two, config(gnss=both))


def test_solutions_are_named_after_their_topics(tmp_path):
    fix = {"timestamp": {"sec": 5, "nsec": 0}, "latitude": 50.0, "longitude": 4.0, "altitude": 1.0}
    one = json_log(tmp_path, {"/rx/egnos": [fix]}, "foxglove.LocationFix")
    assert read_run(one, IngestConfig()).solutions() == ["primary"]
    two = json_log(tmp_path, {"/rx/egnos": [fix, fix], "/gps": [fix]}, "foxglove.LocationFix")
    assert read_run(two, IngestConfig()).solutions() == ["gps", "rx_egnos"]


@pytest.mark.parametrize("schema", ["geometry_msgs/msg/TwistStamped", "geometry_msgs/TwistStamped"])
def test_a_twist_is_an_odometer_where_a_mapping_names_it_only(tmp_path, schema):
    speed = {"header": {"stamp": STAMP, "frame_id": ""}, "twist": {"linear": {"x": 1.0}}}
    fix = {"timestamp": {"sec": 5, "nsec": 0}, "latitude": 50.0, "longitude": 4.0, "altitude": 1.0}
    path = json_log(tmp_path, {"/a": [speed], "/b": [speed], "/gps": [fix]}, schema, {"/gps": "foxglove.LocationFix"})
    alone = read_run(path, IngestConfig())
    assert alone.odometer is None
    assert alone.notes.skipped_topics == (f"/a ({schema})", f"/b ({schema})")
    draft = describe_log(path, IngestConfig()).starting_config
    assert '# topic = "/a"' in draft
    assert "\n[[" not in draft
    named = read_run(path, config(odometer={"topic": "/a"}))
    assert named.odometer is not None
    assert named.odometer["speed_mps"].to_list() == [1.0]
    assert named.odometer["origin"].to_list() == [None]
    with pytest.raises(InputError, match="several topics could be the odometer; found /a, /b"):
        read_run(path, config(odometer=[{"topic": "/a"}, {"topic": "/b"}]))


def test_leap_seconds():
    def utc(*calendar: int) -> int:
        return int(datetime(*calendar, tzinfo=UTC).timestamp()) * 10**9

    after_leap = utc(2017, 1, 1, 0, 0, 18)
    stamps = pl.Series([utc(1980, 6, 1), utc(2005, 12, 31), utc(2015, 6, 30), after_leap, utc(2024, 1, 1)])
    shifts = (stamps - pl.Series(utc_from_gps(stamps.to_numpy()))).to_list()
    assert shifts == [0, 13 * 10**9, 16 * 10**9, 18 * 10**9, 18 * 10**9]
    assert utc_from_gps(pl.Series([utc(2017, 1, 1, 0, 0, 17)]).to_numpy())[0] == utc(2017, 1, 1)


PVT = (
    "std_msgs/Header header\nBlockHeader block_header\nuint8 mode\nuint8 error\nfloat64 latitude\nfloat64 longitude\n"
    "float64 height\nfloat32 undulation\nfloat32 vn\nfloat32 ve\nfloat32 vu\nfloat32 cog\nuint8 nr_sv\n"
    "uint16 reference_id\nuint16 mean_corr_age\n================\n" + HEADER_TEXT + "================\n"
    "MSG: septentrio_gnss_driver/BlockHeader\nuint8 sync_1 36\nuint32 tow\nuint16 wnc\n"
)
POS_COV = (
    "std_msgs/Header header\nBlockHeader block_header\nuint8 mode\nuint8 error\n"
    + "".join(f"float32 cov_{name}\n" for name in ("latlat", "lonlon", "hgthgt", "latlon", "lathgt", "lonhgt"))
    + "================\n"
    + HEADER_TEXT
    + "================\n"
    "MSG: septentrio_gnss_driver/BlockHeader\nuint8 sync_1 36\nuint32 tow\nuint16 wnc\n"
)


def test_septentrio(tmp_path):
    def head(tow: int) -> dict:
        return {"header": {"stamp": STAMP, "frame_id": "gnss"}, "block_header": {"tow": tow, "wnc": 2300}}

    positions = [
        {**head(1000), "mode": 6, "error": 0, "latitude": math.radians(50.5), "longitude": math.radians(4.5),
         "height": 120.0, "vn": 1.5, "ve": 2.5, "vu": -0.5, "nr_sv": 9, "reference_id": 123, "mean_corr_age": 250},
        {**head(1100), "mode": 0, "error": 1, "latitude": -2e10, "longitude": -2e10, "height": -2e10, "vn": -2e10,
         "ve": -2e10, "vu": -2e10, "nr_sv": 255, "reference_id": 65535, "mean_corr_age": 65535},
    ]  # fmt: skip
    horizontal = {"cov_latlat": 4.0, "cov_lonlon": 1.0, "cov_latlon": 0.5}
    covariances = [{**head(1000), **horizontal, "cov_hgthgt": 9.0, "cov_lathgt": 0.25, "cov_lonhgt": -0.75}]
    name = "septentrio_gnss_driver/msg/"
    path = ros_log(
        tmp_path,
        ("/rx/pvtgeodetic", f"{name}PVTGeodetic", PVT, positions),
        ("/rx/poscovgeodetic", f"{name}PosCovGeodetic", POS_COV, covariances),
    )
    first, second = row(path), row(path, index=1)
    assert first["t"] == STAMP_NS
    assert first["latitude_deg"] == pytest.approx(50.5, abs=1e-12)
    assert (first["cov_nn_m2"], first["cov_ee_m2"], first["cov_en_m2"], first["cov_uu_m2"]) == (4.0, 1.0, 0.5, 9.0)
    assert (first["cov_nu_m2"], first["cov_eu_m2"]) == (0.25, -0.75)
    assert (first["vel_e_mps"], first["vel_n_mps"], first["vel_u_mps"]) == (2.5, 1.5, -0.5)
    assert (first["fix"], first["satellites"], first["sbas_prn"], first["sbas_age_s"]) == ("sbas", 9, 123, 2.5)
    assert first["solution"] == "primary"
    unknown = {name for name, value in second.items() if value is None}
    assert {"latitude_deg", "height_m", "vel_e_mps", "cov_ee_m2", "satellites", "sbas_prn"} <= unknown
    assert second["fix"] == "none"


def test_ublox_with_satellites(tmp_path):
    pvt_text = (
        "std_msgs/Header header\nGpsFix gps_fix\nbool gnss_fix_ok\nbool diff_soln\nCarrSoln carr_soln\nuint8 num_sv\n"
        "int32 lon\nint32 lat\nint32 height\nuint32 h_acc\nuint32 v_acc\nint32 vel_n\nint32 vel_e\nint32 vel_d\n"
        "================\n" + HEADER_TEXT + "================\nMSG: ublox_ubx_msgs/GpsFix\nuint8 fix_type\n"
        "================\nMSG: ublox_ubx_msgs/CarrSoln\nuint8 status\n"
    )
    sat_text = (
        "std_msgs/Header header\nuint32 itow\nuint8 num_svs\nSatInfo[] sv_info\n================\n"
        + HEADER_TEXT
        + "================\nMSG: ublox_ubx_msgs/SatInfo\nuint8 gnss_id\nuint8 sv_id\nint8 elev\nint16 azim\n"
        "int16 pr_res\nSatFlags flags\n================\nMSG: ublox_ubx_msgs/SatFlags\nbool sv_used\n"
    )
    head = {"header": {"stamp": STAMP, "frame_id": "gps"}}
    pvt = {
        **head, "gps_fix": {"fix_type": 3}, "gnss_fix_ok": True, "diff_soln": True, "carr_soln": {"status": 0},
        "num_sv": 11, "lon": 45_000_000, "lat": 505_000_000, "height": 120_500, "h_acc": 2000, "v_acc": 3000,
        "vel_n": 1500, "vel_e": 2500, "vel_d": 500,
    }  # fmt: skip
    satellites = [
        {"gnss_id": 0, "sv_id": 8, "elev": 45, "azim": 190, "pr_res": -12, "flags": {"sv_used": True}},
        {"gnss_id": 1, "sv_id": 123, "elev": 30, "azim": 170, "pr_res": 5, "flags": {"sv_used": False}},
    ]
    path = ros_log(
        tmp_path,
        ("/ubx_nav_pvt", "ublox_ubx_msgs/msg/UBXNavPVT", pvt_text, [pvt, pvt | {"gnss_fix_ok": False}]),
        (
            "/ubx_nav_sat",
            "ublox_ubx_msgs/msg/UBXNavSat",
            sat_text,
            [head | {"sv_info": []}, head | {"sv_info": satellites}],
        ),
    )
    found = row(path)
    assert (found["latitude_deg"], found["longitude_deg"], found["height_m"]) == (50.5, 4.5, 120.5)
    assert (found["cov_ee_m2"], found["cov_nn_m2"], found["cov_uu_m2"], found["cov_en_m2"]) == (2.0, 2.0, 9.0, 0.0)
    assert (found["vel_e_mps"], found["vel_n_mps"], found["vel_u_mps"]) == (2.5, 1.5, -0.5)
    assert (found["fix"], row(path, index=1)["fix"]) == ("differential", "none")
    tracked = read_run(path, IngestConfig()).satellites
    assert tracked["sv"].to_list() == ["G08", "S23"]
    assert tracked["residual_m"].to_list() == pytest.approx([-1.2, 0.5])
    assert tracked["used"].to_list() == [True, False]
    assert tracked["azimuth_deg"].to_list() == [190.0, 170.0]


def test_ublox_calendar(tmp_path):
    text = (
        "uint32 i_tow\nuint16 year\nuint8 month\nuint8 day\nuint8 hour\nuint8 min\nuint8 sec\nuint8 valid\nint32 nano\n"
        "uint8 fix_type\nuint8 flags\nuint8 num_sv\nint32 lon\nint32 lat\nint32 height\nuint32 h_acc\nuint32 v_acc\n"
        "int32 vel_n\nint32 vel_e\nint32 vel_d\n"
    )
    calendar = {"year": 2023, "month": 11, "day": 14, "hour": 22, "min": 13, "sec": 20, "nano": -1500}
    message = calendar | {
        "valid": 7,
        "fix_type": 3,
        "flags": 1 | 2 << 6,
        "num_sv": 5,
        "lat": 505_000_000,
        "lon": 45_000_000,
    }
    path = ros_log(tmp_path, ("/navpvt", "ublox_msgs/msg/NavPVT", text, [message]))
    assert (row(path)["t"], row(path)["fix"]) == (1_700_000_000 * 10**9 - 1500, "rtk_fixed")
    early = message | {"valid": 1, "year": 2016}
    log = read_run(ros_log(tmp_path, ("/navpvt", "ublox_msgs/msg/NavPVT", text, [early, message])), IngestConfig())
    assert log.gnss.height == 1
    assert log.notes.skipped_topics == ("/navpvt: 1 messages without a valid time",)


BESTPOS = (
    "std_msgs/Header header\nSolutionStatus sol_status\nPositionOrVelocityType pos_type\nfloat64 lat\nfloat64 lon\n"
    "float64 hgt\nfloat32 undulation\nfloat32 lat_stdev\nfloat32 lon_stdev\nfloat32 hgt_stdev\nuint8 num_sol_svs\n"
    "================\n" + HEADER_TEXT + "================\nMSG: novatel_oem7_msgs/SolutionStatus\nuint32 status\n"
    "================\nMSG: novatel_oem7_msgs/PositionOrVelocityType\nuint32 type\n"
)


def bestpos(kind: int, status: int = 0) -> dict:
    return {
        "header": {"stamp": STAMP, "frame_id": ""},
        "sol_status": {"status": status}, "pos_type": {"type": kind}, "lat": 50.5, "lon": 4.5, "hgt": 75.0,
        "undulation": 45.5, "lat_stdev": 2.0, "lon_stdev": 1.0, "hgt_stdev": 3.0, "num_sol_svs": 8,
    }  # fmt: skip


def test_kinds_of_novatel_solutions(tmp_path):
    # Numbers and names as the vendor's message database has them: SolType, SolStatus.
    kinds = {
        "none": (0, 1, 3, 8, 81), "autonomous": (2, 16, 53), "differential": (17, 20, 54, 64, 69, 74, 76, 78, 79, 80),
        "sbas": (18, 52), "estimated": (19,), "rtk_float": (32, 33, 34, 35, 55), "rtk_fixed": (47, 48, 49, 50, 51, 56),
    }  # fmt: skip
    messages = [bestpos(code) for codes in kinds.values() for code in codes] + [bestpos(50, status=1)]
    path = ros_log(tmp_path, ("/bestpos", "novatel_oem7_msgs/msg/BESTPOS", BESTPOS, messages))
    found = read_run(path, IngestConfig()).gnss["fix"].to_list()
    assert found == [kind for kind, codes in kinds.items() for _ in codes] + ["none"]


def test_novatel_and_gpsfix(tmp_path):
    head = {"header": {"stamp": STAMP, "frame_id": ""}}
    path = ros_log(tmp_path, ("/novatel/bestpos", "novatel_oem7_msgs/msg/BESTPOS", BESTPOS, [bestpos(18)]))
    found = row(path)
    assert (found["height_m"], found["cov_nn_m2"], found["cov_ee_m2"], found["fix"]) == (120.5, 4.0, 1.0, "sbas")
    gps_fix = (
        "std_msgs/Header header\nGPSStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64 track\nfloat64 speed\nfloat64 climb\nfloat64[9] position_covariance\n"
        "uint8 position_covariance_type\n================\n"
        + HEADER_TEXT
        + "================\nMSG: gps_msgs/GPSStatus\nstd_msgs/Header header\nuint16 satellites_used\n"
        "int32[] satellite_used_prn\nint16 status\n"
    )
    message = head | {
        "status": {"satellites_used": 3, "satellite_used_prn": [3, 7, 9], "status": 33}, "latitude": 50.5,
        "longitude": 4.5, "altitude": 120.0, "track": 90.0, "speed": 20.0, "climb": 0.25,
        "position_covariance": [1.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0], "position_covariance_type": 2,
    }  # fmt: skip
    other = message | {"status": {"satellites_used": 1, "satellite_used_prn": [5], "status": -1}, "latitude": math.nan}
    path = ros_log(tmp_path, ("/fix", "gps_msgs/msg/GPSFix", gps_fix, [message, other, message]))
    found = row(path)
    assert (found["vel_e_mps"], found["vel_u_mps"], found["fix"], found["satellites"]) == (20.0, 0.25, "sbas", 3)
    assert found["vel_n_mps"] == pytest.approx(0.0, abs=1e-12)
    assert (row(path, index=1)["fix"], row(path, index=1)["latitude_deg"]) == ("none", None)
    assert read_run(path, IngestConfig()).notes.slow_path_messages == 0


def test_nan_is_null_only_where_there_is_no_fix(tmp_path):
    from tests.read.ingest.samples import DEFINITIONS

    name = "sensor_msgs/msg/NavSatFix"
    message = {"header": {"stamp": STAMP, "frame_id": ""}, "status": {"status": -1}, "latitude": math.nan,
               "longitude": math.nan, "altitude": math.nan, "position_covariance": [0.0] * 9}  # fmt: skip
    path = ros_log(tmp_path, ("/fix", name, DEFINITIONS[name], [message]))
    assert row(path)["latitude_deg"] is None
    path = ros_log(tmp_path, ("/fix", name, DEFINITIONS[name], [message | {"status": {"status": 0}}]))
    with pytest.raises(InputError, match="column latitude_deg: has values that are not finite"):
        read_run(path, IngestConfig())


def test_describe_tells_what_is_mapped_and_what_is_left_over(tmp_path):
    path = json_log(tmp_path, {"/acme": MESSAGES * 5, "/imu": [{"ax": 1.0}]})
    description = describe_log(path, IngestConfig())
    assert "holds no GNSS stream" in description.problems[0]
    assert description.left_over == ("/acme", "/imu")
    assert {topic.topic: topic.messages for topic in description.topics} == {"/acme": 5, "/imu": 1}
    import tomllib

    suggested = settings_from(tomllib.loads(description.starting_config)["ingest"], IngestConfig, "suggested")
    assert suggested.gnss[0].fields == {"latitude_deg": "lat", "longitude_deg": "lon"}
    again = describe_log(path, suggested)
    assert again.problems == ()
    assert again.left_over == ("/imu",)
    assert again.topics[0].mapping["latitude_deg"] == "lat"
    assert again.streams[0].fix_mix == {"autonomous": 5}


def test_describe_measures_rates_and_gaps(tmp_path):
    run = samples.run()
    kept = run.gnss.with_row_index().filter((pl.col("index") < 10) | (pl.col("index") >= 20)).drop("index")
    path = samples.save(tmp_path, samples.log_bytes(run.with_streams(gnss=kept)))
    summary = next(stream for stream in describe_log(path, IngestConfig()).streams if stream.stream == "gnss")
    assert (summary.rate_hz, summary.gaps, summary.longest_gap_s, summary.rows) == (10.0, 1, 1.1, 30)
    folder = tmp_path / "parquet"
    folder.mkdir()
    kept.write_parquet(folder / "gnss.parquet")
    assert describe_log(folder, IngestConfig()).streams[0].gaps == 1
    cut = samples.save(tmp_path, path.read_bytes()[:4000], "cut.mcap")
    assert "cut off" in describe_log(cut, IngestConfig()).notes.damage


def test_described_stamps_are_counted_as_the_replay_counts_them(tmp_path):
    """A row that stands again later is a duplicate, and two late rows are two, however far back they belong."""
    gnss = samples.run().gnss
    mixed = pl.concat([gnss[:12], gnss[10:11], gnss[20:], gnss[12:14]])
    folder = tmp_path / "parquet"
    folder.mkdir()
    mixed.write_parquet(folder / "gnss.parquet")
    (found,) = describe_log(folder, IngestConfig()).streams
    assert (found.duplicates, found.out_of_order, found.rows) == (1, 3, mixed.height)
    (counts,) = clean(read_run(folder, IngestConfig()))[1].solutions.values()
    assert (counts.duplicates, counts.out_of_order) == (1, 3)


@pytest.mark.parametrize(
    ("messages", "lines", "expected"),
    [
        ([{"v": 1.0}, {"v": 2.0}], {"origin": "wheel"}, ["wheel", "wheel"]),
        ([{"v": 1.0}, {"v": 2.0}], {}, [None, None]),
        # What a row says of itself stands before the mapping.
        ([{"v": 1.0, "from": "gnss"}, {"v": 2.0}], {"origin": "wheel", "named": "from"}, ["gnss", "wheel"]),
    ],
)
def test_an_origin_is_that_of_the_rows_else_that_of_the_mapping(tmp_path, messages, lines, expected):
    places = [{"lat": 50.0, "lon": 14.0}, {"lat": 50.0, "lon": 14.0}]
    log = json_log(tmp_path, {"/gps": places, "/tacho": messages})
    fields = {"speed_mps": "v"} | ({"origin": lines.pop("named")} if "named" in lines else {})
    mapping = {"topic": "/tacho", "fields": fields, "time": "log", **lines}
    gnss = {"topic": "/gps", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}, "time": "log"}
    run = read_run(log, config(gnss=[gnss], odometer=[mapping]))
    assert run.odometer is not None
    assert run.odometer["origin"].to_list() == expected


@pytest.mark.parametrize("topic", ["/fix_velocity", "/gps/fix_velocity"])
def test_the_velocity_of_a_receiver_is_of_the_gnss_whatever_is_declared(tmp_path, topic):
    log = json_log(tmp_path, {"/gps": [{"lat": 50.0, "lon": 14.0}], topic: [{"v": 1.0}]})
    mapping = {"topic": topic, "fields": {"speed_mps": "v"}, "time": "log", "origin": "wheel"}
    gnss = {"topic": "/gps", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}, "time": "log"}
    run = read_run(log, config(gnss=[gnss], odometer=[mapping]))
    assert run.odometer is not None
    assert run.odometer["origin"].to_list() == ["gnss"]


def test_only_an_odometer_has_an_origin(tmp_path):
    log = json_log(tmp_path, {"/gps": [{"lat": 50.0, "lon": 14.0}]})
    gnss = {"topic": "/gps", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}, "origin": "gnss"}
    with pytest.raises(ConfigError, match="which only an odometer has"):
        read_run(log, config(gnss=[gnss | {"time": "log"}]))
