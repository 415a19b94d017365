"""Public recordings as streams and tables of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
import polars.selectors as cs
from dataframely import Schema

from pipeline.read.ingest.conform import conform, refuse
from schemas.enums import BaliseDirection, BaliseKind, Reaction
from schemas.errors import InputError
from schemas.inputs import Balises
from schemas.run import Stream


def conform_stream(frame: pl.DataFrame, stream: Stream, place: Path) -> pl.DataFrame:
    """The stream as the contract has it; NaN is not known."""
    breaches: list[InputError] = []
    found = conform(frame.with_columns(cs.float().fill_nan(None)), stream, str(place), breaches)
    refuse(breaches)
    return found


def virtual_balises(places: Sequence[tuple[str, float]]) -> pl.DataFrame:
    """Virtual balises VB1, VB2, ... at (net element, measure), with the default settings."""
    return table_of_contract(
        Balises,
        balise_id=[f"VB{number}" for number in range(1, len(places) + 1)],
        netelement_id=[element for element, _ in places],
        measure_m=[float(measure) for _, measure in places],
        kind=BaliseKind.VIRTUAL.value,
        location_accuracy_m=12.0,
        linked=True,
        link_reaction=Reaction.SERVICE_BRAKE.value,
        direction=BaliseDirection.BOTH.value,
    )


def table_of_contract(schema: type[Schema], **columns: object) -> pl.DataFrame:
    """A table of the contract: scalars are repeated, columns that are not given are null."""
    rows = max(len(value) for value in columns.values() if isinstance(value, pl.Series | np.ndarray | list))
    full = {
        name: value if isinstance(value, pl.Series | np.ndarray | list) else [value] * rows
        for name, value in {**dict.fromkeys(schema.column_names()), **columns}.items()
    }
    table = pl.DataFrame(full, strict=False)
    return schema.validate(table.select(schema.column_names()), cast=True)
