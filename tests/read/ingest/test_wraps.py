"""Counters that begin anew: counted on where that is certain, else named with the line that does it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.mcap_log import write_mcap
from pipeline.make.receivers import convert
from pipeline.make.receivers.convert import words_for_dropped
from pipeline.read.ingest import read_run
from pipeline.read.ingest.conform import conform
from pipeline.read.ingest.csv_draft import draft_mapping
from pipeline.read.ingest.wraps import unwrap, wrap_of
from schemas.config import Configuration, IngestConfig, settings_from
from schemas.errors import ConfigError
from schemas.run import RunLog
from tests.read.ingest import samples
from tests.read.ingest.samples import START_NS, channel, message, position, schema, whole

SECOND = 10**9
ROWS = 400


def distance(step: float = 100.0, start: float = 0.0) -> np.ndarray:
    """Counts of a train that speeds up, runs and brakes."""
    steps = step * np.minimum(1.0, np.minimum(np.arange(ROWS), np.arange(ROWS)[::-1]) / 50.0)
    return start + np.round(np.cumsum(steps))


@pytest.mark.parametrize(
    ("size", "count", "start", "signed"),
    [
        (65536, 1.0, 60_000.0, False),
        (65536, 1.0, 30_000.0, True),  # from 32,767 to -32,768
        (65536, 0.1, 60_000.0, False),
        (2**24, 1.0, 2**24 - 5_000.0, False),
        (2**32, 1.0, 2**32 - 5_000.0, False),
        (100_000, 0.01, 90_000.0, False),
    ],
)
def test_a_counter_is_counted_on_over_its_end(size: int, count: float, start: float, signed: bool) -> None:
    true = distance(start=start)
    shown = (true + size // 2) % size - size // 2 if signed else true % size
    found = wrap_of(shown * count, np.arange(ROWS) * SECOND)
    assert found is not None
    assert (found.size, found.times, found.certain) == (pytest.approx(size * count), 1, True)
    whole_counts = unwrap(shown * count, found.size)
    assert whole_counts - whole_counts[0] == pytest.approx((true - true[0]) * count, abs=1e-6 * size)


def test_a_train_that_turns_back_wraps_the_other_way_too() -> None:
    true = np.concatenate([distance(start=60_000.0), distance(start=60_000.0)[::-1]])
    found = wrap_of(true % 65536)
    assert found is not None
    assert (found.times, found.certain) == (2, True)
    assert unwrap(true % 65536, 65536.0).tolist() == true.tolist()


def test_an_empty_cell_changes_nothing() -> None:
    shown = distance(start=60_000.0) % 65536
    shown[[10, 99, 100, 150]] = np.nan
    counted = unwrap(shown, 65536.0)
    known = np.isfinite(shown)
    assert (known == np.isfinite(counted)).all()
    assert counted[known].tolist() == distance(start=60_000.0)[known].tolist()


def test_what_is_no_wrap() -> None:
    """No fall; a reset in the middle; a fall of no size; a pause; random resets of counters, of 20,000 none."""
    steady = distance()
    assert wrap_of(steady) is None
    assert wrap_of(np.where(np.arange(ROWS) < 200, steady, steady - steady[200])) is None
    assert wrap_of(-(distance(start=60_000.0) % 50_021)) is None
    shown = distance(start=60_000.0) % 65536
    at = int(np.argmin(np.diff(shown)))
    t_ns = np.arange(ROWS) * SECOND
    t_ns[at + 1 :] += 30 * SECOND
    paused = wrap_of(shown, t_ns)
    assert paused is None
    rng = np.random.default_rng(1)
    sure = 0
    for _ in range(20_000 // 20):
        reset = int(rng.integers(100, 300))
        counts = distance(step=float(rng.uniform(1, 60)), start=float(rng.integers(0, 120_000)))
        counts[reset:] -= counts[reset]
        found = wrap_of(counts)
        sure += found is not None and found.certain
    assert sure <= 5


def test_a_small_counter_with_large_steps_is_named_alone() -> None:
    """Eight bits, 40 counts a row: a step over the end looks like any fall to a small number."""
    found = wrap_of(distance(step=40.0) % 256)
    assert found is None or not found.certain


def mapped(**more: object) -> IngestConfig:
    odometer = {
        "topic": "odo.csv",
        "time": "field:t",
        "fields": {"distance_m": "count"},
        "factors": {"distance_m": 0.05},
    }
    gnss = {"topic": "gnss.csv", "time": "field:t", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}}
    return settings_from({"ingest": {"gnss": gnss, "odometer": odometer | more}}, Configuration, "mapping").ingest


def tables(folder: Path, counts: np.ndarray) -> list[Path]:
    t = START_NS + np.arange(counts.size) * SECOND
    pl.DataFrame({"t": t, "lat": 50.0, "lon": 4.0}).write_csv(folder / "gnss.csv")
    pl.DataFrame({"t": t, "count": counts.astype(np.int64)}).write_csv(folder / "odo.csv")
    return [folder / "gnss.csv", folder / "odo.csv"]


def test_of_a_table(tmp_path: Path) -> None:
    true = distance(start=60_000.0)
    logs = tables(tmp_path, true % 65536)
    found = convert(logs, "r", mapped())
    assert found.run.odometer is not None
    assert found.run.odometer["distance_m"].to_numpy() == pytest.approx(true * 0.05)
    (reason,) = [reason for reason in found.dropped if "wrap" in reason]
    assert "`wrap = 65536` in its mapping" in reason
    assert words_for_dropped(reason) == "noted"
    declared = convert(logs, "r", mapped(wrap=65536.0))
    assert declared.run.odometer is not None
    assert declared.run.odometer.equals(found.run.odometer)


def test_declared_where_it_is_not_certain(tmp_path: Path) -> None:
    true = distance(step=40.0)
    declared = convert(tables(tmp_path, true % 256), "r", mapped(wrap=256.0))
    assert declared.run.odometer is not None
    assert declared.run.odometer["distance_m"].to_numpy() == pytest.approx((true - true[0]) * 0.05)


def test_of_several_sensors_in_one_table(tmp_path: Path) -> None:
    logs = tables(tmp_path, distance())
    true = distance(start=60_000.0)
    t = START_NS + np.arange(ROWS) * SECOND
    rows = pl.DataFrame({"t": t, "count": (true % 65536).astype(np.int64), "who": "a"})
    other = pl.DataFrame({"t": t, "count": true.astype(np.int64) * 0 + np.arange(ROWS), "who": "b"})
    pl.concat([rows, other]).sort("t", maintain_order=True).write_csv(logs[1])
    run = convert(logs, "r", mapped(fields={"distance_m": "count", "sensor": "who"})).run
    assert run.odometer is not None
    for name, counts in (("a", true), ("b", np.arange(ROWS))):
        own = run.odometer.filter(pl.col("sensor") == name)
        assert own["distance_m"].to_numpy() == pytest.approx(counts * 0.05)


def test_of_a_topic(tmp_path: Path) -> None:
    true = distance(start=60_000.0)
    payloads = [json.dumps({"ticks": int(count)}).encode() for count in true % 65536]
    log = whole(
        schema(1),
        channel(1, 1, "/gnss"),
        schema(2, "x.Y"),
        channel(2, 2, "/wheel"),
        *(message(position(n), START_NS + n * SECOND) for n in range(2)),
        *(message(payload, START_NS + n * SECOND, 2) for n, payload in enumerate(payloads)),
    )
    odometer = {"topic": "/wheel", "time": "log", "fields": {"distance_m": "ticks"}, "origin": "wheel"}
    config = settings_from({"ingest": {"odometer": odometer}}, Configuration, "mapping").ingest
    run = read_run(samples.save(tmp_path, log), config)
    assert run.odometer is not None
    assert run.odometer["distance_m"].to_list() == true.tolist()
    (said,) = run.notes.skipped_topics
    assert said.startswith("/wheel: 1 x step of ticks over the end of its counter (put right; `wrap = 65536`")


def test_the_draft_names_the_line(tmp_path: Path) -> None:
    (_, log) = tables(tmp_path, distance(start=60_000.0) % 65536)
    log.write_text(log.read_text().replace("count", "distance [m]"))
    assert "\nwrap = 65536\n" in draft_mapping(log)


def counted_run(folder: Path, shown: np.ndarray, as_log: bool) -> Path:
    """A run of the contract whose distances are these [m]."""
    t = pl.Series("t", START_NS + np.arange(shown.size) * SECOND).cast(pl.Datetime("ns", "UTC"))
    odometer = pl.DataFrame({"t": t, "distance_m": shown})
    positions = pl.DataFrame({"t": t, "latitude_deg": 50.0, "longitude_deg": 4.0, "fix": "sbas"})
    if not as_log:
        (folder / "run").mkdir()
        odometer.write_parquet(folder / "run" / "odometer.parquet")
        positions.write_parquet(folder / "run" / "gnss.parquet")
        return folder / "run"
    frames = {
        "gnss": conform(positions, "gnss", "test", []),
        "odometer": conform(odometer, "odometer", "test", []),
    }
    with (folder / "run.mcap").open("wb") as stream:
        write_mcap(RunLog("run", frames["gnss"], odometer=frames["odometer"]), stream, "json")
    return folder / "run.mcap"


@pytest.mark.parametrize("as_log", [False, True])
def test_a_run_is_counted_on_where_that_is_certain_and_says_so(tmp_path: Path, as_log: bool) -> None:
    true = distance(start=60_000.0)
    run = read_run(counted_run(tmp_path, (true % 65536) * 0.05, as_log))
    assert run.odometer is not None
    counted = run.odometer["distance_m"].to_numpy()
    assert counted - counted[0] == pytest.approx((true - true[0]) * 0.05, abs=1e-6)
    (said,) = [text for text in run.notes.skipped_topics if "counter" in text]
    assert '`[[ingest.correct]] stream = "odometer", wrap = 3276.8` in the configuration says so' in said


def test_what_may_be_a_reset_is_counted_on_by_a_correction_alone(tmp_path: Path) -> None:
    """A counter of 1,000: of its one fall nobody knows."""
    true = distance(step=5.0, start=900.0)[:200]
    path = counted_run(tmp_path, true % 1000, as_log=False)
    run = read_run(path)
    assert run.odometer is not None
    assert run.odometer["distance_m"].to_list() == (true % 1000).tolist()
    assert any("may have been reset" in text and "wrap = 1000" in text for text in run.notes.skipped_topics)
    correction = {"ingest": {"correct": [{"stream": "odometer", "wrap": 1000.0}]}}
    mended = read_run(path, settings_from(correction, Configuration, "test").ingest)
    assert mended.odometer is not None
    assert mended.odometer["distance_m"].to_list() == true.tolist()
    assert not any("counter" in text for text in mended.notes.skipped_topics)
    other = {"ingest": {"correct": [{"stream": "gnss", "wrap": 1000.0}]}}
    with pytest.raises(ConfigError, match="distance_m"):
        read_run(path, settings_from(other, Configuration, "test").ingest)


def test_what_makes_it_certain_is_configured(tmp_path: Path) -> None:
    path = counted_run(tmp_path, distance(start=60_000.0) % 65536, as_log=False)
    cautious = settings_from({"ingest": {"wraps": {"sure_size": 1e6}}}, Configuration, "test").ingest
    run = read_run(path, cautious)
    assert run.odometer is not None
    assert np.diff(run.odometer["distance_m"].to_numpy()).min() < 0
