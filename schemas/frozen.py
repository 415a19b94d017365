"""Frozen dataclasses without generated code.

`dataclasses.dataclass` writes and compiles the methods of each class when it is made: 0.5 ms a class, an eighth of a
short replay in a fresh process. What `@frozen` makes is a dataclass too (`fields`, `replace`, `asdict`, pattern
matching), but all of them share methods that look at their fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, field, fields
from operator import attrgetter
from typing import Any, TypeVar, dataclass_transform, overload

Class = TypeVar("Class", bound=type)


@overload
def frozen(cls: Class, /) -> Class: ...
@overload
def frozen(*, eq: bool = True) -> Callable[[Class], Class]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class of named values that never change, as `dataclass(frozen=True, eq=eq)`.

    Args:
        cls: the class, where the decorator is used without arguments.
        eq: compare and hash by value; else an object is only equal to itself.

    Returns:
        The class, or a decorator for it.
    """
    return (lambda named: _made(named, eq)) if cls is None else _made(cls, eq)


def _made(cls: type, eq: bool) -> type:
    """The class with its methods of a data class that cannot be changed."""
    if cls.__doc__ is None:
        cls.__doc__ = cls.__name__  # or `dataclass` writes the signature, by `inspect`
    made: Any = dataclass(init=False, repr=False, eq=False)(cls)
    shown = {each.name: each for each in fields(made)}
    made.__init__ = _initialiser(cls.__name__, shown, getattr(made, "__post_init__", None))
    made.__setattr__ = _refuse_to_set
    made.__delattr__ = _refuse_to_delete
    if "__repr__" not in cls.__dict__:
        made.__repr__ = _shown
    if eq:
        compared = [name for name, each in shown.items() if each.compare]
        values = _values_of(compared)
        if "__eq__" not in cls.__dict__:
            made.__eq__ = _equality(values)
        if "__hash__" not in cls.__dict__ or cls.__dict__["__hash__"] is None:
            made.__hash__ = lambda self: hash(values(self))
    return made  # type: ignore[no-any-return]


def _values_of(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """What gives the values of some fields."""
    if not names:
        return lambda _: ()
    if len(names) == 1:
        return lambda self: (getattr(self, names[0]),)
    return attrgetter(*names)


def _equality(values: Callable[[Any], tuple[Any, ...]]) -> Callable[[Any, object], bool]:
    """What compares two of a class by their values."""

    def equals(self: Any, other: object) -> bool:
        """Whether both are of one class and have the same values."""
        return bool(values(self) == values(other)) if other.__class__ is self.__class__ else NotImplemented

    return equals


def _initialiser(
    name: str, shown: Mapping[str, Field[Any]], after: Callable[[Any], None] | None
) -> Callable[..., None]:
    """What sets the fields of a new instance."""
    names = tuple(each.name for each in shown.values() if each.init and not each.kw_only)
    known = frozenset(each.name for each in shown.values() if each.init)
    count, most = len(shown), len(names)
    complete = _completion(name, shown)

    def initialise(self: Any, /, *given: Any, **named: Any) -> None:
        """Set the fields from arguments and defaults, then call `after`."""
        values = self.__dict__
        if given:
            values.update(zip(names, given, strict=False))
        if named or len(given) > most:
            if len(given) > most or not known.issuperset(named) or not values.keys().isdisjoint(named):
                raise TypeError(_wrong(name, names, known, given, named))
            values.update(named)
        if len(values) < count:
            complete(values)
        if after is not None:
            after(self)

    return initialise


def _completion(name: str, shown: Mapping[str, Field[Any]]) -> Callable[[dict[str, Any]], None]:
    """What sets the fields that no argument gave."""
    defaults = {each.name: each.default for each in shown.values() if each.default is not MISSING}
    factories = {each.name: each.default_factory for each in shown.values() if each.default_factory is not MISSING}

    def complete(values: dict[str, Any]) -> None:
        """Put defaults in for the fields that have no value yet."""
        for missing in shown:
            if missing in values:
                continue
            if missing in defaults:
                values[missing] = defaults[missing]
            elif missing in factories:
                values[missing] = factories[missing]()
            else:
                raise TypeError(f"{name}() lacks the argument {missing!r}")

    return complete


def _wrong(
    name: str, names: tuple[str, ...], known: frozenset[str], given: tuple[Any, ...], named: Mapping[str, Any]
) -> str:
    """What is wrong with these arguments."""
    if len(given) > len(names):
        return f"{name}() takes {len(names)} arguments by place, but {len(given)} were given"
    if not known.issuperset(named):
        return f"{name}() has no argument {min(set(named) - known)!r}"
    return f"{name}() was given the argument {min(set(named) & set(names[: len(given)]))!r} twice"


def _refuse_to_set(self: Any, name: str, value: Any) -> None:
    """Refuse to change a field."""
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_to_delete(self: Any, name: str) -> None:
    """Refuse to delete a field."""
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _shown(self: Any) -> str:
    """The fields with their values, as `dataclass` shows them."""
    values = ", ".join(f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr)
    return f"{self.__class__.__qualname__}({values})"
