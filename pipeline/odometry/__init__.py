"""The odometer of a run, made once: distance over time in continuity segments, with its noise."""
