"""One solution as the train saw it: aligned with the odometer, monitored, with balises detected by the LDS.

Nothing here knows of the truth, but for one case: without an odometer the direction of travel is the evidence's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.alignment.align import alignment, odometer_at
from pipeline.stages.epochs.verdicts import MonitoredEpochs, Verdicts
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.epochs import direction_by_evidence
from pipeline.stages.judge.judgement import Solution
from pipeline.stages.lds.run import LdsResult, run_lds
from pipeline.stages.matching import Match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.monitors.single import NO_OTHER_SOLUTION, WITHOUT_MEMORY, MonitorInput, on_path_of
from pipeline.stages.odometry import Odometry
from pipeline.stages.prepare import PreparedRun
from schemas.arrays import times_ns
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.monitors import ALL_MONITORS
from schemas.stages import AlignedEpochs

_AGAINST_ODOMETER = tuple(monitor.name for monitor in ALL_MONITORS if monitor.against_odometer)


@frozen
class MonitoredSolution:
    """What the train made of one solution; `odometry` grows with its path.

    `other`: the solution of the channel monitor, on this one's path; `singles`: monitors without memory, by name.
    """

    prepared: PreparedRun
    solution: Solution
    match: Match
    aligned: AlignedEpochs
    odometry: Odometry | None
    other: pl.DataFrame | None
    singles: Mapping[str, Verdicts]
    bank: MonitorBank
    lds: LdsResult

    def at_the_end(self) -> dict[str, float | None]:
        """Latency and odometer scale at the last epoch, as columns of `runs`."""
        last = {
            "latency_s": self.aligned.latency_s[-1],
            "latency_sigma_s": self.aligned.latency_sigma_s[-1],
            "odometer_scale": self.aligned.odometer_scale[-1],
            "odometer_scale_sigma": self.aligned.scale_sigma[-1],
        }
        return {name: None if np.isnan(value) else float(value) for name, value in last.items()}


def monitor_solution(
    prepared: PreparedRun, solution: str, matches: Mapping[str, Match], evidence: TrainEvidence
) -> MonitoredSolution:
    """Align one matched solution with the odometer, monitor it, detect balises.

    Args:
        prepared: the run, its site and its odometer.
        solution: the name of the solution.
        matches: paths of this solution, and of the one that the channel monitor compares it with.
        evidence: where the train was; used for the direction of travel alone, and only without an odometer.

    Returns:
        All that the train made of the solution.

    Source:
        DOMAIN sections 3 and 4.
    """
    config = prepared.config
    matched = matches[solution]
    odometry = None if prepared.odometry is None else prepared.odometry.growing_along_path(matched.odometer_sign)
    aligned, along = alignment(matched.epochs, odometry, prepared.vehicle, config)
    if odometry is None:
        # A balise valid in one direction means that of the train, not of one step of the positions (DOMAIN section 4).
        direction = direction_by_evidence(aligned, matched.path, evidence, prepared.vehicle, config)
        aligned = replace(aligned, direction=direction)
    channel = _channel_on_path(prepared, solution, aligned, matches)
    # What is made of the positions cannot say that they are right (DOMAIN section 5.0).
    blind_along = NotEvaluated.ODOMETER_OF_GNSS if odometry is not None and odometry.of_gnss else None
    singles = _single_verdicts(prepared, solution, aligned, channel)
    bank = MonitorBank(aligned, singles, config, blind_along, along)
    balises = matched.path.balises_on_path(prepared.site.balises)
    reads = _reads_on_odometer(prepared.run.balise_reads, aligned, odometry)
    scale_sigma = None if odometry is None else odometry.scale_sigma
    lds = run_lds(aligned, bank, balises, reads, scale_sigma, config, solution)
    found = {**lds.linking, **bank.verdicts()}
    if blind_along is not None:
        found |= {name: found[name].without_passes(blind_along) for name in _AGAINST_ODOMETER}
    epochs = MonitoredEpochs(**aligned.columns(), **lds.epochs.columns(), verdicts=found)
    fixes = prepared.fixes(solution)
    replayed = Solution(solution, fixes, epochs, lds.crossings, lds.passages, balises, matched.path)
    return MonitoredSolution(prepared, replayed, matched, aligned, odometry, channel, singles, bank, lds)


def _channel_on_path(
    prepared: PreparedRun, solution: str, aligned: AlignedEpochs, matches: Mapping[str, Match]
) -> pl.DataFrame | None:
    """The solution of the channel monitor on this one's path; None if none is named or it is not recorded."""
    channel = prepared.config.monitors.channel_reference
    if channel is None or channel == solution or channel not in matches:
        return None
    return on_path_of(aligned.table, matches[channel].epochs.table, prepared.config.lds)


def _single_verdicts(
    prepared: PreparedRun, solution: str, aligned: AlignedEpochs, channel: pl.DataFrame | None
) -> dict[str, Verdicts]:
    """Verdicts of the monitors that look at each epoch by itself, by the monitor's name."""
    named = prepared.config.monitors.channel_reference
    absent = NO_OTHER_SOLUTION if named in (None, solution) else NotEvaluated.OTHER_NOT_RECORDED
    given = MonitorInput(aligned, prepared.ranges(solution), channel, absent, prepared.config)
    return {name: monitor(given) for name, monitor in WITHOUT_MEMORY.items()}


def _reads_on_odometer(
    reads: pl.DataFrame | None, aligned: AlignedEpochs, odometry: Odometry | None
) -> pl.DataFrame | None:
    """Balise reads with the odometer at each [m], on the scale of `aligned`; as they are without an odometer."""
    if reads is None or odometry is None:
        return reads
    odometer_m = odometer_at(times_ns(reads), aligned, odometry)
    return reads.with_columns(pl.Series("odometer_m", odometer_m, nan_to_null=True))
