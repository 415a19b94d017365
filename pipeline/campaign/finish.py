"""What a campaign adds to its runs: the tables over all of them (CONTRACT section 3)."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline import storage, store
from pipeline.campaign_tables import campaign_accuracy, campaign_balises, campaign_runs, with_speed
from pipeline.ingest.files import Address, join
from pipeline.safety.measured import detection_by_level, measured_figures
from schemas.config import Configuration, digest_of
from schemas.tables import CONTRACT_VERSION
from schemas.version import SOFTWARE


def write_campaign(out: Address, config: Configuration) -> dict[str, pl.DataFrame]:
    """Derive the tables of `OUT/campaign/` from all complete runs of the result."""
    runs, hazards, passages = (store.read_table(out, name).collect() for name in ("runs", "hazards", "passages"))
    tables = {
        "runs": campaign_runs(runs, hazards, config.safety),
        "balises": campaign_balises(passages, config),
        "accuracy": campaign_accuracy(_with_speeds(out, passages), config),
        "figures": measured_figures(runs, hazards, config.safety),
        "detection": detection_by_level(hazards, config.safety),
    }
    metadata = {"software": SOFTWARE, "contract": CONTRACT_VERSION, "config_digest": digest_of(config)}
    for name, table in tables.items():
        storage.write_bytes(join(join(out, "campaign"), f"{name}.parquet"), _bytes(table, name, metadata))
    return tables


def _with_speeds(out: Address, passages: pl.DataFrame) -> pl.DataFrame:
    """Passages with the train's speed, run by run, so that memory holds the epochs of one."""
    parts = []
    for (run_id,), of_run in passages.group_by("run_id", maintain_order=True):
        epochs = store.read_table(out, "epochs", str(run_id)).select("t", "solution", "speed_mps").collect()
        for (solution,), part in of_run.group_by("solution", maintain_order=True):
            parts.append(with_speed(part, epochs.filter(pl.col("solution") == solution)))
    return pl.concat(parts) if parts else passages.with_columns(speed_mps=pl.lit(None, pl.Float64))


def _bytes(table: pl.DataFrame, name: str, metadata: Mapping[str, str]) -> bytes:
    return store.parquet_bytes(table, {"table": f"campaign/{name}", **metadata})
