"""What lies in a folder, by what it holds and not by its name alone."""

from __future__ import annotations

from pathlib import Path

from pipeline.project.found import look_around
from pipeline.read.ingest.csv_draft import draft_mapping


def test_a_log_of_gpsd_is_no_map(tmp_path: Path) -> None:
    (tmp_path / "gpsd.json").write_text('{"class":"VERSION","release":"3.25"}\n{"class":"TPV","mode":1}\n')
    (tmp_path / "map.json").write_text('{"version":0.6,"elements":[{"type":"node","id":1,"lat":50.0,"lon":14.0}]}')
    found = look_around(tmp_path)
    assert [path.name for path in found["logs"]] == ["gpsd.json"]
    assert [path.name for path in found["surveys"]] == ["map.json"]


def test_a_log_of_traccar_is_no_line(tmp_path: Path) -> None:
    """The time of the server is not that of the position."""
    header = "id,deviceId,protocol,serverTime,deviceTime,fixTime,valid,latitude,longitude\n"
    row = "1,1,osmand,2025-03-03T08:00:02Z,2025-03-03T08:00:01Z,2025-03-03T08:00:00Z,true,50.0,14.0\n"
    log = tmp_path / "traccar.csv"
    log.write_text(header + row)
    assert look_around(tmp_path)["logs"] == [log]
    assert 'time = "field:fixTime"' in draft_mapping(log)
