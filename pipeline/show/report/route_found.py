"""The path that a run was matched to, as a route file to confirm or correct (CONTRACT section 2)."""

from __future__ import annotations

import base64
from html import escape

import polars as pl

from pipeline.results.places import stretches_of
from pipeline.results.store import file_name
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import link, section
from pipeline.show.report.words import first_names
from pipeline.stages.epochs.clock import least_belief
from schemas.stages import ONE_TRACK_LEFT

_NOTE = (
    "This is the path that the positions were matched to, with how sure it was at the time "
    "(<code>gate_probability</code>, which decides what is used) and in hindsight (<code>path_probability</code>). "
    "Correct it where you know better, and hand it in if you know it to be true: nothing stays ambiguous then "
    "(<code>balise replay --route FILE</code>, in a project <code>route</code> under [replay]). Rival tracks are named "
    "in the notes above and in what <code>--write-route</code> writes. A net element without any position is not in "
    "this list."
)
_TURNED = (
    "The train came back over a net element, and the results do not tell the legs of such a ride apart: "
    "<code>balise replay --write-route DIR</code> (in a project <code>write_route</code> under [replay]) writes it."
)


def found_route(epochs: pl.DataFrame) -> pl.DataFrame | None:
    """Net elements in the order of growing path, from one solution's epochs; None where the train turned over switches.

    `doubtful`: the track was, at the time or in hindsight; the least probabilities of both stand beside it.
    """
    stretches = stretches_of(epochs)
    if stretches.is_empty() or stretches["netelement_id"].n_unique() < stretches.height:
        return None
    of_elements = (
        epochs.filter(pl.col("path_m").is_not_null())
        .group_by("netelement_id")
        .agg(
            pl.col("gate_probability", "path_probability").min(),
            belief=least_belief().min(),
            t_start=pl.col("t").min(),
            t_end=pl.col("t").max(),
        )
    )
    return (
        stretches.join(of_elements, on="netelement_id", how="left")
        .sort("first_m")
        .select(
            "netelement_id",
            pl.when(pl.col("sign") > 0).then(pl.lit("AB")).otherwise(pl.lit("BA")).alias("direction"),
            "gate_probability",
            "path_probability",
            "t_start",
            "t_end",
            doubtful=(pl.col("belief") < ONE_TRACK_LEFT).fill_null(value=True),
        )
    )


def route_section(identity: str, run_id: str, epochs: pl.DataFrame) -> str:
    """The route with its doubtful stretches, and a file of it to take away; nothing without matched positions."""
    if epochs["path_m"].null_count() == epochs.height:
        return ""
    route = found_route(epochs)
    if route is None:
        return section(identity, "Route found", f"<p>{_TURNED}</p>")
    doubtful = route.filter("doubtful")["netelement_id"].to_list()
    doubt = f"In doubt: {first_names(doubtful)}." if doubtful else "No stretch is in doubt."
    href = f"data:text/csv;base64,{base64.b64encode(route.write_csv().encode()).decode()}"
    download = link(href, "route as csv", download=f"{file_name(run_id)}.csv")
    shown = route.select("doubtful", pl.exclude("doubtful"))
    return section(
        identity,
        "Route found",
        f'<p class="notice {"partial" if doubtful else "ok"}">{escape(doubt)} {download}</p>',
        f"<p>{_NOTE}</p>",
        frame_table(f"table-{identity}", "Route found, in the order of the path", shown),
    )
