"""What is broken or remarkable in a site is configuration: each key of `[site]` decides what is said."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest

from pipeline.read.site.read import read_site
from pipeline.read.site.tables import load_table
from pipeline.stages.track.geodesy import moved_deg
from schemas.config import SiteConfig
from schemas.errors import SiteError
from tests.read.site import builders

Line = list[tuple[float, float]]
ARC = [(300.0 * float(np.sin(angle)), 300.0 * float(1.0 - np.cos(angle))) for angle in np.arange(0.0, 1.2, 0.2)]


def linked(count: int) -> bytes:
    """Links that differ in nothing: hardly a byte for each."""
    same = {"netelement_a": "a", "position_a": 0, "netelement_b": "b", "position_b": 0, "navigability": "Both"}
    table = pa.table({name: pa.repeat(pa.scalar(value), count) for name, value in same.items()})
    file = io.BytesIO()
    pq.write_table(table, file, compression="zstd")
    return file.getvalue()


def test_a_table_of_equal_rows_is_read_unless_it_takes_all_memory() -> None:
    """1,000,000 x 5 values are 40 MB, and 3,000,000 x 5 are 114 MiB, beyond the 64 MiB that are always allowed."""
    regular, bomb = linked(1_000_000), linked(3_000_000)
    assert len(regular) < 1_000_000
    breaches: list[str] = []
    table = load_table("links.parquet", regular, breaches)
    assert table is not None
    assert table.frame.height == 1_000_000
    assert load_table("links.parquet", bomb, breaches) is None
    assert breaches == [f"links.parquet: cannot be read as Parquet ({len(bomb)} bytes unpack to 114 MiB)"]


def written(folder: Path, lines: dict[str, Line], links: str = "", measure_m: tuple[float, ...] = ()) -> Path:
    """Lines in metres east and north of one place."""
    rows = [(name, east_m, north_m) for name, line in lines.items() for east_m, north_m in line]
    frame = pl.DataFrame(rows, schema=["netelement_id", "east_m", "north_m"], orient="row")
    flat = np.zeros(frame.height)
    latitude, longitude = moved_deg(
        flat + 50.0, flat + 4.0, flat, frame["east_m"].to_numpy(), frame["north_m"].to_numpy()
    )
    track = frame.select("netelement_id", latitude_deg=pl.Series(latitude), longitude_deg=pl.Series(longitude))
    if measure_m:
        track = track.with_columns(measure_m=pl.Series(measure_m))
    joined = {"links": f"netelement_a,position_a,netelement_b,position_b,navigability\n{links}\n"} if links else {}
    return builders.write(folder, track=track, **joined)


def said(path: Path, **keys: float) -> str:
    try:
        return "\n".join(finding.message for finding in read_site(path, SiteConfig(**keys)).findings)
    except SiteError as error:
        return f"refused: {error}"


A: Line = [(0.0, 0.0), (100.0, 0.0)]


@pytest.mark.parametrize(
    ("lines", "finding", "key", "value"),
    [
        ({"a": A, "b": [(100.0, 3.0), (200.0, 3.0)]}, "3.00 m apart and not linked", "near_ends_m", 2.0),
        ({"a": A, "b": [(200.0, 0.0), (300.0, 0.0)]}, "100.00 m apart and not linked", "facing_m", 50.0),
        ({"a": A, "b": [(200.0, 26.0), (300.0, 52.0)]}, "and not linked", "facing_cosine", 0.98),
        ({"arc": ARC}, "leave the curve by 1.50 m", "chord_m", 2.0),
    ],
)
def test_a_limit_decides_whether_a_finding_is_reported(
    tmp_path: Path, lines: dict[str, Line], finding: str, key: str, value: float
) -> None:
    path = written(tmp_path, lines)
    assert finding in said(path)
    assert finding not in said(path, **{key: value})


def test_a_declared_length_may_differ_by_a_share(tmp_path: Path) -> None:
    path = written(tmp_path, {"a": A}, measure_m=(0.0, 110.0))
    assert "the declared length is 110.0 m" in said(path)
    assert "declared length" not in said(path, length_share=0.2)


def test_joined_ends_may_lie_apart(tmp_path: Path) -> None:
    path = written(tmp_path, {"a": A, "b": [(130.0, 0.0), (230.0, 0.0)]}, links="a,1,b,0,both")
    assert "30.0 m apart; expected at most 20 m" in said(path)
    assert "linked but 30.0 m apart" in said(path, joined_m=40.0)
    assert "refused" not in said(path, joined_m=40.0)


def test_places_may_lie_outside_the_area_of_their_system(tmp_path: Path) -> None:
    """The Belgian grid ends at 6.4 degrees east."""
    x, y = pyproj.Transformer.from_crs(4326, 31370, always_xy=True).transform([8.0, 8.01], [50.0, 50.0])
    rows = "\n".join(f"a,{one},{other}" for one, other in zip(x, y, strict=True))
    path = builders.write(tmp_path, track=f"# epsg: 31370\nnetelement_id,x_m,y_m\n{rows}\n")
    assert "refused" not in said(path)
    assert "far outside the area" in said(path, beyond_area_deg=1.0)
