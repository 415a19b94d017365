"""Streams put in order of time: the first stage of a run.

In: a `RunLog` as recorded. Out: the same with each stamp once, placeholders without a fix, and counts of all this.
Touches no file. It corrects nothing: wrong units and clocks are the fit's to name and the configuration's to correct.
"""

from pipeline.stages.clean.clean import CleanCounts, StreamCounts, clean

__all__ = ["CleanCounts", "StreamCounts", "clean"]
