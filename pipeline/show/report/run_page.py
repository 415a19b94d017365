"""The page of one run: the verdict and why, what happened, where, when, and what the replay made of it."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any
from urllib.parse import quote

import polars as pl

from pipeline.results.figures.campaign_tables import campaign_balises, with_truth
from pipeline.results.figures.head import known_counts
from pipeline.results.places import origin_of
from pipeline.show.report.balises import architectures_section, balise_table, lost_shares, outcome_of_passage
from pipeline.show.report.columns import Row, figures_table, frame_table
from pipeline.show.report.ground import plan_data
from pipeline.show.report.headline import FILES, fact_rows, file_table, run_headline, tile_figures
from pipeline.show.report.markup import (
    Cell,
    Json,
    figure,
    link,
    page,
    pairs,
    script_json,
    section,
    tiles,
    verdict_head,
)
from pipeline.show.report.route_found import route_section
from pipeline.show.report.series import MOMENTS, moments_of, monitor_lines, stanford_data, time_data
from pipeline.show.report.words import WORDS, plots_of
from pipeline.stages.run_row.run_figures import LEVEL_LISTS
from schemas.campaign import CampaignLevels
from schemas.config import Configuration
from schemas.enums import TRUTH
from schemas.frozen import frozen
from schemas.run import RunTables, Site
from schemas.tables import Alarms, Hazards, Passages, Runs
from schemas.words import JUDGES, notes_apart

# The first ten are shown, the others behind a switch.
_HAZARDS = (
    *("hazard_id", "accepted_ids", "within_budget", "monitor", "time_to_detect_s", "hazardous_s", "size_m", "timing"),
    *("balise_ids", "t_onset", "t_failure", "t_detected", "time_since_failure_s", "hazardous_may_s", "budget_s"),
    *("failure_mode", "rate_mps", "suspect", "evidence", "speed_mps", "caused_by"),
)
_PASSAGES = (
    *("balise_id", "judgement", "status", "location_error_m", "confidence_m", "t_offered", "kind", "linking_error"),
    *("cause", "hazard_id", "t_true", "direction", "location_accuracy_m", "speed_mps"),
    *("window_open_m", "odometer_distance_m", "window_close_m", "reaction", "failure_mode", "suspect_after_the_fact"),
)
_ALARMS = (
    *("t_start", "t_end", "verdict", "monitors", "peak_ratio", "suspect", "hazard_id", "netelement_id", "measure_m"),
)
ALLOWED = "Wrong positions in use against the allowed T_D (TVB eq. 7)"
_KEYS = "Keys: n p next and previous hazard, + - 0 zoom, ← → time, [ ] previous and next run"


@frozen
class Made:
    """What stands on every page: limits, and the configuration as it was resolved."""

    config: Configuration
    config_text: str | None
    site: Site | None


@frozen
class Neighbours:
    """The runs before and after in the campaign, each with its page; None at the ends."""

    before: tuple[str, str] | None = None
    after: tuple[str, str] | None = None


def run_page(
    tables: RunTables,
    metadata: Mapping[str, str],
    made: Made,
    architectures: pl.DataFrame,
    neighbours: Neighbours,
) -> str:
    """HTML of one run with all its solutions; one is shown at a time, all of them are in the page.

    `architectures`: the run's solutions side by side, no rows where there is but one.
    """
    rows = list(tables.runs.iter_rows(named=True))
    names = [row["solution"] for row in rows if row["solution"]]
    parts = [_solution_sections(f"s{number}", row, tables, made, len(rows) > 1) for number, row in enumerate(rows)]
    side_by_side = architectures_section("architectures", architectures)
    about = pairs(fact_rows(rows, tables, metadata))
    digests = pairs(sorted((name, value) for name, value in metadata.items() if not name.endswith(FILES)))
    provenance = section("provenance", "Provenance", file_table(metadata), digests, configuration_html(made))
    body = "\n".join([about, _contents_html(names), *parts, side_by_side, provenance])
    hazards = made.config.hazards
    data = {
        "run": tables.run_id,
        "origin": None if made.site is None else origin_of(made.site),
        "monitors": monitor_lines(),
        "limits": {
            "ci_limit_m": made.config.lds.ci_limit_m,
            "failure_limit_m": hazards.failure_limit_m,
            "shift_limit_m": hazards.shift_limit_m,
            "budget_s": made.config.budget_s,
        },
        "order": [row["solution"] for row in rows],
        "solutions": {name: _solution_data(name, tables, made) for name in names},
    }
    head = run_headline(rows, tables.hazards, tables.passages)
    verdict = verdict_head(head.word, head.worst, head.reasons, head.figures)
    links = _navigation_html(neighbours)
    heading = f"{verdict}{links}<h1>Run {escape(tables.run_id)}</h1>"
    foot = f"{rows[0]['software']}, log and site {rows[0]['input_digest'][:12]}"
    return page(f"{tables.run_id} · balise: {head.word}", heading, body, script_json(data), "run.js", foot)


def _navigation_html(neighbours: Neighbours) -> str:
    """Links to the campaign, and to the runs next to this one."""
    links = [link("../index.html", "Campaign", data_go="campaign")]
    for go, words, neighbour in (("previous", "← run", neighbours.before), ("next", "run →", neighbours.after)):
        if neighbour is not None:
            links.append(link(neighbour[1], f"{words} {neighbour[0]}", data_go=go))
    return f'<p class="ways">{" · ".join(links)}</p>'


def _solution_data(name: str, tables: RunTables, made: Made) -> Json:
    """What the drawings of one solution show."""
    epochs, passages, hazards, alarms = (
        frame.filter(pl.col("solution") == name)
        for frame in (tables.epochs, tables.passages, tables.hazards, tables.alarms)
    )
    moments_ns = moments_of(hazards, alarms)
    return {
        "time": time_data(epochs, moments_ns, made.config.align.gap_reset_s),
        "plan": plan_data(epochs, passages, made.site, moments_ns),
        "stanford": stanford_data(epochs, made.config.lds.ci_limit_m),
        "hazards": [
            {"id": row["hazard_id"], "class": row["hazard"], **{name: _as_milliseconds(row[name]) for name in MOMENTS}}
            for row in hazards.iter_rows(named=True)
        ],
        "passages": [
            _passage_data(row) for row in passages.with_columns(outcome=outcome_of_passage()).iter_rows(named=True)
        ],
    }


def _passage_data(row: Row) -> Json:
    """A passage as the drawings take it."""
    return {
        "id": row["balise_id"],
        "outcome": row["outcome"],
        "status": WORDS[row["status"]],
        "t_ms": _as_milliseconds(row["t_offered"] or row["t_true"]),
        "path_m": row["path_m"],
        "error_m": row["location_error_m"],
        "open_m": row["window_open_m"],
        "close_m": row["window_close_m"],
        "odometer_m": row["odometer_distance_m"],
    }


def hazard_cell(row: Row, title: str, page_href: str = "", **attributes: str) -> Cell:
    """A link that zooms a run's page to a hazard; one that no monitor found stands out."""
    href = f"{page_href}#s={quote(row['solution'], safe='')}&h={row['hazard_id']}"
    return Cell(title, title, link(href, title, **attributes), "" if row["detected"] else "bad")


