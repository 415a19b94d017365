"""The page of a campaign: what all runs come to, and the way to each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import polars as pl

from pipeline.campaign.outcome import worst
from pipeline.figures.known_counts import HAZARD_COUNTS, known_counts
from pipeline.figures.verdict import head_of, run_verdicts, word_of
from pipeline.report.architectures import architectures_section, map_section
from pipeline.report.availability import availability_map
from pipeline.report.campaign_figures import Figure, headline, level_figures, share_text
from pipeline.report.markup import Cell, badge, cell, figure, link, number, page, pairs, section, table, verdict_head
from pipeline.report.packing import Json, script_json
from pipeline.report.run_page import Made, hazard_hash
from pipeline.safety.measured import failed_runs, failures_of
from schemas.enums import TRUTH, Hazard, RunStatus, RunVerdict

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Campaign:
    """Tables of all runs, `run_id` in front; `pieces` as from `availability_pieces`; `hrefs` of the runs' pages;
    `architectures` as from `over_all_runs`, `map` as from `map_places`.
    """

    runs: pl.DataFrame
    hazards: pl.DataFrame
    passages: pl.DataFrame
    pieces: pl.DataFrame
    hrefs: Mapping[str, str]
    architectures: pl.DataFrame
    map: pl.DataFrame


_RUN_COLUMNS = (
    ("share_unknown", "share unknown"),
    ("duration_s", "duration [s]"), ("distance_m", "distance [m]"), ("availability", "availability"),
    ("evidence", "evidence"), ("hazards", "hazards"), ("hazards_detected", "detected"),
    ("missed_detections", "missed detections"), ("time_to_detect_max_s", "T_D max [s]"),
    ("hazardous_max_s", "hazardous max [s]"), ("balises_accepted", "VBs accepted"),
    ("balises_on_path", "VBs passed"), ("unsafe_accepted", "unsafe accepted"),
    ("unproven_accepted", "unproven accepted"), ("failures", "failures"), ("failures_within_budget", "within budget"),
    ("location_error_p95_m", "location error 95 % [m]"), ("along_error_p95_m", "error along 95 % [m]"),
    ("alarms", "alarms"), ("false_alarms", "false alarms"), ("exposure_max_s", "exposure max [s]"),
    ("outages", "outages"),
)  # fmt: skip
_HAZARD_COLUMNS = (
    ("failure_mode", "ETCS failure"), ("size_m", "size [m]"), ("t_onset", "onset"), ("monitor", "detected by"),
    ("time_to_detect_s", "T_D [s]"), ("time_since_failure_s", "T_dsf [s]"), ("hazardous_s", "hazardous [s]"),
    ("hazardous_may_s", "with what is unknown [s]"), ("within_budget", "within budget"), ("balise_ids", "VBs hit"),
    ("accepted_ids", "accepted despite the fault"), ("suspect", "suspect"),
)  # fmt: skip
_PLOTS = (
    ("classes", "Hazards by class", "Within the budget, beyond it, not known."),
    ("detection", "Time to detect", "Share of all hazards detected by then, and of all failures in use no longer; "
     "vertical lines are the allowed T_D of the service levels. A curve that ends below 1 shows what was never "
     "detected."),
    ("location", "Location error at VBs", "Positive: offered early. Offers by what became of them."),
    ("map", "Availability of the TVB", "Share of epochs with a valid TVB while moving, by place; crosses are hazards."),
)  # fmt: skip


def campaign_page(campaign: Campaign, made: Made) -> str:
    """HTML of the campaign."""
    solutions = [name for name in dict.fromkeys(sorted(campaign.runs["solution"].to_list())) if name]
    body = [
        *(_solution(f"s{index}", name, campaign, made, len(solutions) > 1) for index, name in enumerate(solutions)),
        architectures_section("architectures", campaign.architectures),
        map_section(campaign.map),
        section("runs", "Runs", _run_counts(campaign.runs), _runs_table(campaign)),
        section("provenance", "Provenance", _provenance(campaign.runs), _configuration(made)),
    ]
    data = {
        "order": solutions,
        "solutions": {name: _solution_data(name, campaign, made) for name in solutions},
        "levels": [
            [level, made.config.safety.allowed_time_to_detect_s(level)] for level in made.config.safety.service_levels
        ],
        "limits": {"failure_limit_m": made.config.hazards.failure_limit_m},
    }
    verdicts = run_verdicts(campaign.runs)
    head = head_of(verdicts.values())
    counts = ", ".join(f"{count} {name}" for name, count in head.counts().items())
    heading = verdict_head(head.word, f"{counts}.") + f"<h1>Campaign of {len(verdicts)} runs</h1>"
    return page("Campaign · balise", heading, "\n".join(body), script_json(data), "assets", "campaign.js")


def _only(frame: pl.DataFrame, name: str) -> pl.DataFrame:
    return frame.filter(pl.col("solution") == name)


def _run_counts(runs: pl.DataFrame) -> str:
    """Runs by the worst status of their solutions, so that each counts once."""
    found = [worst(part) for _, part in runs.group_by("run_id")]
    counts = [f"{badge(status.value)} {found.count(status)}" for status in RunStatus]
    return f"<p>{' '.join(counts)}</p>"


def _runs_table(campaign: Campaign) -> str:
    order = {RunVerdict.UNSAFE.value: 0, RunVerdict.UNPROVEN.value: 2, RunVerdict.SAFE.value: 3}
    failed = 1
    runs = (
        known_counts(campaign.runs)
        .with_columns(
            hazards=pl.sum_horizontal(HAZARD_COUNTS, ignore_nulls=False),
            order=pl.col("verdict").cast(pl.String).replace_strict(order, default=failed, return_dtype=pl.Int64),
        )
        .sort("order", "run_id", "solution")
    )
    rows = []
    for row in runs.iter_rows(named=True):
        name = Cell(row["run_id"], row["run_id"], link(campaign.hrefs[row["run_id"]], row["run_id"]))
        word = word_of(row["verdict"])
        verdict = Cell(word, str(row["order"]), badge(word))
        status = Cell(str(row["status"]), str(row["status"]), badge(str(row["status"])))
        reason = cell("; ".join(text for text in (row["error"], row["notes"]) if text) or None)
        figures = [cell(row[key]) for key, _ in _RUN_COLUMNS]
        rows.append([verdict, name, status, reason, cell(row["solution"] or None), *figures])
    titles = ["verdict", "run", "status", "reason or notes", "solution", *(title for _, title in _RUN_COLUMNS)]
    return table("table-runs", "Runs, unsafe and failed ones first", titles, rows)


def _solution(key: str, name: str, campaign: Campaign, made: Made, several: bool) -> str:
    hazards = _only(campaign.hazards, name)
    figures = headline(
        _only(campaign.runs, name),
        failed_runs(campaign.runs, name),
        hazards,
        _only(campaign.passages, name),
        made.config.safety,
    )
    title = f"Solution {name}" if several else "Figures"
    note = "<p>Rates count all that this campaign holds, injected faults included. Bounds: exact, 95 %, two-sided.</p>"
    return section(
        key,
        title,
        _headline(figures),
        note,
        _levels(key, _only(campaign.runs, name), made),
        *(figure(f"{key}-{plot}", heading, explanation) for plot, heading, explanation in _PLOTS),
        _hazards_table(key, hazards, campaign),
    )


def _headline(figures: list[Figure]) -> str:
    items = "".join(
        f"<div><dt>{escape(item.name)}</dt><dd><strong>{escape(item.value)}</strong><br>{escape(item.bounds)}</dd></div>"
        for item in figures
    )
    return f'<dl class="headline">{items}</dl>'


def _levels(key: str, runs: pl.DataFrame, made: Made) -> str:
    rows = [
        [
            cell(row.level),
            cell(row.allowed_s, 4),
            *(cell(count) for count in (row.within, row.exceeded, row.unknown)),
            cell(share_text(row.share)),
        ]
        for row in level_figures(runs, made.config.safety)
    ]
    titles = [
        "service level",
        "allowed T_D [s]",
        "within it",
        "beyond it",
        "not known",
        "share within it, by a truth",
    ]
    return table(f"table-levels-{key}", "Position failures in use against the allowed T_D (TVB eq. 7)", titles, rows)


def _hazards_table(key: str, hazards: pl.DataFrame, campaign: Campaign) -> str:
    rows = []
    for row in hazards.sort("run_id", "hazard_id").iter_rows(named=True):
        href = campaign.hrefs[row["run_id"]] + hazard_hash(row["solution"], row["hazard_id"])
        first = Cell(row["run_id"], row["run_id"], link(href, f"{row['run_id']} {row['hazard_id']}"))
        kind = Cell(str(row["hazard"]), str(row["hazard"]), tone="" if row["detected"] else "bad")
        rows.append([first, kind, *(cell(row[column]) for column, _ in _HAZARD_COLUMNS)])
    titles = ["run and hazard", "class", *(title for _, title in _HAZARD_COLUMNS)]
    return table(f"table-hazards-{key}", "Hazards of all runs", titles, rows)


def _solution_data(name: str, campaign: Campaign, made: Made) -> Json:
    runs, hazards, passages = (_only(frame, name) for frame in (campaign.runs, campaign.hazards, campaign.passages))
    return {
        "classes": [[kind.value, *_outcomes(hazards.filter(pl.col("hazard") == kind))] for kind in Hazard],
        "runs": runs.height,
        "runs_with_truth": runs["evidence"].is_in(TRUTH).sum(),
        "hazards": hazards.height,
        "failures": int(runs["failures"].sum()),
        "time_to_detect_s": _sorted(hazards.filter(pl.col("detected"))["time_to_detect_s"]),
        "hazardous_s": _sorted(failures_of(runs)["hazardous_may_s"]),
        "location": _location(passages),
        "map": availability_map(_only(campaign.pieces, name), hazards, made.site),
    }


def _outcomes(hazards: pl.DataFrame) -> list[int]:
    """Within the budget, beyond it, not known."""
    within = hazards["within_budget"]
    return [int((within == held).sum()) for held in (True, False)] + [within.null_count()]


def _sorted(values: pl.Series) -> list[float]:
    return [round(value, 6) for value in values.drop_nulls().sort().to_list()]


def _location(passages: pl.DataFrame) -> Json:
    """Location errors of offers as counts per bin of 1 m up to 50 m, beyond in the last bins."""
    known = passages.filter(pl.col("location_error_m").is_not_null())
    counts = (
        known.group_by(
            status=pl.col("status").cast(pl.String),
            at=pl.col("location_error_m").floor().clip(-51, 50).cast(pl.Int64),
        )
        .len("count")
        .sort("status", "at")
    )
    return [list(row) for row in counts.iter_rows()]


def _provenance(runs: pl.DataFrame) -> str:
    names = ("software", "contract", "config_digest")
    return pairs((name, ", ".join(runs[name].unique().sort().to_list())) for name in names)


def _configuration(made: Made) -> str:
    budget = f"<p>Budget of the hazards: {number(made.config.budget_s, 4)} s ({made.config.hazards.service_level}).</p>"
    if made.config_text is None:
        return budget + '<p class="notice partial">The result holds no config.toml: limits are the defaults.</p>'
    text = f'<pre tabindex="0">{escape(made.config_text)}</pre>'
    return budget + f"<details><summary>Resolved configuration (TOML)</summary>{text}</details>"
