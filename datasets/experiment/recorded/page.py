"""The experiment as one offline page: what it says, what it does not prove, pictures and tables."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import polars as pl

from datasets.experiment.recorded.plan import RecordedPlan
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import page, script_json, section
from schemas.enums import OwnError
from schemas.experiment import ExperimentBanks, ExperimentCells, ExperimentPlaces, ExperimentRuns
from schemas.version import SOFTWARE

_CELL_COLUMNS = (
    *("bank", "cell", "injections", "passes", "noticed_share", "time_to_detect_median_s", "time_to_detect_p95_s"),
    *("failures", "pmd_at_failure", "stopped", "noticed_not_stopped", "accepted_wrong", "hazardous_max_s"),
    *("unnoticed_max_m", "in_use_max_m", "tvb_lost_median_s", "reason"),
)
_LIMITS = (
    "Only the faults of the plan were put in. A fault of another shape, or one that a receiver's own filter would have "
    "smoothed, may be noticed later.",
    "Velocity, protection levels and confidence stay as recorded, but for faults in ranges.",
    "Bounds count passes that share no time. They know nothing of other days, weather, skies or trains.",
    "The path is found in hindsight from what was recorded up to the end of the watch.",
)


def recorded_page(tables: Mapping[str, pl.DataFrame], drawn: Mapping[str, tuple[str, str]], plan: RecordedPlan) -> str:
    """The page of the tables, with the pictures in it."""
    places = tables["places"].sort("bank", "slowness", descending=[False, True], nulls_last=True, maintain_order=True)
    cells = tables["cells"]
    body = "\n".join(
        [
            section("limits", "What this does not prove", _list(remarks_on(tables))),
            section("pictures", "Pictures", *(_figure(name, *picture) for name, picture in drawn.items())),
            section(
                "banks",
                "Banks",
                frame_table("t-banks", "Detection against false alarms", tables["banks"], contract=ExperimentBanks),
            ),
            section("cells", "Cells", frame_table("t-cells", "Faults", cells, _CELL_COLUMNS, ExperimentCells)),
            section("places", "Places", frame_table("t-places", "Slowest first", places, contract=ExperimentPlaces)),
            section(
                "runs",
                "Runs",
                frame_table("t-runs", "What was used and left out", tables["runs"], contract=ExperimentRuns),
            ),
        ]
    )
    count = tables["injections"].height
    heading = f"<h1>Faults in recorded runs</h1><p>{count} injections, seed {plan.seed}.</p>"
    return page("Faults in recorded runs", heading, body, script_json({}), "line.js", SOFTWARE)


def remarks_on(tables: Mapping[str, pl.DataFrame]) -> list[str]:
    """The limits that hold always, and those of these runs."""
    runs = tables["runs"]
    remarks = list(_LIMITS)
    assumed = runs.filter(own_error=OwnError.ASSUMED.value)["run_id"].to_list()
    if assumed:
        names = ", ".join(assumed)
        remarks.insert(0, f"No evidence of where the train was, recorded positions taken to be right: {names}.")
    return remarks


def _list(texts: list[str]) -> str:
    return f'<ul class="notice">{"".join(f"<li>{escape(text)}</li>" for text in texts)}</ul>'


def _figure(name: str, title: str, drawing: str) -> str:
    return f'<figure id="{escape(name)}"><figcaption><h3>{escape(title)}</h3></figcaption>{drawing}</figure>'
