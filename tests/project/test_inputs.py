"""What a step reads decides whether it is up to date: each file of each kind of survey and log, and what comes to be.

The interpreter itself tells which files were opened (`sys.addaudithook`); that needs no help of the door under test.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import shutil
import sqlite3
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.recordings import public_recordings
from pipeline.make.survey.make import make_site, site_request
from pipeline.make.survey.sources import read_surveys
from pipeline.project.convert import convert_entry, logs_of
from pipeline.project.made import Product, Record
from pipeline.project.opened import OpenedProject
from pipeline.storage.noted import noting
from schemas.config import Configuration, Vehicle
from schemas.errors import BaliseError
from schemas.project import Project
from tests.conftest import SmallTrial
from tests.make.receivers.messages import nav_pvt, pvt_geodetic
from tests.make.receivers.test_corrections import POS
from tests.make.survey.test_map_files import belgian, line_wkb, write
from tests.project.test_run import nmea
from tests.read.ingest.test_declared import bag_of, part

Reading = Callable[[], object]
Maker = Callable[[Path, SmallTrial], Reading]

_LISTENERS: list[list[Path]] = []


def _hear(event: str, arguments: tuple[object, ...]) -> None:
    if _LISTENERS and event in ("open", "sqlite3.connect") and isinstance(arguments[0], (str, bytes, os.PathLike)):
        _LISTENERS[-1].append(Path(os.fsdecode(arguments[0])).absolute())


sys.addaudithook(_hear)


@contextlib.contextmanager
def heard() -> Iterator[list[Path]]:
    """The files that are opened in this block; such a hook cannot be taken off again."""
    _LISTENERS.append([])
    try:
        yield _LISTENERS[-1]
    finally:
        _LISTENERS.pop()


def survey(*paths: Path, balises: Path | None = None) -> Reading:
    request = site_request(list(paths), None if balises is None else str(balises), None, None, False)
    return lambda: make_site(request, Vehicle(), Configuration())


def logs(folder: Path, *named: str, **mapping: object) -> Reading:
    """The run of these logs, as a project in this folder converts it."""
    table = {"to": "made/run", "logs": [{"files": list(named), **mapping}]}
    opened = OpenedProject(folder / "balise.toml", Project.model_validate({"convert": [table]}))
    (entry,) = opened.project.convert
    config = Configuration()
    assert logs_of(opened, entry)
    return lambda: convert_entry(opened, entry, config.ingest, config.fix_sigma, public_recordings())


def geojson(folder: Path, trial: SmallTrial) -> Reading:
    line = '{"type": "LineString", "coordinates": [[4.48, 50.9], [4.49, 50.91]]}'
    (folder / "line.geojson").write_text(
        f'{{"features": [{{"type": "Feature", "properties": {{}}, "geometry": {line}}}]}}'
    )
    (folder / "list.csv").write_text("name,latitude,longitude\nB1,50.905,4.485\n")
    return survey(folder / "line.geojson", balises=folder / "list.csv")


def gpx(folder: Path, trial: SmallTrial) -> Reading:
    points = "".join(f'<trkpt lat="{50 + n / 1e4}" lon="14"></trkpt>' for n in range(5))
    (folder / "line.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    return survey(folder / "line.gpx")


def kmz(folder: Path, trial: SmallTrial) -> Reading:
    placed = "<Placemark><LineString><coordinates>14,50 14,50.01</coordinates></LineString></Placemark>"
    with zipfile.ZipFile(folder / "line.kmz", "w") as packed:
        packed.writestr("doc.kml", f"<kml><Document>{placed}</Document></kml>")
    return survey(folder / "line.kmz")


def kml(folder: Path, trial: SmallTrial) -> Reading:
    placed = "<Placemark><LineString><coordinates>14,50 14,50.01</coordinates></LineString></Placemark>"
    (folder / "line.kml").write_text(f"<kml><Document>{placed}</Document></kml>")
    return survey(folder / "line.kml")


def points(folder: Path, trial: SmallTrial) -> Reading:
    (folder / "line.csv").write_text("latitude,longitude\n50.0,14.0\n50.01,14.0\n")
    return survey(folder / "line.csv")


def flatgeobuf(folder: Path, trial: SmallTrial) -> Reading:
    return survey(write(folder / "line.fgb", [line_wkb(belgian())]))


def shapefile(folder: Path, trial: SmallTrial) -> Reading:
    return survey(write(folder / "line.shp", [line_wkb(belgian())]))


def geopackage(folder: Path, trial: SmallTrial) -> Reading:
    return survey(write(folder / "line.gpkg", [line_wkb(belgian())]))


def recorded_line(folder: Path, trial: SmallTrial) -> Reading:
    shutil.copytree(trial.paths[0], folder / "drive")
    file = folder / "drive" / "gnss.parquet"
    pl.read_parquet(file).with_columns(fix=pl.lit("rtk_fixed")).write_parquet(file)
    return survey(folder / "drive")


def sentences(folder: Path, trial: SmallTrial) -> Reading:
    (folder / "one.nmea").write_text(nmea())
    return logs(folder, "*.nmea")


def septentrio(folder: Path, trial: SmallTrial) -> Reading:
    blocks = b"".join(pvt_geodetic(1000 * n) for n in range(5))
    (folder / "one.sbf").write_bytes(blocks)
    return logs(folder, "one.sbf")


def ublox(folder: Path, trial: SmallTrial) -> Reading:
    (folder / "one.ubx").write_bytes(b"".join(nav_pvt(1000 * n, (2025, 6, 1, 12, 0, n)) for n in range(5)))
    return logs(folder, "one.ubx")


def rtklib(folder: Path, trial: SmallTrial) -> Reading:
    (folder / "one.pos").write_text(POS)
    return logs(folder, "one.pos")


def gpsd(folder: Path, trial: SmallTrial) -> Reading:
    said = {"class": "TPV", "mode": 3, "lat": 50.0, "lon": 14.0, "alt": 200.0}
    lines = [json.dumps(said | {"time": f"2025-03-03T08:00:0{n}.5Z"}) + "\n" for n in range(5)]
    (folder / "one.json").write_text("".join(lines))
    return logs(folder, "one.json")


def table(folder: Path, trial: SmallTrial) -> Reading:
    rows = "".join(f"2025-03-03T08:00:0{n}Z;50.0;14.0\n" for n in range(5))
    (folder / "one.csv").write_text(f"stamp;lat;lon\n{rows}")
    fields = {"latitude_deg": "lat", "longitude_deg": "lon"}
    return logs(folder, "one.csv", gnss=[{"time": "field:stamp", "fields": fields}])


def mcap(folder: Path, trial: SmallTrial) -> Reading:
    (folder / "one.mcap").write_bytes(part(0, 30))
    return logs(folder, "one.mcap")


def archive(folder: Path, trial: SmallTrial) -> Reading:
    with zipfile.ZipFile(folder / "logs.zip", "w") as packed:
        packed.writestr("one.nmea.gz", gzip.compress(nmea().encode(), mtime=0))
    return logs(folder, "logs.zip")


def bag(folder: Path, trial: SmallTrial) -> Reading:
    bag_of(folder / "bag", [part(0, 10), part(10, 30)], {"/gnss": 30})
    return logs(folder, "bag")


def run_folder(folder: Path, trial: SmallTrial) -> Reading:
    shutil.copytree(trial.paths[0], folder / "run0")
    return logs(folder, "run0")


KINDS = [
    *(geojson, gpx, kml, kmz, points, shapefile, geopackage, flatgeobuf, recorded_line),
    *(sentences, ublox, septentrio, rtklib, gpsd, table, mcap, archive, bag, run_folder),
]


@pytest.fixture
def step(tmp_path: Path) -> Callable[[Reading], bool]:
    """Bring a product up to date that is made by reading; whether that was begun."""
    made = tmp_path / "made" / "product"
    made.parent.mkdir()

    def bring(read: Reading) -> bool:
        begun: list[bool] = []

        def make() -> list[Path]:
            begun.append(True)
            read()
            made.write_bytes(b"made")
            return [made]

        with contextlib.suppress(BaliseError):  # what was changed may not be readable any more
            Record(tmp_path).make_if_changed(Product("it", made, "settings"), make)
        return bool(begun)

    return bring


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_file_that_is_read_is_digested(
    tmp_path: Path, small_trial: SmallTrial, kind: Maker, step: Callable[[Reading], bool]
) -> None:
    folder = tmp_path / "inputs"
    folder.mkdir()
    read = kind(folder, small_trial)
    with heard() as opened, noting() as noted:
        read()
    noted_places = set(noted.digests())
    assert {str(place) for place in opened if place.is_relative_to(folder)} <= noted_places
    assert "" not in noted.digests().values()
    assert step(read)
    assert not step(read)
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    for file in files:
        before = file.read_bytes()
        file.write_bytes(before + b"\n")
        assert step(read), file
        file.write_bytes(before)
        step(read)
        assert not step(read), file


@pytest.mark.parametrize(
    ("kind", "later"),
    [
        (shapefile, "line.CPG"),
        (geopackage, "line.gpkg-wal"),
        (bag, "bag/bag_2.mcap"),
        (run_folder, "run0/reference.csv"),
        (recorded_line, "drive/balise_reads.parquet"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_what_comes_to_be_is_read(
    tmp_path: Path, small_trial: SmallTrial, kind: Maker, later: str, step: Callable[[Reading], bool]
) -> None:
    folder = tmp_path / "inputs"
    folder.mkdir()
    read = kind(folder, small_trial)
    step(read)
    if not (folder / later).exists():
        assert not step(read)
    (folder / later).write_bytes(b"something")
    assert step(read)


def test_edits_in_the_log_of_a_database_are_part_of_the_survey(tmp_path: Path, step: Callable[[Reading], bool]) -> None:
    """GIS programs leave them there for as long as they are open; nothing is written beside the map."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    path = write(folder / "line.gpkg", [line_wkb(belgian())], SPATIAL_INDEX="NO")
    read = survey(path)
    assert step(read)
    assert not step(read)
    with contextlib.closing(sqlite3.connect(path)) as editor:
        editor.execute("PRAGMA journal_mode=WAL")
        ((old,),) = editor.execute("SELECT geom FROM line")
        moved = np.frombuffer(old[-32:], dtype="<f8") + 111.0
        editor.execute("UPDATE line SET geom = ?", [old[:-32] + moved.tobytes()])
        editor.commit()
        beside = sorted(file.name for file in folder.iterdir())
        assert step(read)
        (piece,) = read_surveys([path], None, Vehicle(), Configuration()).pieces
        assert piece.latitude_deg[0] == pytest.approx(50.90 + 0.001, abs=1e-4)
        assert sorted(file.name for file in folder.iterdir()) == beside


