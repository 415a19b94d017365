"""Map matching: which way the train went over the network, and where each epoch is on that path.

In: fixes of one solution (or the reference), odometer, site. Out: `Match`: `schemas.stages.MatchedEpochs` and the path.
Touches no file. The path may use the whole run; `gate_probability`, which feeds detection, only what came before.

Which tracks are possible is the set of `paths`; what it lets a train claim: `claims`. `match` places the epochs on the
path shown, which `path_search` finds within the set. What does each place cost: `path_states`. How does a train get
from one to the next: `paths`. The least sum of both: `least_squares`. Which legs are that: `decode`. The path as a
file: `travelled_route`.
"""

from pipeline.stages.matching.match import Match, match
from pipeline.stages.track.path import TravelledPath

__all__ = ["Match", "TravelledPath", "match"]
