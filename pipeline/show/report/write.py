"""Reports on disk: a page for the campaign and one per run, each a file that needs no other."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import polars as pl

from pipeline import storage
from pipeline.results import catalogue, store
from pipeline.results.figures.campaign_figures import derived_tables
from pipeline.results.manifest import note_pages
from pipeline.results.marker import sha256
from pipeline.results.software import software_digest
from pipeline.results.store import (
    check_site,
    complete_runs,
    completed_runs,
    file_name,
    read_config,
    read_run,
    tables_of,
)
from pipeline.results.workers import map_in_processes, with_progress
from pipeline.show.report.against_page import against_page
from pipeline.show.report.campaign_page import Campaign, campaign_page
from pipeline.show.report.ground import PIECE_COLUMNS, availability_pieces, combine_pieces
from pipeline.show.report.run_page import Made, Neighbours, run_page
from pipeline.storage import files
from pipeline.storage.address import Address
from pipeline.storage.parquet import parquet_bytes, read_parquet
from pipeline.studies.safety.assessment import compare_architectures
from pipeline.studies.safety.side_by_side import side_by_side
from pipeline.studies.safety.tally import COUNTS, add_counts
from schemas.config import Configuration, to_toml
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.run import Site

# Kept of each run until it changes: what its page was made from, the digest of the page, and what the run adds to the
# page of the campaign, rows of `availability_pieces` and `side_by_side`.
_KEPT = "pages"
AGAINST = "against.html"
MOST_PAGES = 1000
"""Runs of a campaign of which each gets a page unasked."""
_RUNS_AT_ONCE = 256


@frozen
class _Page:
    """What the page of one run is made from; `made_of`: the digest of that, empty where nobody knows it."""

    out: Path
    run: str
    path: Path
    made: Made
    neighbours: Neighbours
    made_of: str = ""


def write_report(out: Path, site: Site | None = None, jobs: int = 0, most_pages: int = MOST_PAGES) -> list[Path]:
    """Write `OUT/report`: `index.html`, and `runs/RUN.html` of each run.

    The pages open from disk and make no request. Pages of runs that are no longer in the result are removed; those that
    were made from these very tables, settings and program are left as they are.

    Args:
        out: the result.
        site: the site, for plans; None: places are drawn along the path.
        jobs: processes that make pages; 0: one per core where there are many.
        most_pages: of a result with more runs only the index is written.

    Returns:
        Paths of the pages, the index first.
    """
    markers = _markers(out)
    pages = _possible_pages(out, site, markers, most_pages)
    rows = _current_rows(out, pages)
    left = [page for page in pages if page.run not in rows] if len(pages) <= most_pages else []
    # Starting a process takes as long as some pages.
    jobs = jobs or min(os.cpu_count() or 1, 1 + len(left) // 20)
    rows |= zip((page.run for page in left), map_in_processes(_write_run_page, left, jobs), strict=True)
    there = [page for page in pages if page.run in rows]
    _keep_rows(out, markers, [rows[page.run] for page in there])
    folder = out / "report" / "runs"
    for name in set(files.list_dir(folder) if folder.exists() else []) - {page.path.name for page in there}:
        if name.endswith(".html"):
            storage.remove(folder / name)
    if (folder.parent / AGAINST).exists():
        storage.remove(folder.parent / AGAINST)
    hrefs = {page.run: f"runs/{quote(page.path.name)}" for page in there}
    index = out / "report" / "index.html"
    made = pages[0].made
    of_runs = _parts_of_pages(list(rows.values())) if len(there) == len(pages) else _parts_of_tables(out, made)
    storage.write_bytes(index, campaign_page(_campaign_tables(out, made, hrefs, *of_runs), made).encode())
    return _note_pages(out, [index, *(page.path for page in there)])


def write_page(out: Path, run_id: str, site: Site | None = None, most_pages: int = MOST_PAGES) -> Path:
    """Write the page of one run alone.

    Args:
        out: the result.
        run_id: id of the run.
        site: the site, for plans; None: places are drawn along the path.
        most_pages: of a result with more runs the index names no pages.

    Returns:
        Path of the page.

    Raises:
        UsageError: the run is not in the result.
    """
    markers = _markers(out)
    pages = {page.run: page for page in _possible_pages(out, site, markers, most_pages)}
    if run_id not in pages:
        raise UsageError(f"has no run {run_id!r}", place=str(out), found=", ".join([*pages][:10]))
    known = _current_rows(out, list(pages.values()))
    known[run_id] = _write_run_page(pages[run_id])
    _keep_rows(out, markers, [known[run] for run in pages if run in known])
    _note_pages(out, [out / "report" / name for name in storage.files_below(out / "report")])
    return pages[run_id].path


def write_against(out: Path, other: Address) -> Path:
    """Write `OUT/report/against.html`: this result compared with another; the next report of the result removes it.

    Args:
        out: the result.
        other: the result that it is compared with.

    Returns:
        Path of the page.
    """
    place = out / "report" / AGAINST
    storage.write_bytes(place, against_page(out, other).encode())
    _note_pages(out, [out / "report" / name for name in storage.files_below(out / "report")])
    return place


def _possible_pages(out: Path, site: Site | None, markers: Mapping[str, str], most_pages: int) -> list[_Page]:
    """The pages that there may be; of more than `most_pages` none leads to its neighbours, which may have none."""
    names = {run: page_name(run) for run in complete_runs(out)}
    config = read_config(out)
    made = Made(config or Configuration(), None if config is None else to_toml(config), site)
    neighbours = [
        None,
        *((run, quote(name)) if len(names) <= most_pages else None for run, name in names.items()),
        None,
    ]
    folder = out / "report" / "runs"
    return [
        _with_digest(
            _Page(out, run, folder / name, made, Neighbours(neighbours[at], neighbours[at + 2])), markers.get(run, "")
        )
        for at, (run, name) in enumerate(names.items())
    ]


def _keep_rows(out: Path, markers: Mapping[str, str], rows: Sequence[pl.DataFrame]) -> None:
    """Keep what the runs add to the campaign's page, unless they changed meanwhile."""
    # Runs that changed while they were read must not pass for what was read.
    if rows and markers == _markers(out):
        catalogue.keep(out, _KEPT, software_digest(), parquet_bytes(pl.concat(rows)))


