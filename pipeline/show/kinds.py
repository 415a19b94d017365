"""What stands at a path: a log, a site, a result or a table. Asked before anything is loaded that takes long."""

from __future__ import annotations

from enum import Enum

from pipeline.storage import files
from pipeline.storage.address import Address, is_geojson, name_of, redacted
from schemas.errors import UsageError
from schemas.run import STREAMS

_SITE_FILES = {"track.parquet", "track.csv", "track.geojson"}
# Bags, logs of receivers, and what these are packed in; what they hold is seen when they are read.
_RAW = (
    *(".bag", ".db3", ".ubx", ".sbf", ".nmea", ".nma", ".gps", ".pos", ".log", ".txt", ".tsv", ".dat", ".json", ".bin"),
    *(".gz", ".zip", ".tar", ".tgz", ".bz2", ".xz", ".zst"),
)


class Kind(Enum):
    """What `balise inspect` can describe."""

    LOG = "log"
    RAW = "raw log"
    SITE = "site"
    RESULT = "result"
    CSV = "csv"
    TABLE = "table"


def kind_at(path: Address) -> Kind:
    """Kind of what is at a path, by names alone. Raises `UsageError` where nothing is, and nothing of these."""
    if not files.exists(path):
        raise UsageError("does not exist", place=redacted(str(path)))
    names = set(files.list_dir(path)) if files.is_dir(path) else set()
    if names & _SITE_FILES or (is_geojson(path) and not names):
        return Kind.SITE
    if "runs" in names and _holds_run(path):
        return Kind.RESULT
    if name_of(path).endswith(".mcap") or names & {f"{stream}.parquet" for stream in STREAMS}:
        return Kind.LOG
    if "metadata.yaml" in names or (not names and name_of(path).lower().endswith(_RAW)):
        return Kind.RAW
    if name_of(path).lower().endswith(".csv"):
        return Kind.CSV
    if name_of(path).lower().endswith(".parquet") and not names:
        return Kind.TABLE
    raise UsageError(
        "is neither a log, a site nor a result",
        place=redacted(str(path)),
        expected="RUN.mcap, a bag, a log of a receiver, SITE.geojson, FILE.csv, FILE.parquet, or a folder with"
        " gnss.parquet or metadata.yaml (log), track.parquet (site) or runs/ (result)",
        remedy="`balise convert` makes runs of receiver logs and CSV files.",
    )


def _holds_run(path: Address) -> bool:
    """Whether a folder is a result with a complete run."""
    from pipeline.results import store

    return bool(store.run_ids(path))
