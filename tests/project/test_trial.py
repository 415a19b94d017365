"""Raw logs to a project: streams, rides, corrections, and what is refused."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import cli
from pipeline.project.looking import InspectedLog, StreamSpan, look_at_dates
from pipeline.project.recorded_runs import group_into_runs
from schemas.config import IngestConfig, StreamCorrection
from schemas.project import Project, load_project
from tests.conftest import SmallTrial
from tests.project.test_run import nmea

MORNING = datetime(2025, 3, 3, 6)
ODOMETER = "time;v_kmh\n" + "".join(f"2025-03-03T10:12:{second:02d}Z;0.0\n" for second in range(40))


def log(name: str, begin_min: float, end_min: float, stream: str = "gnss") -> InspectedLog:
    times = (MORNING + timedelta(minutes=minute) for minute in (begin_min, end_min))
    return InspectedLog(Path(name), {stream: StreamSpan(10, *times)})  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("logs", "recorded_runs"),
    [
        ([log("a.ubx", 0, 60), log("b.ubx", 60.5, 120)], [["a.ubx+b.ubx"]]),
        ([log("a.ubx", 0, 60), log("b.ubx", 90, 120)], [["a.ubx"], ["b.ubx"]]),
        ([log("b.sbf", 1, 61), log("a.ubx", 0, 60)], [["b.sbf", "a.ubx"]]),
        ([log("a.ubx", 0, 60), log("o.csv", 700, 760, "odometer")], [["a.ubx", "o.csv"]]),
        (
            [log("a.ubx", 0, 60), log("b.ubx", 90, 120), log("o.csv", 95, 119, "odometer")],
            [["a.ubx"], ["b.ubx", "o.csv"]],
        ),
        (
            [log("a.ubx", 0, 60), log("b.ubx", 90, 120), log("o.csv", 0, 120, "odometer")],
            [["a.ubx", "o.csv"], ["b.ubx", "o.csv"]],
        ),
    ],
)
def test_logs_of_one_ride(logs: list[InspectedLog], recorded_runs: list[list[str]]) -> None:
    found, alone = group_into_runs(logs, [])
    assert alone == []
    runs = [
        ["+".join(file.path.name for file in files) for files in recorded_run.receivers]
        + [other.path.name for other in recorded_run.others]
        for recorded_run in found
    ]
    assert runs == recorded_runs


def test_a_log_of_no_ride_is_reported() -> None:
    _, alone = group_into_runs([log("a.ubx", 0, 1), log("b.ubx", 90, 91), log("o.csv", 30, 31, "odometer")], [])
    assert [one.path.name for one in alone] == ["o.csv"]


def test_logs_of_one_name_have_ids_of_their_own() -> None:
    found, _ = group_into_runs([log("/x/mon/log.ubx", 0, 1), log("/x/tue/log.ubx", 90, 91)], [])
    assert [recorded_run.run_id for recorded_run in found] == ["mon_log", "tue_log"]


@pytest.fixture
def raw(tmp_path: Path, small_trial: SmallTrial, monkeypatch: pytest.MonkeyPatch, in_process: None) -> Path:
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "still.nmea").write_text(nmea())
    (tmp_path / "raw" / "plc.csv").write_text(ODOMETER)
    (tmp_path / "raw" / "notes.txt").write_text("nothing of interest\n")
    (tmp_path / "line.gpx").write_text(
        '<gpx version="1.1"><trk><trkseg><trkpt lat="50.01" lon="14.0"/><trkpt lat="50.03" lon="14.0"/>'
        "</trkseg></trk></gpx>"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*arguments: str) -> int:
    return cli._run_guarded(list(arguments), debug=False)


def written(folder: Path) -> Project:
    return load_project(folder / "balise.toml")


def test_two_commands_from_logs_to_report(raw: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("trial", "raw", "--track", "line.gpx", "--balises", "every 500", "--to", "week12") == 0
    said = capsys.readouterr().out
    assert "not used: raw/notes.txt" in said
    assert said.endswith("now: balise run --project week12\n")
    (entry,) = written(raw / "week12").convert
    assert [found.files for found in entry.logs] == [("../raw/still.nmea",), ("../raw/plc.csv",)]
    (odometer,) = entry.logs[1].odometer
    assert (odometer.fields, odometer.time) == ({"speed_mps": "v_kmh"}, "field:time")
    assert odometer.factors["speed_mps"] == pytest.approx(1 / 3.6)
    assert call("run", "--project", "week12") == 0
    assert (raw / "week12/result/report/index.html").exists()


@pytest.mark.parametrize("way", [("trial", "raw", "--track", "line.gpx", "--to", "."), ("init", ".")])
def test_a_log_that_was_lost_stands_beside_the_verdict(
    raw: Path, way: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    (raw / "raw" / "lost.ubx").write_bytes(bytes(1000))
    assert call(*way) == 0
    assert written(raw).unread == ("raw/lost.ubx",)
    capsys.readouterr()
    assert call("run") == 1
    ending = capsys.readouterr().out
    assert ending.index("unproven") < ending.index("NOT REPLAYED: raw/lost.ubx")
    assert call("run", "--json") == 1
    assert json.loads(capsys.readouterr().out)["unread"] == ["raw/lost.ubx"]
    text = (raw / "balise.toml").read_text()
    (raw / "balise.toml").write_text(text.replace('"raw/lost.ubx",', "", 1))
    assert call("run") == 0


def test_a_folder_is_a_project_by_one_word(raw: Path) -> None:
    assert call("init", ".") == 0
    project = written(raw)
    assert project.track is not None
    assert (project.track.survey, [entry.to for entry in project.convert]) == (("line.gpx",), ["runs/still"])
    assert call("init", ".") == 2


def test_every_key_of_the_comment_is_one(tmp_path: Path) -> None:
    assert call("init", str(tmp_path)) == 0
    text = (tmp_path / "balise.toml").read_text()
    listed = text[text.index("# All other keys") :].splitlines()[1:]
    lines = [line.removeprefix("#").removeprefix(" ") for line in listed]
    # Several vehicles and a calibration exclude each other.
    (tmp_path / "all.toml").write_text("\n".join(line for line in lines if not line.startswith("vehicles")))
    assert load_project(tmp_path / "all.toml").model_fields_set == set(Project.model_fields) - {"vehicles"}
    assert any(line.startswith("vehicles") for line in lines)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["raw"], "--track: needs the line"),
        (["raw", "--track", "nowhere.gpx"], "--track nowhere.gpx: does not exist"),
        (["nowhere", "--track", "line.gpx"], "nowhere: does not exist"),
        (["raw/notes.txt", "--track", "line.gpx"], "raw/notes.txt: needs a mapping of its columns"),
        (["raw/plc.csv", "--track", "line.gpx"], "no log holds positions"),
    ],
)
def test_wrong_calls(raw: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("trial", *arguments, "--to", "week12") in (1, 2)
    assert message in capsys.readouterr().err
    assert not (raw / "week12").exists()


def test_corrections_are_proposed_and_accepted(raw: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (raw / "raw" / "still.nmea").write_text(nmea(100, acceleration_mps2=0.2))
    rows = (f"2025-03-03T10:{12 + s // 60:02d}:{s % 60:02d}Z;{1e-4 * s**2:.5f}" for s in range(100))
    (raw / "raw" / "plc.csv").write_text("time;dist\n" + "\n".join(rows) + "\n")
    base = ("trial", "raw", "--track", "line.gpx", "--json")
    assert call(*base, "--to", "asked") == 0
    (proposed,) = json.loads(capsys.readouterr().out)["corrections"]
    assert proposed["accepted"] is False
    assert "factors" in "".join(proposed["toml"])
    assert written(raw / "asked").convert[0].correct == ()
    assert call("run", "--project", "asked") == 1  # kilometres taken as metres cannot be
    assert call(*base, "--to", "yes", "--accept-corrections") == 0
    (correction,) = written(raw / "yes").convert[0].correct
    assert (correction.stream, correction.factors) == ("odometer", {"distance_m": 1000.0})
    assert call("run", "--project", "yes") == 0


def test_nobody_but_a_person_accepts_that_positions_are_moved(
    raw: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another datum, or a receiver that is wrong by as much: the survey alone cannot tell."""
    moved = StreamCorrection(stream="gnss", shift_east_m=40.0)
    monkeypatch.setattr("pipeline.project.trial._correct_recorder", lambda *_: ([moved], None))
    monkeypatch.setattr("pipeline.project.trial._proposed_corrections", lambda _: [moved])
    assert call("trial", "raw", "--track", "line.gpx", "--json", "--to", "week12", "--accept-corrections") == 0
    (proposed,) = json.loads(capsys.readouterr().out)["corrections"]
    assert proposed["accepted"] is False
    assert written(raw / "week12").convert[0].correct == ()


