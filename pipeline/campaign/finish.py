"""What a campaign adds to its runs: the tables over all of them (CONTRACT section 3)."""

from __future__ import annotations

import polars as pl

from pipeline import storage
from pipeline.results import catalogue, store
from pipeline.results.figures.campaign_figures import derived_tables
from pipeline.results.manifest import write_manifest
from pipeline.storage.address import Address, join
from schemas.config import Configuration, digest_of
from schemas.tables import CONTRACT_VERSION
from schemas.version import SOFTWARE


def write_campaign(out: Address, config: Configuration) -> dict[str, pl.DataFrame]:
    """Derive the tables of `OUT/campaign/` from all complete runs of the result, and write its manifest."""
    found = catalogue.gather(out)
    tables = derived_tables(found["runs"], found["hazards"], found["passages"], found["alarms"], config)
    metadata = {"software": SOFTWARE, "contract": CONTRACT_VERSION, "config_digest": digest_of(config)}
    for name, table in tables.items():
        content = store.parquet_bytes(table, {"table": f"campaign/{name}", **metadata})
        storage.write_bytes(join(join(out, "campaign"), f"{name}.parquet"), content)
    write_manifest(out)
    return tables
