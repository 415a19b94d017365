"""What was injected against what a replay found."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

import polars as pl

from datasets.expectation import ExpectedHazard, ExpectedRun
from datasets.scenario import RunSpec
from pipeline.results.figures.head import word_of, worst_verdict
from schemas.errors import ConfigError
from schemas.frozen import frozen
from schemas.run import RunLog, RunTables

_NOTHING = "none"
# Of the size of a fault, where it is no length.
_UNITS = {"latency": " s", "scale": ""}


@frozen
class ComparisonRow:
    """One line of the comparison."""

    run_id: str
    title: str
    injected: str
    check: str
    expected: str
    found: str

    @property
    def agrees(self) -> bool:
        """The replay found what was injected."""
        return self.expected == self.found


def compare_run(spec: RunSpec, run: RunLog, tables: RunTables) -> list[ComparisonRow]:
    """Compare a run's expectations with its tables: verdict, hazards, onset, balises, alarms, scale."""
    if spec.expected is None:
        raise ConfigError("does not say what has to be found", place=f"scenario: run {spec.id}")
    injected = describe_faults(run.faults)
    pairs = [
        ("verdict", spec.expected.verdict.value, word_of(worst_verdict(tables.runs["verdict"].to_list()))),
        ("status", "ok", _value_or_values(tables.runs["status"].to_list())),
        *_hazard_pairs(spec.expected, tables.hazards),
        *_onset_pairs(spec, run, tables.hazards),
        *_balise_pairs(spec.expected, tables.passages),
        *_alarm_pairs(spec.expected, tables.alarms),
        *_scale_pairs(spec.expected, tables.runs),
    ]
    return [ComparisonRow(spec.id, spec.title, injected, *pair) for pair in pairs]


def checks_table(checks: Iterable[ComparisonRow]) -> pl.DataFrame:
    """The comparison as a table: `run_id, title, injected, check, expected, found, agrees`."""
    names = ("run_id", "title", "injected", "check", "expected", "found", "agrees")
    schema = {name: pl.Boolean if name == "agrees" else pl.String for name in names}
    return pl.DataFrame([[getattr(c, name) for name in names] for c in checks], schema=schema, orient="row")


def describe_faults(faults: pl.DataFrame | None) -> str:
    """Faults in words: kind, target, size, rate, duration."""
    if faults is None or faults.is_empty():
        return _NOTHING
    parts = []
    for row in faults.iter_rows(named=True):
        size = "" if row["size"] is None else f" {row['size']:+g}{_UNITS.get(row['kind'], ' m')}"
        rate = "" if row["rate"] is None else f" at {row['rate']:+g} m/s"
        lasts = (row["t_end"] - row["t_start"]).total_seconds()
        parts.append(f"{row['kind']} {row['target']}{size}{rate} for {lasts:g} s")
    return ", ".join(parts)


Pair = tuple[str, str, str]


def _hazard_pairs(expected: ExpectedRun, found: pl.DataFrame) -> list[Pair]:
    """Hazards expected, and those found."""
    rows = found.sort("hazard_id").to_dicts()
    pairs = [
        (
            f"hazard {i}",
            _hazard_text(expected.hazards[i]) if i < len(expected.hazards) else _NOTHING,
            _found_text(rows[i], expected.hazards[i] if i < len(expected.hazards) else None)
            if i < len(rows)
            else _NOTHING,
        )
        for i in range(max(len(expected.hazards), len(rows)))
    ]
    return pairs or [("hazards", _NOTHING, _NOTHING)]


def _hazard_text(hazard: ExpectedHazard) -> str:
    """An expected hazard in words."""
    text = _hazard_words(
        hazard.hazard.value,
        hazard.failure_mode.value,
        hazard.timing.value,
        hazard.balise_ids,
        hazard.accepted_ids,
        hazard.detected,
    )
    if hazard.before_failure is not None:
        text += ", before the failure" if hazard.before_failure else ", behind the failure"
    return text if hazard.caused_by is None else f"{text}, caused by {hazard.caused_by}"


