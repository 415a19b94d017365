"""Damage archives of logs and files of maps: one error or a reading, in 2 s, and nothing left behind.

    python -m tests.fuzz.archives --count 2000

What an archive still unpacks to must be positions that were packed into it: `gz`, `bz2`, `xz`, `zst` and `zip` have
checksums. `tar` has none over contents, so that its logs are held to their own. `--first N --count 1 --seed S` repeats.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.make.receivers import gather
from pipeline.make.survey.sources import read_surveys
from schemas.config import Configuration, Vehicle
from tests.fuzz.files import Case, main, mutated
from tests.fuzz.ingest import Random

_PLACES = ((60.0 * 50 + number) / 60 for number in range(9))


def _sentence(number: int, latitude_deg: float) -> bytes:
    """NMEA RMC, whose checksum is the parity of its bytes."""
    minutes = f"{int(latitude_deg):02d}{latitude_deg % 1 * 60:07.4f}"
    body = f"GPRMC,1200{number:02d}.00,A,{minutes},N,00430.0000,E,10.0,0.0,010625,,,A".encode()
    return b"$%s*%02X\r\n" % (body, int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8))))


LOG = b"".join(_sentence(number, place) for number, place in enumerate(_PLACES))


def _zip(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("day/a.nmea", content)
        archive.writestr("inner.gz", gzip.compress(b"no log"))
    return buffer.getvalue()


def _tar(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        entry = tarfile.TarInfo("a.nmea")
        entry.size = len(content)
        archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".gz": gzip.compress,
    ".bz2": bz2.compress,
    ".xz": lzma.compress,
    ".zst": lambda content: pa.compress(content, codec="zstd", asbytes=True),
    ".zip": _zip,
    ".tar": _tar,
}


def archive_case(suffix: str, scratch: Path) -> Case:
    """Bytes of an archive changed."""
    whole = PACKERS[suffix](LOG)

    def case(random: Random, folder: Path) -> str:
        before = set(scratch.iterdir())
        path = folder / f"log.nmea{suffix}"
        path.write_bytes(whole)
        packed = set(gather([path]).streams["gnss"].select("t", "latitude_deg", "longitude_deg").rows())
        path.write_bytes(mutated(whole, random))
        try:
            found = gather([path]).streams["gnss"].select("t", "latitude_deg", "longitude_deg").rows()
            return "whole" if set(found) <= packed else "WRONG positions that were not packed"
        finally:
            assert set(scratch.iterdir()) == before, "something is left behind"

    return case


def map_case(suffix: str, folder: Path) -> Case:
    """Bytes of a map changed."""
    import pyogrio.raw

    line = np.array([[4.48, 50.90], [4.49, 50.91], [4.50, 50.91]])
    shape = b"\x01\x02\x00\x00\x00\x03\x00\x00\x00" + line.astype("<f8").tobytes()
    names = [np.array(["a", "b"], dtype=object)]
    place = folder / f"whole{suffix}"
    shapes = np.array([shape, shape], dtype=object)
    pyogrio.raw.write(place, shapes, field_data=names, fields=["name"], geometry_type="LineString", crs="EPSG:4326")
    content = place.read_bytes()

    def case(random: Random, folder: Path) -> str:
        path = folder / f"map{suffix}"
        path.write_bytes(mutated(content, random))
        read_surveys([path], None, Vehicle(), Configuration())
        return "read"

    return case


def kmz_case(random: Random, folder: Path) -> str:
    """Bytes of a KMZ changed."""
    text = b"<kml><Placemark><LineString><coordinates>4.4,50.9 4.5,50.9</coordinates></LineString></Placemark></kml>"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", text)
    path = folder / "line.kmz"
    path.write_bytes(mutated(buffer.getvalue(), random))
    read_surveys([path], None, Vehicle(), Configuration())
    return "read"


def cases(folder: Path) -> dict[str, Case]:
    scratch = folder / "scratch"
    scratch.mkdir()
    tempfile.tempdir = str(scratch)
    archives = {suffix[1:]: archive_case(suffix, scratch) for suffix in PACKERS}
    maps = {suffix[1:]: map_case(suffix, folder) for suffix in (".gpkg", ".fgb")}
    return {**archives, **maps, "kmz": kmz_case}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        sys.exit(main(__doc__, cases(Path(name)), 2000))
