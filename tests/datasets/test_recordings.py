"""Public recordings as they may come: missing values, other rates, folders and files that are something else."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import cli
from datasets.comma2k19 import comma2k19_run
from datasets.infrabel import infrabel_run
from datasets.recordings import known_recording
from pipeline.read.ingest import read_run
from schemas.config import IngestConfig
from schemas.errors import InputError

GNSS, WHEELS = "processed_log/GNSS/live_gnss_ublox", "processed_log/CAN/wheel_speed"
Edit = Callable[[np.ndarray], np.ndarray]


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        np.save(stream, values)


@pytest.fixture
def segment(tmp_path: Path) -> Path:
    """Twenty seconds northwards at 5 m/s, fixes at 5 Hz, wheels at 20 Hz; the device started at 100 s."""
    folder = tmp_path / "segment"
    pose_s = 100.0 + np.arange(40) * 0.5
    ahead = np.arange(40) * 2.5
    north = np.array([-np.sin(np.radians(50.0)), 0.0, np.cos(np.radians(50.0))])
    save(folder / "global_pose/frame_times", pose_s)
    save(folder / "global_pose/frame_positions", np.array([4_107_864.0, 0.0, 4_862_789.0]) + ahead[:, None] * north)
    save(
        folder / "global_pose/frame_gps_times", np.column_stack([np.full(40, 2012.0), 404_106.5 + np.arange(40) * 0.5])
    )
    at_s = 100.0 + np.arange(100) * 0.2
    place = np.column_stack([50.0 + np.arange(100) * 9e-6, np.zeros(100)])
    rest = np.column_stack([np.full(100, 5.0), np.zeros(100), np.full(100, 30.0), np.full(100, 90.0)])
    save(folder / GNSS / "t", at_s)
    save(folder / GNSS / "value", np.hstack([place, rest]))
    save(folder / WHEELS / "t", 100.0 + np.arange(400) * 0.05)
    save(folder / WHEELS / "value", np.full((400, 4), 5.0))
    return folder


def edit(path: Path, change: Edit) -> None:
    save(path, change(np.load(path)))


def with_nan(row: int, column: int | slice = slice(None)) -> Edit:
    def change(values: np.ndarray) -> np.ndarray:
        values[row, column] = np.nan
        return values

    return change


def test_a_segment_is_a_run(segment: Path) -> None:
    run = comma2k19_run(segment)[0]
    assert (run.run_id, run.gnss.height, run.reference.height) == ("segment", 100, 40)  # type: ignore[union-attr]
    # GPS week 2012 starts on 2018-07-29; the second of the week less 18 leap seconds.
    assert run.gnss["t"].dt.to_string("%FT%T%.f")[0] == "2018-08-02T16:14:48.500"
    assert run.gnss["vel_e_mps"].to_list() == pytest.approx([5.0] * 100)
    assert run.gnss["vel_n_mps"].to_list() == pytest.approx([0.0] * 100, abs=1e-12)
    assert run.odometer is not None
    assert run.odometer["speed_mps"].to_list() == [5.0] * 400


def test_what_a_segment_does_not_know_is_null_or_left_out(segment: Path) -> None:
    edit(segment / GNSS / "value", with_nan(3))
    edit(segment / GNSS / "value", with_nan(4, 4))
    edit(segment / WHEELS / "value", with_nan(0, 1))
    edit(segment / WHEELS / "value", with_nan(1))
    edit(segment / "global_pose/frame_positions", with_nan(7))
    edit(segment / "global_pose/frame_gps_times", with_nan(0))
    run = comma2k19_run(segment)[0]
    assert run.gnss.select("latitude_deg", "height_m", "vel_e_mps", "fix").row(3) == (None, None, None, "none")
    assert run.gnss.select("height_m", "fix").row(4) == (None, "autonomous")
    assert run.gnss["t"].dt.to_string("%FT%T%.f")[0] == "2018-08-02T16:14:48.500"
    assert run.odometer is not None
    assert run.odometer["speed_mps"].to_list() == [5.0] * 399
    assert run.reference is not None
    assert run.reference.height == 39


def test_a_pose_that_wanders_at_standstill_adds_nothing_to_the_track(segment: Path) -> None:
    """Ten seconds standing with 0.3 m of noise: no point of the track lies behind the one before."""

    def stand(values: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(1)
        standing = np.repeat(values[20:21], 200, axis=0) + 0.3 * rng.normal(size=(200, 3))
        return np.concatenate([values[:20], standing, values[20:]])

    edit(segment / "global_pose/frame_positions", stand)
    edit(segment / "global_pose/frame_times", lambda values: 100.0 + np.arange(240) * 0.08)
    track = comma2k19_run(segment)[1].track
    assert (track["latitude_deg"].diff().drop_nulls() > 0.0).all()
    assert track["measure_m"].max() == pytest.approx(97.5, abs=5.0)


@pytest.mark.parametrize("change", [lambda values: values[:0], None])
def test_a_segment_without_wheel_speeds_has_no_odometer(segment: Path, change: Edit | None) -> None:
    for name in ("t", "value"):
        if change:
            edit(segment / WHEELS / name, change)
        else:
            (segment / WHEELS / name).unlink()
    if change is None:
        (segment / WHEELS).rmdir()
    assert comma2k19_run(segment)[0].odometer is None


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (f"{GNSS}/t", lambda values: values[:-3], r"t of shape \(97,\), value of shape \(100, 6\)"),
        (f"{GNSS}/value", lambda values: values[:, :5], "one time per row of 6 values"),
        (f"{GNSS}/value", lambda values: values * 10.0, "latitude_deg: is out of range"),
        (f"{WHEELS}/value", lambda values: values[:, 0], "is not as comma2k19 has it"),
        ("global_pose/frame_positions", lambda values: values * np.nan, "holds no poses"),
        ("global_pose/frame_positions", lambda values: values[:, :2], "is not as comma2k19 has it"),
        ("global_pose/frame_gps_times", lambda values: values * np.nan, "holds no GPS time"),
        ("global_pose/frame_gps_times", lambda values: values[:, 0], "is not as comma2k19 has it"),
        ("global_pose/frame_gps_times", lambda values: values[:, :1], "is not as comma2k19 has it"),
        ("global_pose/frame_times", lambda values: values[0], r"float64 of shape \(\)"),
        (f"{GNSS}/value", lambda values: values.astype(str), "is not as comma2k19 has it"),
    ],
)
def test_a_segment_that_is_not_whole_is_one_error(segment: Path, name: str, change: Edit, message: str) -> None:
    edit(segment / name, change)
    with pytest.raises(InputError, match=message):
        comma2k19_run(segment)


def test_a_segment_without_fixes_is_one_error(segment: Path) -> None:
    for name in ("t", "value"):
        edit(segment / GNSS / name, lambda values: values[:0])
    with pytest.raises(InputError, match="has no rows"):
        comma2k19_run(segment)
    (segment / GNSS / "t").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be read"):
        comma2k19_run(segment)


INFRABEL = (
    "solution_status,position_type,latitude,longitude,timestamp\n"
    "SOL_COMPUTED,NARROW_INT3,50.5,4.5,2022-01-14T10:45:25.400\n"
    "INSUFFICIENT_OBS,SINGLE,,,2022-01-14T10:45:26\n"
)


def test_a_log_of_the_measurement_train(tmp_path: Path) -> None:
    log = tmp_path / "log_1.csv"
    log.write_text(INFRABEL)
    gnss = infrabel_run(log).gnss
    assert gnss["t"].dt.to_string("%T%.f").to_list() == ["10:45:25.400", "10:45:26"]
    assert gnss.select("latitude_deg", "fix").rows() == [(50.5, "rtk_fixed"), (None, "none")]
    assert known_recording(log) is not None


@pytest.mark.parametrize(
    ("word", "fix"),
    [
        ("NARROW_INT", "rtk_fixed"),
        ("INS_RTKFIXED", "rtk_fixed"),
        ("WIDE_INT", "rtk_fixed"),
        ("OMNISTAR_HP", "differential"),
        ("PPP", "differential"),
        ("INS_PSRSP", "autonomous"),
        ("WAAS", "sbas"),
        ("NONE", "none"),
        ("", "none"),
    ],
)
def test_position_types_of_the_receiver(tmp_path: Path, word: str, fix: str) -> None:
    """As the same receiver's ROS messages have them (`test_kinds_of_novatel_solutions`)."""
    log = tmp_path / "log_1.csv"
    log.write_text(INFRABEL.replace("NARROW_INT3", word))
    assert infrabel_run(log).gnss["fix"][0] == fix


