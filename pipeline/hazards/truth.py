"""Where the train was: the ladder of evidence (DOMAIN section 5).

The reference stream; else physical balise reads carried on by the odometer; else (by option) GNSS and
odometer smoothed; else the odometer since the LRVB, where only what exceeds its confidence counts.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.hazards.anchors import Anchors, Carried, carry
from pipeline.hazards.arrays import words
from pipeline.hazards.reference import Rung, Samples, dense_rung, sparse_rungs
from pipeline.hazards.slip import Doppler, repaired_by_doppler
from pipeline.hazards.smoothing import smoothed_truth
from pipeline.hazards.travel import Travel, odometer_travel
from schemas.arrays import NS_PER_S, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration, HazardConfig, LdsConfig
from schemas.enums import Evidence, PassageStatus

# A learned latency is no chance of the noise beyond so many of its sigmas, or where so little of the doubt is left.
_PROVEN_SIGMAS, _PROVEN_SHARE = 3.0, 0.5
_NAMES = [member.value for member in Evidence]


def establish_truth(
    epochs: pl.DataFrame,
    reference: pl.DataFrame | None,
    balise_reads: pl.DataFrame | None,
    passages: pl.DataFrame | None,
    config: Configuration,
) -> pl.DataFrame:
    """Truth of one solution's epochs, at the time that each position is of: `t - latency`, as known in the end.

    `epochs`: `t, path_m, fix_valid, direction, latency_s` and the aligned odometer (`odometer_m,
    odometer_segment, scale_sigma, odometer_white_m2_per_s, odometer_rows_m`, and `velocity_along_mps` where known).
    `reference`: `t, path_m, cross_track_m, vertical_m, sigma_m` on the same path;
    `balise_reads`: `t, path_m` of physical balises and, where known, `odometer_m` at the read, which inside an outage
    the epochs cannot tell; `passages`: `status, path_m, t_offered` of the
    LDS, whose accepted VBs anchor the odometer.
    Yields per epoch `t, evidence, truth_path_m, truth_sigma_m, truth_bound_m, truth_slip_m, truth_cross_m,
    truth_up_m, truth_travel_m, truth_stretch, truth_smoothed`: `truth_bound_m` is what an error has to exceed before
    it is called a hazard, `truth_slip_m` by how much two balise reads around the epoch say that the odometer counted
    too far along growing path between them (0: no contradiction), differences of `truth_travel_m` within one
    `truth_stretch` are true movements free of the steps that a new anchor makes; `truth_smoothed` marks the
    post-processed truth of `hazards.smoothed_reference`, which steps in where there is neither reference nor balise
    read.
    """
    at_ns = valid_ns(epochs)
    travel = odometer_travel(epochs, counted_ns(epochs))
    rungs = []
    if reference is not None and reference.height:
        samples = Samples.at(at_ns, reference)
        rungs.append(dense_rung(samples))
        if np.isfinite(rungs[0].path_m).all():
            return _ladder(epochs["t"], rungs, travel)
    hazards = config.hazards
    doppler = Doppler(floats(epochs, "velocity_along_mps"), config.monitors.doppler_sigma_mps)
    travel = repaired_by_doppler(travel, positions(epochs), doppler, hazards.false_alarm_margin_m)
    # Carried to when the odometer counted; how far the train goes from there to the instant of the position.
    since_m = np.nan_to_num(floats(epochs, "speed_mps")) * (at_ns - travel.at_ns) / NS_PER_S
    if reference is not None and reference.height:
        rungs += sparse_rungs(samples, reference, travel, since_m, config.lds)
    if balise_reads is not None and balise_reads.height:
        counted = floats(balise_reads, "odometer_m") if "odometer_m" in balise_reads.columns else None
        anchors = Anchors.of(times_ns(balise_reads), floats(balise_reads, "path_m"), counted)
        sigma_m = hazards.balise_read_sigma_m
        carried = carry(anchors, travel, travel.at_ns, config.lds, both_ways=True, anchor_sigma_m=sigma_m)
        rungs.append(_balise_rung(carried, since_m, positions(epochs), hazards))
    rungs.append(_odometer_rung(epochs, passages, travel, config.lds))
    return _ladder(epochs["t"], rungs, travel)


def valid_ns(epochs: pl.DataFrame) -> Ints:
    """Instant that each position is of: its stamp less the latency as it is known in the end.

    What was learned on the way has its error in the first minutes; at 40 m/s a tenth of a second is 4 m that
    would be called the position's. The same holds in the end of a run that hardly changed its speed, which tells
    little of the latency: stamps are times of validity (CONTRACT section 1), less what the vehicle file says, until
    the run proves them wrong by three sigma or has at least halved what was unknown of the latency at its start.
    """
    known = epochs.select("latency_s", "latency_sigma_s").drop_nulls()
    latency_s = 0.0
    if known.height:
        (said_s, unknown_s), (learned_s, sigma_s) = known.row(0), known.row(-1)
        proven = abs(learned_s - said_s) > _PROVEN_SIGMAS * sigma_s or sigma_s <= _PROVEN_SHARE * unknown_s
        latency_s = learned_s if proven else said_s
    return times_ns(epochs) - round(latency_s * NS_PER_S)


def counted_ns(epochs: pl.DataFrame) -> Ints:
    """Instant that the aligned odometer of each epoch is of: its stamp less the latency in use there."""
    latency_ns = np.round(np.nan_to_num(floats(epochs, "latency_s")) * NS_PER_S).astype(np.int64)
    return times_ns(epochs) - latency_ns


def positions(epochs: pl.DataFrame) -> Floats:
    """Path positions of valid fixes; NaN elsewhere."""
    return np.where(flags(epochs, "fix_valid"), floats(epochs, "path_m"), np.nan)


def _balise_rung(carried: Carried, since_m: Floats, position_m: Floats, config: HazardConfig) -> Rung:
    """Reads carried on; the odometer's share of the doubt bounds what may be called a hazard, and so does its slip.

    Reckoned back from the first read, its whole confidence: a slip on the way would look like an error of GNSS.
    """
    nothing = np.full(carried.path_m.size, np.nan)
    sigma = np.hypot(config.balise_read_sigma_m, carried.sigma_m)
    smallest = np.where(carried.backward, carried.confidence_m, np.minimum(3.0 * sigma, carried.confidence_m))
    hidden = _hidden_by_slip(carried, position_m - carried.path_m - since_m, config.failure_limit_m)
    bound = np.maximum(smallest, hidden)
    return Rung(Evidence.BALISE, carried.path_m + since_m, sigma, bound, carried.slip_m, nothing, nothing)


def _hidden_by_slip(carried: Carried, error_m: Floats, limit_m: float) -> Floats:
    """How large an error has to be beyond which the slip cannot account for it.

    The train is between where the reads before and behind put it. An error that exceeds the limit against both is one
    wherever the odometer slipped; so is one larger than the slip itself.
    """
    by_before, by_behind = carried.share * carried.slip_m, (carried.share - 1.0) * carried.slip_m
    ahead, behind = np.maximum(by_before, by_behind), np.maximum(-by_before, -by_behind)
    reach = np.where(error_m > 0.0, ahead, np.where(error_m < 0.0, behind, np.abs(carried.slip_m)))
    hidden: Floats = np.minimum(np.abs(carried.slip_m), reach + limit_m)
    return hidden


def _smoothed_rung(epochs: pl.DataFrame, travel: Travel, config: HazardConfig) -> Rung:
    """Smoothed from the position itself, so no more than odometer evidence, and marked (`truth_smoothed`)."""
    smoothed = smoothed_truth(epochs, travel, positions(epochs), config.alarm_lead_s)
    nothing, no_slip = np.full(smoothed.path_m.size, np.nan), np.zeros(smoothed.path_m.size)
    bound = 3.0 * smoothed.sigma_m
    return Rung(Evidence.ODOMETER, smoothed.path_m, smoothed.sigma_m, bound, no_slip, nothing, nothing, smoothed=True)


def _odometer_rung(epochs: pl.DataFrame, passages: pl.DataFrame | None, travel: Travel, lds: LdsConfig) -> Rung:
    at_ns = travel.at_ns
    anchors = _initial_anchors(epochs, travel, at_ns, lds.init_s)
    if passages is not None and passages.height:
        accepted = passages.filter(passages["status"] == PassageStatus.ACCEPTED.value).drop_nulls("t_offered")
        accepted = accepted.sort("t_offered")
        offered = times_ns(accepted, "t_offered")
        latency = np.interp(offered, times_ns(epochs), times_ns(epochs) - at_ns)
        path = floats(accepted, "path_m")
        anchors = anchors.with_others(Anchors.of((offered - latency).astype(np.int64), path))
    carried = carry(anchors, travel, at_ns, lds, both_ways=False)
    nothing = np.full(carried.path_m.size, np.nan)
    bound = carried.confidence_m
    return Rung(Evidence.ODOMETER, carried.path_m, carried.sigma_m, bound, carried.slip_m, nothing, nothing)


def _initial_anchors(epochs: pl.DataFrame, travel: Travel, at_ns: Ints, init_s: float) -> Anchors:
    """Where no VB was accepted yet: the median of GNSS minus odometer over a stretch's first `init_s`."""
    offset = positions(epochs) - travel.distance_m
    known = np.flatnonzero(np.isfinite(offset))
    instants: list[int] = []
    places: list[float] = []
    for stretch in np.unique(travel.stretch[known]):
        rows = known[travel.stretch[known] == stretch]
        first = rows[at_ns[rows] <= at_ns[rows[0]] + init_s * NS_PER_S]
        instants.append(int(at_ns[rows[0]]))
        places.append(float(np.median(offset[first]) + travel.distance_m[rows[0]]))
    return Anchors.of(np.array(instants, dtype=np.int64), np.array(places, dtype=np.float64))


def _ladder(t: pl.Series, rungs: list[Rung], travel: Travel) -> pl.DataFrame:
    names = ("path_m", "sigma_m", "bound_m", "slip_m", "cross_m", "up_m")
    best = {name: np.full(t.len(), np.nan) for name in names}
    evidence = np.full(t.len(), -1)
    smoothed = np.zeros(t.len(), dtype=np.bool_)
    for rung in rungs:
        free = ~np.isfinite(best["path_m"]) & np.isfinite(rung.path_m)
        for name in names:
            best[name][free] = getattr(rung, name)[free]
        smoothed[free] = rung.smoothed
        evidence[free] = _NAMES.index(rung.evidence.value)
    by_reference = np.where(evidence == _NAMES.index(Evidence.REFERENCE.value), best["path_m"], np.nan)
    distance_m, stretch = travel.joined_with(by_reference)
    columns = {f"truth_{name}": pl.Series(best[name], nan_to_null=True) for name in names}
    return pl.DataFrame({"t": t, "evidence": words(_NAMES, evidence), **columns}).with_columns(
        truth_travel_m=pl.Series(distance_m, nan_to_null=True),
        truth_stretch=pl.Series(stretch),
        truth_smoothed=pl.Series(smoothed),
    )
