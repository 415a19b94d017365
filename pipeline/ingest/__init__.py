"""Files to frames: recorded runs and sites."""

from pipeline.ingest.run import read_run

__all__ = ["read_run"]
