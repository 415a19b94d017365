"""Whether the streams of a run fit each other, the site and the vehicle file: units, clocks, axes, shifts.

In: a cleaned run, and where they are known the track and the vehicle. Out: a `Fit`, which is a list of checks, each
with what was found, its cause and what mends it. It asks about recorders, never about the truth: no table of the judge
depends on it. A run that cannot be is refused, and evidence that contradicts itself keeps a verdict from being `safe`.
Touches nothing outside.
"""
