"""The `runs` row: what one solution of one run comes to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.clean import StreamCounts
from pipeline.hazards.independent import independent_episodes, missed_detection
from pipeline.statistics import UNKNOWN, Estimate, poisson_rate
from pipeline.timeline import (
    Flags,
    Floats,
    Instants,
    availability,
    gap_limit_s,
    held_s,
    moved,
    nominal_period_s,
    outages_s,
    share_of_time,
    uptime,
)
from schemas.config import Configuration, SafetyConfig
from schemas.conform import conform
from schemas.enums import (
    BaliseKind,
    Evidence,
    Hazard,
    LdsState,
    MonitorState,
    PassageStatus,
    RunStatus,
    ThrVerdict,
    Verdict,
)
from schemas.run import IngestNotes
from schemas.tables import CONTRACT_VERSION, SCALES, Runs

Row = dict[str, object]

CONTINUITY_S = 15.0
"""Most critical phase of an APV-I/LPV-200 operation (LOC section VI)."""

_REJECTED = [status.value for status in PassageStatus if status.value.startswith("rejected_")]


@dataclass(frozen=True)
class Provenance:
    """What the result was made from and by; the same provenance always gives the same tables."""

    config_digest: str
    input_digest: str
    software: str


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
    evidence: Evidence | None = None
    alignment: Alignment = field(default_factory=Alignment)
    counts: StreamCounts = field(default_factory=StreamCounts)
    ingest: IngestNotes = field(default_factory=IngestNotes)
    ambiguous_stretches: int = 0
    notes: tuple[str, ...] = ()


def summarise(results: SolutionResults, config: Configuration, provenance: Provenance) -> pl.DataFrame:
    """One row of the `runs` table (CONTRACT section 3)."""
    clock = _Clock.of(results.epochs, config)
    row = (
        _identity(results)
        | _extent(results.epochs, clock)
        | _positions(results.epochs, clock, config)
        | _accuracy(results.epochs)
        | _balises(results.passages, config.hazards.failure_limit_m)
        | _hazards(results.hazards)
        | _levels(results, config.safety)
        | _alarms(results, clock)
        | _exposure(results.epochs)
        | _state_shares(results.epochs, clock)
        | stanford_counts(results.epochs, config.lds.ci_limit_m)
        | _stanford_of_receiver(results.epochs, config.lds.ci_limit_m)
        | _provenance(provenance)
    )
    return _frame(row)


def failed_row(error: str, provenance: Provenance, solution: str = "") -> pl.DataFrame:
    """The `runs` row of a run that could not be replayed: counts are zero, the rest is not known."""
    zeros: Row = {name: 0 for name, column in Runs.columns().items() if column.dtype == pl.Int64}
    row = (
        zeros
        | {
            "solution": solution,
            "status": RunStatus.FAILED,
            "error": error,
            "false_alarms": None,
        }
        | {name: None for name in Runs.columns() if name.startswith("stanford_hpl_")}
    )
    return _frame(row | _provenance(provenance))


def _frame(row: Mapping[str, object]) -> pl.DataFrame:
    dtypes = {name: column.dtype for name, column in Runs.columns().items()}
    values = {name: [_known(row.get(name))] for name in dtypes}
    return conform(pl.DataFrame(values, schema=dtypes), Runs)


def _known(value: object) -> object:
    """A value as it may stand in a table: never NaN nor infinite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class _Clock:
    """The epochs' times and how long the state of each holds."""

    t_ns: Instants
    period_s: float | None
    limit_s: float
    held_s: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, config: Configuration) -> _Clock:
        t_ns = epochs["t"].to_physical().to_numpy()
        period_s = nominal_period_s(t_ns)
        limit_s = gap_limit_s(period_s, config.align.gap_reset_s)
        return cls(t_ns, period_s, limit_s, held_s(t_ns, limit_s))

    @property
    def duration_s(self) -> float | None:
        return float(self.t_ns[-1] - self.t_ns[0]) / 1e9 if len(self.t_ns) else None


def _floats(frame: pl.DataFrame, column: str) -> Floats:
    """A column with NaN for null."""
    return frame[column].cast(pl.Float64).fill_null(math.nan).to_numpy()


def _flags(frame: pl.DataFrame, condition: pl.Expr) -> Flags:
    """A condition with false for null."""
    return frame.select(condition.fill_null(value=False)).to_series().to_numpy()


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


def _extent(epochs: pl.DataFrame, clock: _Clock) -> Row:
    return {
        "t_start": epochs["t"].first(),
        "t_end": epochs["t"].last(),
        "duration_s": clock.duration_s,
        "distance_m": _distance_m(epochs),
        "epochs": epochs.height,
        "gnss_rate_hz": 1.0 / clock.period_s if clock.period_s else None,
    }


