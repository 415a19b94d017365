"""The area types of a site, and in which area a place lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from pipeline.read.site.tables import load_table, typed_table
from pipeline.storage.address import join, shown
from pipeline.storage.files import exists, read_bytes
from schemas.arrays import Floats, Ints
from schemas.enums import AreaType
from schemas.errors import SiteError, listed
from schemas.frozen import frozen
from schemas.inputs import Areas
from schemas.run import Site

AREA_TYPES = tuple(AreaType)
NO_AREA = -1
_NAMES = ("areas.parquet", "areas.csv")


@frozen
class AreaPlaces:
    """Number of the area type in `AREA_TYPES` (`NO_AREA` outside all), and track speed [m/s] (NaN: not known)."""

    area: Ints
    track_speed_mps: Floats


def read_areas(path: Path | str, site: Site) -> pl.DataFrame | None:
    """Read `areas.parquet` or `areas.csv` of a site's folder.

    Not part of the site's digest: no replay reads it.

    Args:
        path: the site's folder.
        site: the site.

    Returns:
        `netelement_id`, `from_m`, `to_m`, `area_type` and `track_speed_kmh` of each area; None where the folder has no
        such file.

    Raises:
        SiteError: unknown kinds and net elements, areas that overlap or end before they begin; all breaches at once.
    """
    present = [name for name in _NAMES if exists(join(path, name))]
    if not present:
        return None
    if len(present) > 1:
        raise SiteError(f"{' and '.join(present)}: only one may be there", place=shown(path))
    breaches: list[str] = []
    raw = load_table(present[0], read_bytes(join(path, present[0])), breaches)
    areas = None if raw is None else typed_table(raw, "areas", breaches)
    if areas is not None:
        breaches += _faults_of_areas(present[0], areas, site)
    if areas is None or breaches:
        remedy = "Mend what is named; `balise dictionary --table areas` lists the columns."
        raise SiteError(listed(breaches), place=shown(path), remedy=remedy)
    return Areas.validate(areas, cast=True)


def _faults_of_areas(file: str, areas: pl.DataFrame, site: Site) -> list[str]:
    """What is wrong with a file of areas: unknown net elements, overlaps."""
    known = set(site.track["netelement_id"])
    ordered = areas.sort("netelement_id", "from_m", maintain_order=True)
    breaches = [
        f"{file}: no net element of the track is called {name}"
        for name in ordered["netelement_id"].unique(maintain_order=True)
        if name not in known
    ]
    breaches += [
        f"{file}: {row['netelement_id']}: the area from {row['from_m']:g} m ends at {row['to_m']:g} m; "
        "expected an end behind the begin, in growing measure"
        for row in ordered.filter(~(pl.col("to_m") > pl.col("from_m"))).iter_rows(named=True)
    ]
    before = pl.col("to_m").cum_max().shift().over("netelement_id")
    overlaps = ordered.with_columns(before=before).filter(pl.col("from_m") < pl.col("before"))
    breaches += [
        f"{file}: {row['netelement_id']}: the area from {row['from_m']:g} m begins before another ends, at "
        f"{row['before']:g} m; expected one area at each place"
        for row in overlaps.iter_rows(named=True)
    ]
    return breaches


def areas_at(areas: pl.DataFrame | None, netelement_id: pl.Series, measure_m: pl.Series) -> AreaPlaces:
    """The area of each place; at the border of two that of the second."""
    size = len(netelement_id)
    if areas is None or areas.is_empty():
        return AreaPlaces(np.full(size, NO_AREA), np.full(size, np.nan))
    places = pl.DataFrame({"netelement_id": netelement_id, "at_m": measure_m}).with_row_index("row")
    there = areas.with_columns(at_m=pl.col("from_m"), area_type=pl.col("area_type").cast(pl.String))
    in_area = (
        places.drop_nulls()
        .sort("at_m")
        .join_asof(there.sort("at_m"), on="at_m", by="netelement_id", check_sortedness=False)
        .filter(pl.col("at_m") <= pl.col("to_m"))
    )
    area = np.full(size, NO_AREA)
    speed = np.full(size, np.nan)
    rows = in_area["row"].to_numpy()
    numbers = {kind.value: number for number, kind in enumerate(AREA_TYPES)}
    area[rows] = in_area["area_type"].replace_strict(numbers, return_dtype=pl.Int64).to_numpy()
    speed[rows] = in_area["track_speed_kmh"].to_numpy() / 3.6
    return AreaPlaces(area, speed)
