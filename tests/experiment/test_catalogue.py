"""The fault catalogue: what the changes do, how replays are judged, and the fault that each monitor exists for."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS
from datasets.experiment import catalogue as module
from datasets.experiment.catalogue import (
    JOURNEYS,
    JourneyPlan,
    PreparedJourney,
    prepare_journey,
    run_catalogue,
    with_fault,
)
from datasets.experiment.catalogue_faults import CatalogueFault, catalogue
from datasets.experiment.catalogue_report import catalogue_page, faults_table, monitors_table
from pipeline.stages.track.geodesy import point_distances_m
from schemas.config import Configuration, MonitorConfig
from schemas.monitors import MONITORS
from schemas.run import RunLog, Site

FAULTS = {fault.name: fault for fault in catalogue()}


@pytest.fixture(scope="module")
def short() -> PreparedJourney:
    return prepare_journey(JOURNEYS["short"], 7, 1.0)


@pytest.fixture(scope="module")
def healthy(short: PreparedJourney) -> tuple[RunLog, Site]:
    return with_fault(short, FAULTS["healthy short"])


def seconds(frame: pl.DataFrame, prepared: PreparedJourney) -> pl.DataFrame:
    return frame.with_columns(s=((pl.col("t").dt.timestamp("ns") - prepared.onset_ns) / 1e9).round(6))


def test_names_are_unique_and_every_kind_asked_for_is_there() -> None:
    assert len(FAULTS) == len(catalogue())
    kinds = {fault.kind for fault in catalogue()}
    wanted = {
        "range ramp", "range step", "step along", "step cross", "step up", "drift along", "latency", "clock ahead",
        "frozen position", "outage", "noise along", "slip", "slide", "odometer scale", "odometer late",
        "on the parallel track, left", "map off to the left", "physical balise missing", "physical balise late",
        "one solution drifts along",
    }  # fmt: skip
    assert wanted <= kinds


def test_a_frozen_receiver_repeats_its_last_position(short: PreparedJourney, healthy: tuple[RunLog, Site]) -> None:
    run, _ = with_fault(short, FAULTS["frozen position 10 s"])
    frozen, free = (seconds(one.gnss.filter(pl.col("solution") == "primary"), short) for one in (run, healthy[0]))
    last = free.filter(pl.col("s") == -1.0)["latitude_deg"][0]
    held = frozen.filter(pl.col("s").is_between(0.0, 9.0))
    assert held["latitude_deg"].to_list() == [last] * 10
    rest = ~pl.col("s").is_between(0.0, 9.0)
    assert frozen.filter(rest).equals(free.filter(rest))


def test_clocks_jump_at_the_onset_and_not_before(short: PreparedJourney, healthy: tuple[RunLog, Site]) -> None:
    ahead, _ = with_fault(short, FAULTS["clock ahead 3 s"])
    moved = (ahead.gnss["t"] - healthy[0].gnss["t"]).dt.total_milliseconds()
    later = seconds(healthy[0].gnss, short)["s"] >= 0.0
    assert moved.filter(later).unique().to_list() == [3000]
    assert moved.filter(~later).unique().to_list() == [0]
    late, _ = with_fault(short, FAULTS["odometer late 1 s"])
    assert late.odometer is not None
    assert healthy[0].odometer is not None
    assert (late.odometer["t"] - healthy[0].odometer["t"])[-1].total_seconds() == 1.0
    assert late.odometer["distance_m"].equals(healthy[0].odometer["distance_m"])


def test_the_map_is_moved_from_the_next_element_on(short: PreparedJourney, healthy: tuple[RunLog, Site]) -> None:
    """The train is 15 m before the border of the fifth and sixth element at the onset."""
    _, site = with_fault(short, FAULTS["map off to the left 5 m"])
    before, after = healthy[1].track, site.track
    off = [
        float(
            point_distances_m(
                *(np.array([a[name], b[name]]) for name in ("latitude_deg", "longitude_deg", "height_m"))
            )[0]
        )
        for a, b in zip(before.iter_rows(named=True), after.iter_rows(named=True), strict=True)
    ]
    names = before["netelement_id"].to_list()
    assert {name for name, away in zip(names, off, strict=True) if away > 0.0} == {
        name for name in names if name >= "NE005"
    }
    assert max(off) == pytest.approx(5.0, rel=0.01)


def test_lists_and_reads_change_behind_the_onset_alone(short: PreparedJourney, healthy: tuple[RunLog, Site]) -> None:
    _, site = with_fault(short, FAULTS["balise list wrong 30 m"])
    assert site.balises is not None
    assert healthy[1].balises is not None
    moved = site.balises["measure_m"] - healthy[1].balises["measure_m"]
    assert set(moved.to_list()) == {0.0, 30.0}
    prepared = prepare_journey(JOURNEYS["physical"], 7, 1.0)
    full, missing, late = (
        with_fault(prepared, FAULTS[name])[0].balise_reads
        for name in ("healthy physical", "physical balise missing 2", "physical balise late 3 s")
    )
    assert full is not None
    assert missing is not None
    assert late is not None
    gone = full.filter(~pl.col("balise_id").is_in(missing["balise_id"].implode()))
    assert gone.height == 2
    assert (seconds(gone, prepared)["s"] >= 0.0).all()
    assert set((late["t"] - full["t"]).dt.total_seconds()) == {0, 3}


def runs_by_hand() -> pl.DataFrame:
    """Three runs of one fault: found at 4 s before the failure at 10 s, found too late at 12 s, not found."""

    def first_fails(**times: float) -> list[float | None]:
        return [times.get(monitor) for monitor in MONITORS]

    rows = [
        (4.0, 120.0, ["along_raw"], 10.0, 0, 0, first_fails(along_raw=4.0, channel=9.0)),
        (12.0, 360.0, ["channel", "up_raw"], 10.0, 1, 2, first_fails(channel=12.0, up_raw=12.0)),
        (None, None, [], 10.0, 3, 1, first_fails()),
    ]
    return pl.DataFrame(
        [
            {
                "fault": "a 1 m", "kind": "a", "size": 1.0, "unit": "m", "journey": "short", "repetition": number,
                "detected_s": detected, "way_m": way, "first": first, "failure_s": failure, "unsafe": unsafe,
                "linking_errors": linking, "seen_s": times, "budget_s": 1.675, "reaction_s": 1.0,
            }
            for number, (detected, way, first, failure, unsafe, linking, times) in enumerate(rows)
        ],
        infer_schema_length=None,
        schema_overrides=module._NULLABLE,
    )  # fmt: skip


def test_the_tables_by_hand() -> None:
    row = faults_table(runs_by_hand()).row(0, named=True)
    assert (row["detected"], row["missed_at_failure"], row["failed"]) == (pytest.approx(2 / 3), 2, 3)
    # 2 of 3 by Clopper and Pearson.
    assert (row["pmd_at_failure_low"], row["pmd_at_failure_high"]) == pytest.approx((0.0943, 0.9916), abs=1e-4)
    assert row["within_budget"] == pytest.approx(1 / 3)
    assert row["first_monitors"] == "along_raw 50%, channel 50%"
    assert (row["time_to_detect_median_s"], row["way_max_m"]) == (8.0, 360.0)
    assert (row["runs_with_unsafe"], row["unsafe_accepted"], row["seen_by_linking_alone"]) == (2, 4, 1)
    monitors = {one["monitor"]: one for one in monitors_table(runs_by_hand()).iter_rows(named=True)}
    assert list(monitors) == ["along_raw", "up_raw", "channel"]
    assert (monitors["along_raw"]["lead_s"], monitors["along_raw"]["first"]) == (5.0, pytest.approx(1 / 3))
    assert (monitors["channel"]["seen"], monitors["channel"]["first"]) == (pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert [monitors[name]["ahead"] for name in monitors] == [pytest.approx(1 / 3), 0.0, 0.0]
    page = catalogue_page(faults_table(runs_by_hand()), monitors_table(runs_by_hand()))
    assert "| a 1 m | 10 s | along_raw 50%, channel 50% | 8 s | 240 m | 66.7% | 2 of 3 (9.4% to 99.2%) | 2 |" in page


@pytest.fixture(scope="module")
def found() -> pl.DataFrame:
    """One run of each; the channel sees the slowest drift after 12.5 min, and the journey may end soon after that."""
    names = (
        "healthy short", "step along 1200 m", "outage of 90 s, then off by 300 m", "outage of 90 s, then off by 30 m",
        "slip 0.8 m/s", "odometer scale 1.02", "range ramp 0.1 m/s", "one solution drifts along 0.01 m/s",
        "step cross 10 m", "physical balise missing 2",
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(JOURNEYS, "long", JourneyPlan(1_500.0, 500.0))
        return run_catalogue(1, seed=3, faults=[FAULTS[name] for name in names])


def of_fault(found: pl.DataFrame, fault: str) -> list[dict[str, object]]:
    return found.filter(pl.col("fault") == fault).to_dicts()


def test_a_healthy_journey_is_quiet(found: pl.DataFrame) -> None:
    assert found.filter(pl.col("fault") == "healthy short")["detected_s"].null_count() == 1


@pytest.mark.parametrize(
    ("monitor", "fault"),
    [
        ("link_order", "step along 1200 m"),
        ("link_distance", "outage of 90 s, then off by 300 m"),
        ("along_doppler", "slip 0.8 m/s"),
        ("along_doppler", "odometer scale 1.02"),
        ("pseudorange", "range ramp 0.1 m/s"),
        ("channel", "one solution drifts along 0.01 m/s"),
        ("cross_raw", "step cross 10 m"),
    ],
)
def test_each_monitor_sees_the_fault_it_exists_for_first(found: pl.DataFrame, monitor: str, fault: str) -> None:
    assert [monitor in run["first"] for run in of_fault(found, fault)] == [True]  # type: ignore[operator]


def test_a_jump_over_balises_is_seen_at_once_and_a_drift_of_one_solution_by_the_other_alone(
    found: pl.DataFrame,
) -> None:
    assert [run["detected_s"] for run in of_fault(found, "step along 1200 m")] == [0.0]
    table = monitors_table(found).filter(pl.col("fault") == "outage of 90 s, then off by 300 m")
    assert table.filter(pl.col("monitor") == "link_distance")["alone"].to_list() == [1.0]


def test_what_no_monitor_sees_is_said(found: pl.DataFrame) -> None:
    """An offset that comes inside a long outage has no increment to be seen in, but the place where it shows."""
    faults = faults_table(found)
    row = faults.row(by_predicate=pl.col("fault") == "outage of 90 s, then off by 30 m", named=True)
    assert (row["detected"], row["pmd_at_failure"]) == (1.0, 0.0)
    assert row["runs_with_unsafe"] == 0
    page = catalogue_page(faults, monitors_table(found))
    assert "- `link_order`: among the first for step along 1200 m" in page
    assert "- `link_distance`: before all others for outage of 90 s, then off by 300 m (100.0%, alone)" in page
    assert "range ramp 0.1 m/s (100.0%, by" in page
    section = page.split("## What no monitor sees")[1].split("##")[0]
    assert "outage of 90 s, then off by" not in section
    assert "physical balise missing 2: nothing unsafe, linking errors tell" in section
    assert "step cross" not in section


def test_a_configuration_is_judged_as_it_is() -> None:
    config = Configuration(monitors=MonitorConfig(disabled=("cross_raw", "cross_ewma_0p1")))
    run = run_catalogue(1, 3, 1, config, [FAULTS["step cross 3 m"]]).row(0, named=True)
    first_fails = dict(zip(MONITORS, run["seen_s"], strict=True))
    assert first_fails["cross_raw"] is None
    assert first_fails["cross_ewma_0p1"] is None
    assert not {"cross_raw", "cross_ewma_0p1"} & set(run["first"])


@pytest.mark.usefixtures("in_process")
def test_it_is_written_and_does_not_depend_on_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few: tuple[CatalogueFault, ...] = (FAULTS["step along 25 m"],)
    monkeypatch.setattr(module, "catalogue", lambda: few)
    for jobs in (1, 2):
        EXPERIMENTS["catalogue"](tmp_path / str(jobs), 1, 1, jobs, None)
    for name in ("catalogue.parquet", "monitors.parquet", "runs.parquet", "catalogue.md", "settings.json"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()
