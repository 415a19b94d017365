"""What saves time with the next call: never another answer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from pipeline.campaign import run_campaign
from pipeline.campaign.outcome import outcome_of
from pipeline.campaign.verify import NotCompared, verify
from pipeline.results import catalogue, store
from pipeline.results.outcome import RunOutcome
from pipeline.results.software import software_digest
from pipeline.storage.objects import version_of
from schemas.errors import UsageError
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial


@pytest.mark.parametrize(
    ("name", "lie"), [("hazards", 9), ("balises_accepted", 99), ("why", "all is well"), ("status", "partial")]
)
def test_verify_sees_a_false_outcome(small_trial: SmallTrial, tmp_path: Path, name: str, lie: object) -> None:
    """`replay` repeats what is kept of a run, so every figure of it is the tables'."""
    run_campaign(plan_of(small_trial, tmp_path, small_trial.paths[:1]))
    job = plan_of(small_trial, tmp_path, small_trial.paths[:1]).jobs[0]
    tables = [store.tables_of(tmp_path, table, [job.run_id]) for table in ("runs", "hazards", "passages")]
    whole = TypeAdapter(RunOutcome).dump_python(outcome_of(job.run_id, "", 0.0, *tables), mode="json")
    for lies in ({}, {name: lie}):
        kept = {**whole, "proof": "kept", **lies}
        catalogue.keep(tmp_path, "complete", software_digest(), json.dumps([kept]).encode())
        found = [what for what, _, _ in verify(tmp_path).problems]
        assert found == [f".catalogue/complete, {job.run_id}" for _ in lies]


def test_tables_that_this_build_cannot_read_are_not_compared(
    undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(_: Path) -> None:
        raise UsageError("was written by another build of the program")

    monkeypatch.setattr(store, "small_tables", unreadable)
    found = verify(undisturbed)
    assert (found.problems, found.not_compared) == ((), (NotCompared.CATALOGUE, NotCompared.CAMPAIGN_TABLES))


@pytest.mark.parametrize("entry", ["complete", "inputs/log.txt"])
def test_one_damaged_byte_means_not_there(tmp_path: Path, entry: str) -> None:
    out = tmp_path
    file = out / ".catalogue" / entry
    catalogue.keep(out, entry, "key", b"content")
    content = file.read_bytes()
    key = content.split(b"\n")[1].decode()
    assert catalogue.kept_content(out, entry, key) is not None
    for at in range(0, len(content), max(1, len(content) // 97)):
        damaged = bytearray(content)
        damaged[at] ^= 0x10
        file.write_bytes(damaged)
        assert catalogue.kept_content(out, entry, key) is None
    file.unlink()
    file.mkdir()
    assert catalogue.kept_content(out, entry, key) is None


def test_weak_tags_are_no_version() -> None:
    assert version_of({"ETag": "abc", "size": 3, "LastModified": "noon"}) == "abc 3 noon"
    assert version_of({"etag": 'W/"abc"', "size": 3}) is None
