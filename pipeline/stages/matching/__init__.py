"""Map matching: which way the train went over the network, and where each epoch is on that path.

In: fixes of one solution (or the reference), odometer, site. Out: `Match`: `schemas.stages.Positions` and the path.
Touches no file. The path may use the whole run; `gate_probability`, which feeds detection, only what came before.
"""

from pipeline.stages.matching.match import Match, match
from pipeline.stages.track.path import TravelledPath

__all__ = ["Match", "TravelledPath", "match"]
