"""Two receivers in one log: their positions of one time differ, and are never merged (DOMAIN section 1, "solution").

In: positions by time. Out: who tells other positions than whom. Same place within the digits that were sent: one
receiver that speaks with several talkers, or whose message came twice.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from pipeline.make.receivers.epochs import Epoch, Gathered
from schemas.errors import InputError

# Fewer differences are those of a clock that was set, or of logs that were joined. Numerics of the reading.
_FEWEST = 3
_M_PER_DEG = 111_320.0
# Stamps coarser than the rate: the second of two positions lies on the way to the third. Beyond this detour, and this
# share of the way, it does not [m].
_DETOUR_M = 2.0
_DETOUR_SHARE = 0.2


class ToldPosition(NamedTuple):
    """A position as a sentence tells it; `unit_m`: of its last digit. No place: the talker has no fix."""

    talker: str
    place: tuple[float, float] | None
    unit_m: float = 0.0


@dataclass
class Talkers:
    """Who told which position of which time; the talker whose position comes first has it."""

    apart: Counter[frozenset[str]] = field(default_factory=Counter)
    together: Counter[frozenset[str]] = field(default_factory=Counter)
    widest_m: float = 0.0
    fixes: Counter[str] = field(default_factory=Counter)
    _said: dict[Hashable, ToldPosition] = field(default_factory=dict)
    _half: Counter[frozenset[str]] = field(default_factory=Counter)

    def take_position(self, key: Hashable, said: ToldPosition) -> bool:
        """Take a position for the epoch of this time; whether it belongs to it, and not to another receiver."""
        self.fixes[said.talker] += said.place is not None
        first = self._said.get(key)
        if first is None or first.talker == said.talker or first.place is None:
            if first is not None and first.talker != said.talker and said.place is not None:
                self._half[frozenset((first.talker, said.talker))] += 1
            self._said[key] = said
            return True
        pair = frozenset((first.talker, said.talker))
        if said.place is None:
            self._half[pair] += 1
            return False
        apart_m = distance_m(first.place, said.place)
        same = apart_m <= 1.5 * (first.unit_m + said.unit_m)
        (self.together if same else self.apart)[pair] += 1
        self.widest_m = max(self.widest_m, 0.0 if same else apart_m)
        return same

    def latest(self, key: Hashable) -> ToldPosition | None:
        """What was said of this time before."""
        return self._said.get(key)

    @property
    def rivals(self) -> frozenset[str]:
        """Talkers of several receivers: their positions differ, or each has fixes only where the other has none."""
        differ = [pair for pair, count in self.apart.items() if count >= _FEWEST or count > self.together[pair]]
        in_turn = [
            pair
            for pair, count in self._half.items()
            if count >= _FEWEST and not self.together[pair] and all(self.fixes[talker] for talker in pair)
        ]
        return frozenset().union(*differ, *in_turn)


def distance_m(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Distance of two places [deg], near enough for what is asked here."""
    east = (other[1] - one[1]) * math.cos(math.radians(one[0]))
    return math.hypot(other[0] - one[0], (east + 180.0) % 360.0 - 180.0) * _M_PER_DEG


def twin_distance_m(gathered: Gathered) -> float | None:
    """How far apart messages of one kind and time are [m], where they are of two receivers; none where they are not."""
    detours = list(_pair_distances_m(gathered))
    apart = [apart_m for apart_m, detour_m, bound_m in detours if detour_m > bound_m]
    return max(apart) if len(apart) >= _FEWEST else None


def _pair_distances_m(gathered: Gathered) -> Iterator[tuple[float, float, float]]:
    """Distance of each pair of one time, and how far the path over the second is longer than the straight one [m]."""
    for one, two in gathered.twins:
        first, second = _position_of(one), _position_of(two)
        later = gathered.epochs[two.number + 1 : two.number + 4]
        third = next((place for epoch in later if epoch.key != two.key and (place := _position_of(epoch))), None)
        if first and second and third:
            apart_m, straight_m = distance_m(first, second), distance_m(first, third)
            bound_m = max(_DETOUR_M, _DETOUR_SHARE * straight_m)
            yield apart_m, apart_m + distance_m(second, third) - straight_m, bound_m


def _position_of(epoch: Epoch) -> tuple[float, float] | None:
    """Position of an epoch, if it has one."""
    latitude, longitude = epoch.gnss.get("latitude_deg"), epoch.gnss.get("longitude_deg")
    return None if latitude is None or longitude is None else (float(latitude), float(longitude))


def two_receivers_error(place: str, names: frozenset[str], apart_m: float, option: str = "talker") -> InputError:
    """What to do about a log of two receivers; `names`: those that distinguish them."""
    talkers = " and ".join(sorted(names))
    choose = ", ".join(f"--solution {name}" for name in sorted(names))
    return InputError(
        "holds the positions of two receivers",
        place=place,
        found=(f"{talkers}, " if names else "messages of one kind and time, ") + f"up to {apart_m:.1f} m apart",
        expected="one receiver, or the one that is meant",
        remedy=f"Convert one {option} at a time, each as its own solution: {choose}."
        if names
        else "Write each receiver into a log of its own, and convert the second with --solution NAME.",
    )
