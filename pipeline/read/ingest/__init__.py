"""Files to frames: recorded runs.

In: MCAP logs and Parquet folders, mappings of the configuration. Out: `schemas.run.RunLog`.
Touches files. It mends nothing: what does not fit is an error that lists every breach, what was left out is counted.

- Where does each message lie, and is the log whole? `mcap_walk` meets every record once (`mcap_records` parses one,
  `mcap_block` gathers messages, `mcap_summary` holds the log against what it says of itself).
- Which stream does a topic feed? `plan`, by the recipes of schemas (`recipe`, `recipes`, `recipes_drivers`) or as the
  configuration maps it (`mapping`).
- What do messages hold? Many at once where their layout is fixed (`layout`, `protobuf`, `ros_message`, `json_columns`,
  `json_typed`), else one by one; `reader` puts both together.
- When? `stamps`, `timescale`. Which rows? `assemble`, `conform`, `correct`.
- What does a log hold that nothing maps? `describe`, `guesses`, and for tables `csv_text`, `csv_draft`.
"""

from pipeline.read.ingest.run import read_run

__all__ = ["read_run"]