@pytest.mark.parametrize("answer", [True, False])
def test_corrections_are_asked_for_on_a_terminal(
    raw: Path, answer: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (raw / "raw" / "still.nmea").write_text(nmea(100, acceleration_mps2=0.2))
    rows = (f"2025-03-03T10:{12 + s // 60:02d}:{s % 60:02d}Z;{1e-4 * s**2:.5f}" for s in range(100))
    (raw / "raw" / "plc.csv").write_text("time;dist\n" + "\n".join(rows) + "\n")
    asked: list[str] = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr(cli, "confirm", lambda question, **_: asked.append(question) or answer)
    assert call("trial", "raw", "--track", "line.gpx", "--to", "week12") == 0
    assert asked == ["Accept these corrections?"]
    assert "still does not fit as recorded:" in capsys.readouterr().err
    assert bool(written(raw / "week12").convert[0].correct) is answer


def test_a_drive_recorded_with_rtk_is_the_line(raw: Path) -> None:
    rows = (f"2025/03/03 10:12:{s:02d}.000 {50.01 + s * 1e-4:.9f} 14.000000000 250.0 1 8\n" for s in range(40))
    head = "%  UTC                  latitude(deg) longitude(deg)  height(m)   Q  ns\n"
    (raw / "drive.pos").write_text(head + "".join(rows))
    assert call("trial", "raw", "--track", "drive.pos", "--to", "week12") == 0
    assert written(raw / "week12").track.survey == ("../drive.pos",)  # type: ignore[union-attr]
    assert call("run", "--project", "week12") in (0, 1)
    assert (raw / "week12/site/track.parquet").exists()


def test_a_column_called_by_its_unit_counts_in_it(raw: Path) -> None:
    (raw / "raw" / "plc.csv").write_text("time;km\n2025-03-03T10:12:00Z;0.0\n2025-03-03T10:12:39Z;0.0\n")
    assert call("trial", "raw", "--track", "line.gpx", "--to", "week12") == 0
    assert written(raw / "week12").convert[0].logs[1].odometer[0].factors == {"distance_m": 1000.0}


def test_a_logger_of_local_time_is_corrected_in_all_its_streams_and_the_receiver_is_not(raw: Path) -> None:
    (raw / "raw" / "still.nmea").write_text(nmea(100, acceleration_mps2=0.2))
    # Winter in Berlin is an hour ahead of UTC. At 0.1 m per s squared the reads are at 40, 160, 360, 640 m.
    reads = {20: "B20", 40: "B40", 60: "B60", 80: "B80"}
    lines = ["Zeit;Weg [m];Balise"]
    for s in range(100):
        way = f"{0.1 * s**2:.2f}".replace(".", ",")
        lines.append(f"03.03.2025 11:{12 + s // 60:02d}:{s % 60:02d};{way};{reads.get(s, '')}")
    (raw / "raw" / "plc.csv").write_text("\n".join(lines) + "\n")
    # A degree of the meridian is 111,229 m here; the ride begins at 50.02 degrees.
    places = (f"B{s};{50.02 + 0.1 * s**2 / 111229:.7f};14.0;physisch" for s in (20, 40, 60, 80))
    (raw / "balisen.csv").write_text("\n".join(["Name;Breite;Länge;Art", *places]) + "\n")
    (raw / "line.gpx").write_text(
        '<gpx version="1.1"><trk><trkseg><trkpt lat="50.01" lon="14.0"/><trkpt lat="50.04" lon="14.0"/>'
        "</trkseg></trk></gpx>"
    )
    (raw / "settings.toml").write_text("[hazards]\n")
    base = ("trial", "raw", "--track", "line.gpx", "--balises", "balisen.csv", "--config", "settings.toml")
    assert call(*base, "--to", "new/week12", "--accept-corrections") == 0
    (entry,) = written(raw / "new/week12").convert
    shifts = {correction.stream: correction.shift_s for correction in entry.correct}
    assert shifts == {"odometer": -3600.0, "balise_reads": -3600.0}


def test_dates_are_in_the_order_that_fits_other_logs(tmp_path: Path) -> None:
    (tmp_path / "plc.csv").write_text("Zeit;Weg\n12.06.2025 11:30:00;1,0\n12.06.2025 11:30:01;2,0\n")

    def on(month: int, day: int) -> InspectedLog:
        times = (datetime(2025, month, day, 9, 30, tzinfo=UTC), datetime(2025, month, day, 9, 40, tzinfo=UTC))
        return InspectedLog(Path("a.ubx"), {"gnss": StreamSpan(10, *times)})

    def start(*others: InspectedLog) -> datetime | None:
        log = look_at_dates(tmp_path / "plc.csv", IngestConfig(), others)
        return log and log.start

    assert start(on(6, 12)) == datetime(2025, 6, 12, 11, 30, tzinfo=UTC)
    assert start(on(12, 6)) == datetime(2025, 12, 6, 11, 30, tzinfo=UTC)
    assert start() is start(on(3, 3)) is start(on(6, 12), on(12, 6)) is None


def test_what_lies_beside_logs_and_is_none_is_named(raw: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A ride recorded as GPX is taken for a line; nothing in a folder of logs is passed over without a word."""
    (raw / "raw" / "ride.gpx").write_text("<gpx/>")
    assert call("trial", "raw", "--track", "line.gpx", "--to", "week12") == 0
    said = capsys.readouterr().out
    assert "not used: raw/ride.gpx: taken for a line" in said
    assert "still.nmea: messages used: " in said
    assert "plc.csv: columns not used: none" in said


def test_why_no_log_holds_positions(raw: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (raw / "raw" / "still.nmea").unlink()
    rows = "".join(f"2025-03-03 10:12:{second:02d},50.1,14.2\n" for second in range(40))
    (raw / "raw" / "gnss.csv").write_text("Time (CEST),lat,lon\n" + rows)
    assert call("trial", "raw", "--track", "line.gpx", "--to", "week12") != 0
    errors = capsys.readouterr().err
    assert "no log holds positions" in errors
    assert "in 'CEST', which is not UTC" in errors
