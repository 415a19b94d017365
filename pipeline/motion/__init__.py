"""When the train moved, how far and how fast, after the fact."""

from pipeline.motion.moving import Motion, motion_by_odometer, motion_of
from pipeline.motion.void_evidence import void_evidence

__all__ = ["Motion", "motion_by_odometer", "motion_of", "void_evidence"]
