"""A run as the records that are compared: one solution, the other streams, the survey and the vehicle file."""

from __future__ import annotations

from functools import cached_property

import polars as pl

from pipeline.studies.plausibility.pairs import PairFit, fit_pair
from pipeline.studies.plausibility.records import Places, Record, counters_of, places_of, seconds_since
from pipeline.studies.plausibility.shifts import SurveyLine, line_of
from schemas.arrays import Floats, times_ns
from schemas.config import PlausibilityConfig, Vehicle
from schemas.frozen import frozen
from schemas.run import RunLog, Site


@frozen
class Recording:
    """One solution of a cleaned run, its fixes and places, and whatever it is compared with; each comparison is
    made once.
    """

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
        """The survey; None without a site."""
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
        """How each counter fits the positions, by its name."""
        return {name: fit_pair(self.gnss, counter) for name, counter in self.counters.items()}

    def seconds(self, frame: pl.DataFrame) -> Floats:
        """Times of a stream since the epoch of all records [s]."""
        return seconds_since(self.epoch_ns, frame)


def recording_of(
    run: RunLog, solution: str, config: PlausibilityConfig, vehicle: Vehicle, site: Site | None
) -> Recording | None:
    """The records of one solution; None where hardly any position is valid."""
    fixes = run.gnss.filter(pl.col("solution") == solution)
    gnss = places_of(fixes, int(times_ns(run.gnss)[0]))
    return None if gnss is None else Recording(run, solution, config, vehicle, site, fixes, gnss)