@pytest.mark.parametrize("cut", range(1, 29))
def test_half_a_row_at_the_end_is_left_out(tmp_path: Path, cut: int) -> None:
    """However much of the last row the recorder wrote."""
    whole = INFRABEL + "SOL_COMPUTED,SINGLE,50.6,4.6,2022-01-14T10:46:26"
    log = tmp_path / "log_1.csv"
    log.write_text(whole[: len(INFRABEL) + cut])
    found = known_recording(log)
    assert found is not None
    assert found.run.gnss.height == 2
    assert list(found.dropped.values()) == [1]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("50.5", "north", "column latitude: cannot be read.*'north' in row 0"),
        ("2022-01-14T10:45:26", "noon", "column timestamp: cannot be read.*'noon'"),
        ("2022-01-14T10:45:26", "2022-01-14T10:45", "column timestamp: cannot be read.*'2022-01-14T10:45' in row 1"),
        ("2022-01-14T10:45:26", "", "column t: has missing values"),
        ("50.5", "95.5", "latitude_deg: is out of range"),
        ("NARROW_INT3", "MAGIC", "position_type: a position type is not known; found MAGIC"),
        ("latitude", "breadth", "lacks columns of an Infrabel log; found no latitude"),
    ],
)
def test_a_log_that_is_not_whole_is_one_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    log = tmp_path / "log_1.csv"
    log.write_text(INFRABEL.replace(old, new))
    with pytest.raises(InputError, match=message):
        infrabel_run(log)


def test_the_command_makes_runs_of_both(
    segment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log_1.csv"
    log.write_text(INFRABEL)
    for source, epochs in ((segment, 100), (log, 2)):
        to = tmp_path / f"run-{epochs}"
        monkeypatch.setattr(sys, "argv", ["balise", "convert", str(source), "--to", str(to)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith(f"{epochs} epochs in ")
        assert read_run(to, IngestConfig()).gnss.height == epochs
    assert known_recording(tmp_path) is None
