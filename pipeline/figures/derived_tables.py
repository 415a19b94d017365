"""The tables of `OUT/campaign/`, all of them, from those of the runs."""

from __future__ import annotations

import polars as pl

from pipeline.figures.campaign_figures import detection_by_level, measured_figures
from pipeline.figures.campaign_tables import (
    campaign_accuracy,
    campaign_balises,
    campaign_levels,
    campaign_runs,
    with_truth,
)
from pipeline.figures.map_errors import map_places
from schemas.config import Configuration


def derived_tables(
    runs: pl.DataFrame, hazards: pl.DataFrame, passages: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> dict[str, pl.DataFrame]:
    """By the name of their file, as in `schemas.campaign`; rows of all runs with their `run_id`, in any order."""
    told = with_truth(passages, runs)
    return {
        "runs": campaign_runs(runs, hazards, config),
        "balises": campaign_balises(told),
        "accuracy": campaign_accuracy(told, config),
        "figures": measured_figures(runs, hazards, config.safety),
        "detection": detection_by_level(runs, hazards, config.safety),
        "levels": campaign_levels(runs, config),
        "map": map_places(alarms, config.hazards.map_reach_m),
    }
