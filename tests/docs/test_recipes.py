"""Recipes of `docs/developer.md` followed in a copy of the project, step by step."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest

from tests.docs.blocks import ROOT

SINGLE, MONITORS, TABLES = "pipeline/stages/monitors/single.py", "schemas/monitors.py", "schemas/tables.py"
FIGURES = "pipeline/stages/run_row/run_figures.py"
INPUTS, RUN, CONFIG = "schemas/inputs.py", "schemas/run.py", "schemas/config_ingest.py"
ENUMS, WORDS, LIMITS = "schemas/enums.py", "schemas/words.toml", "schemas/config_judge.py"
ANCHORS, PREPARE = "pipeline/stages/evidence/anchors.py", "pipeline/stages/prepare.py"

MONITOR = [
    (
        SINGLE,
        "def _window(",
        "def offside_monitor(epochs: AlignedEpochs, factor: float) -> Verdicts:\n"
        "    unknown = np.isnan(epochs.cross_track_m) | np.isnan(epochs.sigma_cross_m)\n"
        "    reasons = first_reason((unknown, NO_POSITION))\n"
        "    return verdicts(epochs.cross_track_m, factor * epochs.sigma_cross_m, reasons)\n\n\n",
    ),
    (SINGLE, '    "channel": lambda', '    "offside": lambda seen: offside_monitor(seen.epochs, 5.3),\n'),
    (MONITORS, '    Monitor("channel"', '    Monitor("offside", "m", "other", "off side", axis="cross"),\n'),
]
COLUMN = [
    (TABLES, "    part_verdict = one_of(", '    epochs_on_track = count("epochs on the track")\n'),
    (
        FIGURES,
        '        "outages": lost_s.size,',
        '        "epochs_on_track": int(epochs.on_track.sum()),\n',
    ),
]
EPOCH_COLUMN = [
    (
        TABLES,
        '    satellites = dy.Int64(nullable=True, min=0, description="satellites used',
        '    speed_over_ground_mps = real("m/s", "horizontal speed by the GNSS velocity", min=0)\n',
    ),
    (
        "schemas/stages.py",
        "    hpl_m: Floats\n",
        '    speed_over_ground_mps: Floats\n    """Horizontal speed by the GNSS velocity [m/s]."""\n',
    ),
    (
        "pipeline/stages/matching/epochs.py",
        "        hpl_m=fixes.hpl_m,\n",
        "        speed_over_ground_mps=np.hypot(fixes.vel_e_mps, fixes.vel_n_mps),\n",
    ),
]
STREAM = [
    (
        INPUTS,
        "class Faults(dy.Schema)",
        'class Doors(dy.Schema):\n    t = instant("time of validity")\n    open = flag("a door is open")\n\n\n',
    ),
    (INPUTS, '    "faults": Faults,', '    "doors": Doors,\n'),
    (RUN, '"balise_reads"]', '"doors", '),
    (RUN, "    faults: pl.DataFrame", "    doors: pl.DataFrame | None = None\n"),
    (
        CONFIG,
        "    balise_reads: tuple[Mapped",
        "    doors: tuple[Mapped, ...] = ()\n"
        '    """Topics that hold door states.\n\n    As for `ingest.gnss`.\n    """\n',
    ),
]
MESSAGE = [
    (
        "pipeline/read/ingest/recipes_drivers.py",
        "BY_SCHEMA: dict[str,",
        "def _acme() -> Recipe:\n"
        '    places = {"latitude_deg": pl.col("pos.lat"), "longitude_deg": pl.col("pos.lon")}\n'
        "    fix = pl.lit(Fix.SBAS.value, dtype=FIX_TYPE)\n"
        '    return Recipe(stream="gnss", stamps={"t": "at"}, columns={**places, "fix": fix})\n\n\n',
    ),
    (
        "pipeline/read/ingest/recipes_drivers.py",
        '    "gps_msgs/msg/GPSFix": (_gps_fix(),),',
        '    "acme_msgs/msg/Position": (_acme(),),\n',
    ),
]
RULE = [
    (
        LIMITS,
        "    map_reach_m: Positive = 100.0",
        "    proved_confidence_m: Positive = 14.0\n"
        '    """A run is `unproven` if a position in use had a wider confidence interval [m].\n\n'
        '    None in use is wider than `lds.ci_limit_m`. Ours.\n    """\n',
    ),
    (
        TABLES,
        "    part_verdict = one_of(",
        '    confidence_max_m = real("m", "widest interval in use", min=0)\n',
    ),
    (ENUMS, '    EVIDENCE_DISPUTED = "evidence_disputed"', '    WIDE_IN_USE = "wide_in_use"\n'),
    (WORDS, 'nothing_accepted = "no VB was accepted"', 'wide_in_use = "in use with +- {confidence_max_m:.1f} m"\n'),
    (
        FIGURES,
        '        "unknown_in_use_s": _longest_stretch_s(',
        '        "confidence_max_m": float(epochs.confidence_m[used_s > 0.0].max(initial=0.0)),\n',
    ),
    (
        FIGURES,
        "        Reason.NOTHING_ACCEPTED: run[",
        '        Reason.WIDE_IN_USE: (run["confidence_max_m"] or 0.0) > hazards.proved_confidence_m,\n',
    ),
    (FIGURES, '    *("hazardous_natural_s", "duration_s"', '    "confidence_max_m",\n'),
]
DETECTIONS = [
    (
        INPUTS,
        "class Faults(dy.Schema)",
        'class Detections(dy.Schema):\n    t = instant("time of the detection")\n'
        '    netelement_id = text("net element of the detector")\n'
        '    measure_m = real("m", "its place", nullable=False)\n\n\n',
    ),
    (INPUTS, '    "faults": Faults,', '    "detections": Detections,\n'),
    (RUN, '"balise_reads"]', '"detections", '),
    (RUN, "    faults: pl.DataFrame", "    detections: pl.DataFrame | None = None\n"),
    (
        CONFIG,
        "    balise_reads: tuple[Mapped",
        "    detections: tuple[Mapped, ...] = ()\n"
        '    """Topics that hold passages at trackside detectors.\n\n    As for `ingest.gnss`.\n    """\n',
    ),
]
EVIDENCE = [
    (ENUMS, '    BALISE = "balise"', '    DETECTOR = "detector"\n'),
    (WORDS, 'balise = "balise reads"', 'detector = "trackside detectors"\n'),
    (WORDS, 'reference = ""\n', 'detector = "evidence detector: nothing is known of the stops"\n'),
    (
        LIMITS,
        "    known_error_m: Positive = 5.0",
        "    detector_sigma_m: Positive = 0.5\n"
        '    """Standard deviation of a passage at a trackside detector [m].\n\n    A wheel. Ours.\n    """\n',
    ),
    (
        ANCHORS,
        "def put_on_clock(",
        "def detector_anchors(\n"
        "    passed: pl.DataFrame | None, track: SurveyedTrack, config: HazardConfig\n"
        ") -> list[TrueAnchor]:\n"
        '    """Passages at trackside detectors that lie on the survey, in order of time."""\n'
        "    if passed is None:\n"
        "        return []\n"
        "    rows, elements = track.elements_holding(passed)\n"
        '    known = passed[rows].with_columns(element=elements).sort("t")\n'
        '    places = zip(times_ns(known).tolist(), known["element"], known["measure_m"], strict=True)\n'
        "    return [\n"
        "        TrueAnchor(t_ns, (Place(element, measure_m),), config.detector_sigma_m, Evidence.DETECTOR)\n"
        "        for t_ns, element, measure_m in places\n"
        "    ]\n\n\n",
    ),
    (
        PREPARE,
        "from pipeline.stages.evidence.anchors",
        "from pipeline.stages.evidence.anchors import detector_anchors\n",
    ),
    (
        PREPARE,
        "            read_anchors(",
        "            detector_anchors(self.run.detections, network.track, self.config.hazards),\n",
    ),
]
CHECK = """
import json, sys
from pathlib import Path
import polars as pl
from datasets.scenario import Scenario
from datasets.motion import build_motion
from datasets.trial import build_run, build_site
from pipeline import read_run, replay
from pipeline.show.report.series import monitor_lines, time_data
from pipeline.results.figures.campaign_tables import campaign_levels
from pipeline.results.store import write_run
from pipeline.studies.plausibility.fit import _in_order
from schemas.config import Configuration, settings_from
from mcap.writer import Writer
from schemas.dictionary import dictionary_markdown
from schemas.settings_page import settings_markdown
from schemas.monitors import MONITORS
from schemas.project import LogEntry
from schemas.words import JUDGES, reason_words
import numpy as np

scenario = settings_from(json.loads(sys.argv[1]), Scenario, "test")
run = build_run(scenario, scenario.runs[0])
tables = replay(run, build_site(scenario))
states = tables.epochs["offside_state"].value_counts()
aside = build_run(scenario, scenario.runs[1])
motion, start = build_motion(scenario.runs[1].motion), aside.gnss["t"].dt.timestamp("ns")[0]
passed = [start + round(motion.time_at(at_m) * 1e9) for at_m in range(200, 2000, 100)]
passed = pl.Series("t", passed, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
reads = pl.DataFrame([passed, pl.Series("balise_id", [f"BG{at_m}" for at_m in range(200, 2000, 100)])])
alone = {"monitors": {"disabled": [name for name in MONITORS if name != "offside"]}}
alone |= {"hazards": {"false_alarm_lookback_s": 5.0, "false_alarm_margin_m": 20.0}}
aside = aside.with_streams(reference=None, balise_reads=reads)
alarms = replay(aside, build_site(scenario), None, Configuration.model_validate(alone)).alarms
narrow = Configuration.model_validate({"hazards": {"proved_confidence_m": 0.5}})
ruled = replay(run, build_site(scenario), None, narrow).runs
figures = ruled.row(0, named=True)
complete = Configuration.model_validate({"evidence": {"survey_complete": True}})

def by_detectors(number):
    recorded = build_run(scenario, scenario.runs[number])
    places = {"netelement_id": pl.lit("A"), "measure_m": pl.Series(range(200, 2000, 100)).cast(pl.Float64)}
    detected = pl.DataFrame([passed - aside.gnss["t"][0] + recorded.gnss["t"][0]]).with_columns(**places)
    streams = recorded.with_streams(reference=None, detections=detected)
    return replay(streams, build_site(scenario), scenario.vehicle, complete)

clean, shifted = by_detectors(0), by_detectors(2)
alone = build_run(scenario, scenario.runs[0]).with_streams(reference=None)
unseen = replay(alone, build_site(scenario), scenario.vehicle, complete).runs
page = time_data(tables.epochs, np.array([], dtype=np.int64), 1.0)
folder = Path(sys.argv[2]); folder.mkdir()
run.gnss.write_parquet(folder / "gnss.parquet")
pl.DataFrame({"t": run.gnss["t"][:2], "open": [False, True]}).write_parquet(folder / "doors.parquet")
doors = read_run(folder).doors
corrected = Configuration.model_validate({"ingest": {"correct": [{"stream": "doors", "shift_s": 3600}]}})
entry = LogEntry.model_validate({"files": ["doors.csv"], "doors": [{"fields": {"open": "state"}}]})
log = folder.parent / "acme.mcap"
with log.open("wb") as stream:
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("acme_msgs/msg/Position", "jsonschema", b"{}")
    channel = writer.register_channel("/acme", "json", schema)
    message = {"at": {"sec": 5, "nsec": 0}, "pos": {"lat": 50.5, "lon": 4.5}}
    writer.add_message(channel, 6_000_000_000, json.dumps(message).encode(), 6_000_000_000)
    writer.finish()
text = dictionary_markdown()
print(json.dumps({
    "key": "| `ingest.doors` | none |  | Topics that hold door states. |" in settings_markdown(),
    "states": states["offside_state"].cast(pl.String).to_list(),
    "alarms": alarms.select("monitors", pl.col("verdict").cast(pl.String)).rows(),
    "rule": [figures["confidence_max_m"], figures["reasons"], figures["verdict"], reason_words(figures)],
    "levels": campaign_levels(ruled.with_columns(run_id=pl.lit("run")), narrow)["verdict"].to_list(),
    "without": "wide_in_use" in tables.runs["reasons"][0],
    "evidence": clean.runs.select("evidence", "verdict", "reasons").row(0),
    "unseen": unseen["verdict"].to_list(),
    "judged_by": JUDGES["detector"],
    "noted": "evidence detector: nothing is known of the stops" in clean.runs["notes"].item(),
    "shifted": shifted.runs.select("evidence", "verdict", "reasons").row(0),
    "drawn": monitor_lines()["other"],
    "series": sorted(name for name in page["series"] if "offside" in name),
    "column": tables.runs["epochs_on_track"].to_list(),
    "fastest_mps": tables.epochs["speed_over_ground_mps"].max(),
    "acme": read_run(log).gnss.select("latitude_deg", pl.col("fix").cast(pl.String)).rows(),
    "doors": read_run(folder).doors["open"].to_list(),
    "corrected": read_run(folder, corrected.ingest).doors["t"].dt.epoch("s").to_list(),
    "an_hour_later": (doors["t"].dt.epoch("s") + 3600).to_list(),
    "in_project": [topic for made in entry.mappings().values() for topic in (made[0].topic, made[0].fields)],
    "sorted": _in_order(read_run(folder).with_streams(doors=doors[::-1])).doors.equals(doors),
    "documented": [name for name in ("offside_value", "epochs_on_track", "doors") if name in text],
    "disabled": Configuration.model_validate({"monitors": {"disabled": ["offside"]}}).monitors.disabled,
}))
"""
TRIAL = """{"name": "recipe", "seed": 7, "gnss": {"rate_hz": 1.0}, "odometer": {"rate_hz": 5.0},
"line": {"sections": [{"length_m": 3000.0}], "elements": [{"id": "A", "length_m": 3000.0}], "balises": BALISES},
"runs": [{"id": "run", "motion": MOTION}, {"id": "aside", "motion": MOTION, "faults": [ASIDE]},
{"id": "ahead", "motion": MOTION, "faults": [AHEAD]}]}"""
BALISES = [{"id": f"BG{m}", "at_m": m, "kind": "physical"} for m in range(200, 2000, 100)]
BALISES += [{"id": f"VB{m}", "at_m": m, "kind": "virtual"} for m in range(450, 2000, 400)]
TRIAL = (
    TRIAL.replace("BALISES", json.dumps(BALISES))
    .replace("MOTION", '{"start_m": 100.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 2000.0}]}')
    .replace("AHEAD", '{"kind": "step", "target": "along", "size_m": 60.0, "start_s": 40.0, "duration_s": 10.0}')
    .replace("ASIDE", '{"kind": "step", "target": "cross", "size_m": 12.0, "start_s": 40.0, "duration_s": 10.0}')
)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """What a copy of the project answers once all recipes are followed in it."""
    copy = tmp_path_factory.mktemp("copy")
    for folder in ("schemas", "pipeline", "datasets"):
        # With what is compiled of it: only what is changed is compiled again.
        shutil.copytree(ROOT / folder, copy / folder)
    for file, before, text in (*MONITOR, *COLUMN, *EPOCH_COLUMN, *STREAM, *MESSAGE, *RULE, *DETECTIONS, *EVIDENCE):
        source = (copy / file).read_text(encoding="utf-8")
        assert source.count(before) == 1, (file, before)
        (copy / file).write_text(source.replace(before, text + before), encoding="utf-8")
    command = [sys.executable, "-c", CHECK, TRIAL, str(copy / "run")]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def test_a_monitor_takes_two_files(followed: dict[str, object]) -> None:
    """Tables, page, configuration and dictionary know it."""
    assert followed["states"] == ["pass"]
    assert ["offside", "off side"] in followed["drawn"]  # type: ignore[operator]
    assert followed["series"] == ["ratio_offside"]
    assert followed["disabled"] == ["offside"]
    assert len({file for file, _, _ in MONITOR}) == 2
    # Reads say nothing of the place across the track: no alarm of a monitor that sees this axis is a false one.
    assert followed["alarms"] == [[["offside"], "unknown"]]


