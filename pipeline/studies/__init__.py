"""Questions asked of runs and results; no stage depends on their answers.

In: runs, or the tables of a result. Out: tables and sentences of their own.
Touches files to read results and to write its own.
"""
