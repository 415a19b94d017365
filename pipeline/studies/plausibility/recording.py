"""A run as the records that are compared: one solution, the other streams, the survey and the vehicle file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.studies.plausibility.pairs import PairFit, fit_pair
from pipeline.studies.plausibility.records import Places, Record, counters_of, places_of, seconds_since
from pipeline.studies.plausibility.shifts import SurveyLine, line_of
from pipeline.studies.plausibility.velocity import VelocityFit, fit_velocity
from schemas.arrays import Floats, times_ns
from schemas.config import PlausibilityConfig, Vehicle
from schemas.run import RunLog, Site


@dataclass(frozen=True)
class Recording:
    """One solution of a cleaned run, its fixes and places, and whatever it meets; each comparison is made once."""

    run: RunLog
    solution: str
    config: PlausibilityConfig
    vehicle: Vehicle
    site: Site | None
    fixes: pl.DataFrame
    gnss: Places

    @property
    def epoch_ns(self) -> int:
        """The instant from which all records count."""
        return int(times_ns(self.run.gnss)[0])

    @cached_property
    def line(self) -> SurveyLine | None:
        return None if self.site is None else line_of(self.site)

    @cached_property
    def reference(self) -> Places | None:
        """Places of the reference; None where there are hardly any."""
        frame = self.run.reference
        return None if frame is None or frame.is_empty() else places_of(frame, self.epoch_ns)

    @cached_property
    def counters(self) -> dict[str, Record]:
        """Distance and speed of the odometer."""
        return {} if self.run.odometer is None else counters_of(self.run.odometer, self.epoch_ns)

    @cached_property
    def pairs(self) -> dict[str, PairFit]:
        """Each counter against the positions."""
        return {name: fit_pair(self.gnss, counter) for name, counter in self.counters.items()}

    def by_reference(self, name: str) -> PairFit:
        """A counter against the reference, which no drift of the GNSS is in."""
        return fit_pair(self.reference, self.counters[name]) if self.reference else PairFit(reason="no reference")

    @cached_property
    def velocity(self) -> VelocityFit | None:
        return fit_velocity(self.fixes, self.gnss, self.epoch_ns)

    def seconds(self, frame: pl.DataFrame) -> Floats:
        return seconds_since(self.epoch_ns, frame)

    def placed(self, latitude_deg: Floats, longitude_deg: Floats) -> Recording | None:
        """The same run with its fixes at other places; None where they are none on earth."""
        if not np.nanmax(np.abs(latitude_deg)) <= 90.0:
            return None
        fixes = self.fixes.with_columns(latitude_deg=pl.Series(latitude_deg), longitude_deg=pl.Series(longitude_deg))
        gnss = places_of(fixes, self.epoch_ns)
        return None if gnss is None else replace(self, fixes=fixes, gnss=gnss)


def recording_of(
    run: RunLog, solution: str, config: PlausibilityConfig, vehicle: Vehicle, site: Site | None
) -> Recording | None:
    """None where hardly any position is valid."""
    fixes = run.gnss.filter(pl.col("solution") == solution)
    gnss = places_of(fixes, int(times_ns(run.gnss)[0]))
    return None if gnss is None else Recording(run, solution, config, vehicle, site, fixes, gnss)
