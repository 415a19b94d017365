"""Estimated and safe front end of a train at each epoch, and what the judge knows of their errors.

A position in use gives the estimate, with its confidence. Where none is in use it is the report of ETCS: the last
relevant balise and the odometer's distance since then, with its over- and under-reading amounts. Uncertain latency
widens both at speed. Else there is no estimate. Errors do not depend on where on the train the front end is.

Its speed is compared with the one that the evidence leaves, as means over windows.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from pipeline.results.places import stretches_of, train_path_m
from pipeline.stages.epochs.clock import Clock
from pipeline.studies.claim.areas import AreaPlaces, areas_at
from pipeline.studies.claim.profile import KMH_PER_MPS, Method
from pipeline.studies.claim.tally import codes, keeps_and_breaks
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats
from schemas.config import Configuration
from schemas.enums import Judgement, PassageStatus, VehicleFigures
from schemas.frozen import frozen


@frozen
class FrontEnd:
    """Of one solution of one run, per epoch; NaN is not known.

    `path_m`: estimate of the balise antenna, `front_m`: estimated front end, both path positions. `over_m`: estimate
    minus min safe front end, `under_m`: max safe front end minus estimate. `low_m`, `high_m`: error of the estimate in
    the direction of travel, as an interval. `train_m` (2, epochs): least and largest path position of the train by the
    evidence, where that leaves one net element. `proved`: the interval is complete and the track is right; `judged`:
    it may show an exceedance; `wrong_track`: the track is wrong for certain. `speed_late_s`: length of speed means.
    """

    clock: Clock
    path_m: Floats
    front_m: Floats
    over_m: Floats
    under_m: Floats
    low_m: Floats
    high_m: Floats
    train_m: Floats
    proved: Bools
    judged: Bools
    wrong_track: Bools
    speed_mps: Floats
    speed_late_s: float
    direction: Floats
    where: AreaPlaces

    @property
    def has_output(self) -> Bools:
        """Epochs at which the unit says where the train is."""
        return np.isfinite(self.path_m)

    @property
    def gap_after_s(self) -> Floats:
        """How long the log holds nothing after what each epoch holds [s]."""
        steps = np.diff(self.clock.t_ns, append=self.clock.t_ns[-1:]) / NS_PER_S
        return np.where(self.clock.held_s > 0, 0.0, steps)

    @property
    def least_error_m(self) -> Floats:
        """The smallest size that the error of the estimate may have."""
        return np.maximum(np.maximum(self.low_m, -self.high_m), 0.0)

    def codes_within_m(self, over_m: Floats | float, under_m: Floats | float) -> Ints:
        """Codes per epoch: is the estimate at most `over_m` ahead of the train and `under_m` behind it?"""
        inside, beyond = keeps_and_breaks(self.low_m, self.high_m, over_m, under_m)
        asked = np.isfinite(over_m) | np.isfinite(under_m)
        return codes(asked & self.proved & inside, asked & ((self.judged & beyond) | self.wrong_track))


def front_end_of(
    epochs: pl.DataFrame,
    passages: pl.DataFrame,
    run: dict[str, Any],
    config: Configuration,
    method: Method,
    areas: pl.DataFrame | None = None,
    ahead_m: float = 0.0,
) -> FrontEnd:
    """The front end from the tables of one solution of one run; `ahead_m`: its distance from the balise antenna."""
    path, direction, speed = (floats(epochs, name) for name in ("path_m", "direction", "speed_mps"))
    gnss = flags(epochs, "in_use") & np.isfinite(path)
    reported = _reported_position_m(epochs, passages)
    estimate = np.where(gnss, path, reported)
    over, under = (np.where(gnss, floats(epochs, "confidence_m"), floats(epochs, name)) for name in _DOUBTS)
    late_over, late_under = _latency_margins_s(epochs, run, config)
    shift = np.where(gnss, 0.0, direction * (estimate - path))
    low = floats(epochs, "error_low_m") + shift
    high = floats(epochs, "error_high_m") + shift
    right, wrong, elsewhere = _judged_epochs(epochs, config.hazards.limits.failure_m)
    train_m = np.stack(train_path_m(epochs, stretches_of(epochs)))
    # Without a position nothing was judged: the report is compared with the place of the train itself.
    unpositioned = np.isnan(path) & np.isfinite(train_m).all(axis=0)
    ends = np.where(unpositioned, direction * (estimate - train_m), np.stack([low, high]))
    low = np.where(unpositioned, ends.min(axis=0), low)
    high = np.where(unpositioned, ends.max(axis=0), high)
    right |= unpositioned
    there = np.isfinite(estimate)
    known = np.isfinite(low) & np.isfinite(high)
    # A train that has not moved yet has no direction of travel: its front end is looked up at the antenna.
    front = estimate + np.nan_to_num(direction) * ahead_m
    return FrontEnd(
        clock=Clock.of(epochs, config),
        path_m=estimate,
        front_m=front,
        over_m=over + np.abs(speed) * late_over,
        under_m=under + np.abs(speed) * late_under,
        low_m=low,
        high_m=high,
        train_m=train_m,
        proved=there & known & right,
        judged=there & known & (right | (wrong & ~elsewhere)),
        wrong_track=gnss & elsewhere,
        speed_mps=speed,
        speed_late_s=config.align.speed_window_s,
        direction=direction,
        where=_areas_at(front, epochs, areas, method.area_reach_m),
    )


_DOUBTS = ("doubt_over_m", "doubt_under_m")


def _judged_epochs(epochs: pl.DataFrame, limit_m: float) -> tuple[Bools, Bools, Bools]:
    """Epochs judged right; wrong; and wrong for the track, since the place along it does not make them so."""
    judgement = epochs["judgement"].cast(pl.String)
    right, wrong = ((judgement == word).to_numpy() for word in (Judgement.RIGHT.value, Judgement.WRONG.value))
    with np.errstate(invalid="ignore"):
        along = (floats(epochs, "error_low_m") > limit_m) | (floats(epochs, "error_high_m") < -limit_m)
    return right, wrong, wrong & ~along


def _latency_margins_s(epochs: pl.DataFrame, run: dict[str, Any], config: Configuration) -> tuple[Floats, Floats]:
    """How much latency widens the interval behind and ahead of the estimate [s]; what is unknown widens nothing.

    A learned latency is not taken out of positions (DOMAIN 5.1), so the train may be ahead by it.
    """
    spread = config.lds.ci_factor * (run["latency_sigma_s"] or 0.0)
    learned = run["vehicle"] == VehicleFigures.LEARNED.value
    late = np.nan_to_num(floats(epochs, "latency_s")) if learned else np.zeros(epochs.height)
    return np.maximum(spread - late, 0.0), np.maximum(spread + late, 0.0)


def _reported_position_m(epochs: pl.DataFrame, passages: pl.DataFrame) -> Floats:
    """Path position by the last relevant balise and the odometer's distance since then."""
    accepted = passages.filter(pl.col("status").cast(pl.String) == PassageStatus.ACCEPTED.value).drop_nulls("path_m")
    odometer = floats(epochs, "odometer_m")
    distance = floats(epochs, "distance_from_lrvb_m")
    origin_m = odometer - floats(epochs, "direction") * distance
    path = floats(epochs, "path_m")
    names = epochs["lrvb_id"]
    changed = np.flatnonzero((names.is_not_null() & names.ne_missing(names.shift())).to_numpy())
    base = np.full(epochs.height, np.nan)
    for first, last in pairwise([*changed.tolist(), epochs.height]):
        places = accepted.filter(pl.col("balise_id") == names[first])["path_m"].to_numpy()
        if places.size:
            near = places if not np.isfinite(path[first]) else places[[np.abs(places - path[first]).argmin()]]
            base[first:last] = near[0] - origin_m[first]
    base[names.is_null().to_numpy()] = np.nan
    return base + odometer


