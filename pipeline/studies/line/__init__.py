"""The line by its runs: where virtual balises may be placed.

In: a result of `balise replay`, its site, criteria. Out: classes of pieces of track, proposals of balises.
Touches results, to read. `show/line.py` writes its files.

`pieces` cuts the track; `spans` says where the train was between two epochs and what became of the position there;
`passes` lays that on pieces, one outcome per run; `classes` counts and decides; `proposals` places balises;
`study` is the story.
"""

from pipeline.studies.line.proposals import site_balises
from pipeline.studies.line.study import LineResult, read_points, study_line

__all__ = ["LineResult", "read_points", "site_balises", "study_line"]
