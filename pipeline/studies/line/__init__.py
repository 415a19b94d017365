"""The line by its runs: where virtual balises may be placed.

In: a result of `balise replay`, its site, criteria. Out: classes of pieces of track, proposals of balises, a page.
Touches results, to read, and the folder that it writes.

`pieces` cuts the track; `spans` says where the train was between two epochs and what became of the position there;
`passes` lays that on pieces, one outcome per run; `classes` counts and decides; `proposals` places balises; `read`,
`write` and `page` are files.
"""

from pipeline.studies.line.trials import distinct, trials_needed
from pipeline.studies.line.write import write_line

__all__ = ["distinct", "trials_needed", "write_line"]