def _areas_at(front_m: Floats, epochs: pl.DataFrame, areas: pl.DataFrame | None, reach_m: float) -> AreaPlaces:
    """The area of each front end: that of the run's epoch that is nearest on the path, none beyond the reach."""
    known = epochs.select("path_m", "netelement_id", "measure_m").drop_nulls().sort("path_m")
    fronts = pl.DataFrame({"path_m": front_m}, schema={"path_m": pl.Float64}).fill_nan(None).with_row_index("row")
    near = fronts.drop_nulls().sort("path_m").join_asof(known, on="path_m", strategy="nearest", tolerance=reach_m)
    places = fronts.select("row").join(near, on="row", how="left", maintain_order="left")
    return areas_at(areas, places["netelement_id"], places["measure_m"])


@frozen
class SpeedErrors:
    """Per window: its end, length, largest estimated speed, and the mean of estimate minus truth as an interval.

    NaN where the evidence does not know it. The mean is beyond the limit at the largest speed only if some instant is
    beyond the limit at its own speed (limits grow with speed); a mean within says nothing of the instants.
    """

    t_ns: Ints
    length_s: Floats
    fastest_kmh: Floats
    low_kmh: Floats
    high_kmh: Floats

    def codes_within_kmh(self, over_kmh: Floats | float, under_kmh: Floats | float) -> Ints:
        """Codes per window: is the estimate at most so much above the train's speed and below it?"""
        return codes(*keeps_and_breaks(self.low_kmh, self.high_kmh, over_kmh, under_kmh))


