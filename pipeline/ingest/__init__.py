"""Recorded runs in: MCAP logs and Parquet folders become `RunLog`s that fit the contract."""

from pipeline.ingest.run import read_run

__all__ = ["read_run"]
