"""One run of a result as a file that other programs read, the suffix decides which; with a layout for Foxglove."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipeline.results.store import check_site, completed_runs, read_run
from pipeline.show.export.gis import run_geojson, run_gpx
from pipeline.show.export.layers import geopackage_bytes, geoparquet_bytes, layers_of
from pipeline.show.export.mcap_file import PositionMessage, run_topics, write_topics
from pipeline.stages.prepare import input_digest
from pipeline.storage import write_bytes
from schemas.errors import UsageError
from schemas.monitors import AXES, OTHER_MONITORS, SCALES
from schemas.run import RunLog, RunTables, Site

SUFFIXES = (".mcap", ".geojson", ".gpx", ".gpkg", ".parquet")


def export_run(
    out: Path,
    run_id: str,
    to: Path,
    site: Site | None = None,
    log: RunLog | None = None,
    positions: PositionMessage = "foxglove",
) -> tuple[list[Path], list[str]]:
    """Write a run of a result for viewers and GIS.

    `.mcap` holds raw (from the log), GNSS, matched and true positions, track, balises, monitors, LDS, hazards and
    passages; next to it goes `NAME.layout.json` for Foxglove. The others need the site. `.geojson` and `.gpx` hold
    matched positions and hazards, `.gpkg` and `.parquet` epochs, passages and hazards with all their columns;
    GeoParquet has a file for each table.

    Args:
        out: the result.
        run_id: id of the run.
        to: the file; its suffix chooses the format.
        site: the site of the result, for places on the ground.
        log: the recorded run, for raw messages.
        positions: MCAP messages of positions: foxglove.LocationFix or ROS 2 NavSatFix.

    Returns:
        The files, and what they lack for want of site or log.

    Raises:
        UsageError: the suffix is unknown, or the format needs the site.
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
    if to.suffix.lower() == ".gpkg":
        write_bytes(to, geopackage_bytes(layers_of(tables, site), to))
        return [to], []
    if to.suffix.lower() == ".parquet":
        return _write_geoparquet(tables, to, site), []
    make = run_geojson if to.suffix.lower() == ".geojson" else run_gpx
    return [_write_text(to, make(tables, site))], []


def _check(out: Path, tables: RunTables, site: Site | None, log: RunLog | None) -> None:
    """Site and log have to be those of the replay, as far as the result tells."""
    known = completed_runs(out, [tables.run_id])[tables.run_id].get("site_digest", "")
    check_site(site, known, tables.run_id)
    digest = site.digest if site is not None else known
    if log is not None and log.input_digest and digest:
        recorded = input_digest(log, digest)
        expected = str(tables.runs["input_digest"].first())
        if recorded != expected:
            raise UsageError("was replayed from another log", place=tables.run_id, found=recorded, expected=expected)
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


def _write_geoparquet(tables: RunTables, to: Path, site: Site) -> list[Path]:
    """Write a file per table: epochs under the name asked for, the others next to it."""
    files = []
    for name, layer in layers_of(tables, site).items():
        files.append(to if name == "epochs" else to.with_suffix(f".{name}.parquet"))
        write_bytes(files[-1], geoparquet_bytes(layer, name, tables.run_id))
    return files


def _write_text(path: Path, text: str) -> Path:
    write_bytes(path, text.encode())
    return path


Panel = dict[str, Any]


def layout_json(solution: str, with_positions: bool) -> str:
    """The layout as Foxglove imports it; the map stands where there are positions."""
    panels: dict[str, Panel] = {
        "StateTransitions!states": _states(solution),
        "RosOut!hazards": {"searchTerms": [], "minLogLevel": 1, "topicToRender": f"/{solution}/hazards"},
        "Plot!position": _plot([f"/{solution}/lds.{name}" for name in ("error_low_m", "error_high_m", "confidence_m")]),
        "Plot!speed": _plot([f"/{solution}/lds.{name}" for name in ("speed_mps", "exposure_s")]),
        **{f"Plot!{axis}": _monitors(solution, [f"{axis}_{scale}" for scale in SCALES]) for axis in AXES},
        "Plot!others": _monitors(solution, list(OTHER_MONITORS)),
    }
    left = ["StateTransitions!states", "RosOut!hazards"]
    if with_positions:
        panels["map!plan"] = {"layer": "map", "followTopic": f"/{solution}/matched", "zoomLevel": 14}
        left.insert(0, "map!plan")
    right = [name for name in panels if name.startswith("Plot!")]
    layout = {"direction": "row", "first": _stack(left), "second": _stack(right), "splitPercentage": 45}
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    return json.dumps(document, indent=2) + "\n"


def _stack(names: list[str]) -> str | dict[str, Any]:
    """Panels one over the other, each of the same height."""
    if len(names) == 1:
        return names[0]
    share = 100.0 / len(names)
    return {"direction": "column", "first": names[0], "second": _stack(names[1:]), "splitPercentage": round(share, 3)}


def _states(solution: str) -> Panel:
    names = ("lds_mode", "lds_state", "judgement", "tvb", "alarm")
    paths = [{"value": f"/{solution}/lds.{name}", "timestampMethod": "receiveTime"} for name in names]
    return {"paths": paths, "isSynced": True}


def _monitors(solution: str, names: list[str]) -> Panel:
    limits = [{"value": limit, "enabled": True, "timestampMethod": "receiveTime"} for limit in ("1", "-1")]
    panel = _plot([f"/{solution}/monitors.{name}_ratio" for name in names])
    return panel | {"paths": [*panel["paths"], *limits], "minYValue": -3, "maxYValue": 3}


def _plot(values: list[str]) -> Panel:
    paths = [{"value": value, "enabled": True, "timestampMethod": "receiveTime"} for value in values]
    return {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"}
