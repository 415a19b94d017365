"""Hazards after the fact: evidence, episodes, classes, verdicts on alarms, suspects (DOMAIN section 5)."""

from pipeline.hazards.between import places_between
from pipeline.hazards.case import Case
from pipeline.hazards.classify import HazardResult, classify
from pipeline.hazards.truth import establish_truth
from pipeline.hazards.unoffered import with_unoffered

__all__ = ["Case", "HazardResult", "classify", "establish_truth", "places_between", "with_unoffered"]
