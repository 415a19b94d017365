"""The route that a run was found to have taken, for a person to confirm or correct."""

from __future__ import annotations

import polars as pl

from pipeline.ingest.clean import clean
from pipeline.matching import match
from pipeline.matching.found_route import found_route
from pipeline.odometry import odometry_of
from schemas.config import Configuration, Vehicle
from schemas.run import RunLog, Site

_FIRST = "primary"


def found_route_of(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """The route by the run's `primary` solution, or the first by name: all of them were on the same train."""
    cleaned, _ = clean(run, config.ingest)
    solutions = cleaned.solutions()
    chosen = _FIRST if _FIRST in solutions else solutions[0]
    fixes = cleaned.gnss.filter(pl.col("solution") == chosen)
    odometry = odometry_of(cleaned.odometer, vehicle, config)
    found = match(fixes, odometry, site, vehicle, config.matching, config.fix_sigma, cleaned.balise_reads)
    return found_route(found, config.matching.ambiguity_probability)