def _as_milliseconds(value: Any) -> float | None:
    """An instant as the page's scripts take it."""
    return None if value is None else round(value.timestamp() * 1000.0, 3)


def _contents_html(names: list[str]) -> str:
    """HTML of the contents of a page, with the choice of solution and the tools of the drawings."""
    buttons = "".join(
        f'<button type="button" data-solution="{escape(name)}" aria-pressed="false">{escape(name)}</button>'
        for name in names
    )
    chooser = f'<div role="group" aria-label="Solution">{buttons}</div>' if len(names) > 1 else ""
    moves = (
        ("back", "← earlier", "←"), ("forward", "later →", "→"), ("in", "zoom in", "+"), ("out", "zoom out", "-"),
        ("all", "whole run", "0"), ("previous", "previous hazard", "p"), ("next", "next hazard", "n"),
    )  # fmt: skip
    tools = "".join(
        f'<button type="button" data-move="{move}" title="key {key}">{text}</button>' for move, text, key in moves
    )
    if not names:
        return ""
    return (
        f'<nav class="tools" aria-label="Time axis">{chooser}<div role="group" aria-label="Zoom">{tools}</div>'
        f'<p id="window" aria-live="polite"></p><p class="keys">{_KEYS}</p></nav>'
    )


def _solution_sections(key: str, row: Row, tables: RunTables, made: Made, several: bool) -> str:
    """All sections of one solution; of one that failed what reading and matching found out."""
    name = row["solution"]
    texts = [text for text in (row["error"], *notes_apart(row["notes"])) if text]
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    notes = f'<ul class="notice {row["status"]}">{items}</ul>' if items else ""
    if not name:
        return notes
    of_solution = pl.col("solution") == name
    hazards, passages, alarms, epochs, runs = (
        frame.filter(of_solution)
        for frame in (tables.hazards, tables.passages, tables.alarms, tables.epochs, tables.runs)
    )
    known = known_counts(runs).row(0, named=True)
    named = (frame.with_columns(run_id=pl.lit(tables.run_id)) for frame in (passages, runs))
    balises = lost_shares(campaign_balises(with_truth(*named)))
    levels = pl.DataFrame({name: row[column] or [] for name, column in LEVEL_LISTS.items()})

    def section_of_solution(part_name: str, title: str, *content: str) -> str:
        """A section of this solution."""
        return section(f"{part_name}-{key}", title, *content)

    def table_of_solution(part_name: str, caption: str, frame: pl.DataFrame, *given: Any) -> str:
        """A table of this solution."""
        return frame_table(f"table-{part_name}-{key}", caption, frame, *given)

    in_order = "Passages of balises, in order of time"
    shown = tiles(tile_figures(known, balises))
    parts = [
        section_of_solution("figures", f"Summary of {name}" if several else "Summary", shown, notes),
        section_of_solution("hazards", "Hazards", _hazards_html(key, row, hazards)),
        section_of_solution(
            "balises", "Balises", balise_table(f"table-balises-{key}", "Balises, the worst first", balises)
        ),
        section_of_solution(
            "drawings", "Drawings", *(figure(f"{key}-{plot}", *text) for plot, *text in plots_of("run"))
        ),
        section_of_solution(
            "passages",
            "Passages",
            table_of_solution("passages", in_order, passages, _PASSAGES, Passages, {"status": _status_cell}),
        ),
        section_of_solution(
            "levels", "Service levels", table_of_solution("levels", ALLOWED, levels, (), CampaignLevels)
        ),
        section_of_solution("alarms", "Alarms", table_of_solution("alarms", "Alarm episodes", alarms, _ALARMS, Alarms)),
        route_section(f"route-{key}", tables.run_id, epochs),
        section_of_solution(
            "all", "All figures", figures_table(f"table-all-{key}", "All figures of the run", known, Runs)
        ),
    ]
    return f'<div class="solution" id="{key}" data-solution="{escape(name)}">' + "\n".join(parts) + "</div>"