def test_a_column_takes_two_files(followed: dict[str, object]) -> None:
    assert followed["column"] != [0]
    assert len({file for file, _, _ in COLUMN}) == 2


def test_a_column_of_epochs_that_the_judge_only_hands_on_takes_three_files(followed: dict[str, object]) -> None:
    """The train of the trial runs at 30 m/s."""
    assert followed["fastest_mps"] == pytest.approx(30.0, abs=0.5)
    assert len({file for file, _, _ in EPOCH_COLUMN}) == 3


def test_a_stream_takes_three_files(followed: dict[str, object]) -> None:
    """A log's topics are mapped to it, in a project too; it is corrected, and sorted where `clean` refuses its run."""
    assert followed["doors"] == [False, True]
    assert followed["corrected"] == followed["an_hour_later"]
    assert followed["in_project"] == ["doors.csv", {"open": "state"}]
    assert followed["sorted"] is True
    assert followed["key"] is True
    assert len({file for file, _, _ in STREAM}) == 3


def test_a_message_format_takes_one_file_and_its_test(followed: dict[str, object]) -> None:
    assert followed["acme"] == [[50.5, "sbas"]]
    assert len({file for file, _, _ in MESSAGE}) == 1


def test_a_rule_takes_five_files(followed: dict[str, object]) -> None:
    """Beyond its key it stands in reasons, verdict, words and service levels; at its default it changes nothing."""
    words = "in use with +- 6.2 m; the clock of the evidence is assumed, not measured"
    assert followed["rule"] == [6.18, ["wide_in_use", "clock_assumed"], "unproven", words]
    assert set(followed["levels"]) == {"unknown"}  # type: ignore[call-overload]
    assert followed["without"] is False
    assert len({file for file, _, _ in RULE}) == 5


