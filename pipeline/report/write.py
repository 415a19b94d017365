"""Reports on disk: a page for the campaign, one per run, and what they share."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline.assessment import over_all_runs
from pipeline.hazards.map_errors import map_places
from pipeline.report.availability import availability_pieces
from pipeline.report.campaign_page import Campaign, campaign_page
from pipeline.report.run_page import Made, run_page
from pipeline.safety.side_by_side import Key, side_by_side
from pipeline.safety.tally import Tally
from pipeline.store import metadata_of, read_table, run_ids, table_address
from schemas.config import Configuration, read_toml, settings_from
from schemas.errors import OutputError, UsageError
from schemas.run import RunTables, Site
from schemas.tables import TABLES

_OWN_ASSETS = ("report.css", "tables.js", "plots.js", "run.js", "campaign.js")


def write_report(out: Path, site: Site | None = None) -> list[Path]:
    """Write `OUT/report`: `index.html`, `runs/RUN.html`, `assets/`; returns the files, the index first.

    The pages open from disk and make no request beyond the files beside them. Plans need the site; without it
    places are drawn along the path. Pages of runs that are no longer in the result are removed.
    """
    runs = run_ids(out)
    if not runs:
        raise UsageError("holds no complete run", place=str(out), expected="a folder that `balise replay` wrote")
    made = _made(out, site)
    names = {run: page_name(run) for run in runs}
    pages = {out / "report" / "runs" / name: run for run, name in names.items()}
    written = [*_write_assets(out / "report" / "assets")]
    found: dict[str, dict[Key, Tally]] = {}
    for path, run in pages.items():
        metadata = metadata_of(Path(str(table_address(out, "runs", run))))
        _check_site(site, metadata, run)
        tables = _tables(out, run)
        if tables.runs.height > 1:
            found[run] = side_by_side(tables.epochs, tables.hazards, tables.alarms, tables.runs, made.config)
        written.append(_write(path, run_page(tables, metadata, made, found.get(run)).encode()))
    for leftover in sorted(set((out / "report" / "runs").glob("*.html")) - set(pages)):
        leftover.unlink()
    hrefs = {run: f"runs/{quote(name)}" for run, name in names.items()}
    index = _write(out / "report" / "index.html", campaign_page(_campaign(out, made, hrefs, found), made).encode())
    return [index, *written]


def page_name(run_id: str) -> str:
    """File name of a run's page; what a path cannot hold is percent-encoded."""
    return quote(run_id, safe=" +,()[]@!~") + ".html"


def _made(out: Path, site: Site | None) -> Made:
    path = out / "config.toml"
    if not path.exists():
        return Made(Configuration(), None, site)
    config = settings_from(read_toml(path), Configuration, str(path))
    return Made(config, path.read_text(encoding="utf-8"), site)


def _check_site(site: Site | None, metadata: dict[str, str], run: str) -> None:
    known = metadata.get("site_digest")
    if site is not None and site.digest and known and known != site.digest:
        raise UsageError(
            "was replayed on another site than the one given", place=run, found=site.digest, expected=known
        )


def _tables(out: Path, run: str) -> RunTables:
    frames = {name: read_table(out, name, run).drop("run_id").collect() for name in TABLES}
    return RunTables(run, **frames)


def _campaign(out: Path, made: Made, hrefs: dict[str, str], found: dict[str, dict[Key, Tally]]) -> Campaign:
    needed = ("solution", "netelement_id", "measure_m", "speed_mps", "tvb", "alarm")
    epochs = read_table(out, "epochs").select(pl.col(name) for name in needed)
    return Campaign(
        runs=read_table(out, "runs").collect(),
        hazards=read_table(out, "hazards").collect(),
        passages=read_table(out, "passages").collect(),
        pieces=availability_pieces(epochs, made.config.matching.deadband_mps),
        hrefs=hrefs,
        architectures=over_all_runs(found),
        map=map_places(read_table(out, "alarms").collect()),
    )


def _write_assets(folder: Path) -> list[Path]:
    own = [_write(folder / name, (files("pipeline.report") / name).read_bytes()) for name in _OWN_ASSETS]
    library = (files("plotly") / "package_data" / "plotly.min.js").read_bytes()
    return [*own, _write(folder / "plotly.min.js", library)]


def _write(path: Path, content: bytes) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(path)) from None
    return path
