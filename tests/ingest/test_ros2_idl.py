"""Schemas in `ros2idl`: read as the `ros2msg` form of the same messages, or refused with a reason."""

from __future__ import annotations

import pytest
from polars.testing import assert_frame_equal
from rosbags.typesys import get_types_from_idl, get_types_from_msg

from datasets.mcap_messages import odometry_topic
from pipeline.export.position_messages import navsatfix_topic
from pipeline.ingest import read_run
from pipeline.ingest.ros2_idl import IdlError, ros2msg_text
from schemas.config import IngestConfig
from schemas.errors import InputError
from tests.ingest import samples
from tests.ingest.samples import DEFINITIONS, channel, message, schema, whole

CONFIG = IngestConfig()


def section(name: str, body: str) -> str:
    """A file of one message, as rosidl writes them."""
    package, _, short = name.split("/")
    return (
        f"{'=' * 80}\nIDL: {name}\n// generated from rosidl_adapter/resource/msg.idl.em\n\n"
        f'#include "std_msgs/msg/Header.idl"\nmodule {package} {{\n  module msg {{\n{body.replace("@", short)}'
        "  };\n};\n"
    )


TIME = section("builtin_interfaces/msg/Time", "struct @ { int32 sec; uint32 nanosec; };\n")
HEADER = section(
    "std_msgs/msg/Header",
    "struct @ { /* when, and\n where */ builtin_interfaces::msg::Time stamp; string frame_id; };\n",
)
STATUS = section(
    "sensor_msgs/msg/NavSatStatus",
    "module @_Constants { const int8 STATUS_NO_FIX = -1; const uint16 SERVICE_GPS = 1; };\n"
    "struct @ { int8 status; uint16 service; };\n",
)
FIX = section(
    "sensor_msgs/msg/NavSatFix",
    "typedef double double__9[9];\nmodule @_Constants { const uint8 COVARIANCE_TYPE_UNKNOWN = 0; };\n"
    '%verbatim (language="comment", text="Altitude [m]. // Positive (above"\n "the ellipsoid")\n'
    "struct @ { std_msgs::msg::Header header; sensor_msgs::msg::NavSatStatus status;\n"
    '%unit (value="deg") double latitude; double longitude, altitude;\n'
    "double__9 position_covariance; uint8 position_covariance_type; };\n".replace("@", "NavSatFix"),
).replace("%", "@")
NAVSATFIX = FIX + STATUS + HEADER + TIME

GEOMETRY = "".join(
    section(f"geometry_msgs/msg/{name}", f"typedef double double__36[36];\nstruct @ {{ {members} }};\n")
    for name, members in (
        ("PoseWithCovariance", "geometry_msgs::msg::Pose pose; double__36 covariance;"),
        ("Pose", "geometry_msgs::msg::Point position; geometry_msgs::msg::Quaternion orientation;"),
        ("Point", "double x; double y; double z;"),
        ("Quaternion", "double x; double y; double z; double w;"),
        ("TwistWithCovariance", "Twist twist; double__36 covariance;"),
        ("Twist", "geometry_msgs::msg::Vector3 linear, angular;"),
        ("Vector3", "double x, y, z;"),
    )
).replace("{ Twist twist", "{ geometry_msgs::msg::Twist twist")
ODOMETRY = (
    section(
        "nav_msgs/msg/Odometry",
        "struct @ { std_msgs::msg::Header header; string child_frame_id;\n"
        "geometry_msgs::msg::PoseWithCovariance pose; geometry_msgs::msg::TwistWithCovariance twist; };\n",
    )
    + GEOMETRY
    + HEADER
    + TIME
)


@pytest.mark.parametrize(
    ("name", "idl"), [("sensor_msgs/msg/NavSatFix", NAVSATFIX), ("nav_msgs/msg/Odometry", ODOMETRY)]
)
def test_the_layout_is_that_of_the_message_definition(name, idl):
    translated = get_types_from_msg(ros2msg_text(name, idl), name)
    written = get_types_from_msg(DEFINITIONS[name], name)
    assert {kind: fields for kind, (_, fields) in translated.items()} == {
        kind: fields for kind, (_, fields) in written.items()
    }


