"""A short run of the benchmarks that damage archives and results; each has found something."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz import archives as fuzz_archives
from tests.fuzz import results as fuzz_results
from tests.fuzz.files import fuzz


def test_random_damage_to_archives_and_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", None)
    report = fuzz(60, 20_251_123, chosen=fuzz_archives.cases(tmp_path))
    assert report.failures == []
    assert report.outcomes["error"] > 10
    assert report.outcomes["whole"] > 5


def test_random_damage_to_caches_and_manifests(undisturbed: Path) -> None:
    kinds = {"cache": fuzz_results.cache_case(undisturbed), "manifest": fuzz_results.manifest_case(undisturbed)}
    report = fuzz(16, 20_251_123, chosen=kinds)
    assert report.failures == []
    assert report.mutations["cache: whole"] > 3
    assert report.outcomes["seen"] + report.outcomes["error"] > 3
