"""Map matching: which route the train took over the network, and where each epoch is on that path.

In: fixes of one solution (or the reference), odometer, site. Out: `Match`: `schemas.stages.MatchedEpochs` and the path.
Touches no file. The path may use the whole run; `gate_probability`, which feeds detection, only what came before.

Which tracks are possible is the set of `paths`; what it lets a train claim: `claims`. `match` places the epochs on the
path shown, which it finds within the set, and writes the path as a file. What does each place cost, what is the least
sum over all, and which legs are that: `least_squares`. Fixes and their sigmas, and the columns of epochs: `epochs`.
"""

from pipeline.stages.matching.match import Match, match
from pipeline.stages.track.path import TravelledPath

__all__ = ["Match", "TravelledPath", "match"]
