"""What a recipe is: stream columns as expressions over recorded fields.

A field of a message is named by its path (`header.stamp`, `position_covariance[4]`); the decoders
deliver one column per path, and a recipe turns these into the columns of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

import polars as pl

from pipeline.read.ingest.stamps import CivilTime
from schemas.enums import Fix
from schemas.frozen import frozen
from schemas.run import Stream

FIX_TYPE = pl.Enum([kind.value for kind in Fix])


@frozen
class Recipe:
    """Columns of one stream from the fields of one message.

    `stamps` names the fields that hold times (none: the log time), `whole` the fields that are whole numbers, `types`
    the types of others that are no floats. `key` names the fields by which a `supplement` (a message that holds
    further columns of the same epochs, such as a covariance) finds its epoch. `time` is set where the time is a
    calendar. `rows` names an array whose elements become one row each; paths are then looked up in the element first.
    `only_mapped`: read only where a mapping names the topic, since the schema does not tell what is measured.
    """

    stream: Stream
    columns: Mapping[str, pl.Expr]
    stamps: Mapping[str, str] = field(default_factory=lambda: {"t": "header.stamp"})
    types: Mapping[str, pl.DataType] = field(default_factory=dict)
    whole: Sequence[str] = ()
    key: tuple[str, ...] = ()
    supplement: bool = False
    own: bool = False
    remark: str = ""
    time: CivilTime | None = None
    rows: str = ""
    only_mapped: bool = False

    def fields_of(self, column: str) -> list[str]:
        """The recorded fields that a column is made of."""
        return list(dict.fromkeys(self.columns[column].meta.root_names()))

    def type_of(self, path: str) -> pl.DataType:
        """The dtype of a field: whole numbers where the recipe says so, else floats."""
        return self.types.get(path, pl.Int64() if path in self.whole else pl.Float64())


def fix_from(codes: pl.Expr, kinds: Mapping[int, Fix], known: pl.Expr | None = None) -> pl.Expr:
    """The kind of fix from a receiver's code; none of a code that is not listed, and where it is not `known`."""
    names = {code: kind.value for code, kind in kinds.items()}
    fix = codes.replace_strict(names, default=Fix.NONE.value, return_dtype=FIX_TYPE)
    return fix if known is None else pl.when(known).then(fix).otherwise(pl.lit(Fix.NONE.value).cast(FIX_TYPE))


def position_columns(status: pl.Expr) -> dict[str, pl.Expr]:
    """`latitude`, `longitude`, `altitude`; drivers write NaN where there is no fix (and only there it is no error)."""
    places = {
        f"{name}_deg": null_where((status < 0) & pl.col(name).is_nan(), pl.col(name))
        for name in ("latitude", "longitude")
    }
    return places | {"height_m": pl.col("altitude").fill_nan(None)}


def covariance_of_deviations(east: str, north: str, up: str) -> dict[str, pl.Expr]:
    """A covariance of three deviations [m2], without correlation."""
    zero = pl.when(pl.col(north).is_not_null()).then(0.0)
    squares = {f"cov_{axis}{axis}_m2": pl.col(path) ** 2 for axis, path in zip("enu", (east, north, up), strict=True)}
    return squares | {f"cov_{axes}_m2": zero for axes in ("en", "eu", "nu")}


def null_where(condition: pl.Expr, value: pl.Expr) -> pl.Expr:
    """The value, or null where the condition says that it is not known."""
    return pl.when(~condition).then(value)


def covariance_enu(known: pl.Expr, path: str = "position_covariance") -> dict[str, pl.Expr]:
    """Upper triangle of a row-major east-north-up covariance [m2]; NaN is how drivers say that one is not known."""
    places = {"ee": 0, "en": 1, "eu": 2, "nn": 4, "nu": 5, "uu": 8}
    return {
        f"cov_{axes}_m2": pl.when(known).then(pl.col(f"{path}[{place}]").fill_nan(None))
        for axes, place in places.items()
    }
