"""The command `export`."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli import app
from datasets.trial import write_run_log, write_site
from pipeline.show.export.write import export_run
from pipeline.stages.prepare import input_digest, provenance
from schemas.config import Configuration, Vehicle
from schemas.errors import UsageError
from tests.show.export.conftest import Result


def test_export_with_site_and_log(result: Result, tmp_path: Path) -> None:
    write_site(result.site, tmp_path / "site")
    recorded = write_run_log(result.log, tmp_path / "runs")
    to = tmp_path / "out" / "run.mcap"
    arguments = ["export", str(result.out), "jump_two", "--to", str(to)]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    assert "no site given" in answer.output
    bare = to.stat().st_size
    wrong = CliRunner().invoke(app, [*arguments, "--log", str(recorded)])
    assert wrong.exit_code == 0, wrong.output
    answer = CliRunner().invoke(app, [*arguments, "--site", str(tmp_path / "site"), "--ros"])
    assert answer.exit_code == 0, answer.output
    assert to.stat().st_size > bare
    assert to.with_name("run.layout.json").exists()


def test_digest_is_that_of_the_replay(result: Result) -> None:
    log = replace(result.log, input_digest="abc")
    site = replace(result.site, digest="def")
    assert input_digest(log, "def") == provenance(log, site, Vehicle(), Configuration()).input_digest
    assert input_digest(log, "def") == hashlib.sha256(b"abc:def").hexdigest()


def test_another_log_is_refused(result: Result, tmp_path: Path) -> None:
    log = replace(result.log, input_digest="another")
    site = replace(result.site, digest="def")
    with pytest.raises(UsageError, match="another log"):
        export_run(result.out, "jump_two", tmp_path / "a.mcap", site, log)
