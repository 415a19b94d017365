"""A prepared run with other streams hands on nothing of the one that it was made from."""

from __future__ import annotations

from dataclasses import replace

import polars as pl

from pipeline.stages.prepare import prepare
from schemas.config import Configuration
from tests.replay.journeys import VEHICLE, journey


def test_other_streams_have_their_own_positions() -> None:
    run, site = journey()
    prepared = prepare(run, site, VEHICLE, Configuration())
    recorded = prepared.fixes("primary")
    moved = prepared.run.gnss.with_columns(pl.col("latitude_deg") + 0.001)
    other = replace(prepared, run=prepared.run.with_streams(gnss=moved))
    assert (other.fixes("primary")["latitude_deg"] - recorded["latitude_deg"]).min() > 0.0009
