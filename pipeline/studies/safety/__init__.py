"""Safety figures: the published budget, recalculated, and what a campaign measured against it.

In: the configuration's `[safety]`, and the tables of a result. Out: tables, figures with bounds, sentences.
Touches a result to read it. It counts what the judge has said and judges no position.
"""

from __future__ import annotations

import polars as pl

from pipeline.studies.safety.architectures import architectures_table, continuity_table, fail_safety_table
from pipeline.studies.safety.budget import (
    allocation_table,
    allowed_table,
    demands_table,
    published_table,
    substantiation_table,
    tolerable_table,
)
from pipeline.studies.safety.markov import markov_table
from schemas.config import SafetyConfig

__all__ = ["safety_tables"]


def safety_tables(config: SafetyConfig) -> dict[str, pl.DataFrame]:
    """Every table of the safety budget by name, in the order in which one builds on the other.

    Args:
        config: the section `safety` of the configuration.

    Returns:
        Tables by name.

    Source:
        DIAG, TVB and LOC, as the table `errata` cites them.
    """
    return {
        "allocation": allocation_table(config),
        "allowed_time_to_detect": allowed_table(config),
        "tolerable_gnss_rate": tolerable_table(config),
        "demands": demands_table(config),
        "markov": markov_table(config),
        "architectures": architectures_table(config),
        "fail_safety": fail_safety_table(config),
        "continuity": continuity_table(),
        "substantiation": substantiation_table(config),
        # What is printed wrongly (`misprint`), lost or left open in the papers, and what stands here instead.
        "errata": published_table("errata"),
    }
