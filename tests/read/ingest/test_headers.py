"""Header words of loggers in several languages: known, or asked about; a time is never taken for UTC without a word."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.make.receivers import convert
from pipeline.project.convert import Recordings
from pipeline.project.found import look_around
from pipeline.project.looking import look_at
from pipeline.read.ingest.csv_draft import draft_mapping
from pipeline.read.ingest.guesses import columns_in, word_of, zone_in
from schemas.config import IngestConfig, settings_from, toml_of
from schemas.errors import InputError

TIME = "2025-06-03 08:00:0{}"


def drafted(folder: Path, text: str) -> dict[str, Any]:
    path = folder / "log.csv"
    path.write_text(text)
    found = toml_of(draft_mapping(path).encode(), "draft").get("ingest", {})
    assert isinstance(found, dict)
    return found


def times_by_draft(folder: Path, text: str) -> list[str]:
    """The times of the positions that the draft, as it is, makes of a table."""
    mapping = settings_from(drafted(folder, text), IngestConfig, "draft")
    return convert([folder / "log.csv"], "r", mapping).run.gnss["t"].dt.to_string("%Y-%m-%dT%H:%M:%S").to_list()


@pytest.mark.parametrize(
    ("name", "zone"),
    [
        *((name, None) for name in ("Time", "Time (UTC)", "timestamp [ns]", "time (s)", "Zeit (hh:mm:ss.fff)")),
        *((name, None) for name in ("Time (UTC+0)", "GMT time", "UnixTimeMillis", "Datum/Uhrzeit (TT.MM.JJJJ)")),
        *((name, "MESZ") for name in ("Zeit (MESZ)", "Zeit MESZ", "Zeit_MESZ", "ZeitMESZ")),
        *((name, "CEST") for name in ("Time (CEST)", "Time CEST", "Time [CEST]", "TimeCEST")),
        ("timestamp_cest", "cest"),
        ("Local time", "Local"),
        ("localtime", "local"),
        ("Heure locale", "locale"),
        ("Czas lokalny", "lokalny"),
        ("Ortszeit", "Orts"),
        ("Time (EDT)", "EDT"),
        ("Time MSK", "MSK"),
        ("Time (logger)", "logger"),
        ("Time (UTC+2)", "UTC+2"),
        ("Time GMT-03:30", "UTC-03:30"),
        ("Time (Europe/Berlin)", "Europe/Berlin"),
    ],
)
def test_zones_that_names_tell(name: str, zone: str | None) -> None:
    assert zone_in(name)[0] == zone


@pytest.mark.parametrize(
    "name",
    [
        "Zeit (MESZ)",
        "Time CEST",
        "timestamp_cest",
        "Local time",
        "Ortszeit",
        "Heure locale",
        "Czas lokalny",
        "Time (X)",
    ],
)
def test_times_of_a_zone_that_is_not_known_are_asked_about(tmp_path: Path, name: str) -> None:
    text = f"{name},lat,lon\n" + "".join(f"{TIME.format(n)},50.1,14.2\n" for n in range(2))
    (entry,) = drafted(tmp_path, text)["gnss"]
    assert "time" not in entry
    assert f'# time = "field:{name}"' in draft_mapping(tmp_path / "log.csv")
    nothing = Recordings(known=lambda _: None, write=lambda *_: None)
    with pytest.raises(InputError, match="needs a mapping"):
        look_at(tmp_path / "log.csv", IngestConfig(), None, nothing)
    # It is a log all the same: neither a survey nor a list of balises.
    assert look_around(tmp_path)["logs"] == [tmp_path / "log.csv"]


@pytest.mark.parametrize(
    ("name", "first"),
    [
        ("Time (UTC)", "2025-06-03T08:00:00"),
        ("Time (UTC+2)", "2025-06-03T06:00:00"),
        ("Time_UTC-05:00", "2025-06-03T13:00:00"),
        ("Time (Europe/Warsaw)", "2025-06-03T06:00:00"),
    ],
)
def test_zones_that_are_certain(tmp_path: Path, name: str, first: str) -> None:
    text = f"{name},lat,lon\n" + "".join(f"{TIME.format(n)},50.1,14.2\n" for n in range(2))
    assert times_by_draft(tmp_path, text)[0] == first


def test_a_zone_in_the_row_of_units(tmp_path: Path) -> None:
    text = f"Time,lat,lon\nCEST,deg,deg\n{TIME.format(0)},50.1,14.2\n{TIME.format(1)},50.1,14.2\n"
    assert "time" not in drafted(tmp_path, text)["gnss"][0]


@pytest.mark.parametrize(
    ("header", "row", "first"),
    [
        ("#timestamp,lat,lon", "174098880{}000000000,50.1,14.2", "2025-03-03T08:00:00"),
        ("# timestamp [ns], latitude [deg], longitude [deg]", "174098880{}000000000,50.1,14.2", "2025-03-03T08:00:00"),
        ("# made by hand\n#t;lat;lon", "2025-03-03 08:00:0{};50,1;14,2", "2025-03-03T08:00:00"),
        ("UnixTimeMillis,LatitudeDegrees,LongitudeDegrees", "174098880{}000,50.1,14.2", "2025-03-03T08:00:00"),
        # 2025-03-03 is 16493 days after 1980-01-06; GPS time is 18 s ahead.
        ("millisSinceGpsEpoch,latDeg,lngDeg", "142502401{}000,50.1,14.2", "2025-03-03T07:59:52"),
        ("Horodatage;Latitude;Longitude", "2025-03-03 08:00:0{};50,1;14,2", "2025-03-03T08:00:00"),
        ("Date et heure;Lat;Long.", "2025-03-03 08:00:0{};50,1;14,2", "2025-03-03T08:00:00"),
        ("Data i czas;Szerokość geogr.;Długość geogr.", "2025-03-03 08:00:0{};50,1;14,2", "2025-03-03T08:00:00"),
        ("Znacznik czasu;Szerokość;Długość", "2025-03-03 08:00:0{};50,1;14,2", "2025-03-03T08:00:00"),
        ("Czas (UTC),Szer.,Dł.", "2025-03-03 08:00:0{},50.1,14.2", "2025-03-03T08:00:00"),
    ],
)
def test_header_words(tmp_path: Path, header: str, row: str, first: str) -> None:
    text = "\n".join([header, *(row.format(n) for n in range(3)), ""])
    assert times_by_draft(tmp_path, text)[0] == first


def test_a_comment_that_names_no_columns_is_none(tmp_path: Path) -> None:
    text = "# lat, lon, 5\n# exported, by, someone\nt,lat,lon\n2025-03-03T08:00:00Z,50.1,14.2\n"
    assert times_by_draft(tmp_path, text) == ["2025-03-03T08:00:00"]


@pytest.mark.parametrize(
    ("header", "stream", "fields"),
    [
        ("czas;balisa", "balise_reads", {"balise_id": "balisa"}),
        ("Horodatage;Identifiant balise", "balise_reads", {"balise_id": "Identifiant balise"}),
        ("czas;Droga [m]", "odometer", {"distance_m": "Droga [m]"}),
        ("czas;Przebieg [m];Prędkość [m/s]", "odometer", {"distance_m": "Przebieg [m]", "speed_mps": "Prędkość [m/s]"}),
        ("Temps;Odomètre (m)", "odometer", {"distance_m": "Odomètre (m)"}),
        ("Data pomiaru;NID_BG", "balise_reads", {"balise_id": "NID_BG"}),
        ("horodatage;Distance parcourue (m)", "odometer", {"distance_m": "Distance parcourue (m)"}),
    ],
)
def test_other_streams(tmp_path: Path, header: str, stream: str, fields: dict[str, str]) -> None:
    columns = header.count(";")
    text = header + "".join(f"\n2025-03-03 08:00:0{n}" + f";{n}" * columns for n in range(3))
    assert drafted(tmp_path, text)[stream][0]["fields"] == fields


def test_times_called_gps_are_said_to_be_taken_for_utc(tmp_path: Path) -> None:
    rows = "".join(f"{TIME.format(n)},50.1,14.2\n" for n in range(2))
    nothing = Recordings(known=lambda _: None, write=lambda *_: None)
    for name, said in (("GPS time", 1), ("Time (UTC)", 0)):
        (tmp_path / "log.csv").write_text(f"{name},lat,lon\n{rows}")
        log = look_at(tmp_path / "log.csv", IngestConfig(), None, nothing)
        assert sum('time_scale = "gps"' in text for text in log.assumed) == said


def test_units_behind_names_without_brackets(tmp_path: Path) -> None:
    """36 km/h are 10 m/s."""
    rows = "".join(f"{TIME.format(n)};36,0\n" for n in range(3))
    for name in ("Vitesse km/h", "Predkosc_kmh", "v [km/h]"):
        (entry,) = drafted(tmp_path, f"Temps;{name}\n{rows}")["odometer"]
        assert entry["factors"]["speed_mps"] == pytest.approx(10.0 / 36.0)


@pytest.mark.parametrize(
    "name", ["Latitude N", "pos_lat", "geogr. Breite", "szerokosc_geo", "lat_dd", "LatitudeDegrees"]
)
def test_names_of_latitudes(name: str) -> None:
    assert columns_in("gnss", {name: word_of(name)}) == {"latitude_deg": name}


@pytest.mark.parametrize(
    "above",
    [
        "Logger X v1.2\nSerial, 123\n\n",
        "Logger X\n",
        "Start: 2025-06-03 08:00:00\nInterval; 100 ms\n\n\n",
        "a,b\n1,2\n",
    ],
)
def test_what_a_logger_writes_above_the_header(tmp_path: Path, above: str) -> None:
    rows = "".join(f"{TIME.format(n)},50.1,14.2\n" for n in range(3))
    assert times_by_draft(tmp_path, f"{above}time,lat,lon\n{rows}") == [f"2025-06-03T08:00:0{n}" for n in range(3)]
    units = f"{above}time,lat,lon\n,deg,deg\n{rows}"
    assert len(times_by_draft(tmp_path, units)) == 3
    mapping = settings_from(drafted(tmp_path, units), IngestConfig, "draft")
    assert convert([tmp_path / "log.csv"], "r", mapping).dropped["line above the header"] == above.count("\n")


def test_a_header_that_is_shorter_than_its_rows_is_none_above_one(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,lat\n" + "".join(f"{TIME.format(n)},50.1,14.2\n" for n in range(3)))
    with pytest.raises(InputError, match="has more values than the header"):
        draft_mapping(tmp_path / "log.csv")
