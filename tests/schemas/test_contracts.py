"""Contracts, configuration and the generated dictionary."""

from __future__ import annotations

import pickle
from dataclasses import fields
from pathlib import Path

import polars as pl
import pytest

from pipeline.stages.monitors.single import WITHOUT_MEMORY
from schemas.config import Configuration, IngestConfig, Vehicle, digest_of, load_settings, settings_from, to_toml
from schemas.conform import conform
from schemas.dictionary import dictionary_frame, dictionary_markdown
from schemas.errors import BaliseError, ConfigError, InputError
from schemas.inputs import SITE_SCHEMAS, STREAM_SCHEMAS
from schemas.monitors import ALL_MONITORS, AXES, MONITORS, OTHER_MONITORS
from schemas.project import LogEntry
from schemas.run import RECORDED_STREAMS, STREAMS, RunLog
from schemas.tables import TABLES, Alarms, Epochs
from schemas.words import WORDS

ROOT = Path(__file__).parents[2]


def test_the_dictionary_page_is_fresh():
    page = (ROOT / "docs" / "dictionary.md").read_text(encoding="utf-8")
    assert page == dictionary_markdown(), "run `make dictionary`"


def test_every_column_says_what_it_means_and_floats_have_unit_and_tolerance():
    assert dictionary_frame().filter(pl.col("meaning") == "").is_empty()
    for schema in (*STREAM_SCHEMAS.values(), *SITE_SCHEMAS.values(), *TABLES.values()):
        for name, column in schema.columns().items():
            if column.dtype == pl.Float64 and schema is not STREAM_SCHEMAS["faults"]:
                assert {"unit", "tolerance"} <= set(column.metadata), (schema, name)


def test_monitors_have_the_names_of_the_domain():
    names = [
        f"{axis}_{scale}"
        for axis in ("along", "cross", "up")
        for scale in ("raw", "ewma_0p1", "ewma_0p01", "ewma_0p001")
    ]
    assert list(MONITORS) == [*names, "link_order", "link_distance", "along_doppler", "pseudorange", "channel"]
    assert {f"{name}_{part}" for name in MONITORS for part in ("value", "threshold", "state", "reason")} <= set(
        Epochs.column_names()
    )


def test_a_monitor_named_after_an_axis_sees_that_axis():
    """Its alarm across the track or in height is called false by a reference alone."""
    for monitor in ALL_MONITORS:
        named = monitor.name.split("_")[0]
        assert monitor.axis == named or named not in AXES, monitor.name


def test_every_drawing_of_monitors_has_a_title():
    assert {f"monitors-{monitor.drawing}" for monitor in ALL_MONITORS} <= set(WORDS["plots"]["run"])


def test_every_monitor_that_runs_has_columns():
    assert {*WITHOUT_MEMORY, "link_order", "link_distance"} == set(OTHER_MONITORS)


def test_allowed_times_to_detect_of_the_papers():
    """TVB eq. 7; 1.675 s where the paper prints 1.44 s, the rate's mantissa."""
    safety = Configuration().safety
    assert safety.allowed_time_to_detect_s("npa") == pytest.approx(24.12, abs=0.005)
    assert safety.allowed_time_to_detect_s("lpv200") == pytest.approx(0.5025, abs=5e-5)
    assert Configuration().budget_s == pytest.approx(0.5025, abs=5e-5)
    assert safety.allowed_time_to_detect_s("egnos_observed") == pytest.approx(1.675, abs=5e-4)
    assert safety.allowed_time_to_detect_s("horizontal_sis") == pytest.approx(100.5, abs=0.05)


@pytest.mark.parametrize(
    ("stage", "key", "value", "message"),
    [
        pytest.param("monitors", "ewma_alphas", [0.1, 0.01, 0.0], r"ewma_alphas\.2.*found 0\.0", id="never averages"),
        pytest.param("monitors", "ewma_alphas", [0.001, 0.01, 0.1], "the fastest average first", id="slowest first"),
        pytest.param("monitors", "ewma_alphas", [0.1, 0.1, 0.01], "three falling weights", id="the same twice"),
        pytest.param("monitors", "disabled", ["along-raw"], "no monitor is called along-raw", id="no such monitor"),
        pytest.param("lds", "ci_limit_m", True, "must be a number, found True", id="truth for a number"),
        pytest.param("lds", "ci_limit_m", "14", "must be a number, found '14'", id="text for a number"),
        pytest.param("lds", "ci_limit_m", -1.0, "greater than 0, found -1.0", id="out of range"),
    ],
)
def test_settings_that_would_blind_or_mislead_are_refused(stage: str, key: str, value: object, message: str):
    with pytest.raises(ConfigError, match=message):
        settings_from({stage: {key: value}}, Configuration, "my.toml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gnss_latency_s", 83.0),
        ("gnss_latency_sigma_s", 20.0),
        ("gnss_antenna_ahead_m", 12500.0),
        ("antenna_height_m", 4100.0),
        ("odometer_scale_sigma", 1.0),
    ],
)
def test_vehicle_in_other_units_is_refused(key: str, value: float):
    with pytest.raises(ConfigError, match=rf"train\.toml.*{key}.*found {value}"):
        settings_from({key: value}, Vehicle, "train.toml")
    assert getattr(settings_from({key: value / 1000.0}, Vehicle, "train.toml"), key) == value / 1000.0


