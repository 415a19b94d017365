"""Unit, scale, direction and clock of the odometer against the positions and the vehicle file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.follows import Follows, follows_positions
from pipeline.stages.odometry.rows import declared_origin
from pipeline.studies.plausibility.check import (
    IN_VEHICLE_FILE,
    VEHICLE_FILE,
    Cause,
    Check,
    FitState,
    correction,
    explain_factor,
    fits,
    misfit,
    not_checked,
)
from pipeline.studies.plausibility.clocks import StreamLag
from pipeline.studies.plausibility.pairs import LEAST, PairFit, fit_pair, sampled
from pipeline.studies.plausibility.recording import Recording
from pipeline.studies.plausibility.records import MOVING_MPS, SPEED_S, Places, Record
from schemas.arrays import Floats, floats, runs_of
from schemas.config import Configuration, EvidenceConfig, Vehicle
from schemas.enums import MisfitCause, Origin
from schemas.run import RunLog
from schemas.words import say

_SIGNS = "sign of the odometer's speed against its distance"
_TURNS = "direction of the counter where the train reverses"
_COLUMNS = {"distance": "distance_m", "speed": "speed_mps"}
# So many windows agree on the factor of a unit. Pulses, which no unit explains, have to be clearer, and far from 1.
_UNIT_WINDOWS = 0.6
_PULSES_WINDOWS = 0.8
_PULSES_FACTOR = 1.5
# Movements over this time are compared by their signs, except those below this share of the usual one.
_SIGN_S = 10.0
_SIGN_LEAST = 0.2
# The movement over this time before and after a stand shows the heading, where the counter shows the same within this
# share; headings turn back by more than this cosine: a curve of 45 degrees lies within.
_HEADING_S = 20.0
_HEADING_DISTANCE = 0.3
_HEADING_COSINE = 0.7


def odometer_checks(of: Recording) -> tuple[list[Check], list[StreamLag]]:
    """All checks of the odometer, and its clock for comparison with those of the others."""
    if of.run.odometer is None:
        return [], []
    if not of.pairs:
        return [not_checked("odometer against the GNSS", "hardly any row")], []
    checks = [_unit_check(name, of) for name in of.pairs]
    if len(of.counters) == 2:
        checks.append(_sign_check(of.counters))
    name, pair = next((item for item in of.pairs.items() if item[1].known), next(iter(of.pairs.items())))
    if not pair.known:
        return checks, [StreamLag("odometer", reason=pair.reason)]
    checks.append(_turn_check(of.gnss, of.counters[name], pair))
    return [*checks, *_scale_checks(name, of)], [_lag(pair, of)]


def _lag(pair: PairFit, of: Recording) -> StreamLag:
    """The clock of the odometer; it is sure of what is beyond the latency of the vehicle file."""
    if pair.shifted:
        return StreamLag("odometer", pair.lag_s, min(pair.lag_sigma_s, 1.0), sure=True)
    if pair.clock_reason or not pair.lag_known:
        return StreamLag("odometer", reason=pair.clock_reason or "the speed changes too little")
    sure = pair.other_lag(-(of.vehicle.gnss_latency_s or 0.0), of.config.reported_lag_s)
    return StreamLag("odometer", pair.lag_s, pair.lag_sigma_s, sure)


def _unit_check(name: str, of: Recording) -> Check:
    """The unit of one counter."""
    what = f"odometer {name} against the positions"
    pair = of.pairs[name]
    limit = of.config.scale_limit
    if not pair.known:
        return misfit(what, pair.reason) if pair.stands else not_checked(what, pair.reason)
    words = f"{pair.factor:.4g} times the way of the positions"
    if abs(pair.factor - 1.0) <= limit:
        return fits(what, words)
    if pair.constant < _UNIT_WINDOWS or not pair.other_scale(1.0, limit):
        return misfit(what, f"no constant factor ({words} usually)")
    # What the other counter shows too, if it counts metres, is of the wheel or of drifting positions.
    others = [other.factor for other in of.pairs.values() if other is not pair and other.known]
    base = next((other for other in others if abs(other - 1.0) <= 2.0 * limit), 1.0)
    explained = explain_factor(pair.factor / base, name == "speed")
    if explained is None and pair.constant >= _PULSES_WINDOWS and abs(np.log(pair.factor)) > np.log(_PULSES_FACTOR):
        explained = Cause(MisfitCause.PULSES), float(f"{pair.factor:.5g}")
    if explained is None:
        return misfit(what, words)
    cause, exact = explained
    return Check(what, FitState.IMPOSSIBLE, words, (cause,), correction("odometer", {_COLUMNS[name]: 1.0 / exact}))


def _scale_checks(name: str, of: Recording) -> list[Check]:
    """The scale that the run shows against that of the vehicle file, or 1; none of another unit than metres."""
    pair = of.pairs[name]
    config = of.config
    file_scale = of.vehicle.odometer_scale
    what = "odometer scale" if file_scale is None else "odometer scale of the vehicle file"
    metres = abs(pair.factor - 1.0) <= config.scale_limit
    scale = abs(pair.scale)
    lines = f"odometer_scale = {scale:.4f}\nodometer_scale_sigma = {max(2.0 * pair.scale_sigma, 2e-4):.4f}\n"
    if file_scale is not None and abs(file_scale - 1.0) > config.scale_limit:
        causes = (Cause(MisfitCause.IMPOSSIBLE_SCALE),)
        lines = lines if metres else ""
        return [Check(what, FitState.IMPOSSIBLE, f"{file_scale:.4g}", causes, lines, IN_VEHICLE_FILE)]
    if not metres:
        return []
    words = f"the run shows {scale:.4f} (sigma {pair.scale_sigma:.4f})"
    if file_scale is None:
        other = pair.other_scale(1.0, config.reported_scale)
        wheel = misfit(what, words, MisfitCause.WHEEL, lines=lines, into=VEHICLE_FILE)
        return [wheel if other else fits(what, words)]
    words = f"{file_scale:.4f}, {words}"
    least = max(config.file_scale, config.file_sigmas * (of.vehicle.odometer_scale_sigma or 0.0))
    # Where a reference says that the file is right the positions drift.
    by_reference = fit_pair(of.reference, of.counters[name]) if of.reference else pair
    if not pair.other_scale(file_scale, least) or (
        by_reference.known and not by_reference.other_scale(file_scale, least)
    ):
        return [fits(what, words)]
    return [misfit(what, words, MisfitCause.SCALE_OF_FILE, lines=lines, into=IN_VEHICLE_FILE)]


def _sign_check(counters: dict[str, Record]) -> Check:
    """Speed and distance of one odometer."""
    starts = counters["speed"].instants(_SIGN_S)
    gained = np.array([counters[name].gained(starts, starts + _SIGN_S) for name in ("distance", "speed")])
    # By the median of what moves: a counter that is reset seems to run far, once.
    moves = np.all(np.nan_to_num(gained) != 0.0, axis=0)
    gained = gained[:, moves]
    gained = gained[:, np.all(np.abs(gained) > _SIGN_LEAST * np.median(np.abs(gained), axis=1, keepdims=True), axis=0)]
    if gained.shape[1] < LEAST:
        return not_checked(_SIGNS, "hardly any movement with both")
    falls, back = gained < 0
    against = float(np.mean(falls != back))
    if against > 0.9:
        # A train that runs backwards all the way is rarer than a counter of the wrong sign.
        name, does = ("distance", "falls") if falls.mean() > 0.5 else ("speed", "grows")
        causes = (Cause(MisfitCause.COUNTS_BACKWARDS, (name,)),)
        lines = correction("odometer", {_COLUMNS[name]: -1.0})
        return Check(_SIGNS, FitState.IMPOSSIBLE, f"the distance {does} at the opposite speed", causes, lines)
    if against > 0.1 and not back.any() and not falls.all():
        return misfit(_SIGNS, "the speed has no sign", MisfitCause.COUNTER_WITHOUT_SIGN)
    return fits(_SIGNS, "the same")


def _turn_check(gnss: Places, counter: Record, pair: PairFit) -> Check:
    """Whether the counter turns where the train does; stands next to a jump of the position show nothing."""
    grid = gnss.instants(1.0)
    firsts, lasts = (grid[rows] for rows in runs_of(gnss.speed(grid) < MOVING_MPS))
    sides = (firsts - _HEADING_S, firsts), (lasts, lasts + _HEADING_S)
    moved = np.stack([gnss.gained(*side) for side in sides])
    sizes = np.linalg.norm(moved, axis=2)
    counted = np.stack([counter.gained(begin + pair.lag_s, end + pair.lag_s) * pair.scale for begin, end in sides])
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", *moved) / sizes.prod(axis=0)
        sure = np.isfinite(cosine) & (sizes.min(axis=0) > 2.0 * MOVING_MPS * _HEADING_S)
        sure &= np.all(np.abs(np.abs(counted) - sizes) < _HEADING_DISTANCE * sizes, axis=0)
    reverses = sure & (cosine < -_HEADING_COSINE)
    if not reverses.any():
        return not_checked(_TURNS, "the train does not reverse on the way")
    if (counted.prod(axis=0)[reverses] >= 0).all():
        words = f"the train reverses {reverses.sum()} times, the counter never does"
        advice = "Let the recorder write the distance falling, and the speed negative, while the train reverses."
        return misfit(_TURNS, words, MisfitCause.COUNTER_WITHOUT_SIGN, advice=advice)
    return fits(_TURNS, f"{reverses.sum()} reversals")


_WHAT = "GNSS velocity against displacement"
_UP = "GNSS vertical velocity against height"
_VELOCITY_COLUMNS = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
# Slower, scatter turns displacements.
_FAST_MPS = 3.0
# Velocities differ from displacements by less than this share of them: noise of positions over 4 s.
_VELOCITY_SHARE = 0.3
# Exchanged axes or signs explain velocities that are off by this share at least, if they leave at most this part.
_TURNED = 0.1
_EXPLAINED = 0.35
# Up and down differ by this correlation, where the slope changes by so much over the run: 1 % at 10 m/s.
_CLIMB_AGREES = 0.6
_CLIMB_MPS = 0.1
# The mean over a step by the trapezium rule.
_MEAN = np.array([0.125, 0.25, 0.25, 0.25, 0.125])


class Arrangement(NamedTuple):
    """How recorded velocities become east and north: exchanged first, then these signs."""

    exchanged: bool
    east: float
    north: float

    def turned(self, velocity: Floats) -> Floats:
        """Velocities as they should be, (n, 2) east and north."""
        ordered = velocity[:, ::-1] if self.exchanged else velocity
        turned: Floats = ordered * np.array([self.east, self.north])
        return turned

    def correction(self, factor: float) -> str:
        """The lines of configuration that undo this arrangement and scale all axes."""
        axes = (self.east * factor, self.north * factor, factor)
        changed = {name: value for name, value in zip(_VELOCITY_COLUMNS, axes, strict=True) if value != 1.0}
        return correction("gnss", changed, exchange=_VELOCITY_COLUMNS[:2] if self.exchanged else None)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """What was done to the axes."""
        signs = [name for name, sign in (("east", self.east), ("north", self.north)) if sign < 0]
        exchanged = (Cause(MisfitCause.VELOCITY_EXCHANGED),) if self.exchanged else ()
        return exchanged + ((Cause(MisfitCause.VELOCITY_SIGN, (" and ".join(signs),)),) if signs else ())


_AS_RECORDED, *_OTHERS = (Arrangement(*parts) for parts in product((False, True), (1.0, -1.0), (1.0, -1.0)))


def velocity_checks(of: Recording) -> list[Check]:
    """The recorded velocity, as mean over steps, against the displacement of the positions."""
    rows = np.column_stack([floats(of.fixes, name) for name in _VELOCITY_COLUMNS])
    known = np.isfinite(rows[:, :2]).all(axis=1)
    if not known.any():
        return []
    gnss = of.gnss
    begin_s = gnss.instants(SPEED_S)
    begin_s = begin_s[sampled(gnss.known(begin_s) & gnss.known(begin_s + SPEED_S))]
    near = np.clip(np.searchsorted(gnss.t_s, begin_s), 0, gnss.t_s.size - 1)
    axes = np.stack([gnss.points.east[near], gnss.points.north[near]], axis=1)
    moved = np.einsum("ijk,ik->ij", axes, gnss.gained(begin_s, begin_s + SPEED_S)) / SPEED_S
    fast = np.linalg.norm(moved, axis=1) > _FAST_MPS
    if known.sum() < LEAST or fast.sum() < 2 * LEAST or not rows[known, :2].any():
        return [not_checked(_WHAT, "hardly any movement with a velocity")]
    instants = begin_s[fast, None] + np.linspace(0.0, SPEED_S, _MEAN.size)
    t_s = of.seconds(of.fixes)[known]
    recorded = np.column_stack([np.interp(instants, t_s, axis) @ _MEAN for axis in rows[known].T])
    return [_horizontal(recorded[:, :2], moved[fast], of), *_vertical(recorded[:, 2], begin_s[fast], of)]


def _horizontal(recorded: Floats, moved: Floats, of: Recording) -> Check:
    """Axes and signs first, by the arrangement that leaves least; then the unit, by the ratio of the speeds."""
    speed = np.linalg.norm(moved, axis=1)
    ratio = float(np.median(np.linalg.norm(recorded, axis=1) / speed))

    def misses(arrangement: Arrangement) -> float:
        """What it leaves usually, as a share of the speed."""
        left = arrangement.turned(recorded) / max(ratio, 1e-9) - moved
        return float(np.median(np.linalg.norm(left, axis=1) / speed))

    best = min(_OTHERS, key=misses)
    off = misses(_AS_RECORDED)
    turned = off > _TURNED and misses(best) <= min(_EXPLAINED * off, _VELOCITY_SHARE)
    elsewhere = f"they point elsewhere, by {off:.0%} of the speed"
    if off > _VELOCITY_SHARE and not turned:
        return misfit(_WHAT, elsewhere, MisfitCause.VELOCITY_FRAME)
    if turned and off <= _VELOCITY_SHARE:
        return Check(_WHAT, FitState.MISFIT, elsewhere, best.causes)
    return _magnitude(ratio, best if turned else _AS_RECORDED, of.config.scale_limit)


def _magnitude(ratio: float, arrangement: Arrangement, limit: float) -> Check:
    """The recorded speed over that of the positions: it fits, or a known unit explains it."""
    words = f"the recorded speed is {ratio:.4g} times that of the positions"
    explained = explain_factor(ratio, True) if abs(ratio - 1.0) > limit else None
    if explained is None and arrangement == _AS_RECORDED:
        return fits(_WHAT, words) if abs(ratio - 1.0) <= 1.5 * limit else misfit(_WHAT, words)
    if explained is None:
        return Check(_WHAT, FitState.IMPOSSIBLE, words, arrangement.causes, arrangement.correction(1.0))
    cause, unit = explained
    causes = (cause, *arrangement.causes)
    return Check(_WHAT, FitState.IMPOSSIBLE, words, causes, arrangement.correction(1.0 / unit))


def _vertical(up_mps: Floats, begin_s: Floats, of: Recording) -> list[Check]:
    """Up against down."""
    gnss = of.gnss
    known = np.isfinite(gnss.height_m)
    if not np.isfinite(up_mps).all() or known.sum() < 2 * LEAST:
        return []
    ends = np.interp([begin_s, begin_s + SPEED_S], gnss.t_s[known], gnss.height_m[known])
    climbed = (ends[1] - ends[0]) / SPEED_S
    # Jumps of the height are no climbing.
    kept = np.abs(climbed) < 4.0 * np.median(np.abs(climbed)) + _CLIMB_MPS
    climbed = climbed[kept]
    up_mps = up_mps[kept]
    agreement = 0.0
    if climbed.size >= 2 * LEAST and np.std(climbed) >= _CLIMB_MPS and np.ptp(up_mps):
        agreement = float(np.corrcoef(climbed, up_mps)[0, 1])
    if abs(agreement) <= _CLIMB_AGREES:
        return [not_checked(_UP, "the run hardly climbs")]
    words = f"correlation {agreement:.2f}"
    if agreement > 0.0:
        return [fits(_UP, words)]
    causes = (Cause(MisfitCause.VELOCITY_DOWN),)
    return [Check(_UP, FitState.IMPOSSIBLE, words, causes, correction("gnss", {"vel_u_mps": -1.0}))]


COLUMNS = ("sensor", "origin", "declared_by", "what_it_is_good_for")


def follows_check(sensor: str, found: Follows, config: EvidenceConfig) -> Check:
    """Whether the steps of an odometer are those of the positions; no verdict hangs on these words."""
    what = say("odometers", "check", sensor)
    if found.found(config):
        by_steps = found.ratio is not None and found.ratio < config.follows_limit
        words = say("odometers", "copied_noise", found.ratio, config.follows_limit) if by_steps else ""
        words = words or say("odometers", "copied_stand")
        return Check(what, FitState.MISFIT, words, (Cause(MisfitCause.COPY),), advice=say("odometers", "advice"))
    if found.ratio is None:
        return not_checked(what, say("odometers", "too_short"))
    return fits(what, say("odometers", "own_noise", found.ratio))


def sensors_of(run: RunLog) -> list[tuple[str, pl.DataFrame]]:
    """The odometers of a cleaned run by name, that of the LDS first."""
    frames = [frame for frame in (run.odometer, *run.other_odometers) if frame is not None and frame.height]
    return [(frame["sensor"][0] if "sensor" in frame.columns else "primary", frame) for frame in frames]


def follows_checks(run: RunLog, solution: str, config: Configuration) -> list[Check]:
    """Checks of each odometer against the positions of one solution of a cleaned run."""
    fixes = run.gnss.filter(pl.col("solution") == solution)
    return [
        follows_check(name, follows_positions(frame, fixes, config), config.evidence) for name, frame in sensors_of(run)
    ]


def origins_table(run: RunLog, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """One row per odometer of a cleaned run: where it comes from, who says so, and what to write where nobody does."""
    return pl.DataFrame(list(_rows(run, vehicle, config)), schema=dict.fromkeys(COLUMNS, pl.String), orient="row")


def _rows(run: RunLog, vehicle: Vehicle, config: Configuration) -> Iterator[tuple[str, ...]]:
    """Rows of `COLUMNS`, one per odometer."""
    for number, (name, frame) in enumerate(sensors_of(run)):
        # The vehicle file speaks of the odometer that the LDS uses.
        of_vehicle = Vehicle() if number else vehicle
        origin = declared_origin(frame, of_vehicle)
        by_stream = declared_origin(frame, Vehicle()) is not Origin.UNKNOWN
        by = "by_stream" if by_stream else "by_nobody" if origin is Origin.UNKNOWN else "by_vehicle"
        found = [follows_positions(frame, fixes, config) for fixes in run.gnss.partition_by("solution")]
        follows = any(one.found(config.evidence) for one in found)
        yield name, origin.value, say("odometers", by), _use(origin, follows, used=not number)


def _use(origin: Origin, follows: bool, used: bool) -> str:
    """What an odometer of this origin is good for, in words; `used`: it is that of the LDS."""
    if follows:
        return say("odometers", "follows")
    if origin.independent:
        return say("odometers", "independent")
    if origin is Origin.UNKNOWN:
        return say("odometers", "unknown", say("odometers", "line_used" if used else "line_other"))
    return say("odometers", "of_gnss")


def undeclared(table: pl.DataFrame) -> Sequence[str]:
    """The same as sentences, of odometers that are not declared to be independent, or are not."""
    rows = table.filter(pl.col("what_it_is_good_for") != say("odometers", "independent"))
    return [
        say("odometers", "sentence", row["sensor"], say("origins", row["origin"]), row["what_it_is_good_for"])
        for row in rows.iter_rows(named=True)
    ]
