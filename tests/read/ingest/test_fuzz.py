"""A short run of the fuzz benchmark, and a log whose bulk is not ours."""

from __future__ import annotations

import struct
import subprocess
import sys

import numpy as np

from tests.fuzz import files as fuzz_files
from tests.fuzz.ingest import MUTATIONS, fuzz
from tests.read.ingest import samples


def test_random_damage_never_gives_wrong_data():
    report = fuzz(250, seed=20_240_501)
    assert report.failures == []
    assert {name.split(":")[0] for name in report.mutations} == set(MUTATIONS)
    assert report.outcomes["partial"] > 9
    assert report.outcomes["error"] > 93


def test_judge_sees_wrong_data(tmp_path, monkeypatch):
    """The fuzz run can fail: a reader that swaps two rows is caught."""
    import tests.fuzz.ingest as bench

    path = samples.save(tmp_path, samples.log_bytes())
    expected = bench.read_run(path, bench.IngestConfig())
    assert bench.judge(path, expected) == ("whole", "")
    swapped = expected.with_streams(gnss=expected.gnss.reverse())
    monkeypatch.setattr(bench, "read_run", lambda *_: swapped)
    assert bench.judge(path, expected)[0] == "WRONG"


_SCRIPT = """
import re, sys
from pathlib import Path
from pipeline.read.ingest import read_run
from schemas.config import IngestConfig

def status(name):
    return int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text()).group(1)) / 1024

read_run(Path(sys.argv[1]), IngestConfig())
Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from what is resident now
before = status("VmRSS")
assert read_run(Path(sys.argv[2]), IngestConfig()).gnss.height == 3
print(status("VmHWM") - before)
"""


def test_memory_does_not_grow_with_what_is_not_read(tmp_path):
    """160 MB of camera pictures and an attachment pass by in pieces."""
    from tests.read.ingest.samples import channel, definitions, message, position, record, schema, text, whole

    picture = message(bytes(500_000), channel_id=2)
    attachment_body = (
        struct.pack("<QQ", 0, 0) + text("a") + text("b") + struct.pack("<Q", 80_000_000) + bytes(80_000_004)
    )
    bulk = schema(2, "sensor_msgs/msg/Image") + channel(2, 2, "/camera", "cdr")
    content = whole(
        definitions(),
        bulk,
        message(position(0)),
        picture * 160,
        record(0x09, attachment_body),
        message(position(1)),
        message(position(2)),
    )
    small = samples.save(tmp_path, whole(definitions(), samples.some_messages()), "small.mcap")
    large = samples.save(tmp_path, content, "large.mcap")
    done = subprocess.run([sys.executable, "-c", _SCRIPT, small, large], check=True, capture_output=True, text=True)
    assert float(done.stdout) < 60


def test_random_damage_to_what_no_checksum_covers():
    """Messages and schemas under right checksums against the stock decoders; Parquet, CSV, GeoJSON, TOML."""
    report = fuzz_files.fuzz(140, seed=5)
    assert report.failures == []
    kinds = {name.split(":")[0] for name in report.mutations}
    assert kinds == {"cdr", "protobuf", "json", "parquet", "csv", "geojson", "toml"}
    assert report.outcomes["error"] > 66
    assert report.outcomes["whole"] > 13


def test_the_stock_decoders_see_wrong_positions(tmp_path, monkeypatch):
    """The comparison can fail: a reader that gives other latitudes is caught."""
    case = fuzz_files.log_case("cdr", fuzz_files.run_of(0.002))
    read = fuzz_files.read_run

    def shifted(path, config):
        log = read(path, config)
        return log.with_streams(gnss=log.gnss.with_columns(log.gnss["latitude_deg"] + 1e-9))

    monkeypatch.setattr(fuzz_files, "mutated", lambda content, _: content)
    assert case(np.random.default_rng(1), tmp_path) == "whole"
    monkeypatch.setattr(fuzz_files, "read_run", shifted)
    assert case(np.random.default_rng(1), tmp_path).startswith("WRONG")
