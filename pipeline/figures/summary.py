"""The `runs` row: what one solution of one run comes to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl

from pipeline.epochs.clock import Clock
from pipeline.figures import run_figures as figures
from pipeline.ingest.clean import StreamCounts
from pipeline.motion import Motion
from pipeline.results.provenance import Provenance
from schemas.config import Configuration
from schemas.conform import conform, dtypes
from schemas.enums import Evidence, RunStatus
from schemas.run import IngestNotes
from schemas.tables import CONTRACT_VERSION, Runs

Row = dict[str, object]


@dataclass(frozen=True)
class Alignment:
    """Latency and odometer scale at the end of the run; None where nothing is known of them."""

    latency_s: float | None = None
    latency_sigma_s: float | None = None
    odometer_scale: float | None = None
    odometer_scale_sigma: float | None = None


@dataclass(frozen=True)
class SolutionResults:
    """All that the stages found out about one solution; tables as in `schemas.tables`."""

    solution: str
    epochs: pl.DataFrame
    passages: pl.DataFrame
    hazards: pl.DataFrame
    alarms: pl.DataFrame
    motion: Motion
    evidence: Evidence | None = None
    alignment: Alignment = field(default_factory=Alignment)
    counts: StreamCounts = field(default_factory=StreamCounts)
    ingest: IngestNotes = field(default_factory=IngestNotes)
    ambiguous_stretches: int = 0
    notes: tuple[str, ...] = ()


def summarise(results: SolutionResults, config: Configuration, provenance: Provenance) -> pl.DataFrame:
    """One row of the `runs` table (CONTRACT section 3)."""
    clock = Clock.of(results.epochs, config)
    row = (
        _identity(results)
        | _extent(results.epochs, clock, results.motion.distance_m)
        | figures.positions(results.epochs, results.motion, clock, config)
        | figures.accuracy(results.epochs)
        | figures.balise_counts(results.passages, results.evidence, config.hazards.failure_limit_m)
        | figures.hazard_counts(results.hazards)
        | figures.service_levels(results.hazards, results.evidence, config.safety)
        | figures.alarm_counts(results.alarms, results.epochs, results.evidence, clock)
        | figures.exposure(results.epochs)
        | figures.state_shares(results.epochs, clock)
        | figures.stanford_counts(results.epochs, config.lds.ci_limit_m)
        | figures.stanford_of_receiver(results.epochs, config.lds.ci_limit_m)
        | _provenance(provenance)
    )
    return _frame(row)


def failed_row(error: str, provenance: Provenance, solution: str = "") -> pl.DataFrame:
    """The `runs` row of a run that could not be replayed: counts are zero, the rest is not known."""
    zeros: Row = {
        name: 0 for name, column in Runs.columns().items() if column.dtype == pl.Int64 and not column.nullable
    }
    return _frame(zeros | {"solution": solution, "status": RunStatus.FAILED, "error": error} | _provenance(provenance))


def _frame(row: Mapping[str, object]) -> pl.DataFrame:
    schema = dtypes(Runs)
    values = {name: [_known(row.get(name))] for name in schema}
    return conform(pl.DataFrame(values, schema=schema), Runs)


def _known(value: object) -> object:
    """A value as it may stand in a table: never NaN nor infinite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _identity(results: SolutionResults) -> Row:
    ingest = results.ingest
    damaged = ingest.partial_until_ns is not None or ingest.damage is not None
    return {
        "solution": results.solution,
        "status": RunStatus.PARTIAL if damaged else RunStatus.OK,
        "error": ingest.damage,
        "partial_until": ingest.partial_until_ns,
        "duplicates": results.counts.duplicates,
        "out_of_order": results.counts.out_of_order,
        "evidence": results.evidence,
        "ambiguous_stretches": results.ambiguous_stretches,
        "notes": "; ".join([*_ingest_remarks(ingest), *results.notes]) or None,
        "latency_s": results.alignment.latency_s,
        "latency_sigma_s": results.alignment.latency_sigma_s,
        "odometer_scale": results.alignment.odometer_scale,
        "odometer_scale_sigma": results.alignment.odometer_scale_sigma,
    }


def _ingest_remarks(ingest: IngestNotes) -> list[str]:
    remarks = []
    if ingest.chunks_without_crc:
        remarks.append(f"{ingest.chunks_without_crc} chunks without a checksum")
    if ingest.skipped_topics:
        remarks.append("topics not used: " + ", ".join(ingest.skipped_topics))
    return remarks


def _extent(epochs: pl.DataFrame, clock: Clock, distance_m: float | None) -> Row:
    return {
        "t_start": epochs["t"].dt.timestamp("ns").first(),
        "t_end": epochs["t"].dt.timestamp("ns").last(),
        "duration_s": clock.duration_s,
        "distance_m": distance_m,
        "epochs": epochs.height,
        "gnss_rate_hz": 1.0 / clock.period_s if clock.period_s else None,
    }


def _provenance(provenance: Provenance) -> Row:
    return {
        "config_digest": provenance.config_digest,
        "input_digest": provenance.input_digest,
        "software": provenance.software,
        "contract": CONTRACT_VERSION,
    }
