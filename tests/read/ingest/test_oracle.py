"""Random well-formed logs read bit for bit as the `mcap` package and its decoders read them."""

from __future__ import annotations

import io
import json

import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._dynamic import serialize_dynamic
from polars.testing import assert_frame_equal

from pipeline.read.ingest import mcap_walk, read_run, reader
from pipeline.show.export.messages import descriptor, message_class
from pipeline.show.export.position_messages import LOCATION_FIELDS, LOCATION_FIX
from schemas.config import IngestConfig, StreamMapping
from tests.read.ingest import oracle, samples
from tests.read.ingest.samples import DEFINITIONS

SETTINGS = settings(
    max_examples=18, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip

finite = st.floats(-1e15, 1e15)
latitudes = st.one_of(st.just(0.0), st.just(-0.0), st.floats(-90, 90))
longitudes = st.one_of(st.just(0.0), st.floats(-180, 180))
heights = st.one_of(st.just(0.0), finite)
variances = st.one_of(st.just(0.0), st.floats(0, 1e15))
covariances = st.tuples(variances, finite, finite, finite, variances, finite, finite, finite, variances)
stamps = st.tuples(st.integers(0, 2**31 - 1), st.one_of(st.just(0), st.integers(0, 999_999_999)))
names = st.text(max_size=12).filter(lambda text: "\0" not in text)
fixes = st.lists(
    st.fixed_dictionaries(
        {
            "stamp": stamps, "latitude": latitudes, "longitude": longitudes, "altitude": heights,
            "covariance": covariances, "type": st.integers(0, 3), "status": st.sampled_from([-1, 0, 1, 2]),
            "frame": names, "channel": st.integers(0, 1), "log_time": st.integers(0, 2**62),
        }
    ),
    min_size=1,
    max_size=25,
)  # fmt: skip
speeds = st.lists(
    st.fixed_dictionaries(
        {"stamp": stamps, "speed": finite, "frame": names, "child": names, "log_time": st.integers(0, 2**62)}
    ),
    max_size=25,
)
containers = st.fixed_dictionaries(
    {
        "compression": st.sampled_from(list(CompressionType)),
        "chunk_size": st.sampled_from([1, 400, 1_000_000]),
        "use_chunking": st.booleans(),
        "enable_crcs": st.booleans(),
        "enable_data_crcs": st.booleans(),
        "index_types": st.sampled_from([IndexType.ALL, IndexType.NONE, IndexType.MESSAGE, IndexType.CHUNK]),
        "use_statistics": st.booleans(),
        "use_summary_offsets": st.booleans(),
        "repeat_channels": st.booleans(),
    }
)


def written(container: dict, channels: list, messages: list) -> bytes:
    """A log of (topic, encoding, schema) channels and (channel, log time, payload) messages."""
    stream = io.BytesIO()
    writer = Writer(stream, **container)
    writer.start()
    schema_encodings = {"cdr": "ros2msg", "protobuf": "protobuf", "json": "jsonschema"}
    ids = []
    for topic, encoding, name, data in channels:
        schema_id = writer.register_schema(name, schema_encodings[encoding], data)
        ids.append(writer.register_channel(topic, encoding, schema_id))
    for number, log_time, payload in messages:
        writer.add_message(ids[number], log_time, payload, log_time)
    writer.finish()
    return stream.getvalue()


NAVSATFIX = "sensor_msgs/msg/NavSatFix"
ENCODE = {name: serialize_dynamic(name, text)[name] for name, text in DEFINITIONS.items()}


def ros_fix(fix: dict) -> bytes:
    sec, nanosec = fix["stamp"]
    return ENCODE[NAVSATFIX](
        {
            "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": fix["frame"]},
            "status": {"status": fix["status"], "service": 1},
            **{name: fix[name] for name in ("latitude", "longitude", "altitude")},
            "position_covariance": list(fix["covariance"]),
            "position_covariance_type": fix["type"],
        }
    )


def ros_speed(name: str, speed: dict) -> bytes:
    sec, nanosec = speed["stamp"]
    header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": speed["frame"]}
    twist = {"linear": {"x": speed["speed"], "y": 1.0, "z": -0.0}, "angular": {"x": 0.5, "y": 0.0, "z": 2.0}}
    if name.endswith("/TwistStamped"):
        return ENCODE[name]({"header": header, "twist": twist})
    nested = {"header": header, "twist": {"twist": twist, "covariance": [float(n) for n in range(36)]}}
    if name.endswith("Odometry"):
        nested |= {"child_frame_id": speed["child"], "pose": {"pose": {}, "covariance": [1.5] * 36}}
    return ENCODE[name](nested)


def check(tmp_path, content: bytes, gnss: pl.DataFrame, odometer: pl.DataFrame | None, slow: int = 0) -> None:
    """All chunks at once, and one by one, with what is taken of them decoded at once or as it comes."""
    for together, decoded in ((mcap_walk._TOGETHER, reader._TOGETHER), (1, reader._TOGETHER), (1, 1)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mcap_walk, "_TOGETHER", together)
            patch.setattr(reader, "_TOGETHER", decoded)
            _check(tmp_path, content, gnss, odometer, slow)


