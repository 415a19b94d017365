"""The odometer of a run, made once: distance over time in continuity segments, with its noise."""

from pipeline.odometry.odometry import Odometry, odometry_of

__all__ = ["Odometry", "odometry_of"]