def _markers(out: Path) -> dict[str, str]:
    """The digest of each run's marker, which holds those of its tables."""
    return {marker.run_id: marker.sha256 for marker in store.markers(out)}


def _note_pages(out: Path, pages: list[Path]) -> list[Path]:
    """The pages, once the manifest names them."""
    contents = {page.relative_to(out / "report").as_posix(): storage.content_of(page) for page in pages}
    note_pages(out, {name: content for name, content in contents.items() if content is not None})
    return pages


def page_name(run_id: str) -> str:
    """File name of a run's page.

    Args:
        run_id: id of the run.

    Returns:
        A name without characters that file systems refuse.
    """
    return f"{file_name(run_id)}.html"


def _with_digest(page: _Page, marker: str) -> _Page:
    """The page with the SHA-256 over all it follows from: tables, settings, site, neighbours and program.

    Empty where the site has no digest: such a page is never known to be there.
    """
    site = page.made.site
    if not marker or (site is not None and not site.digest):
        return page
    places = (page.run, page.neighbours, None if site is None else site.digest)
    text = f"{software_digest()}\n{page.made.config_text}\n{marker}\n{places}"
    return replace(page, made_of=hashlib.sha256(text.encode()).hexdigest())


def _current_rows(out: Path, pages: Sequence[_Page]) -> dict[str, pl.DataFrame]:
    """What is kept of the runs whose pages are there and would be the same again, a row each."""
    content = catalogue.kept_content(out, _KEPT, software_digest())
    kept = [] if content is None else read_parquet(content).iter_slices(1)
    rows = {row["made_of"][0]: row for row in kept}
    candidates = ((page, rows.get(page.made_of)) for page in pages if page.made_of)
    return {
        page.run: row
        for page, row in candidates
        if row is not None and sha256(storage.content_of(page.path)) == row["page_sha256"][0]
    }


def _write_run_page(page: _Page) -> pl.DataFrame:
    """Write the page; returns the row to keep of it."""
    metadata = completed_runs(page.out, [page.run])[page.run]
    check_site(page.made.site, metadata.get("site_digest"), page.run)
    tables = read_run(page.out, page.run)
    judged = (tables.epochs, tables.hazards, tables.alarms, tables.runs)
    tallies = side_by_side(*judged, page.made.config) if tables.runs.height > 1 else pl.DataFrame(schema=COUNTS)
    content = run_page(tables, metadata, page.made, tallies, page.neighbours).encode()
    storage.write_bytes(page.path, content)
    return pl.DataFrame({"made_of": page.made_of, "page_sha256": sha256(content)}).with_columns(
        pieces=pl.lit(availability_pieces(tables.epochs.lazy()).to_struct()).implode(),
        tallies=pl.lit(tallies.to_struct()).implode(),
    )


def _concat_column(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    """What the runs add, one after the other."""
    return rows[name].explode().drop_nulls().struct.unnest()


def _parts_of_pages(rows: Sequence[pl.DataFrame]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Pieces and architectures of all runs, where all of them have a page."""
    together_rows = pl.concat(rows)
    return combine_pieces(_concat_column(together_rows, "pieces")), add_counts(
        [_concat_column(together_rows, "tallies")]
    )


def _parts_of_tables(out: Path, made: Made) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The same from the tables; the pieces may be longer, as those of many runs are counted at once."""
    names = complete_runs(out)
    for run, metadata in completed_runs(out).items():
        check_site(made.site, metadata.get("site_digest"), run)
    portions = [names[first : first + _RUNS_AT_ONCE] for first in range(0, len(names), _RUNS_AT_ONCE)]
    pieces = [
        availability_pieces(tables_of(out, "epochs", some, PIECE_COLUMNS).lazy()) for some in with_progress(portions)
    ]
    runs, hazards, alarms = (store.read_table(out, table).collect() for table in ("runs", "hazards", "alarms"))
    return combine_pieces(pl.concat(pieces)), add_counts(
        compare_architectures(out, runs, hazards, alarms, made.config).values()
    )


def _campaign_tables(
    out: Path, made: Made, hrefs: dict[str, str], pieces: pl.DataFrame, architectures: pl.DataFrame
) -> Campaign:
    """All that the campaign's page shows."""
    tables = store.small_tables(out)
    return Campaign(
        runs=tables["runs"],
        hazards=tables["hazards"],
        passages=tables["passages"],
        derived=derived_tables(tables["runs"], tables["hazards"], tables["passages"], tables["alarms"], made.config),
        pieces=pieces,
        hrefs=hrefs,
        architectures=architectures,
    )
