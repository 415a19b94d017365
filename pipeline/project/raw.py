"""What `balise inspect` says of a log that is no run yet: a bag, or what a receiver sends."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from pipeline.make.receivers.bags import describe_bag, is_bag
from pipeline.make.receivers.convert import as_run, gather
from pipeline.make.receivers.csv import TABLES, maps_file
from pipeline.make.receivers.messages import UnknownError
from pipeline.read.ingest.describe import description_of
from pipeline.show.inspection import PARTS, inspect_csv, parts_table, tables_of_log
from schemas.config import Configuration, Vehicle
from schemas.errors import BaliseError
from schemas.run import RunLog, Site


def inspect_raw(
    path: Path, config: Configuration, site: Site | None = None, vehicle: Vehicle | None = None
) -> dict[str, pl.DataFrame]:
    """Streams, what the log consists of, what does not fit, and what keeps it from being converted."""
    if is_bag(path):
        return tables_of_log(describe_bag(path, config.ingest), config, site, vehicle)
    try:
        found = gather([path], config.ingest)
    except UnknownError:
        if path.suffix.lower() in TABLES and not maps_file(config.ingest, path):
            return inspect_csv(path, config.ingest)
        raise
    run: RunLog | None = None
    problems: tuple[str, ...] = ()
    try:
        run = as_run(found, path.stem).run
    except BaliseError as error:
        problems = (str(error),)
    size = path.stat().st_size if path.is_file() else 0
    log = description_of(str(path), "receiver log", size, (), run, problems)
    tables = tables_of_log(log, config, site, vehicle)
    not_used = {"reason": list(found.dropped), "count": list(found.dropped.values())}
    return {
        "Log": tables.pop("Log"),
        PARTS: parts_table(found.parts),
        **({"Noted or not used": pl.DataFrame(not_used)} if found.dropped else {}),
        **tables,
    }
