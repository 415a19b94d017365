"""Logs of the Infrabel measurement trains, and the network that they ran on, as runs and sites.

The recordings stay where the caller has them; nothing of them is part of this project.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from datasets.to_contract import conform_stream, virtual_balises
from pipeline.make.receivers import Converted
from pipeline.read.ingest.conform import rows_text
from pipeline.read.ingest.csv_text import CUT_ROW, read_log_table
from pipeline.read.ingest.novatel import FIX_BY_WORD
from pipeline.read.site.read import read_site
from schemas.enums import Fix
from schemas.errors import InputError
from schemas.run import RunLog, Site

COLUMNS = ("timestamp", "latitude", "longitude", "solution_status", "position_type")
# A time cut off before its seconds is another time.
_TO_THE_SECOND = r"^(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?)$"


def infrabel_run(log: Path) -> RunLog:
    """A log of the Infrabel measurement train: see `infrabel_recording`."""
    return infrabel_recording(log).run


def infrabel_recording(log: Path) -> Converted:
    """A log of the Infrabel measurement train: positions with the receiver's own type, nothing else.

    Its naive local times are taken as UTC, and NovAtel's position types (each with any number behind) as kinds of fix;
    without a computed solution, or without a type, there is none. Half a row at the end is left out.
    """
    whole = read_log_table(log, infer=False)
    table = whole.table
    cut = whole.cut
    missing = set(COLUMNS) - set(table.columns)
    if missing:
        raise InputError("lacks columns of an Infrabel log", place=str(log), found=f"no {', '.join(sorted(missing))}")
    computed = pl.col("solution_status") == "SOL_COMPUTED"
    word = pl.col("position_type").replace("", None)
    kind = word.str.replace(r"\d+$", "").replace_strict(FIX_BY_WORD, default=None)
    fix = pl.when(computed & word.is_not_null()).then(kind).otherwise(pl.lit(Fix.NONE.value))
    unknown = table.filter(computed & word.is_not_null() & kind.is_null())["position_type"].unique().sort()
    if unknown.len():
        raise InputError(
            "a position type is not known",
            place=f"{log}: position_type",
            found=", ".join(unknown),
            expected=", ".join(FIX_BY_WORD),
        )
    time = pl.col("timestamp").str.extract(_TO_THE_SECOND)
    gnss = table.select(
        t=time.str.to_datetime(time_unit="ns", strict=False).dt.replace_time_zone("UTC"),
        latitude_deg=pl.col("latitude").cast(pl.Float64, strict=False),
        longitude_deg=pl.col("longitude").cast(pl.Float64, strict=False),
        fix=fix,
    )
    _require_numbers(table.select("timestamp", "latitude", "longitude"), gnss.select(pl.nth(0, 1, 2)), log)
    return Converted(RunLog(log.stem, conform_stream(gnss, "gnss", log)), {CUT_ROW: cut} if cut else {})


def _require_numbers(texts: pl.DataFrame, values: pl.DataFrame, log: Path) -> None:
    """Refuse texts that are no number."""
    for text, value in zip(texts, values, strict=True):
        wrong = value.is_null() & text.is_not_null() & (text != "")
        if wrong.any():
            found = f"{text.filter(wrong)[0]!r} in {rows_text(wrong)}"
            raise InputError("cannot be read", place=f"{log}: column {text.name}", found=found)


def infrabel_site(network: Path, path: Path | None = None, balises: Sequence[tuple[str, float]] = ()) -> Site:
    """The railway network of the Infrabel runs, or of it only the net elements of a `path` file, in WGS 84.

    `balises` are (net element, measure) of virtual balises VB1, VB2, ... to put on it.
    """
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(network, Path(folder) / "track.geojson")
        site = read_site(Path(folder))
    track = site.track
    links = site.links
    if path is not None:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        kept = [f["properties"]["netelement_id"] for f in features if "netelement_id" in f["properties"]]
        track = track.filter(pl.col("netelement_id").is_in(kept))
        links = links.filter(pl.col("netelement_a").is_in(kept) & pl.col("netelement_b").is_in(kept))
    return Site(track, links, virtual_balises(balises) if balises else None)
