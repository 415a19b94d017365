"""The page of the configuration, from the texts under its keys: meaning, unit, default, reason and source."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from schemas.config import Configuration, StreamCorrection, StreamMapping, Vehicle
from schemas.config_base import Settings
from schemas.frozen import frozen

_INTRODUCTION = """# Configuration and vehicle file

Generated from `schemas/config*.py` by `make configuration`; do not edit.

Both files are optional, and a key that is left out keeps its default. Write down only what you change:

`balise.toml`:

```toml
[lds]
ci_source = "hpl"
ci_limit_m = 20.0

[hazards]
service_level = "egnos_observed"
reaction_s = 0.5
```

    balise replay RUN --site SITE --out OUT_NEW --config balise.toml --vehicle vehicle.toml

An unknown key or a value out of range is an error. `OUT/config.toml` holds all values that a result was made with, and
`OUT/vehicle.toml` the vehicle of the last call, if it named one. A run is replayed again when its configuration,
vehicle, log, site or program has changed. How to map a logger and how to correct a stream: [loggers](loggers.md).

The last column gives the reason and source of a default: TVB, LOC and DIAG are the papers that the
[assessor's page](assessor.md) names, DOMAIN is [domain.md](domain.md), and *ours* is a value that no paper gives.
"""
# The unit of a key is the end of its name.
_UNITS = {
    "per_h": "1/h",
    "mps2": "m/s²",
    "mps": "m/s",
    "mib": "MiB",
    "mb": "MB",
    "deg": "°",
    "sigmas": "sigma",
    "m": "m",
    "s": "s",
    "h": "h",
}
# Models that no section of the configuration shows, by the heading of their table.
_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("A mapping: `[ingest.gnss]`, `[[ingest.odometer]]` and so on", StreamMapping),
    ("A correction: `[[ingest.correct]]`", StreamCorrection),
    ("Vehicle file", Vehicle),
)


@frozen
class Key:
    """One key as it is documented: the full name, the default as shown, and the two paragraphs under it."""

    name: str
    default: str
    meaning: str
    reason: str

    @property
    def unit(self) -> str:
        """Unit by the end of the name, empty for a count, a share, a factor or a text."""
        last = self.name.rpartition(".")[2]
        return next((unit for end, unit in _UNITS.items() if last.endswith(f"_{end}")), "")


def field_texts(model: type[BaseModel]) -> dict[str, tuple[str, str]]:
    """Meaning and reason of each field of a model: the paragraphs of the string under it.

    Args:
        model: a model of settings.

    Returns:
        (meaning, reason) by field, those that it inherits too.
    """
    texts: dict[str, tuple[str, str]] = {}
    for base in reversed(model.__mro__):
        # A generic model with its parameters filled in has no source: its origin is a base as well.
        if issubclass(base, Settings) and not base.__pydantic_generic_metadata__["args"]:
            texts |= _texts_in(base)
    return texts


def _texts_in(model: type[BaseModel]) -> dict[str, tuple[str, str]]:
    """Meaning and reason of each field that the body of a model declares."""
    body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    assert isinstance(body, ast.ClassDef)
    texts: dict[str, tuple[str, str]] = {}
    for field, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and (text := _string_of(below)):
            meaning, _, reason = text.partition("\n\n")
            texts[field.target.id] = (" ".join(meaning.split()), " ".join(reason.split()))
    return texts


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[Key]:
    """Every key of a model in order; nested models by dotted names.

    Args:
        model: a model of settings.
        prefix: dotted name of the model, with a dot at its end.

    Returns:
        Keys with default, meaning and reason.
    """
    texts = field_texts(model)
    for name, field in model.model_fields.items():
        value = None if field.is_required() else field.get_default(call_default_factory=True)
        meaning, reason = texts.get(name, ("", ""))
        if isinstance(value, BaseModel):
            yield from keys(type(value), f"{prefix}{name}.")
        elif isinstance(value, dict) and value:
            yield from _keys_of_instances(value, f"{prefix}{name}.", reason)
        else:
            yield Key(prefix + name, _default_words(field, value), meaning, reason)


def settings_markdown() -> str:
    """The whole page."""
    parts = [_INTRODUCTION]
    for name, section in Configuration():
        parts.append(f"\n## `[{name}]`\n\n{_class_text(type(section))}\n\n{_table(keys(type(section), f'{name}.'))}")
    for title, model in _TABLES:
        parts.append(f"\n## {title}\n\n{_class_text(model)}\n\n{_table(keys(model))}")
    return "".join(parts)


def _keys_of_instances(instances: dict[str, BaseModel], prefix: str, reason: str) -> Iterator[Key]:
    """Keys of the instances of a table of settings, such as the sigmas by kind of fix."""
    for instance, values in instances.items():
        texts = field_texts(type(values))
        for name, value in values:
            yield Key(f"{prefix}{instance}.{name}", str(value), texts[name][0], reason)


def _string_of(node: ast.stmt) -> str:
    """The text of a statement that is nothing but a string, else an empty text."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return inspect.cleandoc(node.value.value)
    return ""


def _default_words(field: FieldInfo, value: object) -> str:
    """The default of a key in words."""
    if field.is_required():
        return "required"
    match value:
        case None:
            return "not set"
        case "" | () | []:
            return "none"
        case dict() if not value:
            return "none"
        case bool():
            return str(value).lower()
        case tuple():
            return ", ".join(str(item) for item in value)
        case _:
            return str(value)


def _class_text(model: type[BaseModel]) -> str:
    """The docstring of a settings class without its indentation."""
    return inspect.cleandoc(model.__doc__ or "")


def _table(rows: Iterator[Key]) -> str:
    """Rows as Markdown; the last column is left out where no key has a reason."""
    listed = list(rows)
    cells = [[f"`{key.name}`", key.default, key.unit, _cell(key.meaning), _cell(key.reason)] for key in listed]
    width = 5 if any(key.reason for key in listed) else 4
    head = ["key", "default", "unit", "meaning", "reason and source"]
    lines = [head[:width], ["---"] * width, *(row[:width] for row in cells)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(text: str) -> str:
    """Text for a table cell: the unit stands in a column of its own."""
    return re.sub(r" \[(?:m/s2|m/s|m|s|h|deg|1/h|MiB|MB)\]", "", text).replace("|", "\\|")


if __name__ == "__main__":
    print(settings_markdown(), end="")
