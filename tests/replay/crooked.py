"""Worlds whose witnesses copy, lag, step, freeze, drift, stall, slip back or end early, and the truth beside them.

A train runs over a curved line of two net elements, A and then B, which is stored against the direction of travel.
Where it was is known to the oracle alone, which shares no code with the program: a plane, and degrees from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import dataframely as dy
import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats
from schemas.config import Configuration, Vehicle
from schemas.conform import conform
from schemas.inputs import BaliseReads, Balises, Gnss, Odometer, Reference, Track
from schemas.inputs import Links as LinkTable
from schemas.run import RunLog, RunTables, Site

START_NS = 1_700_000_000_000_000_000
EARTH_M = 6_371_000.0
LATITUDE_DEG, LONGITUDE_DEG = 50.0, 14.0
LINE_M = 11_000.0
BORDER_M = 5_200.0
FAILURE_M = 20.0
# Beyond the limit by so much nobody argues about the rounding of an interval [m].
SLACK_M = 0.5


@dataclass(frozen=True)
class Recorder:
    """What one recorder wrote: times of its stamps [s] and values; `sigma_m` as it states it."""

    t_s: Floats
    along_m: Floats
    aside_m: Floats
    sigma_m: float

    def where(self, kept: Bools) -> Recorder:
        return replace(self, t_s=self.t_s[kept], along_m=self.along_m[kept], aside_m=self.aside_m[kept])


@dataclass
class World:
    """One journey with its recorders; families change them before the run is built."""

    dice: np.random.Generator
    t_s: Floats
    true_m: Floats
    fault_m: Floats
    aside_m: Floats
    gnss: Recorder
    odometer: Recorder
    reference: Recorder | None
    reads: list[tuple[float, str]]
    origin: str | None = "wheel"
    vehicle: Vehicle = field(default_factory=Vehicle)
    complete: bool = True
    survey_m: float = 0.3

    @property
    def last_s(self) -> float:
        return float(self.t_s[-1])

    def place_m(self, at_s: Floats) -> Floats:
        return np.interp(at_s, self.t_s, self.true_m)

    @property
    def read_ns(self) -> list[int]:
        return [START_NS + round(1e9 * at_s) for at_s, _ in self.reads]

    def run(self) -> RunLog:
        reference = None
        if self.reference is not None and self.reference.t_s.size:
            reference = _table(
                self._places(self.reference).with_columns(sigma_m=pl.lit(self.reference.sigma_m)), Reference
            )
        variance = self.gnss.sigma_m**2
        gnss = self._places(self.gnss).with_columns(
            solution=pl.lit("primary"),
            fix=pl.lit("sbas"),
            cov_ee_m2=pl.lit(variance),
            cov_nn_m2=pl.lit(variance),
            cov_uu_m2=pl.lit(2.25 * variance),
            cov_en_m2=pl.lit(0.0),
            cov_eu_m2=pl.lit(0.0),
            cov_nu_m2=pl.lit(0.0),
        )
        return RunLog(
            "crooked",
            _table(gnss, Gnss),
            odometer=self._odometer(),
            reference=reference,
            balise_reads=self._reads(),
        )

    def site(self) -> Site:
        return ground(self.survey_m)

    def config(self) -> Configuration:
        return Configuration.model_validate({"evidence": {"survey_complete": self.complete}})

    def _places(self, recorder: Recorder) -> pl.DataFrame:
        x_m, y_m, heading = plane(recorder.along_m)
        latitude, longitude = degrees(
            x_m - recorder.aside_m * np.sin(heading), y_m + recorder.aside_m * np.cos(heading)
        )
        return pl.DataFrame(
            {
                "t": stamps(recorder.t_s),
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "height_m": 0.0 * latitude,
            }
        )

    def _odometer(self) -> pl.DataFrame:
        counted = {"t": stamps(self.odometer.t_s), "distance_m": self.odometer.along_m}
        return _table(
            pl.DataFrame(counted).with_columns(sensor=pl.lit("primary"), origin=pl.lit(self.origin)), Odometer
        )

    def _reads(self) -> pl.DataFrame:
        at_s = np.array([at for at, _ in self.reads], dtype=float)
        return _table(pl.DataFrame({"t": stamps(at_s), "balise_id": [name for _, name in self.reads]}), BaliseReads)


def _table(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """As the contract has it; a column that is not given is unknown."""
    missing = [name for name in schema.columns() if name not in frame.columns]
    return conform(frame.with_columns(pl.lit(None).alias(name) for name in missing), schema)


def stamps(t_s: Floats) -> pl.Series:
    return pl.Series("t", START_NS + np.round(1e9 * t_s).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def degrees(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
    """WGS 84 about one place, by the ellipsoid's two radii."""
    sine = np.sin(np.radians(LATITUDE_DEG))
    flat = 1.0 - 0.00669437999014 * sine**2
    across_m = 6_378_137.0 / np.sqrt(flat)
    meridian_m = 6_378_137.0 * (1.0 - 0.00669437999014) / flat**1.5
    latitude = LATITUDE_DEG + np.degrees(y_m / meridian_m)
    return latitude, LONGITUDE_DEG + np.degrees(x_m / (across_m * np.cos(np.radians(LATITUDE_DEG))))


