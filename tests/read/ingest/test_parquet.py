"""Runs as folders of Parquet: lossless conversions, and every breach in one error."""

from __future__ import annotations

import hashlib
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from pipeline.read.ingest import read_run
from pipeline.storage.described import noted_bytes
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.inputs import STREAM_SCHEMAS
from tests.read.ingest import samples

CONFIG = IngestConfig()


def folder(tmp_path: Path, **streams: pl.DataFrame) -> Path:
    path = tmp_path / "run-7"
    path.mkdir(exist_ok=True)
    for name, frame in streams.items():
        frame.write_parquet(path / f"{name}.parquet")
    return path


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_run(path, CONFIG)
    return str(caught.value)


MINIMAL = pl.DataFrame(
    {"t": samples.times(3), "latitude_deg": [50.0, 50.1, 50.2], "longitude_deg": [4.0, 4.1, 4.2], "fix": ["sbas"] * 3}
)


def test_a_minimal_run_gets_the_columns_of_the_contract(tmp_path):
    log = read_run(folder(tmp_path, gnss=MINIMAL), CONFIG)
    assert log.run_id == "run-7"
    assert log.odometer is None
    assert log.gnss.columns == list(STREAM_SCHEMAS["gnss"].columns())
    STREAM_SCHEMAS["gnss"].validate(log.gnss)
    assert log.gnss["solution"].to_list() == ["primary"] * 3
    assert log.gnss["height_m"].to_list() == [None] * 3


def test_written_frames_come_back(tmp_path):
    run = samples.run()
    log = read_run(folder(tmp_path, gnss=run.gnss, odometer=run.odometer), CONFIG)
    assert_frame_equal(log.gnss, run.gnss, check_exact=True)
    assert_frame_equal(log.odometer, run.odometer, check_exact=True)


def test_row_groups_stay_in_order(tmp_path):
    path = folder(tmp_path)
    run = samples.run(500)
    run.gnss.write_parquet(path / "gnss.parquet", row_group_size=64)
    assert_frame_equal(read_run(path, CONFIG).gnss, run.gnss, check_exact=True)


def test_order_and_duplicates_are_left_alone(tmp_path):
    shuffled = pl.concat([MINIMAL[[2, 0]], MINIMAL[[1, 1]]])
    assert read_run(folder(tmp_path, gnss=shuffled), CONFIG).gnss["latitude_deg"].to_list() == [50.2, 50.0, 50.1, 50.1]


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("t", samples.times(3).dt.cast_time_unit("ms")),
        ("t", samples.times(3).dt.cast_time_unit("us")),
        ("t", samples.times(3).dt.convert_time_zone("Europe/Brussels")),
        ("latitude_deg", pl.Series([50.5, 50.25, 50.0], dtype=pl.Float32)),
        ("latitude_deg", pl.Series([50, 51, 52])),
        ("fix", pl.Series(["sbas", "none", "rtk_fixed"], dtype=pl.Categorical)),
        ("satellites", pl.Series([7, 8, 9], dtype=pl.UInt8)),
        ("satellites", pl.Series([7.0, None, 9.0])),
        ("height_m", pl.Series([None, None, None])),
        ("solution", pl.Series(["a", "b", "a"], dtype=pl.Categorical)),
    ],
)
def test_lossless_conversions(tmp_path, column, values):
    log = read_run(folder(tmp_path, gnss=MINIMAL.with_columns(values.alias(column))), CONFIG)
    STREAM_SCHEMAS["gnss"].validate(log.gnss)
    expected = values.dt.convert_time_zone("UTC").to_list() if column == "t" else values.to_list()
    assert log.gnss[column].to_list() == expected


