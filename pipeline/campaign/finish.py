"""What a campaign adds to its runs: the tables over all of them (CONTRACT section 3)."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline import storage
from pipeline.campaign_tables import campaign_accuracy, campaign_balises, campaign_levels, campaign_runs
from pipeline.hazards.map_errors import map_places
from pipeline.results import catalogue, store
from pipeline.safety.measured import detection_by_level, measured_figures
from pipeline.storage.files import Address, join
from schemas.config import Configuration, digest_of
from schemas.tables import CONTRACT_VERSION
from schemas.version import SOFTWARE


def write_campaign(out: Address, config: Configuration) -> dict[str, pl.DataFrame]:
    """Derive the tables of `OUT/campaign/` from all complete runs of the result."""
    found = catalogue.gather(out)
    runs, hazards, passages, alarms = (found[name] for name in ("runs", "hazards", "passages", "alarms"))
    wide = campaign_runs(runs, hazards, config.safety)
    tables = {
        "runs": wide,
        "balises": campaign_balises(passages, config),
        "accuracy": campaign_accuracy(passages, config),
        "figures": measured_figures(runs, hazards, config.safety),
        "detection": detection_by_level(hazards, config.safety),
        "levels": campaign_levels(wide, hazards, config.safety, config.hazards.reaction_s),
        "map": map_places(alarms),
    }
    metadata = {"software": SOFTWARE, "contract": CONTRACT_VERSION, "config_digest": digest_of(config)}
    for name, table in tables.items():
        storage.write_bytes(join(join(out, "campaign"), f"{name}.parquet"), _bytes(table, name, metadata))
    return tables


def _bytes(table: pl.DataFrame, name: str, metadata: Mapping[str, str]) -> bytes:
    return store.parquet_bytes(table, {"table": f"campaign/{name}", **metadata})
