"""When the train moved, how far and how fast, after the fact."""

from pipeline.motion.moving import Motion, motion_by_odometer, motion_of

__all__ = ["Motion", "motion_by_odometer", "motion_of"]
