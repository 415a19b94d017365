"""What is wrong with a settings file, key by key, in words of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from schemas.near import did_you_mean

# By pydantic's types of errors; what they say of themselves is for programmers.
_WORDS = {
    "missing": "is missing",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be text",
    "string_pattern_mismatch": "must have the form {pattern}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "model_type": "must be a table of keys",
    "model_attributes_type": "must be a table of keys",
    "dict_type": "must be a table of keys",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "timezone_aware": "needs a time zone, for example 2025-03-03T06:00:00Z",
}


def breach_messages(error: ValidationError, kind: type[BaseModel]) -> list[str]:
    """Every breach with its path: an unknown key with the nearest known one, else what was found and expected.

    Args:
        error: what pydantic found.
        kind: the model that was validated.

    Returns:
        One sentence per breach.
    """
    return [
        _unknown(breach, kind) if breach["type"] == "extra_forbidden" else _wrong(breach) for breach in error.errors()
    ]


def _wrong(breach: ErrorDetails) -> str:
    """One breach, for people."""
    key = ".".join(map(str, breach["loc"])) or "(file)"
    text = _WORDS.get(breach["type"], breach["msg"].removeprefix("Value error, "))
    found = breach["input"]
    single = isinstance(found, str | int | float) and breach["type"] != "missing"
    return f"{key}: {_filled(text, breach.get('ctx') or {})}" + (f", found {_shown(found)}" if single else "")


def _shown(value: object) -> str:
    """The value as TOML was read; an integer of more digits than Python writes has no text."""
    long = isinstance(value, int) and value.bit_length() > 1024
    return "a very large integer" if long else repr(value)[:100]


def _filled(text: str, context: Mapping[str, Any]) -> str:
    try:
        return text.format_map(context)
    except (KeyError, ValueError, IndexError):
        return text


def _unknown(breach: ErrorDetails, kind: type[BaseModel]) -> str:
    """An unknown key; the one that was meant is looked for in the same section first."""
    *path, name = map(str, breach["loc"])
    elsewhere = {key.rsplit(".", 1)[-1]: key for key in _keys(kind)}
    if name in elsewhere:
        near = f" (did you mean `{elsewhere[name]}`?)"
    else:
        near = did_you_mean(name, _model_at(kind, path).model_fields) or did_you_mean(name, elsewhere)
    return f"unknown key `{'.'.join([*path, name])}`{near}"


def _model_at(kind: type[BaseModel], path: list[str]) -> type[BaseModel]:
    """The section that a path leads to; numbers and names of a list or a table of sections are passed over."""
    for part in path:
        field = kind.model_fields.get(part)
        inner = None if field is None else next(_models_in(field.annotation), None)
        kind = inner or kind
    return kind


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Sections that a type may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def _keys(kind: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every key with its path, but for lists and tables of sections."""
    for name, field in kind.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _keys(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name