def test_another_parser_of_idl_finds_the_same_fields():
    idl = (
        "module a { module msg { const unsigned long MOST = 4; typedef sequence<octet, 7> bytes_7;\n"
        "struct Part { boolean on; string w; };\n"
        "struct Whole { long long a; unsigned long long b; unsigned short c; short d; long e; float f; char g;\n"
        "string<9> h; sequence<string> i; sequence<a::msg::Part, 3> j; bytes_7 k; double l[2]; uint8 m, n; };\n};};\n"
    )
    expected = get_types_from_idl(idl)
    found = get_types_from_msg(ros2msg_text("a/msg/Whole", idl), "a/msg/Whole")
    assert list(found) == ["a/msg/Whole", "a/msg/Part"]
    for name, (_, fields) in found.items():
        # `octet` and `char` are one byte under either name.
        plain = str(expected[name][1]).replace("'char'", "'uint8'").replace("'octet'", "'byte'")
        assert str(fields) == plain


def log(encoding: str, fix: str, odometry: str) -> bytes:
    run = samples.run()
    positions = navsatfix_topic("/fix", run.gnss, "gps").messages
    speeds = odometry_topic(run.odometer).messages  # type: ignore[arg-type]
    return whole(
        schema(1, "sensor_msgs/msg/NavSatFix", encoding, fix.encode()),
        schema(2, "nav_msgs/msg/Odometry", encoding, odometry.encode()),
        channel(1, 1, "/fix", "cdr"),
        channel(2, 2, "/odom", "cdr"),
        *(message(payload, channel_id=1) for payload in positions),
        *(message(payload, channel_id=2) for payload in speeds),
    )


def test_a_log_is_read_alike_in_both_forms(tmp_path):
    plain = log("ros2msg", *(DEFINITIONS[name] for name in ("sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry")))
    expected = read_run(samples.save(tmp_path, plain), CONFIG)
    found = read_run(samples.save(tmp_path, log("ros2idl", NAVSATFIX, ODOMETRY)), CONFIG)
    assert_frame_equal(found.gnss, expected.gnss)
    assert_frame_equal(found.odometer, expected.odometer)
    assert found.notes.slow_path_messages == expected.notes.slow_path_messages == 0
    windows = read_run(samples.save(tmp_path, log("ros2idl", NAVSATFIX.replace("\n", "\r\n"), ODOMETRY)), CONFIG)
    assert_frame_equal(windows.gnss, expected.gnss)


@pytest.mark.parametrize(
    ("idl", "reason"),
    [
        ("module a { module msg { union U switch (long) { case 1: long x; }; };};", "'union'"),
        ("module a { module msg { struct Whole { map<long, long> x; }; };};", "'map' is not known"),
        ("module a { module msg { struct Whole { long double x; }; };};", "';' was expected"),
        ("module a { module msg { typedef long l3[3]; struct Whole { sequence<l3> x; }; };};", "array of arrays"),
        ("module a { module msg { struct Whole { long x", "ends too early"),
        ("module a { module msg { struct Whole { long x[N]; }; };};", "'N' where a length"),
        ("module a { module msg { struct Other { long x; }; };};", "no definition of a/msg/Whole"),
        ("", "no definition of a/msg/Whole"),
        ("float64 x\n", "'float64' where a definition"),
    ],
)
def test_what_is_not_understood_is_refused(idl, reason):
    with pytest.raises(IdlError, match=reason):
        ros2msg_text("a/msg/Whole", idl)


def test_a_log_whose_idl_is_not_understood_says_so(tmp_path):
    content = log("ros2idl", NAVSATFIX.replace("double longitude, altitude", "map<long, long> longitude"), ODOMETRY)
    with pytest.raises(InputError, match=r"topic /fix: has a schema that cannot be parsed: the type 'map'"):
        read_run(samples.save(tmp_path, content), CONFIG)
