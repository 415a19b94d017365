"""`@frozen` against `dataclass(frozen=True)`: the same class by both, the same answers."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, asdict, astuple, dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import pytest

from schemas.frozen import frozen


def _classes(decorate: Callable[[type], type]) -> tuple[Any, Any, Any]:
    class Point:
        x: float
        y: float = 2.0
        values: list[int] = field(default_factory=list, compare=False)
        _kept: dict[str, float] = field(default_factory=dict, init=False, repr=False, compare=False)

        @cached_property
        def total(self) -> float:
            return self.x + self.y

    base: Any = decorate(Point)

    class Named(base):
        name: str = "p"

        def __post_init__(self) -> None:
            if not self.name:
                raise ValueError("no name")

    class Nothing:
        pass

    return base, decorate(Named), decorate(Nothing)


OURS, THEIRS = _classes(frozen), _classes(dataclass(frozen=True))


@frozen
class Kept:
    x: int
    of: tuple[int, ...] = ()


def _outcome(call: Callable[[], Any]) -> Any:
    """What is comparable of the result, or the kind of error."""
    try:
        made = call()
    except (TypeError, ValueError, FrozenInstanceError) as error:
        return type(error)
    return (repr(made), asdict(made), astuple(made)) if is_dataclass(made) else made


CALLS: list[Callable[[Any, Any, Any], Any]] = [
    lambda point, named, nothing: point(1.0),
    lambda point, named, nothing: point(1.0, 3.0, [4]),
    lambda point, named, nothing: point(y=3.0, x=1.0),
    lambda point, named, nothing: point(),
    lambda point, named, nothing: point(1.0, 2.0, [], {}),
    lambda point, named, nothing: point(1.0, x=1.0),
    lambda point, named, nothing: point(1.0, z=1.0),
    lambda point, named, nothing: point(1.0, _kept={}),
    lambda point, named, nothing: named(1.0),
    lambda point, named, nothing: named(1.0, name="q"),
    lambda point, named, nothing: named(1.0, name=""),
    lambda point, named, nothing: nothing(),
    lambda point, named, nothing: nothing(1),
    lambda point, named, nothing: replace(point(1.0, 3.0), y=5.0),
    lambda point, named, nothing: replace(point(1.0, 3.0), z=5.0),
    lambda point, named, nothing: point(1.0) == point(1.0, 2.0, [7]),
    lambda point, named, nothing: point(1.0) == point(2.0),
    lambda point, named, nothing: point(1.0) == named(1.0),
    lambda point, named, nothing: nothing() == nothing(),
    lambda point, named, nothing: hash(point(1.0)) == hash(point(1.0, 2.0, [7])),
    lambda point, named, nothing: hash(nothing()) == hash(nothing()),
    lambda point, named, nothing: hash(point([1.0])),
    lambda point, named, nothing: point(1.0).total,
    lambda point, named, nothing: setattr(point(1.0), "x", 2.0),
    lambda point, named, nothing: setattr(point(1.0), "new", 2.0),
    lambda point, named, nothing: delattr(point(1.0), "x"),
    lambda point, named, nothing: [each.name for each in fields(named)],
    lambda point, named, nothing: point.__match_args__,
    lambda point, named, nothing: point(1.0).values is point(1.0).values,
]


@pytest.mark.parametrize("number", range(len(CALLS)))
def test_as_a_frozen_dataclass(number: int) -> None:
    call = CALLS[number]
    assert _outcome(lambda: call(*OURS)) == _outcome(lambda: call(*THEIRS))


def test_without_equality_one_is_only_itself() -> None:
    @frozen(eq=False)
    class Alone:
        x: int

    one = Alone(1)
    assert one == one
    assert one != Alone(1)
    assert len({one, Alone(1)}) == 2


def test_methods_that_a_class_writes_itself_are_kept() -> None:
    @frozen
    class Own:
        x: int

        def __repr__(self) -> str:
            return "own"

        def __eq__(self, other: object) -> bool:
            return isinstance(other, Own)

        def __hash__(self) -> int:
            return 7

    assert (repr(Own(1)), Own(1) == Own(2), hash(Own(1))) == ("own", True, 7)


def test_pickled_and_back() -> None:
    kept = Kept(1, (2, 3))
    assert pickle.loads(pickle.dumps(kept)) == kept


def test_a_message_names_the_argument() -> None:
    with pytest.raises(TypeError, match=r"Kept\(\) lacks the argument 'x'"):
        Kept()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"Kept\(\) has no argument 'y'"):
        Kept(1, y=2)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"Kept\(\) was given the argument 'x' twice"):
        Kept(1, x=2)  # type: ignore[misc]
    with pytest.raises(TypeError, match=r"Kept\(\) takes 2 arguments by place, but 3 were given"):
        Kept(1, (), 2)  # type: ignore[call-arg]
