"""Texts as numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.arrays import Floats


def numbers_of(texts: Sequence[str] | npt.NDArray[np.str_]) -> Floats:
    """Decimal numbers; raises ValueError for what is none.

    Python and numpy also read `1_0` as 10, and Arabic-Indic digits: one such typing error makes a line of 8,700 km.
    """
    written = pl.Series(texts, dtype=pl.String)
    numbers = written.str.strip_chars().cast(pl.Float64, strict=False)
    if numbers.null_count():
        raise ValueError(f"{written.filter(numbers.is_null())[0]!r:.40} is not a decimal number")
    return numbers.to_numpy()
