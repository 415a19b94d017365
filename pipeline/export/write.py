"""One run of a result as a file that other programs read; the suffix decides which."""

from __future__ import annotations

from pathlib import Path

from pipeline.export.gis import run_geojson, run_gpx
from pipeline.export.layout import layout_json
from pipeline.export.mcap_file import PositionMessage, run_topics, write_topics
from pipeline.results.provenance import input_digest
from pipeline.results.store import check_site, metadata_of, read_run, table_address
from pipeline.storage import write_bytes
from schemas.errors import UsageError
from schemas.run import RunLog, RunTables, Site

SUFFIXES = (".mcap", ".geojson", ".gpx")


def export_run(
    out: Path,
    run_id: str,
    to: Path,
    site: Site | None = None,
    log: RunLog | None = None,
    positions: PositionMessage = "foxglove",
) -> tuple[list[Path], list[str]]:
    """Write a run of the result `out`; returns the files, and what they lack for want of site or log.

    `.mcap` holds raw (from the log), GNSS, matched and true positions, track, balises, monitors, LDS, hazards,
    alarms and passages; beside it goes `NAME.layout.json` for Foxglove. `.geojson` and `.gpx` hold matched
    positions and hazards and need the site. `positions` chooses foxglove.LocationFix or ROS 2 NavSatFix.
    """
    if to.suffix.lower() not in SUFFIXES:
        raise UsageError("has an unknown suffix", place=str(to), expected=" or ".join(SUFFIXES))
    tables = read_run(out, run_id)
    _check(out, tables, site, log)
    if to.suffix.lower() == ".mcap":
        return _write_mcap(tables, to, site, log, positions)
    if site is None:
        raise UsageError(
            "positions on the ground need the site", place=str(to), remedy="Give the site of the replay with --site."
        )
    make = run_geojson if to.suffix.lower() == ".geojson" else run_gpx
    return [_write_text(to, make(tables, site))], []


def _check(out: Path, tables: RunTables, site: Site | None, log: RunLog | None) -> None:
    """Site and log have to be those of the replay, as far as the result tells."""
    known = metadata_of(Path(str(table_address(out, "runs", tables.run_id)))).get("site_digest", "")
    check_site(site, known, tables.run_id)
    digest = site.digest if site is not None else known
    if log is not None and log.input_digest and digest:
        found, expected = input_digest(log, digest), str(tables.runs["input_digest"].first())
        if found != expected:
            raise UsageError("was replayed from another log", place=tables.run_id, found=found, expected=expected)
    if tables.epochs.is_empty():
        raise UsageError("has no epoch to export", place=tables.run_id, found=str(tables.runs["error"].first()))


def _write_mcap(
    tables: RunTables, to: Path, site: Site | None, log: RunLog | None, positions: PositionMessage
) -> tuple[list[Path], list[str]]:
    topics, missing = run_topics(tables, site, log, positions)
    write_topics(topics, to, "ros2" if positions == "ros" else "")
    layout = to.with_suffix(".layout.json")
    first = str(tables.epochs["solution"][0])
    return [to, _write_text(layout, layout_json(first, site is not None))], missing


def _write_text(path: Path, text: str) -> Path:
    write_bytes(path, text.encode())
    return path
