"""What lies in a folder, by what it holds and not by its name alone."""

from __future__ import annotations

from pathlib import Path

from pipeline.project.found import look_around


def test_a_log_of_gpsd_is_no_map(tmp_path: Path) -> None:
    (tmp_path / "gpsd.json").write_text('{"class":"VERSION","release":"3.25"}\n{"class":"TPV","mode":1}\n')
    (tmp_path / "map.json").write_text('{"version":0.6,"elements":[{"type":"node","id":1,"lat":50.0,"lon":14.0}]}')
    found = look_around(tmp_path)
    assert [path.name for path in found["logs"]] == ["gpsd.json"]
    assert [path.name for path in found["surveys"]] == ["map.json"]
