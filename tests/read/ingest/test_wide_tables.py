"""Tables of more columns than any recorder writes."""

from pathlib import Path

import pytest

from pipeline.read.ingest.csv_text import read_log_table
from schemas.errors import InputError


def test_a_table_of_a_million_columns_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "wide.csv"
    log.write_text(",".join(map(str, range(10**6))) + "\n" + ",".join(["1"] * 10**6) + "\n")
    with pytest.raises(InputError, match="it has 1000000 columns; at most 10000 are read"):
        read_log_table(log, infer=True)
    log.write_text(",".join(f"c{number}" for number in range(9000)) + "\n" + ",".join(["1"] * 9000) + "\n")
    assert read_log_table(log, infer=True).table.width == 9000
