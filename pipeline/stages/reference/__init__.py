"""The reference on the network, by itself: every track that it may have run along (DOMAIN section 5.1).

In: the reference stream, the survey as a network. Out: stretches of samples with every route that they may have taken.
Nothing that came from GNSS or the odometer is known here.

Which elements lie near which samples, where may the train have left the survey: `stretches`, with coordinates. Which
paths do the samples not refute: the set of `paths`. Which routes are that: `routes`.
"""

from pipeline.stages.reference.stretches import ReferencePath, ReferenceStretch, reference_stretches

__all__ = ["ReferencePath", "ReferenceStretch", "reference_stretches"]