def test_a_log_that_changes_while_it_is_read_is_read_again(
    tmp_path: Path, small_trial: SmallTrial, step: Callable[[Reading], bool]
) -> None:
    folder = tmp_path / "inputs"
    folder.mkdir()
    read = sentences(folder, small_trial)

    def disturbed() -> None:
        read()
        with (folder / "one.nmea").open("a") as log:
            log.write(nmea(1))

    assert step(disturbed)
    assert step(read)
    assert not step(read)


def test_a_linked_folder_within_a_log_is_read(tmp_path: Path, step: Callable[[Reading], bool]) -> None:
    inputs = tmp_path / "inputs"
    other = tmp_path / "other"
    inputs.mkdir()
    other.mkdir()
    bag_of(inputs / "bag", [part(0, 10), part(10, 30)], {"/gnss": 30})
    (inputs / "bag" / "bag_1.mcap").rename(other / "bag_1.mcap")
    (inputs / "bag" / "bag_1.mcap").symlink_to(other / "bag_1.mcap")
    (other / "back").symlink_to(inputs)
    (inputs / "bag" / "more").symlink_to(other)
    read = logs(inputs, "bag")
    assert step(read)
    assert not step(read)
    whole = (other / "bag_1.mcap").read_bytes()
    (other / "bag_1.mcap").write_bytes(whole[:-1])
    assert step(read)
    (other / "bag_1.mcap").write_bytes(whole)
    step(read)
    (other / "new.parquet").write_bytes(b"something")
    assert step(read)
