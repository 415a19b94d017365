"""What the configuration says of a stream, as a recipe."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import dataframely as dy
import polars as pl

from pipeline.read.ingest.recipe import FIX_TYPE, Recipe
from pipeline.read.ingest.recipes import recorded_type
from schemas.config import IngestConfig, StreamMapping
from schemas.enums import Fix, Origin
from schemas.errors import ConfigError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream

# Topics on which drivers of receivers publish the velocity that these computed, as a twist (nmea_navsat_driver, ublox).
_VELOCITIES = ("fix_velocity",)


def mappings_of(config: IngestConfig, stream: Stream) -> tuple[StreamMapping, ...]:
    """What the configuration says about a stream (injected faults cannot be mapped)."""
    mappings: tuple[StreamMapping, ...] = getattr(config, stream, ())
    return mappings


def mapped_recipe(base: Recipe | None, fields: Mapping[str, str], stream: Stream, mapping: StreamMapping) -> Recipe:
    """The mapping over the recipe of the schema, `base`, if that is one of the same stream.

    `fields`: those of the first message, with their kinds.
    """
    of_receiver = (base is not None and base.stream == "gnss") or mapping.topic.rpartition("/")[2] in _VELOCITIES
    if base is None or base.stream != stream:
        fix = {"fix": pl.lit(Fix.AUTONOMOUS.value, dtype=FIX_TYPE)} if stream == "gnss" else {}
        base = Recipe(stream=stream, columns=fix, stamps={})
    contract = STREAM_SCHEMAS[stream].columns()
    _refuse_unknown_columns(stream, mapping, contract)
    paths = {name: path for name, path in mapping.fields.items() if name != "t"}
    columns = dict(base.columns) | {name: _recorded(path) for name, path in paths.items()}
    types = dict(base.types) | {
        root: recorded_type(contract[name]) for name in paths for root in columns[name].meta.root_names()
    }
    if "fix" in paths and mapping.fix_codes:
        types[paths["fix"]], columns["fix"] = _coded(fields.get(paths["fix"]), paths["fix"], mapping)
    columns |= {name: _constant(stream, mapping, name, contract[name]) for name in mapping.constants}
    columns |= {name: columns[name] * factor for name, factor in mapping.factors.items() if name in columns}
    if stream == "odometer" and of_receiver:
        # The message can be nothing else, whatever the mapping declares.
        columns["origin"] = pl.lit(Origin.GNSS.value, dtype=pl.String)
    elif mapping.origin is not None:
        columns["origin"] = _origin(stream, mapping, mapping.origin, columns.get("origin"), fields)
    return replace(base, columns=columns, types=types)


def _recorded(path: str) -> pl.Expr:
    """What a path of a mapping means: a field, or the length of a vector."""
    vector = re.fullmatch(r"norm\((.+)\)", path)
    if vector is None:
        return pl.col(path)
    parts = [pl.col(f"{vector[1].strip()}.{axis}") ** 2 for axis in "xyz"]
    return pl.sum_horizontal(parts, ignore_nulls=False).sqrt()


def _origin(
    stream: Stream, mapping: StreamMapping, origin: Origin, recorded: pl.Expr | None, fields: Mapping[str, str]
) -> pl.Expr:
    """Where an odometer comes from: what its rows say, else what the mapping declares (DOMAIN section 5.0)."""
    if stream != "odometer":
        raise ConfigError(
            "declares an origin, which only an odometer has",
            place=f"[ingest.{stream}] topic {mapping.topic}",
            found=f'origin = "{origin}"',
            remedy="Leave the line out, or write it under [ingest.odometer].",
        )
    declared = pl.lit(origin.value, dtype=pl.String)
    if recorded is None or not set(recorded.meta.root_names()) <= set(fields):
        return declared
    return pl.coalesce(recorded.cast(pl.String), declared)


def _refuse_unknown_columns(stream: Stream, mapping: StreamMapping, contract: Mapping[str, dy.Column]) -> None:
    """Raise `ConfigError` where a mapping names columns that the contract of its stream does not have."""
    named = {*mapping.fields, *mapping.constants, *mapping.factors}
    unknown = sorted(named - set(contract))
    if unknown:
        raise ConfigError(
            "maps columns that this stream does not have",
            place=f"[ingest.{stream}] topic {mapping.topic}",
            found=", ".join(unknown),
            expected=", ".join(contract),
        )


def _coded(kind: str | None, path: str, mapping: StreamMapping) -> tuple[pl.DataType, pl.Expr]:
    """Kinds of fix by recorded number or text, as the `kind` of the field is.

    A code that is not listed stays as it is, and is refused later.
    """
    kinds: dict[object, str] = {code: kind.value for code, kind in mapping.fix_codes.items()}
    dtype: pl.DataType = pl.String()
    if kind != "text" and all(re.fullmatch(r"-?[0-9]+", code) for code in mapping.fix_codes):
        kinds = {int(str(code)): kind for code, kind in kinds.items()}
        dtype = pl.Int64()
    known = pl.col(path).replace_strict(kinds, default=None, return_dtype=pl.String)
    return dtype, pl.coalesce(known, pl.format("code {}", pl.col(path)))


def _constant(stream: Stream, mapping: StreamMapping, name: str, column: dy.Column) -> pl.Expr:
    """The constant that a mapping gives for a column. Raises `ConfigError` where the column cannot hold it."""
    value = mapping.constants[name]
    words = column.categories if isinstance(column, dy.Enum) else None
    if isinstance(column, dy.Float64 | dy.Int64):  # to Python, true is a number as well
        fits = isinstance(value, float) and (value.is_integer() or isinstance(column, dy.Float64))
    else:
        fits = isinstance(value, bool if isinstance(column, dy.Bool) else str)
    if not fits or (words is not None and value not in words):
        raise ConfigError(
            "is not a valid constant for this column",
            place=f"[ingest.{stream}] topic {mapping.topic}: constants.{name}",
            found=repr(value),
            expected=", ".join(words) if words is not None else str(column.dtype),
        )
    return pl.lit(value, dtype=column.dtype)
