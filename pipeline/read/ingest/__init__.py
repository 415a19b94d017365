"""Files to frames: recorded runs.

In: MCAP logs and Parquet folders, mappings of the configuration. Out: `schemas.run.RunLog`.
Touches files. It mends nothing: what does not fit is an error that lists every breach, what was left out is counted.
"""

from pipeline.read.ingest.run import read_run

__all__ = ["read_run"]
