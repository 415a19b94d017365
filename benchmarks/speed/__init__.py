"""Time and memory of one run, as ratios within one process or against work that does not change."""