def _distance_m(epochs: pl.DataFrame) -> float | None:
    """Distance travelled [m]: by the odometer; without one by the positions while they moved.

    Positions count from first to last of each stretch in one direction, so that noise adds nothing.
    """
    odometer = epochs["odometer_m"].drop_nulls()
    if odometer.len() > 1:
        return float(odometer.diff().abs().sum())
    moving = epochs.filter(pl.col("path_m").is_not_null() & (pl.col("direction").fill_null(0) != 0))
    if moving.height < 2:
        return None
    stretches = moving.group_by(pl.col("direction").rle_id(), maintain_order=True).agg(
        (pl.col("path_m").last() - pl.col("path_m").first()).abs()
    )
    return float(stretches["path_m"].sum())


def usable() -> pl.Expr:
    """An epoch with a position on the track."""
    return pl.col("path_m").is_not_null() & pl.col("on_track")


def trusted(config: Configuration) -> pl.Expr:
    """An epoch whose position is valid, confident and unambiguous (CONTRACT section 3, `mtbf_h`)."""
    confident = pl.col("confidence_m") <= config.lds.ci_limit_m
    return usable() & confident & (pl.col("gate_probability") >= config.matching.ambiguity_probability)


def _positions(epochs: pl.DataFrame, clock: _Clock, config: Configuration) -> Row:
    """Availability, outages and continuity (CONTRACT section 3; LOC eq. 8)."""
    lost = outages_s(clock.t_ns, _flags(epochs, usable()), clock.limit_s)
    distance = _floats(epochs, "odometer_m")
    speed = _floats(epochs, "speed_mps")
    moving = moved(clock.t_ns, distance, speed, config.matching.deadband_mps)
    trust = uptime(clock.t_ns, _flags(epochs, trusted(config)), clock.limit_s)
    mtbf_h = trust.mean_time_between_losses_h
    return {
        "availability": availability(clock.t_ns, _flags(epochs, pl.col("tvb")), moving, clock.limit_s),
        "outages": len(lost),
        "longest_outage_s": float(lost.max()) if len(lost) else 0.0 if epochs.height else None,
        "cross_bias_m": epochs.filter("on_track")["cross_track_m"].median(),
        "mtbf_h": mtbf_h,
        "continuity_15s": math.exp(-CONTINUITY_S / 3600.0 / mtbf_h) if mtbf_h else None,
        "trusted_s": trust.up_s if epochs.height else None,
        "trusted_losses": trust.losses,
    }


def _spread(errors: pl.Series, name: str) -> Row:
    """Mean, 95 % and largest of the known errors; the latter two of their magnitude."""
    size = errors.abs()
    return {
        f"{name}_mean_m": errors.mean(),
        f"{name}_p95_m": size.quantile(0.95, interpolation="linear"),
        f"{name}_max_m": size.max(),
    }


def _accuracy(epochs: pl.DataFrame) -> Row:
    row: Row = {}
    for axis in ("along", "cross", "up"):
        row |= _spread(epochs[f"error_{axis}_m"], f"{axis}_error")
    return row


def _balises(passages: pl.DataFrame, failure_limit_m: float) -> Row:
    virtual = passages.filter(pl.col("kind") == BaliseKind.VIRTUAL)
    accepted = virtual.filter(pl.col("status") == PassageStatus.ACCEPTED)
    return {
        "balises_on_path": virtual.filter(is_passage()).height,
        "balises_accepted": accepted.height,
        "balises_rejected": virtual.filter(pl.col("status").is_in(_REJECTED)).height,
        "balises_missed": virtual.filter(pl.col("status") == PassageStatus.MISSED).height,
        "balises_not_available": virtual.filter(pl.col("status") == PassageStatus.NOT_AVAILABLE).height,
        "unsafe_accepted": accepted.filter(pl.col("location_error_m").abs() > failure_limit_m).height,
        **_spread(accepted["location_error_m"], "location_error"),
    }


def is_passage() -> pl.Expr:
    """A row of `passages` that is no offer beyond the passages of the train.

    An offer beyond is one for which the evidence knows no true crossing; an offer without evidence
    (no location error) counts as a passage.
    """
    beyond = pl.col("t_true").is_null() & pl.col("t_offered").is_not_null() & pl.col("location_error_m").is_not_null()
    return ~beyond


def _hazards(hazards: pl.DataFrame) -> Row:
    classes = {
        Hazard.VB_JUMP_1A: "hazards_1a",
        Hazard.VB_JUMP_1B: "hazards_1b",
        Hazard.VB_SHIFT: "hazards_shift",
    }
    return {
        **{column: hazards.filter(pl.col("hazard") == kind).height for kind, column in classes.items()},
        "hazards_detected": hazards.filter(pl.col("detected")).height,
        "hazards_within_budget": hazards.filter(pl.col("within_budget")).height,
        "missed_detections": hazards.filter(missed_detection()).height,
        "time_to_detect_max_s": hazards["time_to_detect_s"].max(),
        "time_since_failure_max_s": hazards["time_since_failure_s"].max(),
        "hazardous_max_s": hazards["hazardous_s"].max(),
    }


