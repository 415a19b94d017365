"""Small tables that meet their contract, from the columns a test is about."""

from typing import Any

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.stages.judge.failures import Failure
from schemas.conform import conform
from schemas.enums import Judgement, Origin
from schemas.tables import Alarms, Epochs, Hazards, Passages

_DEFAULTS: dict[type, Any] = {dy.Bool: False, dy.String: "x", dy.List: [], dy.Int64: 0, dy.Float64: 0.0}
NS = 1_000_000_000
# Where the odometers of tests come from, unless a test is about that.
WHEEL = pl.lit(Origin.WHEEL.value, dtype=pl.Enum(Origin)).alias("origin")
# Where a test says no more, a failure began when it surely had begun.
_SURE = (("t_failure", ""), ("time_since_failure", "_s"))


def table(schema: type[dy.Schema], height: int, **columns: Any) -> pl.DataFrame:
    """`height` rows; a column not given is null, or the plainest value where it must not be null."""
    unknown = columns.keys() - schema.columns().keys()
    assert not unknown, unknown
    values = {}
    for name, column in schema.columns().items():
        given = columns.get(name, None if column.nullable else _plain(column))
        whole = isinstance(given, list) and not (isinstance(column, dy.List) and name not in columns)
        values[name] = given if whole else [given] * height
    dtypes = {name: column.dtype for name, column in schema.columns().items()}
    # `schema.validate` asks the same, and takes several times as long.
    return conform(pl.DataFrame(values, schema=dtypes), schema)


def _plain(column: dy.Column) -> Any:
    if isinstance(column, dy.Enum):
        return next(iter(column.categories))
    if isinstance(column, dy.Datetime):
        return 0
    return next(value for kind, value in _DEFAULTS.items() if isinstance(column, kind))


def epochs(t_s: list[float], **columns: Any) -> pl.DataFrame:
    """Epochs on the track with all in order, unless said otherwise."""
    good: dict[str, Any] = {
        "t": [round(t * NS) for t in t_s],
        "path_m": [20.0 * t for t in t_s],
        "odometer_m": [20.0 * t for t in t_s],
        "speed_mps": 20.0,
        "direction": 1,
        "on_track": True,
        "gate_probability": 1.0,
        "confidence_m": 8.0,
        "error_along_m": 0.0,
        "tvb": True,
        "lds_state": "P0",
        "judgement": "right",
        "in_use": True,
        "moving": True,
    }
    # Between stages an epoch has columns that no table has.
    between = {"fix_valid": True, "odometer_reason": None, "survey_sigma_m": 1.0}
    between |= {"undiagnosed": False, "negated": False}
    of_stages = {name: columns.pop(name, value) for name, value in between.items()}
    kinds = {"odometer_reason": pl.String, "survey_sigma_m": pl.Float64}
    since_s = np.diff(np.array(t_s), prepend=t_s[:1])
    rows = table(Epochs, len(t_s), **(good | columns)).with_columns(
        *(pl.Series(name, _each(value, len(t_s)), kinds.get(name, pl.Boolean)) for name, value in of_stages.items()),
        pl.Series("counted_s", np.where(since_s <= 1.5, since_s, 0.0), pl.Float64),
        epoch=pl.Series(range(len(t_s)), dtype=pl.Int64),
        at=pl.col("t"),
    )
    return rows.with_columns(used_s=pl.when("in_use").then(pl.Series(since_s)).otherwise(0.0))


def _each(value: Any, height: int) -> list[Any]:
    return value if isinstance(value, list) else [value] * height


def passages(height: int = 0, **columns: Any) -> pl.DataFrame:
    return table(Passages, height, **columns)


def hazards(height: int = 0, **columns: Any) -> pl.DataFrame:
    surely: dict[str, Any] = {f"{name}_may{end}": columns.get(f"{name}{end}") for name, end in _SURE}
    return table(Hazards, height, **(surely | columns))


def alarms(height: int = 0, **columns: Any) -> pl.DataFrame:
    return table(Alarms, height, **columns)


def failures(height: int = 0, **columns: Any) -> list[Failure]:
    """Failures of a position each, with these values or lists of them."""
    plain: dict[str, Any] = {
        "hazardous_s": 0.0,
        "natural_s": columns.get("hazardous_s", 0.0),
        "hazardous_may_s": columns.get("hazardous_s", 0.0),
        "accepted": Judgement.RIGHT,
        "within_budget": None,
    }
    each = {name: _each(value, height) for name, value in (plain | columns).items()}
    return [
        Failure(row, row, row, row + 1, **{name: values[row] for name, values in each.items()}) for row in range(height)
    ]
