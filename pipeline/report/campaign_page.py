"""The page of a campaign: what all runs come to, and the way to each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import polars as pl

from pipeline.campaign.outcome import worst
from pipeline.figures.campaign_figures import failures_of
from pipeline.figures.known_counts import HAZARD_COUNTS, known_counts
from pipeline.figures.verdict import head_of, run_verdicts, word_of
from pipeline.report.architectures import architectures_section
from pipeline.report.availability import availability_map
from pipeline.report.columns import Row, figures, frame_table
from pipeline.report.markup import (
    Cell,
    Json,
    badge,
    figure,
    link,
    number,
    page,
    pairs,
    script_json,
    section,
    verdict_head,
)
from pipeline.report.run_page import Made, configuration, hazard_cell
from pipeline.safety.sentences import level_statements, plain_statements
from schemas.campaign import CampaignBalises, CampaignDetection, CampaignFigures, CampaignMap, CampaignRuns
from schemas.enums import TRUTH, Hazard, RunStatus, RunVerdict
from schemas.tables import Hazards


@dataclass(frozen=True)
class Campaign:
    """Tables of all runs, `run_id` in front, and `derived` from them by the name of their file; `pieces` as from
    `availability_pieces`; `hrefs` of the runs' pages; `architectures` as from `added`.
    """

    runs: pl.DataFrame
    hazards: pl.DataFrame
    passages: pl.DataFrame
    derived: Mapping[str, pl.DataFrame]
    pieces: pl.DataFrame
    hrefs: Mapping[str, str]
    architectures: pl.DataFrame


RUN_COLUMNS = (
    *("verdict", "run_id", "status", "error", "notes", "solution", "share_unknown", "duration_s", "distance_m"),
    *("availability", "evidence", *HAZARD_COUNTS, "hazards_detected", "missed_detections", "time_to_detect_max_s"),
    *("hazardous_max_s", "balises_accepted", "balises_on_path", "unsafe_accepted", "unproven_accepted", "failures"),
    *("failures_within_budget", "location_error_p95_m", "along_error_p95_m", "alarms", "false_alarms"),
    *("exposure_max_s", "outages"),
)
_HAZARD_COLUMNS = (
    *("run_id", "hazard", "failure_mode", "size_m", "t_onset", "monitor", "time_to_detect_s", "time_since_failure_s"),
    *("hazardous_s", "hazardous_may_s", "within_budget", "balise_ids", "accepted_ids", "suspect"),
)
_BALISE_COLUMNS = (
    *("balise_id", "kind", "passages", "accepted", "accepted_share", "deletions", "deletion_rate", "accepted_judged"),
    *("unsafe_accepted", "unsafe_rate", "unproven_accepted", "location_error_mean_m", "location_error_max_m"),
)
_LEVEL_COLUMNS = ("service_level", "allowed_s", "failures", "within", "exceeded", "failures_judged", "within_share")
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
        *(_solution(f"s{index}", name, campaign, len(solutions) > 1) for index, name in enumerate(solutions)),
        architectures_section("architectures", campaign.architectures),
        _map_in_doubt(campaign.derived["map"]),
        section("runs", "Runs", _run_counts(campaign.runs), _runs_table(campaign)),
        section("provenance", "Provenance", _provenance(campaign.runs), _budget(made), configuration(made)),
    ]
    safety = made.config.safety
    data = {
        "order": solutions,
        "solutions": {name: _solution_data(name, campaign, made) for name in solutions},
        "levels": [[level, safety.allowed_time_to_detect_s(level)] for level in safety.service_levels],
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
        .with_columns(order=pl.col("verdict").cast(pl.String).replace_strict(order, default=failed))
        .sort("order", "run_id", "solution")
    )

    def verdict(row: Row) -> Cell:
        word = word_of(row["verdict"])
        return Cell(word, str(row["order"]), badge(word))

    special = {
        "verdict": verdict,
        "run_id": lambda row: Cell(row["run_id"], row["run_id"], link(campaign.hrefs[row["run_id"]], row["run_id"])),
        "status": lambda row: Cell(row["status"], row["status"], badge(row["status"])),
    }
    caption = "Runs, unsafe and failed ones first"
    return frame_table("table-runs", caption, runs, RUN_COLUMNS, CampaignRuns, special)


def _solution(key: str, name: str, campaign: Campaign, several: bool) -> str:
    found, levels, balises = (_only(campaign.derived[table], name) for table in ("figures", "detection", "balises"))
    said = "".join(f"<p>{escape(text)}</p>" for text in (*plain_statements(found), *level_statements(levels)))
    note = "<p>Rates count all that this campaign holds, injected faults included. Bounds: exact, 95 %, two-sided.</p>"
    title = "Position failures in use against the allowed T_D (TVB eq. 7)"
    return section(
        key,
        f"Solution {name}" if several else "Figures",
        said,
        *(figures(row, CampaignFigures) for row in found.drop("solution").iter_rows(named=True)),
        note,
        frame_table(f"table-levels-{key}", title, levels, _LEVEL_COLUMNS, CampaignDetection),
        *(figure(f"{key}-{plot}", heading, explanation) for plot, heading, explanation in _PLOTS),
        frame_table(f"table-balises-{key}", "Balises over all runs", balises, _BALISE_COLUMNS, CampaignBalises),
        _hazards_table(key, _only(campaign.hazards, name), campaign),
    )


def _hazards_table(key: str, hazards: pl.DataFrame, campaign: Campaign) -> str:
    special = {
        "run_id": lambda row: hazard_cell(row, f"{row['run_id']} {row['hazard_id']}", campaign.hrefs[row["run_id"]]),
    }
    ordered = hazards.sort("run_id", "hazard_id")
    return frame_table(f"table-hazards-{key}", "Hazards of all runs", ordered, _HAZARD_COLUMNS, Hazards, special)


def _map_in_doubt(places: pl.DataFrame) -> str:
    """Places where several runs raised the same alarm across the track; nothing where there are none."""
    if places.is_empty():
        return ""
    columns = ("netelement_id", "from_m", "to_m", "axis", "runs", "alarms", "solutions", "run_ids")
    note = "<p>Monitors across the track alone failed there in several runs: look at the survey first.</p>"
    shown = frame_table("table-map", "Map in doubt", places, columns, CampaignMap)
    return section("map", "Places where the map is in doubt", note, shown)


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


def _budget(made: Made) -> str:
    return f"<p>Budget of the hazards: {number(made.config.budget_s, 4)} s ({made.config.hazards.service_level}).</p>"
