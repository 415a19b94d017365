"""What comes in: recorded runs, and the site they ran on.

In: files of runs and sites. Out: `RunLog` and `Site` as `schemas/run.py` holds them.
Touches files to read them.
"""
