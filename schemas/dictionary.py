"""The data dictionary: every table, column, unit and meaning, from the contracts themselves."""

from __future__ import annotations

from collections.abc import Mapping

import dataframely as dy
import polars as pl
from pydantic import BaseModel

from schemas.campaign import CAMPAIGN_TABLES
from schemas.config import Configuration, Vehicle
from schemas.errors import UsageError
from schemas.experiment import EXPERIMENT_TABLES
from schemas.inputs import SITE_SCHEMAS, STREAM_SCHEMAS
from schemas.line import LINE_TABLES
from schemas.tables import CONTRACT_VERSION, TABLES

_INTRODUCTION = f"""# Data dictionary

Generated from the contracts by `balise dictionary --markdown`; do not edit. Contract version {CONTRACT_VERSION}.

Times are UTC, nanoseconds, GNSS time of validity. A null means "not known". Floats are never NaN.
"""


def _dtype(column: dy.Column) -> str:
    """Type of a column, for people."""
    if isinstance(column, dy.Enum):
        return "enum " + " ".join(column.categories)
    if isinstance(column, dy.List):
        return f"list of {_dtype(column.inner)}"
    return str(column.dtype)


def groups() -> dict[str, Mapping[str, type[dy.Schema]]]:
    """All table contracts by where they stand: input streams, site, output tables."""
    return {
        "Input streams": {str(name): schema for name, schema in STREAM_SCHEMAS.items()},
        "Site": SITE_SCHEMAS,
        "Output tables": TABLES,
        "Campaign tables": CAMPAIGN_TABLES,
        "Line tables": LINE_TABLES,
        "Tables of `experiment recorded`": EXPERIMENT_TABLES,
    }


def dictionary_frame(only: str | None = None) -> pl.DataFrame:
    """Every column of every table, or of one: one row per column.

    Args:
        only: name of a table, or None for all.

    Returns:
        `group, table, column, dtype, unit, nullable, meaning`.

    Raises:
        UsageError: there is no table of that name.
    """
    known = [table for tables in groups().values() for table in tables]
    if only is not None and only not in known:
        raise UsageError("is not a table", place=only, expected=", ".join(known))
    rows = [
        {
            "group": group,
            "table": table,
            "column": name,
            "dtype": _dtype(column),
            "unit": (column.metadata or {}).get("unit", ""),
            "nullable": column.nullable,
            "meaning": column.description or "",
        }
        for group, tables in groups().items()
        for table, schema in tables.items()
        for name, column in schema.columns().items()
        if only in (None, table)
    ]
    return pl.DataFrame(rows)


def settings_frame() -> pl.DataFrame:
    """One row per key of the configuration and the vehicle file: `file, key, default`."""
    rows = _settings_rows("configuration", "", Configuration()) + _settings_rows("vehicle", "", Vehicle())
    return pl.DataFrame(rows, schema={"file": pl.String, "key": pl.String, "default": pl.String}, orient="row")


def _settings_rows(file: str, prefix: str, settings: BaseModel) -> list[tuple[str, str, str]]:
    """Settings with units and meanings, sections within sections included."""
    rows: list[tuple[str, str, str]] = []
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            rows += _settings_rows(file, f"{prefix}{name}.", value)
        elif isinstance(value, dict) and value and all(isinstance(item, BaseModel) for item in value.values()):
            for key, item in value.items():
                rows += _settings_rows(file, f"{prefix}{name}.{key}.", item)
        else:
            rows.append((file, prefix + name, "not set" if value is None else str(value)))
    return rows


def dictionary_markdown() -> str:
    """The dictionary as one Markdown page."""
    parts = [_INTRODUCTION]
    for group, tables in groups().items():
        parts.append(f"\n## {group}\n")
        for table, schema in tables.items():
            parts.append(f"\n### `{table}`\n\n{(schema.__doc__ or '').strip()}\n")
            parts.append("\n| column | dtype | unit | null | meaning |\n|---|---|---|---|---|\n")
            parts.extend(_markdown_row(name, column) for name, column in schema.columns().items())
    parts.append("\n## Configuration and vehicle file\n\n| file | key | default |\n|---|---|---|\n")
    parts.extend(f"| {file} | `{key}` | {default} |\n" for file, key, default in settings_frame().iter_rows())
    return "".join(parts)


def _markdown_row(name: str, column: dy.Column) -> str:
    """A column as a row of a table in Markdown."""
    unit = (column.metadata or {}).get("unit", "")
    nullable = "yes" if column.nullable else ""
    return f"| `{name}` | {_dtype(column)} | {unit} | {nullable} | {column.description or ''} |\n".replace(
        "|value|", "\\|value\\|"
    )


if __name__ == "__main__":
    print(dictionary_markdown(), end="")