def _status_cell(row: Row) -> Cell:
    """The status of a passage as a cell."""
    word = WORDS[row["status"]]
    return Cell(word, word, tone="" if row["status"] == "accepted" else "lost")


def _hazards_html(key: str, run: Row, hazards: pl.DataFrame) -> str:
    """HTML of the hazards of a run, or what it means that there are none."""
    if hazards.height:
        caption = "Hazards; a link zooms every drawing to its hazard"
        return frame_table(f"table-hazards-{key}", caption, hazards, _HAZARDS, Hazards, {"hazard_id": _hazard_link})
    if run["evidence"] is None:
        return '<p class="notice partial">No hazard was found, but there was nothing to judge the positions by.</p>'
    if run["evidence"] not in TRUTH:
        return (
            '<p class="notice partial">No hazard was found, but the odometer alone can only show that a position'
            " was wrong, never that it was right.</p>"
        )
    share = run["share_unknown"]
    left = "no position was in use" if share is None else f"{share:.1%} of the moving time in use could not be checked"
    return f'<p class="none">No hazard was found, judged by {JUDGES[run["evidence"]]}; {left}.</p>'


def _hazard_link(row: Row) -> Cell:
    """A link to a hazard in the drawings."""
    return hazard_cell(row, f"{row['hazard_id']} {row['hazard']}", data_hazard=str(row["hazard_id"]))


def configuration_html(made: Made) -> str:
    """The resolved configuration, folded."""
    if made.config_text is None:
        return '<p class="notice partial">The result holds no config.toml: limits are the defaults.</p>'
    text = f'<pre tabindex="0">{escape(made.config_text)}</pre>'
    return f"<details><summary>Configuration as it was used (TOML)</summary>{text}</details>"
