"""Results on disk: the tables of each run, the catalogue over all of them, and SQL over both.

In: tables of the contract, or a folder of results. Out: Parquet files; rows and figures for people and programs.
Touches files. No value is made here but provenance (digests and versions).
"""
