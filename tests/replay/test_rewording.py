"""Words are for people: rewording every message changes no figure, column or verdict, and nothing parses a sentence."""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from pipeline.results.store import write_run
from pipeline.show.inspection import inspect_result
from pipeline.studies.line.passes import PieceIndex, passes_of
from pipeline.studies.line.pieces import middles_in_plane_m, pieces_of
from pipeline.studies.safety.assessment import assess
from schemas import words
from schemas.config import Configuration, Vehicle, settings_from
from schemas.line import LineCriteria

ROOT = Path(__file__).parents[2]
TRIAL: dict[str, Any] = {
    "name": "words",
    "seed": 7,
    "line": {
        "sections": [{"length_m": 3000.0}],
        "elements": [{"id": "A", "length_m": 3000.0}],
        "balises": [{"id": f"VB{at}", "at_m": float(at)} for at in (600, 1200, 1800)],
    },
    "gnss": {"rate_hz": 1.0},
    "odometer": {"rate_hz": 5.0},
    "reference": False,
    "runs": [
        {
            "id": "run",
            "motion": {"start_m": 100.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 2800.0}]},
            "faults": [{"kind": "step", "at_m": 1150.0, "size_m": 90.0, "duration_s": 6.0}],
        }
    ],
}
# Enough that does not fit: the file's scale is another vehicle's.
VEHICLE = Vehicle(odometer_scale=1.05, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002)


def tables_of(out: Path) -> dict[str, pl.DataFrame]:
    """Every table of one replay, and what is made of it, without the words themselves."""
    scenario, config = settings_from(TRIAL, Scenario, "test"), Configuration()
    site = build_site(scenario)
    found = replay(build_run(scenario, scenario.runs[0]), site, VEHICLE, config)
    write_run(found, out, {})
    pieces = pieces_of(site, LineCriteria().piece_m)
    ground = PieceIndex.of_pieces(site, pieces, middles_in_plane_m(site, pieces))
    passes = passes_of(found.epochs, found.passages, found.alarms, ground, LineCriteria(), config)
    tables = {name: getattr(found, name) for name in ("hazards", "passages", "alarms", "epochs")}
    assessed = assess(str(out))
    return {
        **tables,
        "runs": found.runs.drop("notes"),
        "line": passes,
        **{f"safety {name}": table for name, table in assessed.tables.items()},
        "reservations": pl.DataFrame({"count": [len(assessed.statements)]}),
        **{f"inspect {name}": table for name, table in inspect_result(str(out)).items()},
        "notes": found.runs.select("notes"),
    }


def dictionaries() -> Iterator[dict[Any, str]]:
    """Every dictionary of words for an enum in `schemas/words.py`, and every section of phrases in its file."""
    yield from (words.WORDS[section] for section in ("hazards", "verdicts", "studies", "safety", "line"))
    yield from of_enums()


def of_enums() -> Iterator[dict[Any, str]]:
    for name, value in vars(words).items():
        if name.isupper() and isinstance(value, dict) and all(isinstance(code, Enum) for code in value):
            yield value


# What was looked for once: none of it, and all of it, in every message.
LOOKED_FOR = "faults were injected, the rest lost to: 3% no fix, a GPS week rollover, in feet, in the survey"


def gibberish(chance: random.Random) -> str:
    return "".join(chance.choices("abcdefghijklmnopqrstuvwxyz ,%()", k=40))


@pytest.mark.parametrize("more", ["", LOOKED_FOR])
def test_rewording_every_message_changes_no_figure(more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = tables_of(tmp_path / "plain")
    assert plain["runs"].select("faults_injected").item()
    assert plain["runs"].select(pl.col("misfits", "lost_to", "remedies").list.len() > 0).row(0) == (True,) * 3
    chance = random.Random(5)
    for sentences in dictionaries():
        for code in sentences:
            monkeypatch.setitem(sentences, code, gibberish(chance) + more)
    reworded = tables_of(tmp_path / "reworded")
    assert plain.pop("notes").item() != reworded.pop("notes").item()
    assert plain.keys() == reworded.keys()
    for name, table in plain.items():
        assert table.equals(reworded[name]), name


def test_every_code_has_its_words() -> None:
    for sentences in of_enums():
        kind = type(next(iter(sentences)))
        assert set(sentences) == set(kind), kind
        assert not any(words.BETWEEN in text for text in sentences.values()), kind


# What looks into a text: in these columns and names stand sentences.
# Readers of logs look at words that others wrote: no sentences of ours.
SOURCES = [
    *(path for path in ROOT.glob("pipeline/**/*.py") if path.parent.name not in ("receivers", "ingest")),
    *ROOT.glob("datasets/**/*.py"),
    ROOT / "cli.py",
]
SENTENCES = r"(notes|note|cause|sentence|statement|words|message|told|said|why|reason)s?"
LOOKS = ("contains", "extract", "starts_with", "ends_with", "startswith", "endswith", "removeprefix", "find", "split")


def test_nothing_parses_a_sentence() -> None:
    """No method of texts is asked of what holds a sentence, and none is searched for a word."""
    found = []
    for source in SOURCES:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in LOOKS:
                asked = ast.unparse(node.func.value)
            elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In) and _is_text(node.left):
                asked = ast.unparse(node.comparators[0])
            else:
                continue
            if re.search(rf"\b{SENTENCES}\b", asked):
                found.append(f"{source.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}")
    assert found == []


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
