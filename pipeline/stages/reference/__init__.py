"""The reference on the network, by itself: every track that it may have run along (DOMAIN section 5.1).

In: the reference stream, the survey as a network. Out: stretches of samples with every way that they may have taken.
Nothing that came from GNSS or the odometer is known here.

Which elements lie near which samples: `samples`. Where may the train have left the survey: `open_ends`. Which paths do
the samples not refute: the set of `paths`. Which ways are that: `ways`, `visits`; with coordinates: `stretches`.
"""

from pipeline.stages.reference.stretches import ReferencePath, ReferenceStretch, reference_stretches

__all__ = ["ReferencePath", "ReferenceStretch", "reference_stretches"]
