"""What a single Parquet file says of itself."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.storage import described
from pipeline.storage.described import describe, noted_bytes
from pipeline.storage.parquet import ParquetError


def test_only_the_first_rows_of_a_file_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Damage is seen in the row groups that are read."""
    frame = pl.DataFrame({"n": [7]}).select(pl.col("n").repeat_by(600_000).explode())
    content = noted_bytes(frame, {"table": "x"})
    found = describe(content)
    assert (found.rows, found.metadata["balise.table"]) == (600_000, "x")
    assert found.columns.rows() == [("n", "Int64", "", "")]
    damaged = content[:20] + bytes([content[20] ^ 0xFF]) + content[21:]
    with pytest.raises(ParquetError):
        describe(damaged)
    monkeypatch.setattr(described, "_MOST_READ", 200_000)
    assert describe(damaged).rows == 600_000
