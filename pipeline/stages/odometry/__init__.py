"""The odometer of a run, made once: distance over time in continuity segments, with its noise.

In: the cleaned odometer stream, vehicle file, configuration. Out: one `Odometry`, handed to every stage.
Touches no file, and knows no position: only the sign against the path is set from one (`polarity`).

Where it comes from, as declared, and from one row to the next: `rows`. Over all rows: `odometry`; at given instants:
`reading`. By how much it may be off, and when a position may return after an alarm: `bound`. The sign with which a
counter counts, and over slip by another one: `polarity`. What is movement and what noise of the rows: `driven`,
`quantisation`. Shared with evidence, plausibility, calibration and alignment: `scale_lag`, scale and lag of any counter
against another recorder, by `regression`.
"""

from pipeline.stages.odometry.odometry import OdometerDistance, Odometry, odometry_of
from pipeline.stages.odometry.polarity import counted_over_slip

__all__ = ["Odometry", "OdometerDistance", "counted_over_slip", "odometry_of"]
