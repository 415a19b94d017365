"""Reports on disk: a page for the campaign and one per run, each a file that needs no other."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline import storage
from pipeline.campaign.plan import software_digest
from pipeline.campaign.workers import each
from pipeline.figures.campaign_figures import derived_tables
from pipeline.report.campaign_page import Campaign, campaign_page
from pipeline.report.ground import availability_pieces, together
from pipeline.report.run_page import Made, Neighbours, run_page
from pipeline.report.shares import Share, known_shares, remember
from pipeline.results import catalogue
from pipeline.results.store import (
    check_site,
    complete_runs,
    file_name,
    metadata_of,
    read_config,
    read_run,
    table_address,
)
from pipeline.safety.side_by_side import side_by_side
from pipeline.safety.tally import added
from pipeline.storage import files
from schemas.config import Configuration, to_toml
from schemas.run import Site
from schemas.tables import TABLES

# The end of a page: what it was made from.
_MARK = "<!-- {} -->\n"


@dataclass(frozen=True)
class _Page:
    """What the page of one run is made from; `content`: digest of its tables as last read, empty if they changed."""

    out: Path
    run: str
    path: Path
    made: Made
    neighbours: Neighbours
    content: str


def write_report(
    out: Path, site: Site | None = None, jobs: int = 0, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Write `OUT/report`: `index.html`, `runs/RUN.html`; returns the files, the index first.

    The pages open from disk and make no request. Plans need the site; without it
    places are drawn along the path. Pages of runs that are no longer in the result are removed; those that were made
    from these very tables, settings and program are left as they are. `jobs` processes make the others, by
    default one per core where there are many; `progress` is told how many pages of how many are done.
    """
    names = {run: page_name(run) for run in complete_runs(out)}
    config = read_config(out)
    made = Made(config or Configuration(), None if config is None else to_toml(config), site)
    states = catalogue.states(out, *TABLES) or {}
    shares = known_shares(out, states, _settings_digest(made))
    ways = [None, *((run, quote(name)) for run, name in names.items()), None]
    beside = {run: Neighbours(ways[at], ways[at + 2]) for at, run in enumerate(names)}
    pages = [
        _Page(out, run, out / "report" / "runs" / name, made, beside[run], shares[run].content if run in shares else "")
        for run, name in names.items()
    ]
    left = [page for page in pages if not _is_there(page)]
    # Starting a process takes as long as some pages.
    jobs = jobs or min(os.cpu_count() or 1, 1 + len(left) // 20)
    for done, share in enumerate(each(_written, left, jobs), start=len(pages) - len(left) + 1):
        shares[share.run] = share
        if progress is not None:
            progress(done, len(pages))
    if states == catalogue.states(out, *TABLES):
        remember(out, states, _settings_digest(made), shares)
    folder, own = out / "report" / "runs", {page.path.name for page in pages}
    for name in files.list_dir(folder):
        if name.endswith(".html") and name not in own:
            storage.remove(folder / name)
    hrefs = {run: f"runs/{quote(name)}" for run, name in names.items()}
    index = out / "report" / "index.html"
    storage.write_bytes(index, campaign_page(_campaign(out, made, hrefs, shares), made).encode())
    return [index, *(page.path for page in pages)]


def page_name(run_id: str) -> str:
    """File name of a run's page."""
    return f"{file_name(run_id)}.html"


def _is_there(page: _Page) -> bool:
    """Whether the page was made from these very tables; one of a site without digest is never known to be."""
    known_site = page.made.site is None or page.made.site.digest
    return bool(page.content and known_site) and _end_of(page.path).endswith(_mark(page, page.content))


def _end_of(path: Path) -> bytes:
    """The last bytes of a file; none of one that cannot be read, which is written anew."""
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - len(_MARK.format("0" * 64)), 0))
            return file.read()
    except OSError:
        return b""


def _written(page: _Page) -> Share:
    """Write the page unless it is there already; returns what the run adds to the page of the campaign."""
    contents = {name: storage.content_of(table_address(page.out, name, page.run)) for name in TABLES}
    metadata = metadata_of(contents["runs"] or b"")
    check_site(page.made.site, metadata.get("site_digest"), page.run)
    tables = read_run(page.out, page.run)
    several, config = tables.runs.height > 1, page.made.config
    judged = (tables.epochs, tables.hazards, tables.alarms, tables.runs)
    tallies = side_by_side(*judged, config) if several else None
    share = Share(page.run, _digest(contents), availability_pieces(tables.epochs.lazy()), tallies)
    if not _is_there(replace(page, content=share.content)):
        html = run_page(tables, metadata, page.made, share.tallies, page.neighbours)
        storage.write_bytes(page.path, html.encode() + _mark(page, share.content))
    return share


def _digest(contents: Mapping[str, bytes | None]) -> str:
    digest = hashlib.sha256()
    for content in contents.values():
        digest.update(hashlib.sha256(b"missing" if content is None else content).digest())
    return digest.hexdigest()


def _mark(page: _Page, content: str) -> bytes:
    """SHA-256 over the run's tables, the settings, the site and the program: all that its page follows from."""
    site = page.made.site
    beside = f"{page.run}\n{page.neighbours}\n{None if site is None else site.digest}"
    digest = hashlib.sha256(f"{_settings_digest(page.made)}\n{content}\n{beside}".encode())
    return _MARK.format(digest.hexdigest()).encode()


def _settings_digest(made: Made) -> str:
    """SHA-256 over the program and the configuration."""
    return hashlib.sha256(f"{software_digest()}\n{made.config_text}".encode()).hexdigest()


def _campaign(out: Path, made: Made, hrefs: dict[str, str], shares: Mapping[str, Share]) -> Campaign:
    found = catalogue.gather(out)
    runs, hazards, passages, alarms = (found[name] for name in ("runs", "hazards", "passages", "alarms"))
    in_order = [shares[run] for run in hrefs]
    return Campaign(
        runs=runs,
        hazards=hazards,
        passages=passages,
        derived=derived_tables(runs, hazards, passages, alarms, made.config),
        pieces=together(pl.concat([share.pieces for share in in_order])),
        hrefs=hrefs,
        architectures=added(share.tallies for share in in_order if share.tallies is not None),
    )