def _found_text(row: dict[str, object], expected: ExpectedHazard | None) -> str:
    """A hazard that was found in words, with the same facts as the expected one."""
    names = ("hazard", "failure_mode", "timing", "balise_ids", "accepted_ids", "detected")
    text = _hazard_words(*(row[name] for name in names))
    if expected is not None and expected.before_failure is not None:
        detected = row["t_detected"]
        failure = row["t_failure"]
        known = isinstance(detected, datetime) and isinstance(failure, datetime)
        text += ", before the failure" if known and detected < failure else ", behind the failure"  # type: ignore[operator]
    return text if row["caused_by"] is None else f"{text}, caused by {row['caused_by']}"


def _hazard_words(hazard: object, mode: object, timing: object, hit: object, accepted: object, detected: object) -> str:
    """A hazard in words, by its columns."""
    lists = [" ".join(ids) or "-" if isinstance(ids, list | tuple) else "-" for ids in (hit, accepted)]
    detection = "detected" if detected else "not detected"
    return f"{hazard} {mode} {timing}: {lists[0]}, accepted despite the fault {lists[1]}, {detection}"


def _onset_pairs(spec: RunSpec, run: RunLog, found: pl.DataFrame) -> list[Pair]:
    """The first hazard begins with the fault, within one epoch."""
    if spec.expected is None or not spec.expected.hazards or run.faults is None or found.is_empty():
        return []
    begin = run.faults.filter(pl.col("target") != "odometer")["t_start"].min()
    onset = found.sort("hazard_id")["t_onset"][0]
    if begin is None or onset is None:
        return [("onset", "known", "unknown")]
    late_s = (onset - begin) / timedelta(seconds=1)
    near = abs(late_s) <= 1.0 / spec.gnss.rate_hz + 1e-6
    return [("onset", "within one epoch", "within one epoch" if near else f"{late_s:+.3f} s")]


def _balise_pairs(expected: ExpectedRun, found: pl.DataFrame) -> list[Pair]:
    """The status that all rows of a balise have, and for some balises that there is one row only."""
    statuses = {
        str(balise): _value_or_values(rows["status"].to_list())
        for (balise,), rows in found.group_by(["balise_id"], maintain_order=True)
    }
    balises = sorted({*expected.passages, *statuses})
    pairs = [(b, str(expected.passages.get(b, _NOTHING)), statuses.get(b, _NOTHING)) for b in balises]
    many = found["balise_id"].value_counts().filter(pl.col("count") > 1)["balise_id"].to_list()
    repeated = sorted(set(many) & set(expected.once))
    if expected.once:
        pairs.append(("one passage each", "yes", "yes" if not repeated else f"no: {' '.join(repeated)}"))
    return _merge_pairs(pairs)


def _merge_pairs(pairs: list[Pair]) -> list[Pair]:
    """Balises that agree in one line per status, the others one by one."""
    lines: dict[str, list[str]] = {}
    rest = []
    for name, expected, found in pairs:
        if expected == found and name != "one passage each":
            lines.setdefault(expected, []).append(name)
        else:
            rest.append((name, expected, found))
    return [(" ".join(names), status, status) for status, names in lines.items()] + rest


def _alarm_pairs(expected: ExpectedRun, found: pl.DataFrame) -> list[Pair]:
    """Alarms expected, and those found."""
    pairs = [("alarms", expected.alarms, _value_or_values(found["verdict"].to_list()))]
    if expected.suspect is not None:
        pairs.append(("suspect", expected.suspect, _value_or_values(found["suspect"].to_list())))
    return pairs


def _scale_pairs(expected: ExpectedRun, found: pl.DataFrame) -> list[Pair]:
    """Scale of the odometer expected, and that found."""
    if expected.odometer_scale is None:
        return []
    text = f"{expected.odometer_scale:g} ± {expected.odometer_scale_tolerance:g}"
    scale = found["odometer_scale"][0]
    near = scale is not None and abs(scale - expected.odometer_scale) <= expected.odometer_scale_tolerance
    return [("odometer scale", text, text if near else str(scale))]


def _value_or_values(values: list[str]) -> str:
    """The value that all have, or all values that occur."""
    return " ".join(sorted(set(values))) or _NOTHING
