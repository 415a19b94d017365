"""The largest error that no monitor would have noticed, at every epoch of a run (docs/undetected.md).

In: what the bank along the track saw (`MonitorBank.along`), the aligned epochs, what the LDS did, the times of
independent fixes, the ranges. Out: per epoch and passage the largest error ahead and behind, what bounds it, and how
far apart physical balises may be. Touches no file, knows no truth, and changes nothing that it looks at.
"""
