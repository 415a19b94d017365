"""Map matching: which way the train went over the network, and where each epoch is on that path."""

from pipeline.matching.match import Match, match
from pipeline.track.path import TravelledPath

__all__ = ["Match", "TravelledPath", "match"]
