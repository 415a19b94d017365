"""What is made of something that stays is made once, and kept as long as that."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

Source = TypeVar("Source")
Made = TypeVar("Made")


class Once(Generic[Source, Made]):
    """A function of one argument that is itself alone (no other is equal to it): a site, a track."""

    def __init__(self, make: Callable[[Source], Made]) -> None:
        self._make = make
        self._made: WeakKeyDictionary[Source, Made] = WeakKeyDictionary()

    def __call__(self, source: Source) -> Made:
        if source not in self._made:
            self.keep(source, self._make(source))
        return self._made[source]

    def keep(self, source: Source, made: Made) -> None:
        """Whoever has made it already need not have it made again."""
        self._made[source] = made
