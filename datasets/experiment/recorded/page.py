"""The experiment as pictures and one offline page: what it says, what it does not prove, pictures and tables.

Pmd over T_dsf (DIAG Fig. 5), T_D over the rate, the line by how much it hides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from math import log10

import polars as pl

from datasets.experiment.figures import pmd_plot
from datasets.experiment.recorded.plan import RecordedPlan
from datasets.faults import FaultKind
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import page, script_json, section
from pipeline.show.svg_plot import COLOURS, Axis, Curve, Piece, plot, strips_svg
from schemas.enums import OwnError
from schemas.experiment import ExperimentBanks, ExperimentCells, ExperimentPlaces, ExperimentRuns
from schemas.version import SOFTWARE

_DETECT_S = (0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0)
_TARGETS = {"along": "along the track", "cross": "across the track", "satellite": "in one satellite's range"}
UNNOTICED_M = (2.0, 5.0, 10.0, 20.0)
SLOWNESS = (0.8, 1.0, 1.25, 2.0)
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


def draw_pictures(tables: dict[str, pl.DataFrame]) -> dict[str, tuple[str, str]]:
    """Title and SVG by name of the file, without its ending."""
    ramps = pl.col("kind") == FaultKind.RAMP.value
    drawn: dict[str, tuple[str, str]] = {}
    for (bank,), pmd in tables["pmd"].filter(ramps).group_by("bank", maintain_order=True):
        for (target,), part in pmd.group_by("target", maintain_order=True):
            title = f"Pmd over the time since failure: ramps, {_TARGETS.get(str(target), target)}, {bank}"
            drawn[f"pmd_{bank}_{target}"] = title, _pmd_svg(title, part)
    for (target,), part in (
        tables["cells"].filter(ramps, pl.col("injections") > 0).group_by("target", maintain_order=True)
    ):
        title = f"T_D over the rate: ramps, {_TARGETS.get(str(target), target)}"
        drawn[f"time_to_detect_{target}"] = title, _detection_svg(title, part)
    for (bank,), places in tables["places"].group_by("bank", maintain_order=True):
        title = f"The line: largest unnoticed error (upper lane) and slowness of detection (lower lane), {bank}"
        drawn[f"line_{bank}"] = title, _line_svg(title, places)
    return drawn


def _pmd_svg(title: str, pmd: pl.DataFrame) -> str:
    """Pmd over the time since failure, a curve per amount."""
    rates = sorted(pmd["amount"].abs().unique().to_list())
    curves = [
        Curve(
            name=f"{amount:g} {part['unit'][0]}",
            points=list(part.select("time_since_failure_s", "pmd").iter_rows()),
            colour=COLOURS[rates.index(abs(float(amount))) % len(COLOURS)],
            dashed=float(amount) < 0.0,
            band=list(part.select("pmd_low", "pmd_high").iter_rows()),
        )
        for (amount,), part in pmd.group_by("amount", maintain_order=True)
    ]
    return pmd_plot(title, curves)


def _detection_svg(title: str, cells: pl.DataFrame) -> str:
    """Time to detect over the rate."""
    curves = list(_detection_curves(cells))
    rates = cells["amount"].abs().unique().sort().to_list()
    longest_s = float(cells["watched_s"].max())  # type: ignore[arg-type]
    ticks = [tick for tick in _DETECT_S if tick <= longest_s]
    across = Axis("rate [m/s]", rates[0] / 1.5, rates[-1] * 1.5, rates, log10)
    up = Axis("T_D [s]: median and bounds; △ not noticed in the watch", 0.05, 2.0 * longest_s, ticks, log10)
    return plot(title, across, up, curves)


def _detection_curves(cells: pl.DataFrame) -> Iterator[Curve]:
    """A line per bank and direction through the medians; where half went unnoticed, a triangle at the watch's end."""
    groups = cells.with_columns(rate=pl.col("amount").abs()).sort("rate", maintain_order=True)
    banks = groups["bank"].unique(maintain_order=True).sort().to_list()
    for (bank, direction), part in groups.group_by("bank", "direction", maintain_order=True):
        known = part.drop_nulls("time_to_detect_median_s")
        low, high = (pl.col(f"time_to_detect_median_{side}_s") for side in ("low", "high"))
        band = known.select(low.fill_null(0.05), high.fill_null(pl.col("watched_s")))
        unnoticed = part.filter(pl.col("time_to_detect_median_s").is_null())
        yield Curve(
            name=f"{bank}, {direction}",
            # An epoch at which the fault is noticed at once has no place on a logarithmic axis.
            points=[
                (rate, max(time_s, 0.05))
                for rate, time_s in known.select("rate", "time_to_detect_median_s").iter_rows()
            ],
            colour=COLOURS[banks.index(bank) % len(COLOURS)],
            dashed=float(part["amount"][0]) < 0.0,
            band=[(max(lowest, 0.05), highest) for lowest, highest in band.iter_rows()],
            marks=list(unnoticed.select("rate", "watched_s").iter_rows()),
        )


def _line_svg(title: str, places: pl.DataFrame) -> str:
    """A strip of two lanes per net element."""
    rows: dict[str, list[Piece]] = {}
    for row in places.iter_rows(named=True):
        slow = "not known" if row["slowness"] is None else f"{row['slowness']:.2f}"
        words = (
            f"{row['from_m']:.0f} to {row['to_m']:.0f} m: {row['injections']} faults, {row['noticed']} noticed; "
            f"up to {row['unnoticed_max_m']:.1f} m unnoticed; slowness {slow}"
        )
        piece = Piece(row["from_m"], row["to_m"], (row["unnoticed_max_m"], row["slowness"]), words)
        rows.setdefault(row["netelement_id"], []).append(piece)
    return strips_svg(title, rows, {"unnoticed [m]": UNNOTICED_M, "slowness": SLOWNESS})


def recorded_page(tables: Mapping[str, pl.DataFrame], drawn: Mapping[str, tuple[str, str]], plan: RecordedPlan) -> str:
    """The page of the tables, with the pictures in it."""
    places = tables["places"].sort("bank", "slowness", descending=[False, True], nulls_last=True, maintain_order=True)
    cells = tables["cells"]
    body = "\n".join(
        [
            section("limits", "What this does not prove", _html_list(remarks_on(tables))),
            section("pictures", "Pictures", *(_figure_html(name, *picture) for name, picture in drawn.items())),
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


def _html_list(texts: list[str]) -> str:
    """Sentences as a list of HTML."""
    return f'<ul class="notice">{"".join(f"<li>{escape(text)}</li>" for text in texts)}</ul>'


def _figure_html(name: str, title: str, drawing: str) -> str:
    """A picture with its title."""
    return f'<figure id="{escape(name)}"><figcaption><h3>{escape(title)}</h3></figcaption>{drawing}</figure>'
