"""What the state machine notes of its way: on what it stands, and when the position was not used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.lds.passage import Reference

Return = Literal["re-link", "physical balise", "initialisation"]


@dataclass(slots=True)
class Negation:
    """The position was not used from `first_epoch` on until `end_epoch` (`None`: to the end)."""

    first_epoch: int
    end_epoch: int | None = None
    ended_by: Return | None = None


@dataclass(frozen=True, slots=True)
class Standing:
    """What the LDS stands on from an epoch on: its reference, and whether a chain has begun."""

    epoch: int
    reference: Reference | None
    chain_begun: bool
