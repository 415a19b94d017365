"""Settings files that cost more than they say."""

import time

import pytest

from schemas.config import toml_of
from schemas.errors import ConfigError


@pytest.mark.parametrize("part", ["a", '"a b"', "'a'"])
def test_keys_of_thousands_of_parts_are_refused_at_once(part: str) -> None:
    """The parser would take 12 s and 3.6 GB for 60 KB of them."""
    begun = time.process_time()
    with pytest.raises(ConfigError, match="fifty parts"):
        toml_of((part + f".{part}" * 30_000 + " = 1").encode(), "a.toml")
    assert toml_of(("k" * 900_000 + " = 1").encode(), "a.toml")
    assert toml_of(("a = [" + "0.1, " * 10_000 + "]").encode(), "a.toml")
    assert time.process_time() - begun < 4.0