def test_a_kind_of_evidence_takes_five_files_and_its_stream(followed: dict[str, object]) -> None:
    """Passages at detectors, every 100 m: alone they prove a clean run, and show 60 m ahead for 10 s to be wrong."""
    assert followed["evidence"] == ["detector", "safe", ["clock_assumed"]]
    assert followed["shifted"] == ["detector", "unsafe", ["failure_beyond_budget", "nothing_accepted"]]
    assert followed["unseen"] == ["unproven"]
    assert followed["judged_by"] == "trackside detectors"
    assert followed["noted"] is True
    assert len({file for file, _, _ in EVIDENCE}) == 5
    assert len({file for file, _, _ in DETECTIONS}) == 3


def test_the_dictionary_follows(followed: dict[str, object]) -> None:
    assert followed["documented"] == ["offside_value", "epochs_on_track", "doors"]


@pytest.mark.parametrize(
    ("title", "edits"),
    [
        ("monitor", MONITOR),
        ("column", COLUMN),
        ("column", EPOCH_COLUMN),
        ("input stream", STREAM),
        ("message format", MESSAGE),
        ("rule", RULE),
        ("kind of evidence", EVIDENCE),
    ],
)
def test_the_page_names_the_files(title: str, edits: list[tuple[str, str, str]]) -> None:
    page = (ROOT / "docs" / "developer.md").read_text(encoding="utf-8")
    recipe = page.split(f"## How to add a{'n' if title == 'input stream' else ''} {title}\n")[1].split("\n## ")[0]
    assert {file for file, _, _ in edits if file not in recipe} == set()