@pytest.mark.parametrize(
    ("column", "values", "says"),
    [
        ("t", samples.times(3).dt.replace_time_zone(None), "without a time zone"),
        ("t", pl.Series([1, 2, 3]), "Int64"),
        ("t", pl.Series([0, 2**62, 5]).cast(pl.Datetime("ms", "UTC")), "beyond the years"),
        ("t", pl.Series([None, *samples.times(2)]), "null in row 0"),
        ("latitude_deg", pl.Series([50.0, float("nan"), 51.0]), "NaN"),
        ("latitude_deg", pl.Series([50.0, float("inf"), 51.0]), "inf in row 1"),
        ("latitude_deg", pl.Series([50.0, 90.5, 91.0]), "91.0 in 2 rows, first 1; expected at most 90"),
        ("latitude_deg", pl.Series(["50", "51", "52"]), "String"),
        ("longitude_deg", pl.Series([2**60, 0, 0]), "beyond 2^53"),
        ("cov_ee_m2", pl.Series([1.0, -1e-9, 1.0]), "expected at least 0"),
        ("fix", pl.Series(["sbas", "SBAS", "dgps"]), "'SBAS', 'dgps'"),
        ("fix", pl.Series(["sbas", None, "none"]), "null in row 1"),
        ("satellites", pl.Series([7.5, 8.0, 9.0]), "not 64-bit integers"),
        ("satellites", pl.Series([2**64 - 1, 1, 1], dtype=pl.UInt64), "not 64-bit integers"),
        ("solution", pl.Series([1.0, 2.0, 3.0]), "Float64"),
    ],
)
def test_what_would_lose_or_invent_is_refused(tmp_path, column, values, says):
    message = refused(folder(tmp_path, gnss=MINIMAL.with_columns(values.alias(column))))
    assert "gnss.parquet" in message
    assert f"column {column}" in message
    assert says.lower() in message.lower()


def test_all_breaches_at_once(tmp_path):
    gnss = MINIMAL.drop("fix").with_columns(pl.lit("x").alias("longitude_deg"), pl.lit(99.0).alias("latitude_deg"))
    odometer = pl.DataFrame({"t": samples.times(2), "slip": [True, None]})
    message = refused(folder(tmp_path, gnss=gnss, odometer=odometer))
    for part in ("column fix: is missing", "column longitude_deg", "column latitude_deg", "distance_m, speed_mps"):
        assert part in message


@pytest.mark.parametrize(
    ("content", "says"), [(b"", "empty"), (b"PAR1 but not really", "Parquet"), (b"t,lat\n1,2\n", "Parquet")]
)
def test_files_that_are_no_parquet(tmp_path, content, says):
    path = folder(tmp_path)
    (path / "gnss.parquet").write_bytes(content)
    message = refused(path)
    assert "gnss.parquet" in message
    assert says in message


