"""What every use of a recorded run begins with: streams in order, one odometer, each solution on the track."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import field, replace

import polars as pl

from pipeline.stages.clean import CleanCounts
from pipeline.stages.clean.clean import (
    ClockAdvice,
    clean,
    require_one_journey,
    require_two_times,
    without_advice,
    without_undated_streams,
)
from pipeline.stages.evidence import TrainEvidence, evidence_of
from pipeline.stages.evidence.anchors import read_anchors
from pipeline.stages.evidence.gathering import without_frozen, without_latency
from pipeline.stages.follows import NOT_TESTED, Follows, follows_positions
from pipeline.stages.matching import Match, match
from pipeline.stages.odometry import Odometry, counted_over_slip, odometry_of
from pipeline.stages.reference import reference_stretches
from pipeline.stages.track.network import network_in_pieces, site_network
from schemas.config import Configuration, Vehicle, digest_of
from schemas.enums import Remedy, VehicleFigures
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site
from schemas.version import SOFTWARE
from schemas.words import remedy_words


@frozen
class Provenance:
    """The same provenance always gives the same tables; `calibrated_by`: runs that tell of vehicle and noise."""

    config_digest: str
    input_digest: str
    software: str
    calibrated_by: tuple[str, ...] = ()


def provenance(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration) -> Provenance:
    """Which log, site, settings and program results are made of."""
    return Provenance(
        config_digest=digest_of(config, vehicle),
        input_digest=input_digest(run, site.digest),
        software=SOFTWARE,
        calibrated_by=config.calibration.runs,
    )


def input_digest(run: RunLog, site_digest: str) -> str:
    """What the `runs` table calls the input digest: SHA-256 over those of log and site."""
    return hashlib.sha256(f"{run.input_digest}:{site_digest}".encode()).hexdigest()


@frozen
class PreparedRun:
    """`recorded`: in order of time; `run`: without streams of another day. `odometers`: each as it counted, the one of
    the LDS first; `odometry`: that one, by other independent ones where it slips. `follows`: whether the odometer of
    the LDS is made of the positions, by solution.
    """

    recorded: RunLog
    run: RunLog
    site: Site
    vehicle: Vehicle
    config: Configuration
    counts: CleanCounts
    odometers: tuple[Odometry, ...]
    odometry: Odometry | None
    follows: Mapping[str, Follows] = field(default_factory=dict)
    # Made anew with every run, so that `replace` cannot hand on those of another.
    _fixes: dict[str, pl.DataFrame] = field(default_factory=dict, init=False, repr=False, compare=False)

    def fixes(self, solution: str) -> pl.DataFrame:
        """The positions of one solution, checked once; `InputError` unless they are those of one journey."""
        if solution not in self._fixes:
            fixes = self.run.gnss.filter(pl.col("solution") == solution)
            require_two_times(fixes, "gnss", f" of solution {solution!r}")
            require_one_journey(fixes, f"gnss of solution {solution!r}", self.config.ingest)
            # Solutions come one after the other: the last one alone is kept.
            self._fixes.clear()
            self._fixes[solution] = fixes
        return self._fixes[solution]

    def ranges(self, solution: str) -> pl.DataFrame | None:
        """Satellites of one solution, or None."""
        satellites = self.run.satellites
        return None if satellites is None else satellites.filter(pl.col("solution") == solution)

    def match(self, solution: str) -> Match:
        """The solution on the track network; raises `InputError` where it comes near no track."""
        config = self.config
        reads = self.run.balise_reads
        fixes = self.fixes(solution)
        return match(fixes, self.odometry, self.site, self.vehicle, config.matching, config.fix_sigma, reads)

    def evidence(self) -> TrainEvidence:
        """What is known of where the train was; knows of no solution."""
        network = site_network(self.site)
        pieces = network_in_pieces(self.site)
        recorded = without_latency(self.run.reference, self.vehicle.reference_latency_s)
        moving = without_frozen(recorded, self.odometers, self.config.hazards)
        reference = reference_stretches(moving, pieces, network.track.index, self.config)
        reads = without_latency(self.run.balise_reads, self.vehicle.reads_latency_s)
        recorders = [
            read_anchors(reads, self.site.balises, network.track, self.config.hazards),
        ]
        return evidence_of(reference, recorders, self.odometers, network, self.vehicle, self.config)

    def follows_of(self, solution: str) -> Follows:
        """Whether the odometer of the LDS is made of the positions of this solution."""
        return self.follows.get(solution, NOT_TESTED)

    @property
    def provenance(self) -> Provenance:
        """Which inputs and settings the results are made of."""
        return provenance(self.run, self.site, self.vehicle, self.config)

    @property
    def figures_from(self) -> VehicleFigures:
        """Origin of scale and latency, for people (DOMAIN section 5.4)."""
        if self.odometry is None:
            return VehicleFigures.NONE
        in_file = self.vehicle.odometer_scale is not None and self.vehicle.gnss_latency_s is not None
        return VehicleFigures.FILE if in_file else VehicleFigures.LEARNED


def prepare(
    run: RunLog, site: Site, vehicle: Vehicle, config: Configuration, clock_advice: ClockAdvice = without_advice
) -> PreparedRun:
    """Put the streams of a run in order, make its odometers, and test whether they are made of the positions.

    Args:
        run: the run as recorded.
        site: track, links, balises and route.
        vehicle: what is known of the vehicle.
        config: the configuration.
        clock_advice: what would move recorders of different times to one journey, for the error's remedy.

    Returns:
        The run in order, with its odometers; solutions are matched when asked for.

    Raises:
        InputError: nothing can be replayed: no two times, none in common, longer than a journey.
    """
    recorded, counts = clean(run, config, clock_advice)
    journey = without_undated_streams(recorded)
    sensors = () if journey.odometer is None else (journey.odometer, *journey.other_odometers)
    found = [_test_following(sensor, journey, config) for sensor in sensors]
    odometers = tuple(
        # Scale, latency and origin of the vehicle file are of the odometer that the LDS uses.
        replace(odometer, follows_gnss=any(one.found(config.evidence) for one in found[number].values()))
        for number, sensor in enumerate(sensors)
        if (odometer := odometry_of(sensor, Vehicle() if number else vehicle, config)) is not None
    )
    used = odometers[0] if odometers and sensors[0].height >= 2 else None
    # Another one takes part in what the LDS uses only where it is free of the positions.
    others = [odometer for odometer in odometers[1:] if odometer.independent]
    counted = (
        None if used is None else counted_over_slip(used, others, config.matching.orientation_distance_m, config.align)
    )
    follows = found[0] if found else {}
    return PreparedRun(recorded, journey, site, vehicle, config, counts, odometers, counted, follows)


def _test_following(sensor: pl.DataFrame, run: RunLog, config: Configuration) -> dict[str, Follows]:
    """Whether one odometer is made of the positions, by the name of the solution."""
    return {
        str(name): follows_positions(sensor, fixes, config)
        for (name,), fixes in run.gnss.partition_by("solution", as_dict=True).items()
    }


def require_independent_odometer(prepared: PreparedRun) -> None:
    """Refuse a run that would be measured against positions (DOMAIN section 5.0)."""
    odometry = prepared.odometry
    if odometry is not None and odometry.independent:
        return
    raise InputError(
        "has no odometer that is declared to be free of the GNSS",
        place=f"{prepared.run.run_id}: odometer, column origin",
        found="no odometer" if odometry is None else _origin_words(odometry),
        expected="origin wheel, radar or inertial",
        remedy=remedy_words(Remedy.ODOMETER if odometry is None or odometry.of_gnss else Remedy.ODOMETER_ORIGIN),
    )


def _origin_words(odometry: Odometry) -> str:
    """Where the odometry comes from, for people."""
    follows = ", but it follows the positions" if odometry.follows_gnss else ""
    return f"{odometry.origin}{follows}"
