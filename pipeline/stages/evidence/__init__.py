"""Where the train was, as a set: net elements and an interval (DOMAIN section 5.1).

In: reference, balise reads, odometer, survey, figures of the vehicle file. Out: evidence at any instants.
Nothing that came from GNSS is known here, and nothing of matching, alignment, monitors, LDS or judge is imported.

`evidence` is asked for any instants; `gathering` makes it of all recorders; `places` gives it as columns. Which places
are known at which instants: `anchors`. What contradicts a reference: `contradictions`. By which clock, and how far does
the odometer carry them: `carrying`. Which chains of net elements lead from one to the next: `gaps`.
"""

from pipeline.stages.evidence.evidence import EvidenceSet, TrainEvidence, unite
from pipeline.stages.evidence.gathering import evidence_of
from pipeline.stages.evidence.places import TruePlaces, true_places

__all__ = ["EvidenceSet", "TrainEvidence", "TruePlaces", "unite", "evidence_of", "true_places"]
