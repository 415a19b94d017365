"""A run is corrected once: when it is converted, or when it is read."""

from __future__ import annotations

from pathlib import Path

import pytest

import cli
from datasets.recordings import convert_logs
from pipeline.make.receivers import Purpose
from pipeline.read.ingest import read_run
from schemas.config import Configuration, IngestConfig
from schemas.errors import InputError

LATER = {"stream": "gnss", "shift_s": 2.0}
FARTHER = {"stream": "odometer", "factors": {"distance_m": 1000.0}}
MAPPING = {"topic": "plc.csv", "time": "field:time", "fields": {"distance_m": "way"}}
POS = "%  UTC                  latitude(deg) longitude(deg)  height(m)   Q  ns\n" + "".join(
    f"2025/03/03 10:12:{second:02d}.000   50.{second:09d}   14.000000000   250.0   5   8\n" for second in range(5)
)
PLC = "time,way\n" + "".join(f"2025-03-03T10:12:{second:02d}Z,{second / 1000}\n" for second in range(5))


def settings(*corrections: dict[str, object]) -> Configuration:
    return Configuration(ingest=IngestConfig.model_validate({"odometer": [MAPPING], "correct": list(corrections)}))


def converted(folder: Path, to: Path, config: Configuration, *names: str, purpose: Purpose | None = None) -> None:
    (folder / "a.pos").write_text(POS)
    (folder / "b.pos").write_text(POS)
    (folder / "plc.csv").write_text(PLC)
    convert_logs([folder / name for name in names], to, config, purpose or Purpose(), None, False)


def reading(config: Configuration) -> IngestConfig:
    """Without the mapping of a table, which is no topic of the run."""
    return config.ingest.model_copy(update={"odometer": ()})


def first_second(run: Path, config: Configuration) -> int:
    return int(read_run(run, reading(config)).gnss["t"].dt.second()[0])


@pytest.mark.parametrize("name", ["run", "run.mcap"])
def test_what_was_corrected_when_converted_is_not_corrected_again(tmp_path: Path, name: str) -> None:
    to = tmp_path / name
    both = settings(LATER, FARTHER)
    converted(tmp_path, to, both, "a.pos", "plc.csv")
    for config in (both, settings(), settings(LATER), settings(LATER, FARTHER, {"stream": "odometer", "shift_s": 1.0})):
        assert first_second(to, config) == 2
    run = read_run(to, reading(both))
    assert run.odometer is not None
    assert run.odometer["distance_m"].to_list() == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])
    assert [made.changes for made in run.notes.corrections] == ["shift_s 2.0", "factors {'distance_m': 1000.0}"]
    assert first_second(to, settings(LATER, {"stream": "gnss", "shift_s": 5.0})) == 7


def test_other_corrections_than_those_of_the_file_are_refused(tmp_path: Path) -> None:
    converted(tmp_path, tmp_path / "run", settings(LATER), "a.pos")
    with pytest.raises(InputError, match="written with other corrections"):
        read_run(tmp_path / "run", settings({"stream": "gnss", "shift_s": 11.0}).ingest)


def test_streams_that_come_later_are_corrected_when_they_come(tmp_path: Path) -> None:
    both = settings(LATER, FARTHER)
    converted(tmp_path, tmp_path / "run", both, "a.pos")
    converted(tmp_path, tmp_path / "run", both, "plc.csv")
    run = read_run(tmp_path / "run", both.ingest)
    assert run.odometer is not None
    assert (run.gnss["t"].dt.second()[0], run.odometer["distance_m"][1]) == (2, pytest.approx(1.0))


def test_a_second_receiver_is_corrected_as_the_first(tmp_path: Path) -> None:
    converted(tmp_path, tmp_path / "run", settings(LATER), "a.pos")
    with pytest.raises(InputError, match="receivers of one gnss with different corrections"):
        converted(tmp_path, tmp_path / "run", settings(), "b.pos", purpose=Purpose("second"))
    converted(tmp_path, tmp_path / "run", settings(LATER), "b.pos", purpose=Purpose("second"))
    assert read_run(tmp_path / "run").gnss["t"].dt.second().unique().sort().to_list() == [2, 3, 4, 5, 6]


def test_a_corrected_log_converted_again_keeps_its_corrections(tmp_path: Path) -> None:
    converted(tmp_path, tmp_path / "run.mcap", settings(LATER), "a.pos")
    converted(tmp_path, tmp_path / "again", Configuration(ingest=reading(settings(LATER))), "run.mcap")
    assert first_second(tmp_path / "again", settings(LATER)) == 2


def test_the_command_says_what_it_corrected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.pos").write_text(POS)
    config = tmp_path / "c.toml"
    config.write_text('[[ingest.correct]]\nstream = "gnss"\nshift_s = 2.0\n')
    arguments = ["convert", str(tmp_path / "a.pos"), "--out", str(tmp_path / "run"), "--config", str(config)]
    assert cli._run_guarded(arguments, debug=False) == 0
    assert "corrected: gnss: shift_s 2.0" in capsys.readouterr().out