def _check(tmp_path, content: bytes, gnss: pl.DataFrame, odometer: pl.DataFrame | None, slow: int) -> None:
    mapped = () if odometer is None else (StreamMapping(topic="/odom"),)
    log = read_run(samples.save(tmp_path, content), IngestConfig(odometer=mapped))
    assert_frame_equal(oracle.compared(log.gnss, gnss.columns), gnss, check_exact=True)
    assert log.notes.slow_path_messages <= slow
    assert log.notes.partial_until_ns is None
    if odometer is None:
        assert log.odometer is None
    else:
        assert_frame_equal(oracle.compared(log.odometer, odometer.columns), odometer, check_exact=True)


@pytest.mark.parametrize(
    "odometry",
    ["nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped"],
)
def test_cdr(tmp_path, odometry):
    paths = {"TwistStamped": "twist", "Odometry": "twist.twist", "TwistWithCovarianceStamped": "twist.twist"}

    @SETTINGS
    @given(fixes=fixes, speeds=speeds, container=containers)
    def holds(fixes, speeds, container):
        channels = [
            ("/fix", "cdr", NAVSATFIX, DEFINITIONS[NAVSATFIX].encode()),
            ("/fix", "cdr", NAVSATFIX, DEFINITIONS[NAVSATFIX].encode()),
            ("/odom", "cdr", odometry, DEFINITIONS[odometry].encode()),
        ]
        messages = [(fix["channel"], fix["log_time"], ros_fix(fix)) for fix in fixes]
        mixed = [(2, speed["log_time"], ros_speed(odometry, speed)) for speed in speeds]
        half = len(messages) // 2
        content = written(container, channels, messages[:half] + mixed + messages[half:])
        topics = oracle.decoded(content)
        path = paths[odometry.split("/")[-1]]
        twists = [twist for message in topics.get("/odom", []) for twist in [_at(message, path)]]
        rows = [
            {"t": message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, "speed_mps": twist.linear.x}
            for message, twist in zip(topics.get("/odom", []), twists, strict=True)
        ]
        expected = pl.DataFrame(rows, schema={"t": pl.Int64, "speed_mps": pl.Float64}) if rows else None
        check(tmp_path, content, oracle.navsatfix_rows(topics["/fix"]), expected)

    holds()


def _at(message, path: str):
    for step in path.split("."):
        message = getattr(message, step)
    return message


@SETTINGS
@given(fixes=fixes, container=containers)
def test_protobuf(tmp_path, fixes, container):
    kind = message_class(LOCATION_FIX, LOCATION_FIELDS)
    messages = []
    for fix in fixes:
        message = kind(
            latitude=fix["latitude"], longitude=fix["longitude"], altitude=fix["altitude"], frame_id=fix["frame"],
            position_covariance=fix["covariance"], position_covariance_type=fix["type"],
        )  # fmt: skip
        message.timestamp.SetInParent()
        message.timestamp.seconds, message.timestamp.nanos = fix["stamp"]
        messages.append((fix["channel"], fix["log_time"], message.SerializeToString()))
    channels = [("/loc", "protobuf", LOCATION_FIX, descriptor(LOCATION_FIX, LOCATION_FIELDS))] * 2
    content = written(container, channels, messages)
    check(tmp_path, content, oracle.location_fix_rows(oracle.decoded(content)["/loc"]), None)


@SETTINGS
@given(fixes=fixes, container=containers, indent=st.sampled_from([None, 1]))
def test_json(tmp_path, fixes, container, indent):
    messages = [
        (
            fix["channel"],
            fix["log_time"],
            json.dumps(
                {
                    "timestamp": dict(zip(("sec", "nsec"), fix["stamp"], strict=True)),
                    "frame_id": fix["frame"],
                    **{name: fix[name] for name in ("latitude", "longitude", "altitude")},
                    "position_covariance": fix["covariance"],
                    "position_covariance_type": fix["type"],
                },
                indent=indent,
            ).encode(),
        )
        for fix in fixes
    ]
    content = written(container, [("/loc", "json", LOCATION_FIX, b"{}")] * 2, messages)
    places = {"ee": 0, "en": 1, "eu": 2, "nn": 4, "nu": 5, "uu": 8}
    rows = [
        {
            "t": message["timestamp"]["sec"] * 10**9 + message["timestamp"]["nsec"],
            **{f"{name}_deg": message[name] for name in ("latitude", "longitude")},
            "height_m": message["altitude"],
            "fix": "autonomous",
            **{
                f"cov_{axes}_m2": message["position_covariance"][place] if message["position_covariance_type"] else None
                for axes, place in places.items()
            },
        }
        for message in oracle.decoded(content)["/loc"]
    ]
    schema = {name: pl.Int64 if name == "t" else pl.String if name == "fix" else pl.Float64 for name in rows[0]}
    slow = len(fixes) if indent else 0
    check(tmp_path, content, pl.DataFrame(rows, schema=schema), None, slow)


@pytest.mark.parametrize("encoding", ["json", "protobuf", "cdr"])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("chunk_size", [700, None])
def test_written_runs_come_back(tmp_path, encoding, compression, chunk_size):
    run = samples.run()
    content = samples.log_bytes(run, encoding, compression, chunk_size)
    assert content == samples.log_bytes(run, encoding, compression, chunk_size)
    # A twist is read as an odometer where a mapping names its topic.
    mapped = (StreamMapping(topic="/odometer"),) if encoding == "cdr" else ()
    log = read_run(samples.save(tmp_path, content), IngestConfig(odometer=mapped))
    assert_frame_equal(log.gnss, run.gnss, check_exact=True)
    assert_frame_equal(log.odometer, run.odometer, check_exact=True)
    assert log.notes.slow_path_messages == 0
    assert log.run_id == "run"
