"""Every schema that is read by name is read from a message here: a wrong path of a field does not pass."""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path

import pytest

from pipeline.read.ingest import read_run
from pipeline.read.ingest.recipe import Recipe
from pipeline.read.ingest.recipes import BY_SCHEMA, OWN_PREFIX
from schemas.config import IngestConfig
from tests.read.ingest.test_mapping import HEADER_TEXT, STAMP, STAMP_NS, json_log, ros_log, row


def texts_of_tests() -> set[str]:
    """All texts in the tests of this folder and of the receivers: names of schemas, definitions, keys of messages."""
    folders = (Path(__file__).parent, Path(__file__).parents[2] / "make" / "receivers")
    texts: set[str] = set()
    for file in (file for folder in folders for file in folder.glob("*.py")):
        nodes = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        texts |= {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return texts


def fields_of(recipe: Recipe) -> set[str]:
    """Names of all fields on the paths that a recipe reads."""
    columns = (path for column in recipe.columns for path in recipe.fields_of(column))
    paths = [*columns, *recipe.stamps.values(), *recipe.key, *recipe.whole, *recipe.types, recipe.rows]
    return {name for path in paths for name in re.findall(r"[A-Za-z_]\w*", path)}


def test_every_field_of_a_recipe_stands_in_a_message_of_a_test() -> None:
    """So a field that no driver writes does not pass, whether or not a test asks for its column."""
    words = {word for text in texts_of_tests() for word in re.findall(r"\w+", text)}
    recipes = [recipe for name, some in BY_SCHEMA.items() if not name.startswith(OWN_PREFIX) for recipe in some]
    assert {field for recipe in recipes for field in fields_of(recipe)} - words == set()


def test_every_schema_has_a_test_of_its_messages() -> None:
    """Its name stands in a test of this folder, or of the receivers."""
    named = texts_of_tests()
    built = {f"septentrio_gnss_driver/msg/{name}" for name in ("PVTGeodetic", "PosCovGeodetic")}
    assert {name for name in BY_SCHEMA if not name.startswith(OWN_PREFIX)} - built - named == set()


def test_satellites_of_ublox_msgs(tmp_path: Path) -> None:
    """The UBX message as it is: flags in one number, tenths of a metre, PRN of SBAS above 100; no stamp of its own."""
    text = (
        "uint32 i_tow\nuint8 version\nuint8 num_svs\nuint8[2] reserved0\nNavSATSV[] sv\n================\n"
        "MSG: ublox_msgs/NavSATSV\nuint8 gnss_id\nuint8 sv_id\nuint8 cno\nint8 elev\nint16 azim\nint16 pr_res\n"
        "uint32 flags\n"
    )
    satellites = [
        {"gnss_id": 0, "sv_id": 8, "cno": 40, "elev": 45, "azim": 190, "pr_res": -12, "flags": 8},
        {"gnss_id": 1, "sv_id": 123, "cno": 35, "elev": 30, "azim": 170, "pr_res": 5, "flags": 7},
    ]
    position = {"timestamp": {"sec": 5, "nsec": 0}, "latitude": 50.0, "longitude": 4.0, "altitude": 1.0}
    message = {"i_tow": 1, "version": 1, "num_svs": 2, "reserved0": [0, 0], "sv": satellites}
    fix_text = (
        "builtin_interfaces/Time timestamp\nstring frame_id\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64[9] position_covariance\nuint8 position_covariance_type\n================\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    fix = position | {"timestamp": STAMP, "frame_id": "", "position_covariance": [4.0, *[0.0] * 8]}
    path = ros_log(
        tmp_path,
        ("/navsat", "ublox_msgs/msg/NavSAT", text, [message]),
        ("/fix", "foxglove_msgs/msg/LocationFix", fix_text, [fix | {"position_covariance_type": 2}]),
    )
    found = read_run(path, IngestConfig())
    assert found.satellites is not None
    assert found.satellites["sv"].to_list() == ["G08", "S23"]
    assert found.satellites["residual_m"].to_list() == pytest.approx([-1.2, 0.5])
    assert found.satellites["used"].to_list() == [True, False]
    assert found.satellites["elevation_deg"].to_list() == [45.0, 30.0]
    assert (row(path)["t"], row(path)["latitude_deg"], row(path)["cov_ee_m2"]) == (STAMP_NS, 50.0, 4.0)


def test_the_name_of_gpsfix_in_ros_1(tmp_path: Path) -> None:
    head = {"header": {"stamp": STAMP, "frame_id": ""}}
    text = (
        "std_msgs/Header header\nGPSStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64 track\nfloat64 speed\nfloat64 climb\nfloat64[9] position_covariance\n"
        "uint8 position_covariance_type\n================\n" + HEADER_TEXT + "================\n"
        "MSG: gps_common/GPSStatus\nstd_msgs/Header header\nint16 satellites_used\nint16 status\n"
    )
    message = head | {
        "status": {"satellites_used": 7, "status": 18}, "latitude": 50.5, "longitude": 4.5, "altitude": 120.0,
        "track": 0.0, "speed": 12.0, "climb": math.nan, "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,
    }  # fmt: skip
    found = row(ros_log(tmp_path, ("/fix", "gps_common/msg/GPSFix", text, [message])))
    assert (found["fix"], found["satellites"], found["vel_n_mps"], found["vel_u_mps"]) == (
        "differential",
        7,
        12.0,
        None,
    )
    assert found["cov_ee_m2"] is None


@pytest.mark.parametrize("fields", ["snake", "camel"])
def test_both_spellings_of_navpvt(tmp_path: Path, fields: str) -> None:
    """Older drivers of u-blox keep the capitals of the interface description."""
    spelt = {
        "fix_type": "fixType", "num_sv": "numSV", "h_acc": "hAcc", "v_acc": "vAcc", "vel_n": "velN", "vel_e": "velE",
        "vel_d": "velD",
    }  # fmt: skip
    message = {
        "year": 2023, "month": 11, "day": 14, "hour": 22, "min": 13, "sec": 20, "nano": 0, "valid": 7, "fix_type": 3,
        "flags": 1, "num_sv": 5, "lat": 505_000_000, "lon": 45_000_000, "height": 120_500, "h_acc": 2000,
        "v_acc": 3000, "vel_n": 1500, "vel_e": 2500, "vel_d": 500,
    }  # fmt: skip
    renamed = {spelt.get(name, name) if fields == "camel" else name: value for name, value in message.items()}
    found = row(json_log(tmp_path, {"/navpvt": [renamed]}, "ublox_msgs/msg/NavPVT"))
    assert (found["latitude_deg"], found["height_m"], found["fix"], found["satellites"]) == (
        50.5,
        120.5,
        "autonomous",
        5,
    )
    assert (found["vel_e_mps"], found["vel_n_mps"], found["vel_u_mps"]) == (2.5, 1.5, -0.5)
    assert (found["cov_ee_m2"], found["cov_uu_m2"]) == (2.0, 9.0)