def speed_errors(front: FrontEnd, window_s: float) -> SpeedErrors:
    """One window after the other; none over a gap, a reversal, or epochs without a speed."""
    clock = front.clock
    pairs = _speed_windows(front, round(window_s * NS_PER_S))
    first, last = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    length_s = (clock.t_ns[last] - clock.t_ns[first]) / NS_PER_S
    steps_m = 0.5 * (front.speed_mps[1:] + front.speed_mps[:-1]) * clock.held_s[:-1]
    until_m = np.concatenate(([0.0], np.cumsum(np.nan_to_num(steps_m))))
    estimated_m = front.direction[first] * (until_m[last] - until_m[first])
    least_m, most_m = _driven_interval_m(front, first, last)
    # The more the train drove, the lower the estimate lies relative to it.
    low_kmh = (estimated_m - most_m) / length_s * KMH_PER_MPS
    high_kmh = (estimated_m - least_m) / length_s * KMH_PER_MPS
    fastest = np.array([np.abs(front.speed_mps[begin : end + 1]).max() for begin, end in pairs], dtype=np.float64)
    return SpeedErrors(clock.t_ns[last], length_s, fastest * KMH_PER_MPS, low_kmh, high_kmh)


def _driven_interval_m(front: FrontEnd, first: Ints, last: Ints) -> tuple[Floats, Floats]:
    """Least and largest distance of the train over windows by the evidence [m]; NaN unless it calls both ends right."""
    begin_m = _train_interval_m(front, first)
    end_m = _train_interval_m(front, last)
    # The estimate is a mean over the time before each epoch: how late that is while the speed changes is not known.
    late_m = front.speed_late_s * np.abs(front.speed_mps[last] - front.speed_mps[first])
    late_m = np.where(front.proved[first] & front.proved[last], late_m, np.nan)
    return end_m[0] - begin_m[1] - late_m, end_m[1] - begin_m[0] + late_m


def _train_interval_m(front: FrontEnd, rows: Ints) -> Floats:
    """Least and largest place of the train in its direction of travel [m]; at joints the estimate less its error."""
    sense = front.direction[rows]
    evidence = np.sort(front.direction[rows] * front.train_m[:, rows], axis=0)
    by_error = sense * front.path_m[rows] - np.stack([front.high_m[rows], front.low_m[rows]])
    return np.where(np.isfinite(evidence).all(axis=0), evidence, by_error)


def _speed_windows(front: FrontEnd, window_ns: int) -> list[tuple[int, int]]:
    """First and last epoch of each window, over which the speed and one direction of travel are known."""
    held = front.clock.held_s
    t_ns = front.clock.t_ns
    sense = front.direction
    usable = np.isfinite(front.speed_mps) & np.isfinite(sense) & (sense != 0)
    joined = usable[:-1] & usable[1:] & (held[:-1] > 0) & (sense[:-1] == sense[1:])
    windows: list[tuple[int, int]] = []
    begin = 0
    for row, together in enumerate(joined, start=1):
        if not together:
            begin = row
        elif t_ns[row] - t_ns[begin] >= window_ns:
            windows.append((begin, row))
            begin = row
    return windows
