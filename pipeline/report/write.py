"""Reports on disk: a page for the campaign and one per run, each a file that needs no other."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline.campaign.plan import software_digest
from pipeline.campaign.workers import each
from pipeline.figures.derived_tables import derived_tables
from pipeline.report.availability import availability_pieces
from pipeline.report.campaign_page import Campaign, campaign_page
from pipeline.report.run_page import Made, Neighbours, run_page
from pipeline.results.store import (
    check_site,
    complete_runs,
    file_name,
    metadata_of,
    read_run,
    read_table,
    table_address,
)
from pipeline.safety.side_by_side import side_by_side
from pipeline.safety.tally import added
from schemas.config import Configuration, read_toml, settings_from
from schemas.errors import OutputError
from schemas.run import Site
from schemas.tables import TABLES

_PAGES_PER_PROCESS = 20


@dataclass(frozen=True)
class _Page:
    """What the page of one run is made from."""

    out: Path
    run: str
    path: Path
    made: Made
    neighbours: Neighbours


def write_report(
    out: Path, site: Site | None = None, jobs: int = 0, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Write `OUT/report`: `index.html`, `runs/RUN.html`; returns the files, the index first.

    The pages open from disk and make no request. Plans need the site; without it
    places are drawn along the path. Pages of runs that are no longer in the result are removed; those that were made
    from these very tables, settings and program are left as they are. `jobs` processes make the others, by
    default one per core where there are many; `progress` is told how many pages of how many are done.
    """
    runs = complete_runs(out)
    made = _made(out, site)
    names = {run: page_name(run) for run in runs}
    beside = _neighbours(names)
    pages = [_Page(out, run, out / "report" / "runs" / name, made, beside[run]) for run, name in names.items()]
    written: list[Path] = []
    found: dict[str, pl.DataFrame] = {}
    for done, (page, tallies) in enumerate(
        zip(pages, each(_written, pages, jobs or _worth(len(pages))), strict=True), start=1
    ):
        written.append(page.path)
        if tallies is not None:
            found[page.run] = tallies
        if progress is not None:
            progress(done, len(pages))
    for leftover in sorted(set((out / "report" / "runs").glob("*.html")) - {page.path for page in pages}):
        leftover.unlink()
    hrefs = {run: f"runs/{quote(name)}" for run, name in names.items()}
    index = _write(out / "report" / "index.html", campaign_page(_campaign(out, made, hrefs, found), made).encode())
    return [index, *written]


def page_name(run_id: str) -> str:
    """File name of a run's page."""
    return f"{file_name(run_id)}.html"


def _neighbours(names: dict[str, str]) -> dict[str, Neighbours]:
    """The pages before and after each run's."""
    ways = [None, *((run, quote(name)) for run, name in names.items()), None]
    return {run: Neighbours(ways[at], ways[at + 2]) for at, run in enumerate(names)}


def _worth(pages: int) -> int:
    """Processes that so many pages are worth: starting one takes as long as some pages."""
    return min(os.cpu_count() or 1, 1 + pages // _PAGES_PER_PROCESS)


def _written(page: _Page) -> pl.DataFrame | None:
    """Write the page, unless it is there already; returns the run's solutions side by side where it has several."""
    metadata = metadata_of(Path(str(table_address(page.out, "runs", page.run))))
    check_site(page.made.site, metadata.get("site_digest"), page.run)
    mark = f"<!-- {_made_from(page)} -->\n".encode()
    known_site = page.made.site is None or page.made.site.digest
    kept = bool(known_site) and page.path.exists() and page.path.read_bytes().endswith(mark)
    if kept and read_table(page.out, "runs", page.run).select(pl.len()).collect().item() == 1:
        return None
    tables = read_run(page.out, page.run)
    tallies = None
    if tables.runs.height > 1:
        tallies = side_by_side(tables.epochs, tables.hazards, tables.alarms, tables.runs, page.made.config)
    if not kept:
        _write(page.path, run_page(tables, metadata, page.made, tallies, page.neighbours).encode() + mark)
    return tallies


def _made_from(page: _Page) -> str:
    """SHA-256 over the run's tables, the settings, the site and the program: all that its page follows from."""
    digest = hashlib.sha256(software_digest().encode())
    for name in TABLES:
        table = Path(str(table_address(page.out, name, page.run)))
        digest.update(table.read_bytes() if table.exists() else b"missing")  # which reading the tables tells
    site = page.made.site
    beside = f"{page.run}\n{page.neighbours}"
    digest.update(f"{beside}\n{page.made.config_text}\n{None if site is None else site.digest}".encode())
    return digest.hexdigest()


def _made(out: Path, site: Site | None) -> Made:
    path = out / "config.toml"
    if not path.exists():
        return Made(Configuration(), None, site)
    config = settings_from(read_toml(path), Configuration, str(path))
    return Made(config, path.read_text(encoding="utf-8"), site)


def _campaign(out: Path, made: Made, hrefs: dict[str, str], found: dict[str, pl.DataFrame]) -> Campaign:
    needed = ("solution", "netelement_id", "measure_m", "moving", "tvb", "alarm")
    epochs = read_table(out, "epochs").select(pl.col(name) for name in needed)
    small = ("runs", "hazards", "passages", "alarms")
    runs, hazards, passages, alarms = (read_table(out, name).collect() for name in small)
    return Campaign(
        runs=runs,
        hazards=hazards,
        passages=passages,
        derived=derived_tables(runs, hazards, passages, alarms, made.config),
        pieces=availability_pieces(epochs),
        hrefs=hrefs,
        architectures=added(found.values()),
    )


def _write(path: Path, content: bytes) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(path)) from None
    return path