_FINE_M = np.arange(-500.0, LINE_M + 500.0, 1.0)
_HEADING = 0.4 + 0.35 * np.sin(2.0 * np.pi * _FINE_M / 6_000.0)
_X_M = np.concatenate([[0.0], np.cumsum(np.cos(_HEADING[:-1]))])
_Y_M = np.concatenate([[0.0], np.cumsum(np.sin(_HEADING[:-1]))])


def plane(along_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Place east and north and direction at a chainage [m, m, rad]."""
    return tuple(np.interp(along_m, _FINE_M, values) for values in (_X_M, _Y_M, _HEADING))  # type: ignore[return-value]


def ground(survey_m: float) -> Site:
    """Two net elements, the second against the chainage; virtual balises each 450 m, physical ones each 1,700 m."""
    points = []
    for name, begin_m, end_m in (("A", 0.0, BORDER_M), ("B", BORDER_M, LINE_M)):
        at_m = np.append(np.arange(begin_m, end_m, 10.0), end_m)
        at_m = at_m if name == "A" else at_m[::-1]
        x_m, y_m, _ = plane(at_m)
        latitude, longitude = degrees(x_m, y_m)
        steps_m = np.hypot(np.diff(x_m), np.diff(y_m))
        columns = {"measure_m": np.concatenate([[0.0], np.cumsum(steps_m)]), "latitude_deg": latitude}
        frame = pl.DataFrame({**columns, "longitude_deg": longitude})
        points.append(frame.with_columns(netelement_id=pl.lit(name), sigma_m=pl.lit(survey_m)))
    link = {
        "netelement_a": ["A"],
        "position_a": [1],
        "netelement_b": ["B"],
        "position_b": [1],
        "navigability": ["both"],
    }
    balises = [(f"V{number}", 450.0 * number + 120.0, "virtual") for number in range(1, 24)]
    balises += [(f"P{number}", 1_700.0 * number - 900.0, "physical") for number in range(1, 8)]
    rows = [(name, *element_of(at_m), kind) for name, at_m, kind in balises]
    plain = {"location_accuracy_m": 12.0, "linked": True, "link_reaction": "service_brake", "direction": "both"}
    names = ["balise_id", "netelement_id", "measure_m", "kind"]
    listed = pl.DataFrame(rows, schema=names, orient="row").with_columns(**{n: pl.lit(v) for n, v in plain.items()})
    return Site(
        _table(pl.concat(points), Track), _table(pl.DataFrame(link), LinkTable), balises=_table(listed, Balises)
    )


PHYSICAL_M = {f"P{number}": 1_700.0 * number - 900.0 for number in range(1, 8)}


def element_of(along_m: float) -> tuple[str, float]:
    """Net element and measure of a chainage."""
    return ("A", along_m) if along_m <= BORDER_M else ("B", LINE_M - along_m)


def chainage_m(element: pl.Series, measure_m: pl.Series) -> Floats:
    first = (element == "A").fill_null(value=True).to_numpy()
    return np.where(first, measure_m.to_numpy(), LINE_M - measure_m.to_numpy())


def honest(seed: int, lasts_s: float = 300.0) -> World:
    """A train that starts, changes its speed and stops; recorders of drawn rates and noises, and mostly a fault."""
    dice = np.random.default_rng([20_261_128, seed])
    t_s = np.arange(0.0, lasts_s, 0.05)
    knots_s = np.array([0.0, 10.0, *np.sort(dice.uniform(50.0, lasts_s - 40.0, 4)), lasts_s - 12.0, lasts_s])
    speeds = np.array([0.0, 0.0, *dice.uniform(8.0, 38.0, 4), 0.0, 0.0])
    true_m = 250.0 + np.concatenate([[0.0], np.cumsum(np.interp(t_s, knots_s, speeds)[:-1]) * 0.05])
    gnss_s = np.arange(0.2, lasts_s - 0.5, 1.0 / float(dice.choice([1.0, 2.0, 5.0])))
    counted_s = np.arange(0.0, lasts_s - 0.1, 1.0 / float(dice.choice([5.0, 10.0])))
    referred_s = np.arange(0.1, lasts_s - 0.4, 1.0 / float(dice.choice([1.0, 5.0])))
    begin_s, size_m = dice.uniform(90.0, 150.0), dice.choice([0.0, 30.0, -45.0, 60.0], p=[0.2, 0.3, 0.3, 0.2])
    fault_m = np.where(t_s > begin_s, size_m, 0.0)
    if dice.random() < 0.4:
        fault_m = np.clip((t_s - begin_s) * np.sign(size_m) * 0.4, -abs(size_m), abs(size_m)) * (t_s > begin_s)
    world = World(
        dice,
        t_s,
        true_m,
        fault_m,
        np.zeros(t_s.size),
        Recorder(gnss_s, walk(dice, gnss_s, 0.6), walk(dice, gnss_s, 0.6), 1.0),
        Recorder(counted_s, walk(dice, counted_s, 0.0), np.zeros(counted_s.size), 0.0),
        Recorder(referred_s, dice.normal(0.0, 0.05, referred_s.size), dice.normal(0.0, 0.05, referred_s.size), 0.1),
        [],
        vehicle=KNOWN if dice.random() < 0.5 else Vehicle(),
        survey_m=float(dice.choice([0.1, 0.3, 1.0])),
    )
    world.gnss = replace(
        world.gnss, along_m=world.gnss.along_m + world.place_m(gnss_s) + np.interp(gnss_s, t_s, fault_m)
    )
    world.odometer = replace(world.odometer, along_m=world.odometer.along_m + world.place_m(counted_s) - 250.0)
    if world.reference is not None:
        world.reference = replace(world.reference, along_m=world.reference.along_m + world.place_m(referred_s))
    passed = {name: at_m for name, at_m in PHYSICAL_M.items() if true_m[0] < at_m < true_m[-1]}
    world.reads = [(float(np.interp(at_m, true_m, t_s)), name) for name, at_m in passed.items()]
    return world


KNOWN = Vehicle(odometer_scale=1.0, odometer_scale_sigma=5e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.005)


def walk(dice: np.random.Generator, t_s: Floats, sigma_m: float, tau_s: float = 100.0) -> Floats:
    """Gauss-Markov error with a little white noise [m]."""
    kept = np.exp(-np.diff(t_s, prepend=t_s[0]) / tau_s)
    kicks = dice.normal(0.0, 1.0, t_s.size) * sigma_m * np.sqrt(1.0 - kept**2)
    error = np.empty(t_s.size)
    now = dice.normal(0.0, sigma_m)
    for number, (keep, kick) in enumerate(zip(kept, kicks, strict=True)):
        now = keep * now + kick
        error[number] = now
    return error + dice.normal(0.0, 0.02, t_s.size)


# ---- families: each takes an honest world and makes a witness crooked ----


def late(recorder: Recorder, lag_s: float) -> Recorder:
    return replace(recorder, t_s=recorder.t_s + lag_s)


def lag_of_reference(world: World) -> World:
    """The reference stamps 0.1 to 2 s late, or early, and the GNSS with it in half of the worlds."""
    lag_s = float(world.dice.choice([-1.0, 1.0]) * world.dice.uniform(0.1, 2.0))
    world.reference = late(_reference(world), lag_s)
    if world.dice.random() < 0.5:
        world.gnss = late(world.gnss, lag_s)
    return world


def one_bus(world: World) -> World:
    """GNSS and odometer go over one bus, and both stamp late."""
    lag_s = float(world.dice.uniform(0.3, 1.5))
    world.gnss = late(world.gnss, lag_s)
    world.odometer = late(world.odometer, lag_s)
    return world


def shared_step(world: World) -> World:
    """GNSS and reference are both off by more than the limit, and jump back together, across a gap or not."""
    back_s = float(world.dice.uniform(110.0, 200.0))
    off_m = float(world.dice.choice([-1.0, 1.0]) * world.dice.uniform(24.0, 50.0))
    before = bool(world.dice.random() < 0.6)
    world.gnss = _shifted(world.gnss, (world.gnss.t_s < back_s) == before, off_m)
    reference = _reference(world)
    world.reference = _shifted(reference, (reference.t_s < back_s) == before, off_m)
    if world.dice.random() < 0.5:
        gap_s = float(world.dice.uniform(2.5, 15.0))
        world.reference = world.reference.where(np.abs(world.reference.t_s - back_s) > 0.5 * gap_s)
    return world


def freeze(world: World) -> World:
    """Reference and GNSS repeat one place for some seconds while the train moves on, noise kept or not."""
    begin_s, lasts_s = float(world.dice.uniform(60.0, 200.0)), float(world.dice.uniform(3.0, 20.0))
    world.gnss = _frozen(world.gnss, begin_s, lasts_s)
    world.reference = _frozen(_reference(world), begin_s, lasts_s)
    if world.dice.random() < 0.5:
        noise_m = world.dice.normal(0.0, 0.03, world.reference.t_s.size)
        world.reference = replace(world.reference, along_m=world.reference.along_m + noise_m)
    return world


def shared_drift(world: World) -> World:
    """Reference and GNSS drift away together at 0.15 to 2 m/s."""
    begin_s, rate_mps = float(world.dice.uniform(60.0, 120.0)), float(world.dice.uniform(0.15, 2.0))
    top_m = float(world.dice.uniform(25.0, 80.0))
    for name in ("gnss", "reference"):
        recorder = getattr(world, name)
        drift_m = np.clip(rate_mps * (recorder.t_s - begin_s), 0.0, top_m)
        setattr(world, name, replace(recorder, along_m=recorder.along_m + drift_m))
    return world


def counter_set(world: World) -> World:
    """The counter is set anew, at a stand or on the way; no reference."""
    at_s = float(world.dice.uniform(20.0, 250.0))
    by_m = float(world.dice.choice([-1.0, 1.0]) * world.dice.uniform(10.0, 300.0))
    world.odometer = _shifted(world.odometer, world.odometer.t_s > at_s, by_m)
    world.reference = None
    return world


def stall(world: World) -> World:
    """The odometer's logger repeats its rows for a while, and jumps on or goes on from there; no reference."""
    begin_s, lasts_s = float(world.dice.uniform(60.0, 200.0)), float(world.dice.uniform(1.0, 6.0))
    moved = world.odometer.along_m
    world.odometer = _frozen(world.odometer, begin_s, lasts_s)
    if world.dice.random() < 0.5:
        after = world.odometer.t_s > begin_s + lasts_s
        lost_m = float(np.ptp(moved[(world.odometer.t_s > begin_s) & ~after]))
        world.odometer = _shifted(world.odometer, after, -lost_m)
    world.reference = None
    return world


def slow_part(world: World) -> World:
    """A part of the GNSS log is slow, and the fault of some seconds lies there."""
    begin_s = float(world.dice.uniform(80.0, 160.0))
    t_s = world.gnss.t_s
    fault = (t_s > begin_s + 20.0) & (t_s < begin_s + 20.0 + world.dice.uniform(1.5, 4.0))
    world.gnss = _shifted(world.gnss, fault, 40.0)
    slow = (t_s > begin_s) & (t_s < begin_s + 60.0)
    world.gnss = world.gnss.where(~slow | (np.abs(t_s % 1.0 - t_s[0] % 1.0) < 1e-6))
    return world


def aside(world: World) -> World:
    """The train runs on a track 3.6 to 5 m beside the surveyed one, and nobody says that the survey is complete."""
    off_m = float(world.dice.choice([-1.0, 1.0]) * world.dice.uniform(3.6, 5.0))
    world.complete = False
    begin_s = float(world.dice.choice([-9.0, 100.0]))
    for name in ("gnss", "reference"):
        recorder = getattr(world, name)
        # Over a turnout of some 100 m.
        there = np.clip((recorder.t_s - begin_s) / 5.0, 0.0, 1.0)
        setattr(world, name, replace(recorder, aside_m=recorder.aside_m + off_m * there))
    world.aside_m = np.where(world.t_s > begin_s + 4.0, off_m, 0.0)
    world.reads = [] if begin_s < 0.0 else [(at_s, name) for at_s, name in world.reads if at_s < begin_s]
    return world


def copied(world: World) -> World:
    """The odometer and the reads are made of the positions; declared a wheel, undeclared, or what it is."""
    smooth = max(1, round(1.0 / float(np.median(np.diff(world.gnss.t_s)))))
    mean = np.ones(2 * smooth + 1) / (2 * smooth + 1)
    along_m: Floats = np.convolve(np.pad(world.gnss.along_m, smooth, mode="edge"), mean, "valid")
    world.odometer = Recorder(world.gnss.t_s, along_m - along_m[0], 0.0 * along_m, 0.0)
    world.origin = str(world.dice.choice(["unknown", "gnss", "fused"]))
    world.reference = None
    if world.dice.random() < 0.5:
        grown_m = np.maximum.accumulate(along_m)
        world.reads = [(float(np.interp(PHYSICAL_M[name], grown_m, world.gnss.t_s)), name) for _, name in world.reads]
    return world


def late_reads(world: World) -> World:
    """The reads have a clock of their own, up to 3 s off, or one of them names another balise; no reference."""
    lag_s = float(world.dice.uniform(-3.0, 3.0))
    world.reads = [(at_s + lag_s, name) for at_s, name in world.reads if 0.0 < at_s + lag_s < world.last_s]
    if len(world.reads) > 2 and world.dice.random() < 0.3:
        world.reads[1] = (world.reads[1][0], world.reads[2][1])
    world.reference = None
    return world


def ends_early(world: World) -> World:
    """Odometer, reference and reads end while the train and its GNSS go on."""
    end_s = float(world.dice.uniform(100.0, 220.0))
    world.odometer = world.odometer.where(world.odometer.t_s < end_s)
    reference = _reference(world)
    world.reference = reference.where(reference.t_s < end_s + world.dice.uniform(-30.0, 30.0))
    world.reads = [(at_s, name) for at_s, name in world.reads if at_s < end_s]
    return world


def wrong_scale(world: World) -> World:
    """The counter counts 0.5 to 3 % too much or too little; no reference."""
    scale = 1.0 + float(world.dice.choice([-1.0, 1.0]) * world.dice.uniform(0.005, 0.03))
    world.odometer = replace(world.odometer, along_m=world.odometer.along_m * scale)
    world.reference = None
    return world


def by_reads(world: World) -> World:
    """Reads and odometer only, all honest."""
    world.reference = None
    return world


def _reference(world: World) -> Recorder:
    assert world.reference is not None
    return world.reference


def _shifted(recorder: Recorder, where: Bools, by_m: float) -> Recorder:
    return replace(recorder, along_m=recorder.along_m + by_m * where)


def _frozen(recorder: Recorder, begin_s: float, lasts_s: float) -> Recorder:
    t_s = recorder.t_s
    first = int(np.searchsorted(t_s, begin_s))
    held = np.arange(t_s.size)
    held[(t_s >= begin_s) & (t_s < begin_s + lasts_s)] = first
    return replace(recorder, along_m=recorder.along_m[held], aside_m=recorder.aside_m[held])


FAMILIES: dict[str, Callable[[World], World]] = {
    "honest": lambda world: world,
    "by_reads": by_reads,
    "lag_of_reference": lag_of_reference,
    "one_bus": one_bus,
    "shared_step": shared_step,
    "freeze": freeze,
    "shared_drift": shared_drift,
    "counter_set": counter_set,
    "stall": stall,
    "slow_part": slow_part,
    "aside": aside,
    "copied": copied,
    "late_reads": late_reads,
    "ends_early": ends_early,
    "wrong_scale": wrong_scale,
}


CLOCKS_DIFFER = frozenset({"lag_of_reference", "one_bus", "late_reads"})
"""Families in which a recorder stamps late."""


def world_of(family: str, seed: int) -> World:
    return FAMILIES[family](honest(seed))


# ---- less evidence ----


def thinned(world: World) -> World:
    if world.reference is not None:
        world.reference = world.reference.where(np.arange(world.reference.t_s.size) % 3 == 0)
    return world


def cut_out(world: World) -> World:
    begin_s, lasts_s = float(world.dice.uniform(20.0, 240.0)), float(world.dice.uniform(3.0, 60.0))
    if world.reference is not None:
        inside = (world.reference.t_s > begin_s) & (world.reference.t_s < begin_s + lasts_s)
        world.reference = world.reference.where(~inside)
    return world


def frozen_reference(world: World) -> World:
    """It repeats one place, while the train goes on."""
    begin_s, lasts_s = _part(world)
    if world.reference is not None:
        world.reference = _frozen(world.reference, begin_s, lasts_s)
    return world


def thinned_odometer(world: World) -> World:
    every = int(world.dice.choice([2, 5, 10]))
    world.odometer = world.odometer.where(np.arange(world.odometer.t_s.size) % every == 0)
    return world


def cut_odometer(world: World) -> World:
    begin_s, lasts_s = _part(world)
    t_s = world.odometer.t_s
    world.odometer = world.odometer.where((t_s < begin_s) | (t_s > begin_s + lasts_s))
    return world


def frozen_odometer(world: World) -> World:
    world.odometer = _frozen(world.odometer, *_part(world))
    return world


def _part(world: World) -> tuple[float, float]:
    """Begin and length of a part of the journey [s]."""
    return float(world.dice.uniform(20.0, 240.0)), float(world.dice.uniform(2.0, 40.0))


def fewer_reads(world: World) -> World:
    kept = world.dice.random(len(world.reads)) < 0.5
    world.reads = [read for read, stays in zip(world.reads, kept.tolist(), strict=True) if stays]
    return world


def no_reads(world: World) -> World:
    world.reads = []
    return world


def no_reference(world: World) -> World:
    world.reference = None
    return world


def undeclared(world: World) -> World:
    world.origin = None
    return world


def open_survey(world: World) -> World:
    world.complete = False
    return world


WEAKER: dict[str, Callable[[World], World]] = {
    "thinned": thinned,
    "cut_out": cut_out,
    "frozen_reference": frozen_reference,
    "thinned_odometer": thinned_odometer,
    "cut_odometer": cut_odometer,
    "frozen_odometer": frozen_odometer,
    "fewer_reads": fewer_reads,
    "no_reads": no_reads,
    "no_reference": no_reference,
    "undeclared": undeclared,
    "open_survey": open_survey,
}
OF_ODOMETER = ("thinned_odometer", "cut_odometer", "frozen_odometer")


# ---- the oracle ----


@dataclass(frozen=True)
class Danger:
    """Epochs and balises called right beyond the limit, and a run called safe in spite of one."""

    right_epochs: int
    right_balises: int
    accepted_while_safe: int

    @property
    def any(self) -> bool:
        return bool(self.right_epochs or self.right_balises or self.accepted_while_safe)


def danger_of(world: World, tables: RunTables) -> Danger:
    epochs, passages = tables.epochs, tables.passages
    at_s = (epochs["t"].dt.timestamp("ns").to_numpy() - START_NS) / 1e9
    error_m = chainage_m(epochs["netelement_id"], epochs["measure_m"]) - world.place_m(at_s)
    beyond = np.abs(error_m) > FAILURE_M + SLACK_M
    elsewhere = np.interp(at_s, world.t_s, np.abs(world.aside_m)) > 0.0
    right = (epochs["judgement"].cast(pl.String) == "right").to_numpy()
    offered = passages.filter(pl.col("t_offered").is_not_null())
    offered_s = (offered["t_offered"].dt.timestamp("ns").to_numpy() - START_NS) / 1e9
    off_m = chainage_m(offered["netelement_id"], offered["measure_m"]) - world.place_m(offered_s)
    wrong = (np.abs(off_m) > FAILURE_M + SLACK_M) | (np.interp(offered_s, world.t_s, np.abs(world.aside_m)) > 0.0)
    judged_right = (offered["judgement"].cast(pl.String) == "right").fill_null(value=False).to_numpy()
    accepted = (offered["status"].cast(pl.String) == "accepted").to_numpy()
    safe = verdict_of(tables) == "safe"
    return Danger(
        int((right & (beyond | elsewhere)).sum()),
        int((judged_right & wrong).sum()),
        int(safe * (accepted & wrong).sum()),
    )


def verdict_of(tables: RunTables) -> str:
    return str(tables.runs["verdict"][0])


def reasons_of(tables: RunTables) -> list[str]:
    return [str(reason) for reason in tables.runs["reasons"][0]]
