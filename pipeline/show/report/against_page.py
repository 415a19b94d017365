"""Two results side by side: two configurations, programs or campaigns over the same runs, on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from pipeline.results.figures.head import HAZARD_COUNTS, head_of, known_counts, run_verdicts, verdict_figures, word_of
from pipeline.results.query import run_sql
from pipeline.results.store import read_config, read_table
from pipeline.show.report.columns import column_title, frame_table
from pipeline.show.report.markup import (
    UNKNOWN,
    Cell,
    number,
    page,
    pairs,
    script_json,
    section,
    table,
    value_cell,
    verdict_head,
)
from pipeline.show.report.words import count_words
from pipeline.storage.address import Address
from schemas.errors import UsageError

_RUN = ["run_id", "solution"]
_COUNTED = ("faults", "missed_detections", *HAZARD_COUNTS, "failures", "failures_beyond_budget", "unsafe_accepted")
_LARGEST = ("time_to_detect_max_s", "time_since_failure_max_s", "hazardous_max_s", "location_error_max_m")
_SUMMED = ("balises_found", "balises_passed", "alarms", "false_alarms", "outages")
# What of a run has to change for its row.
_COMPARED = ("verdict", "availability", "balises_found", *_COUNTED, "time_to_detect_max_s")
# Half a percent of the time is a change that somebody should see.
_AVAILABILITY = 0.005
_PLACES = 20


def against_page(out: Address, other: Address) -> str:
    """The page of `out` and `other`, over the runs that both have. Raises `UsageError` where there are none."""
    this, that = (read_table(of, "runs").collect() for of in (out, other))
    both = this.join(that, on=_RUN, how="semi").select(_RUN)
    if both.is_empty():
        raise UsageError("shares no run with the other result", place=f"--against {other}", found=str(out))
    runs, runs_of_other = (known_counts(frame.join(both, on=_RUN, how="semi").sort(_RUN)) for frame in (this, that))
    alone = [count_words(frame.join(both, on=_RUN, how="anti").height, "run") for frame in (this, that)]
    head = head_of(run_verdicts(runs).values())
    of_other = head_of(run_verdicts(runs_of_other).values())
    facts = [
        ("This result", str(out)),
        ("The other", str(other)),
        ("Runs in both", str(both["run_id"].n_unique())),
        ("Only here, only there", f"{alone[0]}, {alone[1]}: left out"),
        ("Programs", " and ".join(_program_words(frame) for frame in (runs, runs_of_other))),
    ]
    body = [
        section("what", "What is compared", pairs(facts), _settings_table(out, other)),
        section("verdicts", "Verdicts", _verdict_table(runs, runs_of_other)),
        section("figures", "Figures of these runs", _figure_table(runs, runs_of_other)),
        section("runs", "Runs that changed", _changed_runs_table(runs, runs_of_other)),
        section("places", "Where availability changed", _places_table(out, other, both)),
        section("balises", "Balises that changed", _balises_table(out, other, both)),
    ]
    heading = verdict_head(head.word, f"the other result: {of_other}", f"This one: {head}.", "")
    foot = _program_words(runs)
    return page(
        "Two results · balise",
        f"{heading}<h1>Two results side by side</h1>",
        "\n".join(body),
        script_json({}),
        "line.js",
        foot,
    )


def _program_words(runs: pl.DataFrame) -> str:
    """Programs that made the runs."""
    return ", ".join(runs["software"].unique().sort().to_list())


def _settings_table(out: Address, other: Address) -> str:
    """Keys of the configuration that are not the same."""
    here, there = (_flatten(config.model_dump()) if (config := read_config(of)) else {} for of in (out, other))
    rows = [
        [Cell(key, key), value_cell(str(there.get(key, UNKNOWN))), value_cell(str(here.get(key, UNKNOWN)))]
        for key in sorted({*here, *there})
        if here.get(key) != there.get(key)
    ]
    heads = [("key", "of the configuration"), ("the other", ""), ("this result", "")]
    return table("table-settings", "Settings that differ", heads, rows)


def _flatten(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings by their whole path."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        inner = _flatten(value, f"{before}{name}.") if isinstance(value, dict) else {f"{before}{name}": value}
        flat |= inner
    return flat


def _verdict_table(runs: pl.DataFrame, of_other: pl.DataFrame) -> str:
    """How many runs had which verdict there, and which here."""
    here, there = run_verdicts(runs), run_verdicts(of_other)
    counts: dict[tuple[str, str], list[str]] = {}
    for run in here:
        counts.setdefault((word_of(there[run]), word_of(here[run])), []).append(run)
    rows = [
        [Cell(was, was), Cell(now, now), value_cell(len(named)), value_cell(named)]
        for (was, now), named in sorted(counts.items())
    ]
    heads = [("the other", ""), ("this result", ""), ("runs", ""), ("which", "")]
    return table("table-verdicts", "Verdicts there and here", heads, rows)


def _figure_table(runs: pl.DataFrame, of_other: pl.DataFrame) -> str:
    """HTML of the figures of the runs in both, and how they changed."""
    rows = []
    for name, now, was in zip(_figure_names(), _figures_of(runs), _figures_of(of_other), strict=True):
        change = None if now is None or was is None else now - was
        rows.append([Cell(column_title(name), name), *(_value_cell(name, one) for one in (was, now, change))])
    heads = [("figure", ""), ("the other", ""), ("this result", ""), ("change", "this one minus the other")]
    return table("table-figures", "Figures of the runs in both", heads, rows)


def _figure_names() -> Sequence[str]:
    """Names of the figures that are compared."""
    return ("availability", "proof_margin_m", *_SUMMED, *_COUNTED, "hazardous_s", *_LARGEST)


def _figures_of(runs: pl.DataFrame) -> list[float | None]:
    """Values of the figures in `_figure_names`; null where no run knows it."""
    figures = verdict_figures(runs)
    sums = {name: runs[name].sum() if runs[name].count() else None for name in (*_SUMMED, *_COUNTED, "hazardous_s")}
    most = {name: runs[name].max() for name in _LARGEST}
    known = {**{name: figures[name] for name in ("availability", "proof_margin_m")}, **sums, **most}
    return [known[name] for name in _figure_names()]


def _value_cell(name: str, value: float | None) -> Cell:
    """A figure as a cell."""
    if value is None:
        return Cell("not known")
    if name == "availability":
        return Cell(f"{value:.1%}", float(value))
    return Cell(number(value), float(value))


def _changed_runs_table(runs: pl.DataFrame, of_other: pl.DataFrame) -> str:
    """HTML of the runs whose verdict, availability, balises, faults or detection times changed."""
    here = runs.select(*_RUN, *_COMPARED).with_columns(pl.col("verdict").cast(pl.String))
    there = of_other.select(*_RUN, *_COMPARED).with_columns(pl.col("verdict").cast(pl.String))
    pairs_of = there.join(here, on=_RUN, suffix="_now")
    step = (pl.col("availability_now") - pl.col("availability")).abs()
    known = pl.col("availability").is_null() != pl.col("availability_now").is_null()
    exact = [pl.col(name).ne_missing(pl.col(f"{name}_now")) for name in _COMPARED if name != "availability"]
    changed = pairs_of.filter(pl.any_horizontal(*exact, known, (step > _AVAILABILITY).fill_null(value=False)))
    if changed.is_empty():
        return "<p>None: verdicts, availability, balises, faults and times to detect are the same.</p>"
    shown = changed.sort(step, descending=True, nulls_last=True)
    rows = [
        [*(value_cell(row[name]) for name in _RUN), *(_change_cell(row, name) for name in _COMPARED)]
        for row in shown.iter_rows(named=True)
    ]
    heads = [(column_title(name), "") for name in (*_RUN, *_COMPARED)]
    return table("table-changed", "Runs that changed: there → here", heads, rows)


def _change_cell(row: Mapping[str, Any], name: str) -> Cell:
    """What a value became, as a cell."""
    was, now = row[name], row[f"{name}_now"]
    if name == "verdict":
        was, now = word_of(was), word_of(now)
    texts = [_value_cell(name, one).text if not isinstance(one, str) else one for one in (was, now)]
    if was == now:
        return Cell(texts[1], texts[1])
    return Cell(" → ".join(texts), texts[1], tone="bad" if now == "unsafe" else "")


def _places_table(out: Address, other: Address, both: pl.DataFrame) -> str:
    """Pieces of line by how much their availability changed, the largest first."""
    sql = (
        "SELECT netelement_id, FLOOR(measure_m / 500) * 500 AS from_m, run_id, solution, SUM(moving_s) AS moving_s,"
        " SUM(lost_s) AS lost_s FROM epochs WHERE moving_s > 0 GROUP BY netelement_id, from_m, run_id, solution"
    )
    place = ["netelement_id", "from_m"]

    def availabilities(of: Address) -> pl.DataFrame:
        """Availability of a result by piece of line."""
        summed = (
            run_sql(of, sql).join(both, on=_RUN, how="semi").group_by(place).agg(pl.col("moving_s", "lost_s").sum())
        )
        return summed.select(*place, "moving_s", availability=1.0 - pl.col("lost_s") / pl.col("moving_s"))

    joined = availabilities(other).join(availabilities(out), on=place, suffix="_now", nulls_equal=True)
    frame = joined.select(
        *place,
        "moving_s",
        pl.col("availability").round(3).alias("there"),
        pl.col("availability_now").round(3).alias("here"),
        change=(pl.col("availability_now") - pl.col("availability")).round(3),
    )
    changed = frame.filter(pl.col("change").abs() > _AVAILABILITY).sort(
        pl.col("change").abs(), *place, descending=[True, False, False]
    )
    return frame_table(
        "table-places", "Pieces of 500 m of a net element, the largest change first", changed.head(_PLACES)
    )


def _balises_table(out: Address, other: Address, both: pl.DataFrame) -> str:
    """Virtual balises whose passages ended otherwise."""
    sql = (
        "SELECT run_id, solution, balise_id, status, COUNT(*) AS passages FROM passages WHERE kind = 'virtual'"
        " GROUP BY run_id, solution, balise_id, status"
    )

    def count_passages(of: Address) -> pl.DataFrame:
        """Passages of a result by balise and status."""
        rows = run_sql(of, sql).join(both, on=_RUN, how="semi").with_columns(pl.col("status").cast(pl.String))
        return rows.group_by("balise_id", "status").agg(pl.col("passages").sum())

    joined = count_passages(other).join(
        count_passages(out), on=["balise_id", "status"], how="full", coalesce=True, suffix="_now"
    )
    frame = joined.select(
        "balise_id", "status", there=pl.col("passages").fill_null(0), here=pl.col("passages_now").fill_null(0)
    )
    changed = frame.filter(pl.col("there") != pl.col("here")).sort("balise_id", "status")
    return frame_table("table-balises", "Virtual balises by what became of them", changed)
