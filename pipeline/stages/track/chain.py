"""A chain of oriented net elements with one coordinate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.track.network import Network
from pipeline.stages.track.path import RoutePath


@dataclass(frozen=True)
class Chain:
    """Oriented net elements in order, and the coordinate [m] at which each is entered."""

    oriented: tuple[int, ...]
    entry_m: tuple[float, ...]

    def route(self, network: Network, numbers: dict[str, int] | None = None) -> RoutePath:
        """`numbers`: net elements as the caller counts them, where the network has them in pieces."""
        oriented = np.array(self.oriented, dtype=np.int64)
        element = oriented // 2
        track = network.track
        numbered = element if numbers is None else np.array([numbers[track.ids[number]] for number in element.tolist()])
        return RoutePath(
            element=numbered,
            forward=oriented % 2 == 0,
            entry_m=np.array(self.entry_m),
            low_m=track.begin_m[element],
            high_m=track.end_m[element],
        )
