"""What `balise inspect` says of a site or a result."""

from __future__ import annotations

from dataclasses import fields

import polars as pl

from pipeline import storage, store
from pipeline.ingest import files
from pipeline.ingest.files import Address
from pipeline.ingest.site import read_site
from pipeline.matching.describe import describe_site
from schemas.errors import UsageError
from schemas.run import Finding

_SITE_FILES = {"track.parquet", "track.csv", "track.geojson"}
_RUN_COLUMNS = (
    *("run_id", "solution", "status", "duration_s", "distance_m", "gnss_rate_hz", "availability", "evidence"),
    *("balises_on_path", "balises_accepted", "unsafe_accepted", "hazards_1a", "hazards_1b", "hazards_shift"),
    *("missed_detections", "alarms", "false_alarms", "error"),
)


def inspect_path(path: Address) -> dict[str, pl.DataFrame]:
    """Tables by title, for whatever stands at the path."""
    if not files.exists(path):
        raise UsageError("does not exist", place=storage.redacted(str(path)))
    if files.is_dir(path):
        names = set(files.list_dir(path))
        if names & _SITE_FILES:
            return inspect_site(path)
        if "runs" in names and store.run_ids(path):
            return inspect_result(path)
    raise UsageError(
        "is neither a site nor a result",
        place=storage.redacted(str(path)),
        expected="a folder with track.parquet (site) or with runs/ (result)",
    )


def inspect_site(path: Address) -> dict[str, pl.DataFrame]:
    """Figures and findings of a site."""
    description = describe_site(read_site(path))
    names = [item.name for item in fields(description) if item.name != "findings"]
    figures = pl.DataFrame({"figure": names, "value": [_value(getattr(description, name)) for name in names]})
    return {"Site": figures, "Findings": _findings(description.findings)}


def inspect_result(path: Address) -> dict[str, pl.DataFrame]:
    """The runs of a result in their main figures."""
    return {"Runs": store.read_table(path, "runs").select(_RUN_COLUMNS).collect()}


def _findings(findings: tuple[Finding, ...]) -> pl.DataFrame:
    columns = ("severity", "place", "message", "remedy")
    rows = [tuple(getattr(finding, name) for name in columns) for finding in findings]
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.String), orient="row")


def _value(value: object) -> str:
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.6g}"
        case dict():
            return ", ".join(f"{count} {name}" for name, count in value.items()) or "none"
        case tuple():
            return ", ".join(map(_value, value))
        case _:
            return str(value)