def test_unknown_keys_are_refused_with_their_path():
    with pytest.raises(ConfigError) as caught:
        settings_from({"lds": {"recovery_sec": 3.0}, "foo": 1}, Configuration, "my.toml")
    assert str(caught.value).splitlines() == [
        "my.toml: 2 problems in this file",
        "  unknown key `lds.recovery_sec` (did you mean `recovery_s`?)",
        "  unknown key `foo`",
        "`balise dictionary` lists every key.",
    ]


@pytest.mark.parametrize(
    ("given", "kind", "meant"),
    [
        ({"antenna_hight_m": 3.0}, Vehicle, "unknown key `antenna_hight_m` (did you mean `antenna_height_m`"),
        ({"hazards": {"recovery_s": 3.0}}, Configuration, "(did you mean `lds.recovery_s`?)"),
        ({"ingest": {"gnss": {"topic": "/x", "feilds": {}}}}, Configuration, "(did you mean `fields`?)"),
        (
            {"safety": {"service_levels": {"x": {"integrity": 1e-7, "exposure_s": 1.0}}}},
            Configuration,
            "`integrity_risk`",
        ),
    ],
)
def test_an_unknown_key_names_the_nearest(given, kind, meant):
    with pytest.raises(ConfigError) as caught:
        settings_from(given, kind, "my.toml")
    assert meant in str(caught.value)


@pytest.mark.parametrize("text", ["lds = [", "\x00"])
def test_a_file_that_is_no_toml_is_one_error(tmp_path, text):
    path = tmp_path / "f.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"f\.toml"):
        load_settings(path, Configuration)


def test_a_missing_file_is_one_error(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_settings(tmp_path / "no.toml", Vehicle)


def test_resolved_configuration_reads_back_as_itself(tmp_path):
    config = settings_from({"lds": {"ci_limit_m": 20}, "ingest": {"gnss": {"topic": "/fix"}}}, Configuration, "x")
    path = tmp_path / "c.toml"
    path.write_text(to_toml(config))
    again = load_settings(path, Configuration)
    assert again == config
    assert digest_of(again) == digest_of(config) != digest_of(Configuration())


def test_a_service_level_that_does_not_exist_is_refused():
    with pytest.raises(ConfigError, match="service_level"):
        settings_from({"hazards": {"service_level": "apv"}}, Configuration, "x")


def test_errors_keep_their_kind_and_words_between_processes():
    error = InputError("no column", place="r/gnss.parquet", found="a", expected="t", remedy="Add it.")
    again = pickle.loads(pickle.dumps(error))
    assert isinstance(again, InputError)
    assert isinstance(again, BaliseError)
    assert str(again) == "r/gnss.parquet: no column; found a; expected t. Add it."


def test_a_table_with_nan_or_a_forbidden_null_is_a_defect():
    alarms = Alarms.create_empty()
    row = {
        "solution": "primary", "alarm_id": 0, "t_start": 0, "t_end": 1, "monitors": ["along_raw"], "peak_ratio": 2.0,
        "verdict": "true", "suspect": "gnss", "hazard_id": None, "netelement_id": None, "measure_m": None,
    }  # fmt: skip
    good = pl.DataFrame([row], schema_overrides=alarms.schema)
    assert conform(good, Alarms).schema == alarms.schema
    with pytest.raises(ValueError, match="peak_ratio holds NaN or infinity"):
        conform(good.with_columns(peak_ratio=float("nan")), Alarms)
    with pytest.raises(ValueError, match="verdict holds null"):
        conform(good.with_columns(verdict=pl.lit(None)), Alarms)
    with pytest.raises(ValueError, match=r"^table Alarms: no stage makes column peak_ratio, verdict$"):
        conform(good.drop("verdict", "peak_ratio"), Alarms)


def test_every_stream_has_its_columns_its_frame_and_its_key() -> None:
    assert tuple(STREAM_SCHEMAS) == STREAMS == (*RECORDED_STREAMS, "faults")
    assert [field.name for field in fields(RunLog) if field.name in STREAMS] == list(STREAMS)
    for model in (IngestConfig, LogEntry):
        assert [name for name in model.model_fields if name in STREAMS] == list(RECORDED_STREAMS)
