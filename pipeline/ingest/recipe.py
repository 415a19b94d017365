"""What a recipe is: stream columns as expressions over recorded fields.

A field of a message is named by its path (`header.stamp`, `position_covariance[4]`); the decoders
deliver one column per path, and a recipe turns these into the columns of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl

from pipeline.ingest.stamps import CivilTime
from schemas.enums import Fix
from schemas.run import Stream

FIX_TYPE = pl.Enum([kind.value for kind in Fix])


@dataclass(frozen=True)
class Recipe:
    """Columns of one stream from the fields of one message.

    `stamps` names the fields that hold times (absent: the log time), `types` the types of fields that
    are not floats. `key` names the fields by which a `supplement` (a message that holds
    further columns of the same epochs, such as a covariance) finds its epoch. `time` is set where the
    time is a calendar.
    `rows` names an array whose elements become one row each; paths are then looked up in the element
    first.
    """

    stream: Stream
    columns: Mapping[str, pl.Expr]
    stamps: Mapping[str, str]
    types: Mapping[str, pl.DataType] = field(default_factory=dict)
    key: tuple[str, ...] = ()
    supplement: bool = False
    own: bool = False
    remark: str = ""
    time: CivilTime | None = None
    rows: str = ""

    def fields_of(self, column: str) -> list[str]:
        """The recorded fields that a column is made of."""
        return list(dict.fromkeys(self.columns[column].meta.root_names()))

    def type_of(self, path: str) -> pl.DataType:
        return self.types.get(path, pl.Float64())


def fix_from(codes: pl.Expr, kinds: Mapping[int, Fix]) -> pl.Expr:
    """The kind of fix from a receiver's code; a code that is not listed makes no fix."""
    names = {code: kind.value for code, kind in kinds.items()}
    return codes.replace_strict(names, default=Fix.NONE.value, return_dtype=FIX_TYPE)


def unless(condition: pl.Expr, value: pl.Expr) -> pl.Expr:
    """The value, or null where the condition says that it is not known."""
    return pl.when(~condition).then(value)


def covariance_enu(known: pl.Expr, path: str = "position_covariance") -> dict[str, pl.Expr]:
    """Upper triangle of a row-major east-north-up covariance [m2]; NaN is how drivers say that one is not known."""
    places = {"ee": 0, "en": 1, "eu": 2, "nn": 4, "nu": 5, "uu": 8}
    return {
        f"cov_{axes}_m2": pl.when(known).then(pl.col(f"{path}[{place}]").fill_nan(None))
        for axes, place in places.items()
    }


def position_unless_no_fix(path: str, status: pl.Expr) -> pl.Expr:
    """A coordinate; drivers write NaN where there is no fix (and only there it is no error)."""
    return unless((status < 0) & pl.col(path).is_nan(), pl.col(path))
