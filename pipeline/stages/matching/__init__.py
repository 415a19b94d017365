"""Map matching: which way the train went over the network, and where each epoch is on that path.

In: fixes of one solution (or the reference), odometer, site. Out: `Match`: `schemas.stages.Positions` and the path.
Touches no file. The path may use the whole run; `gate_probability`, which feeds detection, only what came before.

`match` places the epochs on the path that `path_search` finds. Some epochs are `steps`, with `candidates` beside them.
How well do they explain the position: `likelihood`. How does it move against all tracks but for survey errors:
`innovations`. How does a train get from one to the next: `moves`. All of it as states: `trellis`. How probable are
they: `search`. Which legs are that: `decode`. How sure is it: `doubt`. The path as a file: `travelled_route`.
"""

from pipeline.stages.matching.match import Match, match
from pipeline.stages.track.path import TravelledPath

__all__ = ["Match", "TravelledPath", "match"]
