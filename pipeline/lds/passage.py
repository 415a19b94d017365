"""A balise offered to the train, and the row of `passages` that comes of it."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.lds.crossings import Balise
from pipeline.lds.windows import Window
from schemas.enums import LinkingError, PassageStatus, Reaction

_SEVERITY = (Reaction.NONE, Reaction.SERVICE_BRAKE, Reaction.TRIP)


@dataclass(slots=True)
class Passage:
    """A row of `passages` in the making. `reckoned_odometer_m`: where the train passes it by linking."""

    balise: Balise
    t_ns: int
    heading: int
    status: PassageStatus = PassageStatus.MISSED
    t_offered_ns: int | None = None
    window: Window | None = None
    odometer_distance_m: float | None = None
    confidence_m: float | None = None
    linking_error: LinkingError = LinkingError.NONE
    reaction: Reaction = Reaction.NONE
    reckoned_odometer_m: float | None = None


@dataclass(frozen=True, slots=True)
class Offer:
    """A balise offered to the train: a crossing of the position, or a telegram read.

    `refusal`: why it does not count as a detection, `None` where it does. `sense`: direction in
    which the position passes the balise, `heading`: direction of travel.
    """

    balise: Balise
    t_ns: int
    sense: int
    heading: int
    odometer_m: float | None
    travelled_m: float
    confidence_m: float | None
    refusal: PassageStatus | None


@dataclass(frozen=True, slots=True)
class Reference:
    """The last relevant balise: where odometer and way run stood when it was detected."""

    balise: Balise
    odometer_m: float | None
    travelled_m: float


def blame(passage: Passage, error: LinkingError, reaction: Reaction) -> None:
    """The first linking error of a passage stays, the most severe reaction counts."""
    if passage.linking_error is LinkingError.NONE:
        passage.linking_error = error
    passage.reaction = max(passage.reaction, reaction, key=_SEVERITY.index)
