"""Files to frames: recorded runs and sites."""

from pipeline.ingest.describe import LogDescription, describe_log
from pipeline.ingest.mcap_writer import write_mcap
from pipeline.ingest.run import read_run

__all__ = ["LogDescription", "describe_log", "read_run", "write_mcap"]
