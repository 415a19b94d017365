"""Files to frames: recorded runs.

In: MCAP logs and Parquet folders, mappings of the configuration. Out: `schemas.run.RunLog`.
Touches files. It mends nothing: what does not fit is an error that lists every breach, what was left out is counted.
"""

from pipeline.ingest.describe import LogDescription, describe_log
from pipeline.ingest.mcap_writer import write_mcap
from pipeline.ingest.run import read_run

__all__ = ["LogDescription", "describe_log", "read_run", "write_mcap"]
