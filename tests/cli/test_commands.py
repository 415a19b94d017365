"""Commands as a user types them: exit status, one message per error, text in a pipe, JSON for programs."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import dataframely as dy
import polars as pl
import pytest
import typer

import cli
from pipeline.read.ingest import read_run
from pipeline.storage.described import describe
from schemas.campaign import CAMPAIGN_TABLES
from schemas.config import IngestConfig
from schemas.conform import meanings
from schemas.inputs import SITE_SCHEMAS, STREAM_SCHEMAS
from schemas.tables import CONTRACT_VERSION
from tests.conftest import SmallTrial
from tests.make.receivers.messages import sentence

pytestmark = pytest.mark.usefixtures("replayed_once")

ROOT = Path(__file__).parents[2]


class Said:
    """What a command said and its exit status."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err


Balise = Callable[..., Said]


@pytest.fixture
def balise(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Balise:
    def call(*arguments: str | Path) -> Said:
        monkeypatch.setattr(sys, "argv", ["balise", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return Said(ended.value.code, captured.out, captured.err)

    return call


@pytest.fixture(scope="module")
def result(small_trial: SmallTrial, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from pipeline.campaign import make_plan, run_campaign

    out = tmp_path_factory.mktemp("result")
    for path in small_trial.paths[:2]:
        run_campaign(make_plan([str(path)], small_trial.site, out))
    return out


def test_replay_one_run(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    said = balise("replay", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path / "out")
    assert said.status == 0
    head = r"(safe|unproven|unsafe): \d unsafe, \d unproven, \d safe, 0 failed; .*; 1 of 1 runs: 1 ok"
    assert re.match(head, said.out)
    assert "\x1b[" not in said.out + said.err
    assert "\u2502" not in said.out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *(".catalogue", ".held", "alarms", "campaign", "config.toml", "epochs", "hazards", "manifest.json", "passages"),
        *("replay.log", "runs"),
    ]
    quiet = balise("replay", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path / "out", "--quiet")
    assert (quiet.status, quiet.out, quiet.err) == (0, "", "")


@pytest.mark.usefixtures("in_process")
def test_quiet_says_what_failed_and_nothing_else(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"")
    given = (tmp_path / "bad.mcap", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path / "out")
    said = balise("replay", *given, "--quiet")
    assert (said.status, said.out) == (1, "")
    (line,) = said.err.splitlines()
    assert line.startswith("balise: bad: failed")
    assert "bad.mcap" in line


def test_a_verdict_that_is_refused_is_the_exit_status(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    replayed = ("replay", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path, "--quiet")
    # Without vehicle file, reference and reads the run is unproven; the second call only looks at what is there.
    assert [balise(*replayed, "--fail-on", name).status for name in ("unproven", "unsafe")] == [1, 0]


def test_replay_as_json(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"")
    said = balise(
        *("replay", tmp_path / "bad.mcap", "--site", small_trial.site, "--out", tmp_path / "out", "--json"),
    )
    assert said.status == 1
    assert {json.loads(line)["event"] for line in said.err.splitlines()} == {"progress", "run"}
    found = json.loads(said.out)
    assert next(iter(found)) == "verdict"
    assert found["verdicts"] == {"unsafe": 0, "unproven": 0, "safe": 0, "failed": 1}
    assert (found["verdict"], found["planned"]) == ("failed", 1)
    assert [(run["run_id"], run["status"]) for run in found["runs"]] == [("bad", "failed")]
    assert "bad.mcap" in found["runs"][0]["error"]


def test_failed_run_is_said_and_filed(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    (tmp_path / "bad" / "sub").mkdir(parents=True)
    (tmp_path / "bad" / "gnss.parquet").write_bytes(b"no parquet")
    said = balise("replay", tmp_path / "bad", "--site", small_trial.site, "--out", tmp_path / "out")
    assert said.status == 1
    assert "gnss.parquet" in said.err
    assert "Traceback" not in said.err
    runs = pl.read_parquet(tmp_path / "out/runs/run_id=bad/runs.parquet")
    assert runs["status"].to_list() == ["failed"]
    assert str(tmp_path) not in runs["error"][0]


USAGE_ERRORS: list[tuple[Sequence[str], str]] = [
    (("replay",), "Missing argument"),
    (("replay", "{run}"), "--site"),
    (("replay", "{run}", "--site", "{tmp}/none", "--out", "{tmp}/out"), "none"),
    (("replay", "{tmp}/none.mcap", "--site", "{site}", "--out", "{tmp}/out"), "no such run"),
    (("replay", "{run}", "--site", "{site}", "--out", "{tmp}/file"), "cannot be written"),
    (("replay", "{run}", "--site", "{site}", "--out", "{tmp}/out", "--config", "{tmp}/file"), "is not TOML"),
    (("replay", "{run}", "--site", "{site}", "--out", "{tmp}/out", "--config", "{tmp}/bad.toml"), "lds.ci_limit"),
    (("replay", "{run}", "--site", "{site}", "--out", "{tmp}/out", "--vehicle", "{tmp}/bad.toml"), "lds"),
    (("replay", "{run}", "--site", "{site}", "--out", "{tmp}/out", "--jobs", "-1"), "--jobs"),
    (("inspect", "{tmp}"), "neither"),
    (("inspect", "{tmp}/none"), "does not exist"),
    (("sql", "{tmp}", "select 1"), "no complete run"),
    (("sql", "{result}", "select nonsense from runs"), "nonsense"),
    (("diff", "{result}", "{tmp}"), "no complete run"),
    (("experiment", "nonsense"), "is not an experiment"),
    (("convert", "{run}", "--to", "s3://key:secret@bucket/run"), "s3://bucket/run: is an address; expected a path"),
    (("convert", "s3://bucket/run.ubx", "--to", "{tmp}/out"), "s3://bucket/run.ubx: is an address"),
    (("report", "s3://bucket/out"), "s3://bucket/out: is an address"),
    (("inject", "{run}", "--fault", "{tmp}/bad.toml", "--out", "{tmp}/out"), "docs/scenarios.md lists every key"),
    (("inject", "{run}", "--out", "{tmp}/out"), "is wanted once; found neither; expected FAULT, or --fault FAULT"),
    (("inject", "{run}", "{tmp}/file", "--fault", "{tmp}/file", "--out", "{tmp}/out"), "found both"),
    (("sql", "{result}", "select 1", "--out", "{tmp}/out.txt"), "expected .csv or .parquet or .xlsx"),
    (("export", "{result}", "none", "--to", "{tmp}/x.mcap"), "has no run 'none'; found run0"),
    (("dictionary", "--table", "nonsense"), "is not a table"),
    (("nonsense",), "No such command"),
]


@pytest.mark.parametrize(("arguments", "message"), USAGE_ERRORS, ids=lambda value: str(value)[:60])
def test_bad_usage(
    balise: Balise, small_trial: SmallTrial, result: Path, tmp_path: Path, arguments: Sequence[str], message: str
) -> None:
    (tmp_path / "file").write_text("[[ neither TOML nor a folder")
    (tmp_path / "bad.toml").write_text("[lds]\nci_limit = 3\n")
    known = {"run": small_trial.paths[0], "site": small_trial.site, "tmp": tmp_path, "result": result}
    said = balise(*(argument.format(**known) for argument in arguments))
    assert said.status == 2
    assert message in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "out").exists()


def test_traceback_on_request_only(balise: Balise, tmp_path: Path) -> None:
    assert "Traceback" not in balise("inspect", tmp_path / "none").err
    assert "Traceback" in balise("inspect", tmp_path / "none", "--debug").err


def test_our_own_defect(balise: Balise, monkeypatch: pytest.MonkeyPatch, result: Path) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("pipeline.results.query.run_sql", broken)
    said = balise("sql", result, "select 1")
    assert said.status == 3
    assert "a defect of this program: ZeroDivisionError" in said.err
    assert "Traceback" not in said.err


def test_inspect(balise: Balise, small_trial: SmallTrial, result: Path) -> None:
    site = balise("inspect", small_trial.site)
    assert (site.status, "15 virtual" in site.out) == (0, True)
    runs = json.loads(balise("inspect", result, "--json").out)
    assert [row["run_id"] for row in runs["Runs"]] == ["run0", "run1"]


def test_inspect_a_site_against_the_runs_over_it(balise: Balise, small_trial: SmallTrial, result: Path) -> None:
    found = json.loads(balise("inspect", small_trial.site, "--result", result, "--json").out)["Survey"]
    # Both runs are parts of one journey, so only which rows there are is tested, not how they come out.
    assert {row["axis"] for row in found} == {"cross", "vertical"}
    assert {row["netelement_id"] for row in found} == {"NE1"}
    assert {row["runs"] for row in found} == {2}
    wrong = balise("inspect", result, "--result", result)
    assert (wrong.status, "is not a site" in wrong.err) == (2, True)
    empty = balise("inspect", small_trial.site, "--result", small_trial.site)
    assert (empty.status, "holds no complete run" in empty.err) == (2, True)


def test_inspect_logs(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    log = json.loads(balise("inspect", small_trial.paths[0], "--json").out)
    assert {row["stream"]: row["rate_hz"] for row in log["Streams"]} == {"gnss": 10.0, "odometer": 25.0}
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    bad = balise("inspect", tmp_path / "bad.mcap")
    assert bad.status == 1
    assert "does not start with the MCAP magic bytes" in bad.out


def test_a_single_file_says_what_it_is(balise: Balise, result: Path, tmp_path: Path) -> None:
    """Mailed to a colleague, without the folders that it was in."""
    sent = shutil.copy(result / "epochs/run_id=run1/epochs.parquet", tmp_path / "sent.parquet")
    found = json.loads(balise("inspect", sent, "--json").out)
    figures = {row["figure"]: row["value"] for row in found["File"]}
    assert (figures["table"], figures["run_id"], figures["contract"]) == ("epochs", "run1", CONTRACT_VERSION)
    assert {"software", "config_digest", "log_digest", "site_digest"} <= set(figures)
    meant = {row["column"]: (row["unit"], row["meaning"]) for row in found["Columns"]}
    assert meant["confidence_m"][0] == "m"
    assert all(meaning for _, meaning in meant.values())
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1")
    assert balise("inspect", broken).status == 2


@pytest.mark.parametrize(
    ("folder", "schemas"), [("run", STREAM_SCHEMAS), ("site", SITE_SCHEMAS), ("campaign", CAMPAIGN_TABLES)]
)
def test_every_parquet_file_has_its_name_and_meanings(
    small_trial: SmallTrial, result: Path, folder: str, schemas: Mapping[str, type[dy.Schema]]
) -> None:
    places = {"run": small_trial.paths[0], "site": small_trial.site, "campaign": result / "campaign"}
    for file in places[folder].glob("*.parquet"):
        found = describe(file.read_bytes())
        name = f"campaign_{file.stem}" if folder == "campaign" else file.stem
        assert found.metadata["balise.table"].replace("/", "_") == name
        documented = {row["column"]: (row["unit"], row["meaning"]) for row in found.columns.iter_rows(named=True)}
        assert documented == {
            key: tuple(note.values()) for key, note in meanings(schemas[name]).items() if key in documented
        }
        assert all(meaning for _, meaning in documented.values())


def test_convert_into_a_run_that_exists(balise: Balise, tmp_path: Path) -> None:
    def log(name: str, minutes: float) -> Path:
        times = [f"1159{second:02d}.00" for second in range(58, 60)] + [f"1200{second:02d}.00" for second in range(8)]
        path = tmp_path / name
        path.write_bytes(
            b"".join(sentence(f"GPGGA,{t},50{minutes},N,00430.0,E,1,09,0.9,55.0,M,45.0,M,,") for t in times)
        )
        return path

    first, second, run = log("a.nmea", 30.0), log("b.nmea", 30.001), tmp_path / "run.mcap"
    day = ("--date", "2025-06-01")
    assert balise("convert", first, "--to", run, *day).status == 0
    assert "--solution" in balise("convert", second, "--to", run, *day).err
    assert balise("convert", second, "--to", run, *day, "--solution", "second").status == 0
    assert balise("convert", second, "--to", run, *day, "--stream", "reference").status == 0
    assert "--force" in balise("convert", first, "--to", run, *day, "--stream", "reference").err
    assert balise("convert", first, "--to", run, *day, "--stream", "reference", "--force").status == 0
    other_day = balise("convert", first, "--to", run, "--date", "2025-06-02", "--solution", "third")
    assert (other_day.status, "is of another time" in other_day.err) == (1, True)
    log_of_all = read_run(run, IngestConfig())
    assert dict(log_of_all.gnss.group_by("solution").len().iter_rows()) == {"primary": 10, "second": 10}
    assert log_of_all.reference is not None
    assert log_of_all.reference["latitude_deg"][0] == pytest.approx(50.5, abs=1e-9)


def test_report(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    balise("replay", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path, "--quiet")
    said = balise("report", tmp_path, "--site", small_trial.site)
    assert said.status == 0
    assert (tmp_path / "report/index.html").exists()
    assert (tmp_path / "report/runs/run0.html").exists()


def test_export(balise: Balise, small_trial: SmallTrial, result: Path, tmp_path: Path) -> None:
    log = ("--log", small_trial.paths[0], "--site", small_trial.site)
    said = balise("export", result, "run0", "--to", tmp_path / "run0.mcap", *log)
    assert said.status == 0, said.err
    assert (tmp_path / "run0.mcap").read_bytes().startswith(b"\x89MCAP0\r\n")
    other = balise("export", result, "run0", "--to", tmp_path / "x.mcap", "--log", small_trial.paths[1])
    assert (other.status, "another log" in other.err) == (2, True)


def test_experiments_are_listed(balise: Balise) -> None:
    assert "diagnostics" in balise("experiment", "list").out.split()


def test_sql(balise: Balise, result: Path) -> None:
    said = balise("sql", result, "select run_id, count(*) as n from passages group by run_id order by run_id", "--json")
    assert [row["run_id"] for row in json.loads(said.out)] == ["run0", "run1"]


def test_sql_writes_files(balise: Balise, result: Path, tmp_path: Path) -> None:
    query = "SELECT run_id, t_start, service_levels FROM runs ORDER BY run_id"
    files = {kind: tmp_path / f"answer.{kind}" for kind in ("csv", "parquet", "xlsx")}
    said = balise("sql", result, query, *(part for kind, file in files.items() for part in (f"--{kind}", file)))
    assert (said.status, said.out) == (0, "")
    lines = files["csv"].read_text().splitlines()
    assert (lines[0], len(lines)) == ("run_id,t_start,service_levels", 3)
    assert re.fullmatch(r"run0,2025-03-03T13:00:4\d\.\d{9}Z,npa lpv200 egnos_observed horizontal_sis", lines[1])
    assert pl.read_parquet(files["parquet"])["service_levels"].to_list()[0][0] == "npa"
    assert zipfile.ZipFile(files["xlsx"]).testzip() is None
    assert balise("sql", result, query, "--csv", "-").out.splitlines() == lines
    assert balise("sql", result, query, "--out", tmp_path / "by_suffix.csv").status == 0
    assert (tmp_path / "by_suffix.csv").read_text().splitlines() == lines


def test_sql_over_two_results(balise: Balise, result: Path) -> None:
    query = "SELECT r.run_id, o.verdict FROM runs r JOIN old_runs o ON o.run_id = r.run_id ORDER BY r.run_id"
    said = balise("sql", result, query, "--with", f"old={result}", "--json")
    assert [row["run_id"] for row in json.loads(said.out)] == ["run0", "run1"]
    wrong = balise("sql", result, query, "--with", str(result))
    assert (wrong.status, "expected NAME=OUT" in wrong.err) == (2, True)


def test_verify(balise: Balise, small_trial: SmallTrial, result: Path, tmp_path: Path) -> None:
    said = balise("verify", result)
    assert said.status == 0
    assert said.out.startswith("18 files of 2 runs against manifest.json: all agree\nmanifest.json: sha256 ")
    copy = shutil.copytree(result, tmp_path / "copy")
    (copy / "config.toml").write_text("")
    assert balise("verify", copy, "--quiet").status == 1
    no_site = balise("verify", result, "--logs", small_trial.paths[0])
    assert (no_site.status, "needs the site" in no_site.err) == (2, True)


def test_diff(balise: Balise, small_trial: SmallTrial, result: Path, tmp_path: Path) -> None:
    assert balise("diff", result, result).status == 0
    balise("replay", small_trial.paths[0], "--site", small_trial.site, "--out", tmp_path, "--quiet")
    changed = balise("diff", result, tmp_path)
    assert (changed.status, "run1: only in A" in changed.out) == (1, True)


def test_inject(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    (tmp_path / "fault.toml").write_text('[[faults]]\nkind = "outage"\nstart_s = 10\nduration_s = 5\n')
    said = balise("inject", small_trial.paths[0], "--fault", tmp_path / "fault.toml", "--out", tmp_path / "faulty")
    assert said.status == 0
    assert pl.read_parquet(tmp_path / "faulty/faults.parquet")["kind"].cast(pl.String).to_list() == ["outage"]
    onto_itself = balise("inject", tmp_path / "faulty", tmp_path / "fault.toml", "--out", tmp_path / "faulty")
    assert (onto_itself.status, "is the recording itself" in onto_itself.err) == (2, True)
    a_file = tmp_path / "fault.toml"
    nowhere = balise("inject", small_trial.paths[0], "--fault", a_file, "--out", a_file / "run")
    assert nowhere.status == 2
    assert "fault.toml/run" in nowhere.err
    assert "cannot be written: Not a directory" in nowhere.err


def test_dictionary(balise: Balise) -> None:
    text = balise("dictionary")
    assert (text.status, "missed_detections" in text.out) == (0, True)
    assert balise("dictionary", "--markdown").out.startswith("# Data dictionary")
    columns = json.loads(balise("dictionary", "--table", "hazards", "--json").out)
    assert {"solution", "size_m"} <= {row["column"] for row in columns}


def test_safety(balise: Balise) -> None:
    tables = json.loads(balise("safety", "--json").out)
    assert {"allocation", "allowed_time_to_detect", "markov", "architectures", "fail_safety", "errata"} <= set(tables)
    assert balise("safety").out.count("1.36e-4 h") == 1


def test_safety_of_a_result(balise: Balise, result: Path, tmp_path: Path) -> None:
    said = json.loads(balise("safety", result, "--json").out)
    assert {"figures", "time_to_detect", "levels", "levels_of_runs", "accuracy", "side_by_side", "map"} <= set(said)
    assert said["figures"] == json.loads(balise("sql", result, "SELECT * FROM campaign_figures", "--json").out)
    assert "needed to prove a THR_VB of 6.70e-10/h" in " ".join(said["statements"])
    assert {row["service_level"] for row in said["levels"]} == {"npa", "lpv200", "egnos_observed", "horizontal_sis"}
    shown = balise("safety", result)
    assert shown.status == 0
    assert "hours_still_needed" in shown.out
    assert said["statements"][-1] in shown.out


def test_safety_of_a_result_by_another_service_level(balise: Balise, result: Path, tmp_path: Path) -> None:
    levels = (
        '[safety.service_levels.own]\nintegrity_risk = 1e-6\nexposure_s = 3600.0\n[hazards]\nservice_level = "own"\n'
    )
    (tmp_path / "own.toml").write_text(levels)
    said = json.loads(balise("safety", result, "--config", tmp_path / "own.toml", "--json").out)
    assert {row["service_level"] for row in said["levels"]} == {"own"}
    assert said["levels"][0]["allowed_s"] == pytest.approx(2.412)


def test_safety_of_no_result(balise: Balise, tmp_path: Path) -> None:
    said = balise("safety", tmp_path)
    assert said.status == 2
    assert "holds no complete run; expected the output folder of `balise replay`" in said.err


def test_calibrate_names_the_solutions_there_are(balise: Balise, small_trial: SmallTrial, tmp_path: Path) -> None:
    said = balise(
        *("calibrate", small_trial.paths[0], "--site", small_trial.site, "--solution", "gallileo"),
        *("--out", tmp_path / "train.toml"),
    )
    assert said.status == 1
    assert "gallileo: no run has this solution; found primary" in said.err


def test_inspect_names_balises_that_linking_cannot_tell_apart(
    balise: Balise, small_trial: SmallTrial, tmp_path: Path
) -> None:
    site = shutil.copytree(small_trial.site, tmp_path / "site")
    balises = pl.read_parquet(site / "balises.parquet")
    near = balises.sort("measure_m")[:1]
    moved = [
        near.with_columns(balise_id=pl.lit(name), measure_m=pl.col("measure_m") + along_m)
        for name, along_m in (("NEAR1", 400.0), ("NEAR2", 480.0))
    ]
    pl.concat([near, *moved]).write_parquet(site / "balises.parquet")
    said = balise("inspect", site, "--json")  # a table would break the sentences to the width of the terminal
    assert "balises NEAR1, NEAR2" in said.out
    assert "80.0 m apart, 103.2 m needed" in said.out


def test_version(balise: Balise) -> None:
    assert balise("--version").out.startswith("balise ")


@pytest.mark.parametrize("command", sorted(typer.main.get_command(cli.app).commands))  # type: ignore[attr-defined]
def test_every_help_has_examples(balise: Balise, command: str) -> None:
    shown = balise(command, "-h")
    assert shown.status == 0
    assert f"balise {command}" in shown.out.partition("Examples:")[2]


@pytest.mark.parametrize("command", sorted(typer.main.get_command(cli.app).commands))  # type: ignore[attr-defined]
def test_examples_of_the_help_have_options_that_exist(command: str) -> None:
    known = typer.main.get_command(cli.app).commands[command]  # type: ignore[attr-defined]
    options = {option for parameter in known.params for option in parameter.opts}
    examples = [line for line in known.epilog.splitlines() if line.startswith("balise ")]
    assert examples
    for line in examples:
        words = shlex.split(line.partition(" | ")[0])
        assert words[1] == command
        assert {word for word in words if word.startswith("--")} <= options


def test_a_misspelled_option_is_answered_with_those_there_are(balise: Balise) -> None:
    said = balise("report", "OUT", "--jbos", "2")
    assert said.status == 2
    assert "--jobs" in said.err


def test_reader_that_goes_away(result: Path) -> None:
    command = f"{sys.executable} -m cli dictionary | head -n 1"
    done = subprocess.run(
        command, shell=True, cwd=ROOT, text=True, capture_output=True, check=True, env=dict(os.environ)
    )
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1