def _levels(results: SolutionResults, safety: SafetyConfig) -> Row:
    """Whether the failures were negated within the allowed T_D of each service level (TVB eq. 7)."""
    hazardous_s: list[float | None] = []
    if results.hazards.height:
        faults = independent_episodes(results.hazards.with_columns(run_id=pl.lit("")))
        hazardous_s = faults.filter("failed")["hazardous_s"].to_list()
    failures = len(hazardous_s)
    allowed_s = [safety.allowed_time_to_detect_s(level) for level in safety.service_levels]
    within = [sum(spent_s is not None and spent_s <= limit_s for spent_s in hazardous_s) for limit_s in allowed_s]
    return {
        "failures": failures,
        "service_levels": list(safety.service_levels),
        "level_allowed_s": allowed_s,
        "level_within": within,
        "level_verdict": [_verdict(failures, count, results.evidence) for count in within],
    }


def _verdict(failures: int, within: int, evidence: Evidence | None) -> ThrVerdict:
    if failures:
        return ThrVerdict.KEPT if within == failures else ThrVerdict.EXCEEDED
    return ThrVerdict.UNKNOWN if evidence is None else ThrVerdict.NO_FAILURE


def _alarms(results: SolutionResults, clock: _Clock) -> Row:
    """Alarms and the rate of false ones, which needs a truth and a verdict on every alarm.

    The rate counts the time in which the along-track bank judged; where it never did there is none.
    """
    alarms = results.alarms
    false = alarms.filter(pl.col("verdict") == Verdict.FALSE).height
    truth = results.evidence is not None and results.epochs["error_along_m"].is_not_null().any()
    judged = truth and not (alarms["verdict"] == Verdict.UNKNOWN).any()
    monitored_s = float(clock.held_s[_flags(results.epochs, _along_evaluated())].sum())
    rate: Estimate = poisson_rate(false, monitored_s / 3600.0) if judged else UNKNOWN
    return {
        "held_s": float(clock.held_s.sum()) if len(clock.held_s) else None,
        "monitored_s": monitored_s if len(clock.held_s) else None,
        "alarms": alarms.height,
        "false_alarms": false if truth else None,
        "false_alarm_rate_per_h": rate.value,
        "false_alarm_rate_low_per_h": rate.low,
        "false_alarm_rate_high_per_h": rate.high,
    }


def _along_evaluated() -> pl.Expr:
    """A monitor of the along-track bank has a verdict."""
    return pl.any_horizontal(pl.col(f"along_{scale}_state") != MonitorState.NOT_EVALUATED for scale in SCALES)


def _exposure(epochs: pl.DataFrame) -> Row:
    exposure = epochs["exposure_s"]
    return {
        "exposure_max_s": exposure.max(),
        "exposure_p99_s": exposure.quantile(0.99, interpolation="linear"),
    }


def _state_shares(epochs: pl.DataFrame, clock: _Clock) -> Row:
    """Shares of the time, gaps apart, known to be spent in each state of the LDS (TVB section 4).

    Where the truth is missing for a while the four do not add up to one; where it is missing
    throughout, P0 and P1 are not known.
    """
    states = epochs["lds_state"]
    row: Row = {
        f"share_{state.value.lower()}": share_of_time(clock.held_s, _flags(epochs, pl.col("lds_state") == state))
        for state in LdsState
    }
    if states.is_null().any() and not states.is_in([LdsState.P0.value, LdsState.P1.value]).any():
        row |= {"share_p0": None, "share_p1": None}
    return row


def stanford_counts(epochs: pl.DataFrame, limit_m: float, bound: str = "confidence_m") -> Row:
    """Epochs of known error by error and bound along the track (CONTRACT section 3, `stanford_*`)."""
    known = epochs.select(error=pl.col("error_along_m").abs(), bound=pl.col(bound)).drop_nulls()
    error, claimed = known["error"].to_numpy(), known["bound"].to_numpy()
    offered = claimed <= limit_m
    return {
        "stanford_nominal": int(np.sum(offered & (error <= claimed))),
        "stanford_misleading": int(np.sum(offered & (error > claimed) & (error <= limit_m))),
        "stanford_hazardous": int(np.sum(offered & (error > limit_m))),
        "stanford_unavailable": int(np.sum(~offered)),
    }


def _stanford_of_receiver(epochs: pl.DataFrame, limit_m: float) -> Row:
    """The same counts with the receiver's protection level as bound; not known where it gives none."""
    counts = stanford_counts(epochs, limit_m, "hpl_m") if epochs["hpl_m"].count() else {}
    return {f"stanford_hpl_{name.removeprefix('stanford_')}": value for name, value in counts.items()}


def _provenance(provenance: Provenance) -> Row:
    return {
        "config_digest": provenance.config_digest,
        "input_digest": provenance.input_digest,
        "software": provenance.software,
        "contract": CONTRACT_VERSION,
    }
