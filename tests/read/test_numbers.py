"""Which texts are numbers."""

from __future__ import annotations

import pytest

from pipeline.read.numbers import numbers_of


def test_decimal_numbers_are_read_and_nothing_else():
    assert numbers_of(["50.5", " 4 ", "-0.5e2", "+.5"]).tolist() == [50.5, 4.0, -50.0, 0.5]


@pytest.mark.parametrize("text", ["1_0", "٥٠", "0x10", "1,5", "", "50 4", "−5"])
def test_what_only_python_reads_is_no_number(text):
    with pytest.raises(ValueError, match="is not a decimal number"):
        numbers_of(["50.5", text])
