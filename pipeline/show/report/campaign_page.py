"""The page of a campaign: what all runs come to, and the way to each of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from html import escape

import polars as pl

from pipeline.results.figures.campaign_figures import failures_table
from pipeline.results.figures.head import HAZARD_COUNTS, head_of, known_counts, run_verdicts, word_of
from pipeline.results.places import origin_of
from pipeline.show.report.balises import architectures_section, balise_table, lost_shares, outcome_of_passage
from pipeline.show.report.columns import Row, figures_table, frame_table
from pipeline.show.report.ground import availability_map
from pipeline.show.report.headline import campaign_headline, run_headline
from pipeline.show.report.markup import (
    UNKNOWN,
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
    tiles,
    verdict_head,
)
from pipeline.show.report.run_page import ALLOWED, Made, configuration_html, hazard_cell
from pipeline.show.report.words import count_words, plots_of
from pipeline.studies.safety.sentences import level_statements, plain_statements
from schemas.campaign import CampaignDetection, CampaignFigures, CampaignMap, CampaignRuns
from schemas.enums import TRUTH, Hazard, RunVerdict
from schemas.frozen import frozen
from schemas.tables import Hazards
from schemas.words import accepted_words, notes_apart


@frozen
class Campaign:
    """Tables of all runs, `run_id` in front, and `derived` from them by the name of their file; `pieces` as from
    `availability_pieces`; `hrefs` of the runs' pages, as far as there are; `architectures` as from `added`.
    """

    runs: pl.DataFrame
    hazards: pl.DataFrame
    passages: pl.DataFrame
    derived: Mapping[str, pl.DataFrame]
    pieces: pl.DataFrame
    hrefs: Mapping[str, str]
    architectures: pl.DataFrame


# The first ten are shown, the others behind a switch.
RUN_COLUMNS = (
    *("verdict", "run_id", "why", "unsafe_accepted", "failures_beyond_budget", "missed_detections"),
    *("balises_found", "availability", "proof_margin_m", "remedies"),
    *("balises_on_path", "unproven_accepted", "share_unknown", "part_verdict", "part_share"),
    *("location_error_max_m", "hazards", "hazardous_max_s", "time_to_detect_max_s", "alarms", "false_alarms"),
    *("lost_to", "lost_to_share", "lost_to_monitor", "outages", "evidence", "solution"),
    *("t_start", "duration_s", "distance_m", "status", "notes", "input_digest"),
)
_HAZARD_COLUMNS = (
    *("run_id", "hazard", "accepted_ids", "within_budget", "monitor", "time_to_detect_s", "hazardous_s", "size_m"),
    *("balise_ids", "t_onset", "time_since_failure_s", "hazardous_may_s", "failure_mode", "suspect"),
)
_LEVEL_COLUMNS = ("service_level", "allowed_s", "failures", "within", "exceeded", "failures_judged", "within_share")
_TONES = {"unsafe": "bad", "failed": "bad", "unproven": "doubt", "safe": "good"}
# What comes first in the list of runs; failed ones, which have no verdict, after the unsafe.
_RANK = {RunVerdict.UNSAFE.value: 0, None: 1, RunVerdict.UNPROVEN.value: 2, RunVerdict.SAFE.value: 3}


def campaign_page(campaign: Campaign, made: Made) -> str:
    """HTML of the campaign."""
    solutions = [name for name in dict.fromkeys(sorted(campaign.runs["solution"].to_list())) if name]
    head, named = campaign_headline(campaign.runs, campaign.hazards, campaign.passages)
    # Each run counts once, by the worst of its solutions.
    counts = head_of(run_verdicts(campaign.runs).values()).counts()
    body = [
        tiles((f"runs {name}", str(count), _TONES[name] if count else "") for name, count in counts.items()),
        pairs(_fact_rows(campaign, solutions)),
        section("runs", "Runs", _pages_on_demand(campaign), _runs_table(campaign)),
        *(_solution_section(f"s{index}", name, campaign, len(solutions) > 1) for index, name in enumerate(solutions)),
        architectures_section("architectures", campaign.architectures),
        _map_in_doubt(campaign.derived["map"]),
        _provenance_section(campaign.runs, made),
    ]
    safety = made.config.safety
    data = {
        "origin": None if made.site is None else origin_of(made.site),
        "order": solutions,
        "solutions": {name: _solution_data(name, campaign, made) for name in solutions},
        "levels": [[level, safety.allowed_time_to_detect_s(level)] for level in safety.service_levels],
        "limits": {"failure_limit_m": made.config.hazards.failure_limit_m},
    }
    href = campaign.hrefs.get(named or "", "")
    link_to_run = f'<p class="ways">{link(href, f"Open run {named}")}</p>' if href else ""
    count = count_words(campaign.runs["run_id"].n_unique(), "run")
    heading = (
        verdict_head(head.word, head.worst, head.reasons, head.figures) + link_to_run + f"<h1>Campaign of {count}</h1>"
    )
    foot = ", ".join(campaign.runs["software"].unique().sort().to_list())
    title = f"Campaign · balise: {head.word}"
    return page(title, heading, "\n".join(body), script_json(data), "campaign.js", foot)


def _rows_of_solution(frame: pl.DataFrame, name: str) -> pl.DataFrame:
    """Rows of one solution."""
    return frame.filter(pl.col("solution") == name)


def _fact_rows(campaign: Campaign, solutions: list[str]) -> list[tuple[str, str]]:
    """When, where, with what, by which program."""
    runs = campaign.runs
    begun, ended = runs.select(pl.col("t_start").min(), pl.col("t_end").max()).row(0)
    elements = campaign.pieces["netelement_id"].n_unique()
    balises = campaign.passages["balise_id"].n_unique()
    trains = runs["vehicle"].cast(pl.String).fill_null("not known").value_counts(sort=True)
    rates = runs["gnss_rate_hz"].drop_nulls().unique().sort().to_list()
    once = runs.unique("run_id")
    hours, km = (
        float(once[name].sum() or 0.0) / unit for name, unit in (("duration_s", 3600.0), ("distance_m", 1000.0))
    )
    lines = {
        "Dates": f"{begun:%Y-%m-%d %H:%M} to {ended:%Y-%m-%d %H:%M} UTC" if begun and ended else "not known",
        "Ridden": f"{number(hours)} h, {number(km)} km",
        "Line": f"{count_words(elements, 'net element')}, {count_words(balises, 'balise')} met",
        "Trains (vehicle file)": ", ".join(f"{name} {count}" for name, count in trains.iter_rows()),
        "Receivers": f"{', '.join(solutions)} at {', '.join(number(rate) for rate in rates)} Hz",
        "Files": "the last of all columns of Table 1 has each run's digest of log and site",
    }
    return list(lines.items())


def _runs_table(campaign: Campaign) -> str:
    """HTML of the table of all runs, the worst first."""
    runs = (
        known_counts(campaign.runs)
        .with_columns(
            order=pl.col("verdict").cast(pl.String).replace_strict(_RANK),
            hazards=pl.sum_horizontal(HAZARD_COUNTS, ignore_nulls=False),
        )
        .sort(
            *("order", "unsafe_accepted", "failures_beyond_budget", "share_unknown", "run_id", "solution"),
            descending=[False, True, True, True, False, False],
            nulls_last=True,
        )
    )
    why = _why_words(campaign)

    def digest_cell(row: Row) -> Cell:
        """A digest, shortened."""
        whole = row["input_digest"]
        short = whole[:12]
        return Cell(short, whole, f'<span title="{escape(whole)}">{escape(short)}</span>')

    special = {
        "verdict": lambda row: Cell(word := word_of(row["verdict"]), str(row["order"]), badge(word)),
        "run_id": lambda row: Cell(
            row["run_id"], row["run_id"], link(campaign.hrefs.get(row["run_id"], ""), row["run_id"], data_run="")
        ),
        "balises_found": _accepted_cell,
        "notes": _notes_cell,
        "why": lambda row: Cell(text := why[row["run_id"], row["solution"]], text),
        "status": lambda row: Cell(row["status"], row["status"], badge(f"reading {row['status']}", row["status"])),
        "input_digest": digest_cell,
    }
    caption = "Runs, the worst first"
    return frame_table("table-runs", caption, runs, RUN_COLUMNS, CampaignRuns, special)


def _accepted_cell(row: Row) -> Cell:
    """How many of the balises on the path were accepted."""
    found = row["balises_found"]
    return Cell(UNKNOWN) if found is None else Cell("".join(accepted_words(row)), float(found))


def _notes_cell(row: Row) -> Cell:
    """The notes, folded: some are longer than all around them."""
    notes = notes_apart(row["notes"])
    items = "".join(f"<p>{escape(note)}</p>" for note in notes)
    summary = count_words(len(notes), "note")
    return Cell(summary, float(len(notes)), f"<details><summary>{summary}</summary>{items}</details>" if notes else "")


def _why_words(campaign: Campaign) -> dict[tuple[str, str], str]:
    """What is wrong with each run and solution, in a few words; nothing where it is safe."""
    faults = campaign.hazards.partition_by("run_id", as_dict=True)
    offers = campaign.passages.filter(pl.col("hazard_id").is_not_null()).partition_by("run_id", as_dict=True)
    whys = {}
    for row in campaign.runs.iter_rows(named=True):
        run = (row["run_id"],)
        of_run = faults.get(run, campaign.hazards.clear()), offers.get(run, campaign.passages.clear())
        safe = row["verdict"] == RunVerdict.SAFE
        whys[row["run_id"], row["solution"]] = "" if safe else run_headline([row], *of_run).worst
    return whys


def _solution_section(key: str, name: str, campaign: Campaign, several: bool) -> str:
    """HTML of balises, hazards and figures of one solution."""
    rates, levels, balises = (
        _rows_of_solution(campaign.derived[table], name) for table in ("figures", "detection", "balises")
    )
    statements = "".join(f"<p>{escape(text)}</p>" for text in (*plain_statements(rates), *level_statements(levels)))
    note = "<p>Rates count all that this campaign holds, injected faults included. Bounds: exact, 95 %, two-sided.</p>"
    rows = rates.drop("solution").iter_rows(named=True)
    caption = "All figures of the campaign"
    return section(
        key,
        f"Solution {name}" if several else "Balises, hazards, figures",
        balise_table(f"table-balises-{key}", "Balises over all runs, the worst first", lost_shares(balises)),
        _hazards_table(key, _rows_of_solution(campaign.hazards, name), campaign),
        *(figure(f"{key}-{plot}", heading, explanation) for plot, heading, explanation in plots_of("campaign")),
        statements,
        frame_table(f"table-levels-{key}", ALLOWED, levels, _LEVEL_COLUMNS, CampaignDetection),
        note,
        *(figures_table(f"table-figures-{key}", caption, row, CampaignFigures) for row in rows),
    )


def _pages_on_demand(campaign: Campaign) -> str:
    """How to get the pages that are not there."""
    without = campaign.runs.filter(~pl.col("run_id").is_in(list(campaign.hrefs)))["run_id"].n_unique()
    command = "<code>balise report OUT --run RUN</code> (in a project without OUT)"
    return f"<p>{count_words(without, 'run')} without a page: {command} writes one.</p>" if without else ""


def _hazards_table(key: str, hazards: pl.DataFrame, campaign: Campaign) -> str:
    """HTML of the hazards of one solution, the worst first."""
    special = {
        "run_id": lambda row: hazard_cell(
            row, f"{row['run_id']} {row['hazard_id']}", campaign.hrefs.get(row["run_id"], ""), data_hazard=""
        ),
    }
    ordered = hazards.sort(
        pl.col("accepted_ids").list.len() == 0, "detected", "within_budget", "run_id", "hazard_id", nulls_last=False
    )
    caption = "Hazards of all runs, the worst first"
    return frame_table(f"table-hazards-{key}", caption, ordered, _HAZARD_COLUMNS, Hazards, special)


def _map_in_doubt(places: pl.DataFrame) -> str:
    """Places where several runs raised the same alarm across the track; nothing where there are none."""
    if places.is_empty():
        return ""
    columns = ("netelement_id", "from_m", "to_m", "axis", "runs", "alarms", "solutions", "run_ids")
    note = "<p>Monitors across the track alone failed there in several runs: look at the survey first.</p>"
    shown = frame_table("table-map", "Map in doubt", places, columns, CampaignMap)
    return section("map", "Places where the map is in doubt", note, shown)


def _solution_data(name: str, campaign: Campaign, made: Made) -> Json:
    """What the drawings of one solution show."""
    runs, hazards, passages = (
        _rows_of_solution(frame, name) for frame in (campaign.runs, campaign.hazards, campaign.passages)
    )
    counts = Counter(hazards.select(pl.col("hazard").cast(pl.String), "within_budget").rows())
    return {
        # Within the budget, beyond it, not known.
        "classes": [[kind.value, *(counts[kind.value, held] for held in (True, False, None))] for kind in Hazard],
        "runs": runs.height,
        "runs_with_truth": runs["evidence"].is_in(TRUTH).sum(),
        "hazards": hazards.height,
        "failures": int(runs["failures"].sum()),
        "time_to_detect_s": _sorted_values(hazards.filter(pl.col("detected"))["time_to_detect_s"]),
        "hazardous_s": _sorted_values(failures_table(runs)["hazardous_may_s"]),
        "location": _location_counts(passages),
        "map": availability_map(_rows_of_solution(campaign.pieces, name), hazards, made.site),
    }


def _sorted_values(values: pl.Series) -> list[float]:
    """Known values in order, to the microsecond."""
    return [round(value, 6) for value in values.drop_nulls().sort().to_list()]


def _location_counts(passages: pl.DataFrame) -> Json:
    """Location errors of offers as counts per outcome and bin of 1 m up to 50 m, beyond in the last bins."""
    known = passages.filter(pl.col("location_error_m").is_not_null())
    counts = (
        known.group_by(
            outcome=outcome_of_passage(),
            at=pl.col("location_error_m").floor().clip(-51, 50).cast(pl.Int64),
        )
        .len("count")
        .sort("outcome", "at")
    )
    return [list(row) for row in counts.iter_rows()]


def _provenance_section(runs: pl.DataFrame, made: Made) -> str:
    """HTML of program, configuration and budget."""
    names = ("software", "contract", "config_digest")
    digests = pairs((name, ", ".join(runs[name].unique().sort().to_list())) for name in names)
    level = escape(made.config.hazards.service_level)
    allowed = number(made.config.budget_s, 4)
    budget = f"<p>A wrong position may be in use for {allowed} s (service level {level}).</p>"
    return section("provenance", "Provenance", digests, budget, configuration_html(made))
