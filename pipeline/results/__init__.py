"""Results on disk: the tables of each run, and SQL over all of them.

In: tables of the contract, or a folder of results. Out: Parquet files; rows and figures for people and programs.
Touches files. No value is made here but provenance (digests and versions).

Tables of runs: `store`; of many runs in few files: `packs`, `packed_tables`, `packing`; what marks a run complete:
`marker`. In parts for SQL: `source`; SQL and its answers as files: `query`, `answer_files`. What saves time with the
next call: `catalogue`. Which files made a result: `manifest`; by which build of the program: `software`. What became
of the runs of a campaign: `outcome`. Where a run was, on the ground: `places`. Work on several processes: `workers`.
"""
