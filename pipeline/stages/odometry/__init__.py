"""The odometer of a run, made once: distance over time in continuity segments, with its noise.

In: the cleaned odometer stream, vehicle file, configuration. Out: one `Odometry`, handed to every stage.
Touches no file, and knows no position: only the sign against the path is set from one (`polarity`).

Where it comes from, as declared: `origin`. From one row to the next: `rows`. Over all rows: `odometry`, over slip by
another one: `over_slip`. What is movement and what noise of the rows: `driven`, `quantisation`, `written_steps`. Shared
with evidence, plausibility, calibration and alignment: `scale_lag`, scale and lag of any counter against another
recorder; with the LDS and alignment: `recovery`, when a position may return after an alarm.
"""

from pipeline.stages.odometry.odometry import OdometerDistance, Odometry, odometry_of
from pipeline.stages.odometry.polarity import counted_over_slip

__all__ = ["Odometry", "OdometerDistance", "counted_over_slip", "odometry_of"]
