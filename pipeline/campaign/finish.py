"""What a campaign adds to its runs: the tables over all of them (CONTRACT section 3), and the manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping

import polars as pl

from pipeline import storage
from pipeline.results import manifest, store
from pipeline.results.figures.campaign_figures import derived_tables
from pipeline.results.marker import metadata_of, sha256
from pipeline.results.software import software_digest
from pipeline.storage.address import Address, join
from pipeline.storage.described import table_bytes
from schemas.campaign import CAMPAIGN_TABLES
from schemas.config import Configuration, digest_of
from schemas.version import SOFTWARE

_MADE_FROM = "made_from"


def write_campaign(out: Address, config: Configuration, made: Collection[str] = ()) -> None:
    """Derive the tables of `OUT/campaign/` from all complete runs, write the manifest; `made`: runs replayed now."""
    key = campaign_key(out, config)
    if not _is_current(out, key):
        for name, content in campaign_files(store.small_tables(out), config, key):
            storage.write_bytes(join(out, name), content)
    manifest.write_manifest(out, made)


def campaign_files(tables: Mapping[str, pl.DataFrame], config: Configuration, key: str) -> Iterator[tuple[str, bytes]]:
    """Name and content of each of these tables, from the small tables of all runs."""
    derived = derived_tables(tables["runs"], tables["hazards"], tables["passages"], tables["alarms"], config)
    made = {"software": SOFTWARE, "config_digest": digest_of(config), _MADE_FROM: key}
    for name, table in derived.items():
        schema = CAMPAIGN_TABLES[f"campaign_{name}"]
        yield f"campaign/{name}.parquet", table_bytes(table, f"campaign/{name}", schema, made)


def _is_current(out: Address, key: str) -> bool:
    """Whether all of these tables are there, made from these runs, and as the manifest has them."""
    names = [f"campaign/{name.removeprefix('campaign_')}.parquet" for name in CAMPAIGN_TABLES]
    contents = {name: storage.content_of(join(out, name)) for name in names}
    expected = manifest.earlier(out)["files"]
    return all(
        content is not None
        and metadata_of(content).get(_MADE_FROM) == key
        and expected.get(name, {}).get("sha256") == sha256(content)
        for name, content in contents.items()
    )


def campaign_key(out: Address, config: Configuration) -> str:
    """The digest of all that decides these tables: program, configuration and every marker, which names its tables."""
    runs = [(marker.run_id, marker.sha256) for marker in store.markers(out)]
    return hashlib.sha256(repr((software_digest(), digest_of(config), runs)).encode()).hexdigest()