def test_damaged_parquet(tmp_path):
    path = folder(tmp_path, gnss=samples.run().gnss)
    content = (path / "gnss.parquet").read_bytes()
    for damaged in (content[: len(content) // 2], content[:-20] + bytes(20)):
        (path / "gnss.parquet").write_bytes(damaged)
        assert "cannot be read as Parquet" in refused(path)


def test_missing_streams_and_paths(tmp_path):
    assert "gnss.parquet" in refused(folder(tmp_path, odometer=samples.odometer()))
    assert "does not exist" in refused(tmp_path / "absent")
    (tmp_path / "run.csv").write_text("x")
    assert "neither an MCAP file nor a folder" in refused(tmp_path / "run.csv")
    assert "does not exist" in refused(tmp_path / "absent.mcap")


def test_empty_streams(tmp_path):
    assert "no rows" in refused(folder(tmp_path, gnss=MINIMAL.clear()))
    faults = samples.conformed(
        pl.DataFrame(schema={"t_start": pl.Datetime("ns", "UTC"), "kind": pl.String, "target": pl.String}), "faults"
    )
    log = read_run(folder(tmp_path, gnss=MINIMAL, faults=faults), CONFIG)
    assert log.faults is not None
    assert log.faults.height == 0


def test_odometer_with_distance_or_speed(tmp_path):
    mixed = pl.DataFrame({"t": samples.times(2), "distance_m": [1.0, None], "speed_mps": [None, 2.0]})
    assert read_run(folder(tmp_path, gnss=MINIMAL, odometer=mixed), CONFIG).odometer.height == 2
    lacking = mixed.with_columns(speed_mps=pl.lit(None, pl.Float64))
    assert "distance or speed in every row" in refused(folder(tmp_path, gnss=MINIMAL, odometer=lacking))


def test_unknown_columns_and_files_are_named(tmp_path):
    path = folder(tmp_path, gnss=MINIMAL.with_columns(hpl=pl.lit(3.0)))
    (path / "notes.txt").write_text("x")
    assert read_run(path, CONFIG).notes.skipped_topics == ("gnss.parquet: column hpl", "notes.txt")


def test_digest_is_that_of_the_content(tmp_path):
    path = folder(tmp_path, gnss=MINIMAL)
    first = read_run(path, CONFIG).input_digest
    assert first == read_run(path, CONFIG).input_digest
    assert len(first) == 64
    folder(tmp_path, gnss=MINIMAL.head(2))
    assert read_run(path, CONFIG).input_digest != first
    content = samples.log_bytes()
    log = samples.save(tmp_path, content)
    assert read_run(log, CONFIG).input_digest == hashlib.sha256(content).hexdigest()


def test_addresses_through_fsspec(tmp_path):
    import fsspec

    store = fsspec.filesystem("memory")
    content = samples.log_bytes()
    store.pipe("/bucket/trip.mcap", content)
    for name in ("gnss", "odometer"):
        target = tmp_path / "x.parquet"
        samples.run().stream(name).write_parquet(target)
        store.pipe(f"/bucket/folder/{name}.parquet", target.read_bytes())
    log = read_run("memory://bucket/trip.mcap", CONFIG)
    assert log.run_id == "trip"
    assert_frame_equal(log.gnss, samples.run().gnss, check_exact=True)
    again = read_run("memory://bucket/folder/", CONFIG)
    assert again.run_id == "folder"
    assert_frame_equal(again.gnss, log.gnss, check_exact=True)
    with pytest.raises(InputError, match="does not exist"):
        read_run("memory://bucket/other.mcap", CONFIG)
    part = content[: len(content) // 2]
    store.pipe("/bucket/cut.mcap", part)
    assert read_run("memory://bucket/cut.mcap", CONFIG).notes.partial_until_ns is not None


def test_decimals_and_half_floats_of_other_programs_are_numbers(tmp_path):
    with_decimals = MINIMAL.with_columns(
        pl.Series("height_m", ["98.5", "99.25", None]).cast(pl.Decimal(6, 2)),
        pl.Series("hpl_m", [1.5, 2.5, None], dtype=pl.Float32).cast(pl.Float16),
    )
    log = read_run(folder(tmp_path, gnss=with_decimals), CONFIG)
    assert log.gnss["height_m"].to_list() == [98.5, 99.25, None]
    assert log.gnss["hpl_m"].to_list() == [1.5, 2.5, None]


@pytest.mark.parametrize("names", [[None] * 3, [None, "b", None]])
def test_a_solution_without_a_name_is_the_default_one(tmp_path, names):
    log = read_run(folder(tmp_path, gnss=MINIMAL.with_columns(pl.Series("solution", names, dtype=pl.String))), CONFIG)
    assert log.gnss["solution"].to_list() == [name or "primary" for name in names]


@pytest.mark.parametrize(
    "noted",
    [
        "[]",
        "shift",
        '[{"stream": "gnss"}]',
        '[{"stream": "odometer", "shift_s": 1.0}]',
        '[{"stream": "gnss", "shift": 1.0}]',
        '[{"stream": "gnss", "factors": {"latitude": 2.0}}]',
        '[{"stream": "gnss", "exchange": ["latitude_deg", "fix"]}]',
    ],
)
def test_noted_corrections_that_nobody_makes_are_refused(tmp_path, noted):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "gnss.parquet").write_bytes(noted_bytes(samples.gnss(), {"corrections": noted}))
    with pytest.raises(InputError, match="does not say clearly how its gnss was corrected"):
        read_run(folder)
    (folder / "gnss.parquet").write_bytes(
        noted_bytes(samples.gnss(), {"corrections": '[{"stream": "gnss", "shift_s": 1.0}]'})
    )
    assert [made.changes for made in read_run(folder).notes.corrections] == ["shift_s 1.0"]
