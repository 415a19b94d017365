"""Is the track right where lines branch, cross and come back?

`python -m benchmarks.truth.topologies [--runs N] [--seed S]`.

Worlds by chance: rings, balloon loops, shuttles, yards, crossings at grade and above, stations, passing loops,
turnouts and ladders on one of two tracks.
Tracks are drawn from curves of a radius, trains drive them from element to element, and both the track and the place of
every epoch are known. Errors are those of `benchmarks.truth.calibration`; nothing here uses the program's geometry.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from benchmarks.truth.calibration import degrees, fixes_at, noise, odometer_at, stated
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from schemas.arrays import floats
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import Links, Track
from schemas.run import Site

# About a joint of two elements either is right, for positions are no better [m].
JOINT_M = 30.0
# At a switch two tracks are one until they are so far apart [m].
ONE_TRACK_M = 2.0
SURE = 0.99


@dataclass
class World:
    """Elements as points (x, y, height) [m], links, and a ride: elements with the measures driven from and to [m]."""

    elements: dict[str, np.ndarray] = field(default_factory=dict)
    links: list[tuple[str, int, str, int, str]] = field(default_factory=list)
    ride: list[tuple[str, float, float]] = field(default_factory=list)

    def link(self, one: str, end: int, other: str, start: int) -> None:
        self.links.append((one, end, other, start, "both"))

    def length(self, name: str) -> float:
        return float(measures(self.elements[name])[-1])

    def through(self, *names: str, start_m: float = 40.0, stop_m: float = 40.0) -> None:
        """Drive elements one after the other, `-name` against its measure, some metres left out at both ends."""
        for name in names:
            one = name.lstrip("-")
            ends = (0.0, self.length(one)) if name == one else (self.length(one), 0.0)
            self.ride.append((one, *ends))
        name, begin, end = self.ride[0]
        self.ride[0] = (name, float(begin + start_m * np.sign(end - begin)), end)
        name, begin, end = self.ride[-1]
        self.ride[-1] = (name, begin, float(end - stop_m * np.sign(end - begin)))


@dataclass(frozen=True)
class Drive:
    """Truth per epoch: element, measure, place (x, y, height) and way driven with its sign [m]."""

    t_s: np.ndarray
    element: np.ndarray
    measure_m: np.ndarray
    place: np.ndarray
    chainage_m: np.ndarray


@dataclass(frozen=True)
class Verdict:
    """Shares of epochs on a wrong element, and on one that is claimed; how far the path is off at worst [m]."""

    wrong: float
    sure_and_wrong: float
    claimed: float
    path_off_m: float


def draw(start: Sequence[float], *parts: tuple[float, float], rise: float = 0.0, step_m: float = 5.0) -> np.ndarray:
    """Points from a pose (x, y, heading [rad], height) over parts of a length [m] and a turn to the left [rad]."""
    x, y, heading, height = start
    points = [(x, y, height)]
    for length, turn in parts:
        pieces = max(1, round(length / step_m))
        for _ in range(pieces):
            heading += 0.5 * turn / pieces
            x, y = x + length / pieces * np.cos(heading), y + length / pieces * np.sin(heading)
            heading += 0.5 * turn / pieces
            height += rise * length / pieces
            points.append((x, y, height))
    return np.array(points)


def measures(points: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def split(world: World, names: Sequence[str], points: np.ndarray) -> None:
    """One line as so many elements in a row, linked."""
    cuts = np.linspace(0, len(points) - 1, len(names) + 1).astype(int)
    for number, name in enumerate(names):
        world.elements[name] = points[cuts[number] : cuts[number + 1] + 1]
        if number:
            world.link(names[number - 1], 1, name, 0)


def ring(rng: np.random.Generator) -> World:
    """Laps of a test ring of one to three elements."""
    world, names = World(), [f"r{k}" for k in range(rng.integers(1, 4))]
    radius = rng.uniform(150.0, 500.0)
    points = draw((0, 0, 0, 0), (2 * np.pi * radius, rng.choice([-1, 1]) * 2 * np.pi))
    split(world, names, np.vstack([points[:-1], points[:1]]))
    world.link(names[-1], 1, names[0], 0)
    world.through(*(names * int(rng.integers(2, 4))), start_m=rng.uniform(5.0, 100.0), stop_m=rng.uniform(5.0, 100.0))
    return world


def balloon(rng: np.random.Generator) -> World:
    """A line into a loop whose ends join the same switch, and back."""
    world, names = World(), [f"r{k}" for k in range(rng.choice([1, 1, 2]))]
    radius, side = rng.uniform(100.0, 350.0), rng.choice([-1, 1])
    world.elements["s"] = draw((-900, 0, 0, 0), (900.0, 0.0))
    bend = np.radians(60.0)
    points = draw(
        (0, 0, 0, 0),
        (radius * bend, -side * bend),
        (radius * (np.pi + 2 * bend), side * (np.pi + 2 * bend)),
        (radius * bend, -side * bend),
    )
    points[-1] = points[0]
    split(world, names, points)
    world.link("s", 1, names[0], 0)
    world.link("s", 1, names[-1], 1)
    around = names if rng.random() < 0.5 else [f"-{name}" for name in names[::-1]]
    world.through("s", *around, "-s")
    return world


def branches(rng: np.random.Generator) -> World:
    """Three elements in a row, and at both joints a track that leads away at the angle of a switch."""
    world = World()
    split(world, "abc", draw((0, 0, 0, 0), (2100.0, rng.uniform(-0.4, 0.4))))
    for name, after in (("d", "a"), ("e", "b")):
        end = world.elements[after][-1], world.elements[after][-1] - world.elements[after][-2]
        heading = float(np.arctan2(end[1][1], end[1][0]))
        world.elements[name] = draw((*end[0][:2], heading, 0), (60.0, rng.choice([-0.11, 0.11])), (540.0, 0.0))
        world.link(after, 1, name, 0)
    return world


def shuttle(rng: np.random.Generator) -> World:
    """To and fro, turning anywhere."""
    world = branches(rng)
    begin = rng.uniform(100.0, 600.0)
    for end in rng.uniform(100.0, 600.0, 3):
        world.ride += [("a", begin, 700.0), ("b", 0.0, 700.0), ("c", 0.0, end)]
        world.ride += [("c", end, 0.0), ("b", 700.0, 0.0), ("a", 700.0, begin)]
        world.ride += [("a", begin, begin + 50.0), ("a", begin + 50.0, begin)]
    return world


def yard(rng: np.random.Generator) -> World:
    """Zig-zag: beyond a switch, back into the other track, and forth again."""
    world = branches(rng)
    far, near = rng.uniform(120.0, 400.0, 2)
    world.ride += [("d", far, 0.0), ("a", 700.0, near), ("a", near, 700.0), ("b", 0.0, 700.0), ("c", 0.0, far)]
    world.ride += [("c", far, 0.0), ("b", 700.0, 600.0), ("b", 600.0, 700.0), ("e", 0.0, far)]
    return world


def crossing(rng: np.random.Generator, angle_deg: float, over_m: float = 0.0) -> World:
    """Two lines through one place, each in two elements; at grade, or one over the other with its ramps."""
    world, angle = World(), np.radians(angle_deg)
    split(world, ["a0", "a1"], draw((-1000, 0, 0, 0), (2000.0, 0.0)))
    x, y = 1000.0 * np.cos(angle), 1000.0 * np.sin(angle)
    points = draw((-x, -y, angle, 0), (2000.0, 0.0))
    points[:, 2] = over_m * np.clip((700.0 - np.abs(measures(points) - 1000.0)) / 400.0, 0.0, 1.0)
    split(world, ["b0", "b1"], points)
    world.through(*([["a0", "a1"], ["b0", "b1"]][rng.integers(2)]), start_m=rng.uniform(20.0, 960.0))
    return world


def diamond(rng: np.random.Generator) -> World:
    return crossing(rng, rng.uniform(5.0, 60.0))


def bridge(rng: np.random.Generator) -> World:
    """Nearly over each other for some hundred metres, where only heights tell."""
    return crossing(rng, float(rng.choice([0.0, 0.3, 1.0, 10.0])), over_m=7.0)


def station(rng: np.random.Generator) -> World:
    """Eight tracks 4.5 m apart between two throats; the train calls at one of them."""
    world = World()
    world.elements["in"] = draw((-800, 0, 0, 0), (800.0, 0.0))
    for number in range(8):
        y = 4.5 * (number - 3.5)
        turn = 2.0 * np.arctan2(y, 200.0)
        run = 200.0 / np.cos(turn / 2.0) * (turn / 2.0) / np.sin(turn / 2.0) / 2.0
        points = draw((0, 0, 0, 0), (run, turn), (run, -turn), (400.0, 0.0), (run, -turn), (run, turn))
        world.elements[f"t{number}"] = points
        world.link("in", 1, f"t{number}", 0)
        world.link(f"t{number}", 1, "out", 0)
    ends = np.array([points[-1] for points in (world.elements[f"t{k}"] for k in range(8))])
    for number in range(8):
        points = world.elements[f"t{number}"]
        points[:, :2] += np.linspace(0.0, 1.0, len(points))[:, None] * (ends.mean(axis=0) - points[-1])[:2]
    world.elements["out"] = draw((*ends.mean(axis=0)[:2], 0, 0), (800.0, 0.0))
    own = f"t{rng.integers(8)}"
    world.through(*(["in", own, "out"] if rng.random() < 0.7 else [own, "out"]), start_m=rng.uniform(40.0, 600.0))
    return world


def passing_loop(rng: np.random.Generator) -> World:
    """A single line with a second track for some hundred metres."""
    world, apart = World(), rng.uniform(4.0, 5.0)
    split(world, ["w", "m", "e"], draw((0, 0, 0, 0), (2400.0, 0.0)))
    turn = 2.0 * np.arctan2(apart, 80.0)
    x = 800.0 - 160.0
    points = draw((800, 0, 0, 0), (40.0, turn), (40.0, -turn), (x, 0.0), (40.0, -turn), (40.0, turn))
    points[:, 0] = 800.0 + (points[:, 0] - 800.0) * 800.0 / (points[-1, 0] - 800.0)
    world.elements["l"] = points
    world.link("w", 1, "l", 0)
    world.link("l", 1, "e", 0)
    own = str(rng.choice(["m", "l"]))
    world.through(*(["w", own, "e"] if rng.random() < 0.7 else [own, "e"]), start_m=rng.uniform(40.0, 600.0))
    return world


def one_sided(rng: np.random.Generator) -> World:
    """Two tracks of which one alone has turnouts, all leading away from both."""
    world, apart = World(), rng.uniform(4.0, 5.0)
    names = [f"a{k}" for k in range(int(rng.integers(3, 8)))]
    split(world, names, draw((0, 0, 0, 0), (3000.0, 0.0)))
    world.elements["b"] = draw((0, apart, 0, 0), (3000.0, 0.0))
    for number, name in enumerate(names[1:]):
        x, y, height = world.elements[name][0]
        world.elements[f"d{number}"] = draw((x, y, 0, height), (60.0, -0.1), (340.0, 0.0))
        world.link(names[number], 1, f"d{number}", 0)
    world.through(*(names if rng.random() < 0.5 else ["b"]))
    return world


def ladder(rng: np.random.Generator) -> World:
    """Two tracks, and on the side of one of them a yard of sidings that part from a ladder."""
    world = World()
    names = [f"a{k}" for k in range(5)]
    split(world, names, draw((0, 0, 0, 0), (3000.0, 0.0)))
    world.elements["b"] = draw((0, 4.5, 0, 0), (3000.0, 0.0))
    for number, name in enumerate(names[1:]):
        x, y, height = world.elements[name][0]
        out = 4.5 * (4 - number) / np.sin(0.1)
        parts = ((30.0, -0.1), (out, 0.0), (30.0, 0.1), (2500.0 - x - out, 0.0))
        world.elements[f"s{number}"] = draw((x, y, 0, height), *(part for part in parts if part[0] > 0.0))
        world.link(names[number], 1, f"s{number}", 0)
    world.through(*(names if rng.random() < 0.5 else ["b"]))
    return world


WORLDS: dict[str, Callable[[np.random.Generator], World]] = {
    "ring": ring,
    "balloon": balloon,
    "shuttle": shuttle,
    "yard": yard,
    "diamond": diamond,
    "bridge": bridge,
    "station": station,
    "passing loop": passing_loop,
    "one-sided turnouts": one_sided,
    "ladder": ladder,
}


def drive(world: World, rng: np.random.Generator, rate_hz: float) -> Drive:
    """The ride at one speed, slower before turns; where the train turns it stands for some seconds.

    The way grows as the train sets out, and falls after a turn.
    """
    speed, sense = rng.uniform(10.0, 30.0), 1
    parts: list[tuple[str, float, float, int]] = []
    for number, (name, begin, end) in enumerate(world.ride):
        sense = -sense if number and turned(world, number) else sense
        parts.append((name, begin, end, sense))
    lengths = np.array([abs(end - begin) for _, begin, end, _ in parts])
    before = np.concatenate([[0.0], np.cumsum(lengths)])
    senses = np.array([part[3] for part in parts])
    turns = before[1:-1][np.diff(senses) != 0]
    gone = stops_at(turns, float(before[-1]), speed, 1.0 / rate_hz, rng.uniform(5.0, 30.0))
    part = np.clip(np.searchsorted(before, gone, side="right") - 1, 0, len(parts) - 1)
    inside = gone - before[part]
    signed = np.concatenate([[0.0], np.cumsum(np.diff(gone) * senses[part[1:]])])
    element = np.array([name for name, *_ in parts])[part]
    measure = np.array([begin for _, begin, *_ in parts])[part]
    measure += inside * np.array([np.sign(end - begin) for _, begin, end, _ in parts])[part]
    place = np.array([place_of(world, name, one) for name, one in zip(element, measure, strict=True)])
    return Drive(np.arange(len(gone)) / rate_hz, element, measure, place, signed)


def turned(world: World, number: int) -> bool:
    """Whether the train turns between two parts of its ride: it comes back over the place where it was."""
    (one, begin, end), (other, start, stop) = world.ride[number - 1], world.ride[number]
    back = place_of(world, one, end) - place_of(world, one, end - np.sign(end - begin) * 5.0)
    ahead = place_of(world, other, start + np.sign(stop - start) * 5.0) - place_of(world, other, start)
    return bool(back[:2] @ ahead[:2] < 0.0)


def stops_at(turns: np.ndarray, length_m: float, speed: float, step_s: float, stand_s: float) -> np.ndarray:
    """Way at each epoch: braking at 0.8 m/s² to each turn, standing there, starting again."""
    gone, at, v = [], 0.0, 5.0
    ahead = [*turns.tolist(), length_m]
    while at < length_m - 0.5:
        gone.append(at)
        left = ahead[0] - at
        v = min(v + 0.6 * step_s, speed, float(np.sqrt(max(1.6 * left, 0.01))) + 0.3)
        at += v * step_s
        if at >= ahead[0] and len(ahead) > 1:
            at, v = ahead.pop(0), 0.0
            gone += [at] * round(stand_s / step_s)
    return np.array(gone)


def place_of(world: World, name: str, measure_m: float) -> np.ndarray:
    points = world.elements[name]
    along = measures(points)
    return np.array([np.interp(measure_m, along, points[:, axis]) for axis in range(3)])


def site_of(world: World, survey_m: float, rng: np.random.Generator) -> Site:
    """The survey: each element aside by an error of its own."""
    frames = []
    for name, points in world.elements.items():
        latitude, longitude = degrees(points[:, 0], points[:, 1] + survey_m * rng.normal())
        columns = {"measure_m": measures(points), "latitude_deg": latitude, "longitude_deg": longitude}
        frame = pl.DataFrame({"netelement_id": [name] * len(points), **columns, "height_m": points[:, 2] + 300.0})
        frames.append(frame.with_columns(sigma_m=pl.lit(survey_m)))
    relations = pl.DataFrame(world.links, schema=list(Links.columns()), orient="row")
    return Site(conform(pl.concat(frames), Track), conform(relations, Links))


def judge(name: str, seed: int) -> Verdict:
    """One world by chance, and what the match makes of a ride on it."""
    rng = np.random.default_rng([seed, list(WORLDS).index(name)])
    world = WORLDS[name](rng)
    rate_hz, sigma_m = float(rng.choice([1.0, 10.0])), float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    truth = drive(world, rng, rate_hz)
    site = site_of(world, float(rng.choice([0.02, 0.2])), rng)
    error = np.column_stack([noise(rng, len(truth.t_s), 1.0 / rate_hz, sigma_m) for _ in range(3)])
    error[:, :2] += rng.normal(size=2) * 1.0
    place = truth.place + error * [1.0, 1.0, 1.5]
    fixes = fixes_at(place[:, 0], place[:, 1], truth.t_s, stated(rng, sigma_m))
    fixes = fixes.with_columns(height_m=pl.Series(place[:, 2] + 300.0 + rng.normal()))
    way = odometer_at(truth.t_s, truth.chainage_m * (1.0 + 0.003 * rng.normal())) if rng.random() < 0.7 else None
    odometry = odometry_of(way, Vehicle(), Configuration())
    found = match(fixes, odometry, site, Vehicle(), MatchingConfig(), FixSigma())
    return verdict(world, truth, found.epochs.table, np.hypot(error[:, 0], error[:, 1]))


def verdict(world: World, truth: Drive, epochs: pl.DataFrame, error_m: np.ndarray) -> Verdict:
    known = epochs["on_track"].to_numpy() & epochs["netelement_id"].is_not_null().to_numpy()
    lengths = np.array([world.length(name) for name in truth.element])
    near_joint = np.minimum(truth.measure_m, lengths - truth.measure_m) < JOINT_M + error_m
    names = epochs["netelement_id"].fill_null("").to_numpy()
    wrong = known & (names != truth.element) & ~near_joint
    for row in np.flatnonzero(wrong).tolist():
        wrong[row] = apart_m(world, names[row], truth.place[row]) > ONE_TRACK_M
    claims = np.fmax(*(np.nan_to_num(floats(epochs, f"{name}_probability")) for name in ("gate", "path")))
    sure = claims >= SURE
    off_m = path_off_m(truth, epochs, known)
    return Verdict(float(wrong.mean()), float((wrong & sure).mean()), float(sure.mean()), off_m)


def apart_m(world: World, name: str, place: np.ndarray) -> float:
    """How far an element lies from a place, above it or aside."""
    points, along = world.elements[name], measures(world.elements[name])
    at = np.arange(0.0, along[-1], 0.5)
    return float(min(np.linalg.norm(place - np.column_stack([np.interp(at, along, p) for p in points.T]), axis=1)))


def path_off_m(truth: Drive, epochs: pl.DataFrame, known: np.ndarray) -> float:
    """How far the path position runs away from the way driven, but for which way it grows."""
    path_m, chainage_m = floats(epochs, "path_m")[known], truth.chainage_m[known]
    moved, driven = path_m - path_m[0], chainage_m - chainage_m[0]
    return float(min(np.abs(moved - driven).max(), np.abs(moved + driven).max()))


def figures(runs: int, seed: int) -> list[Figure]:
    """Per kind of world: runs that went wrong, at most one in a hundred, and shares of epochs."""
    out = []
    for name in WORLDS:
        found = [judge(name, seed * 100_000 + number) for number in range(runs)]
        sure, off = sum(one.sure_and_wrong > 0.0 for one in found), sum(one.path_off_m > 25.0 for one in found)
        out += [
            Figure(f"{name}: runs of {runs} sure of a wrong element", float(sure), "", 0.01 * runs),
            Figure(f"{name}: runs of {runs} with a path over 25 m off", float(off), "", 0.01 * runs),
            Figure(f"{name}: share of epochs on a wrong element", float(np.mean([one.wrong for one in found])), ""),
            Figure(f"{name}: share of epochs claimed", float(np.mean([one.claimed for one in found])), ""),
        ]
    return out


def measure(out: Path) -> list[Figure]:
    """All figures over 30 runs of each; nothing is written."""
    return figures(30, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for figure in figures(options.runs, options.seed):
        print(f"{figure.name:<60} {figure.value:8.3f}")


if __name__ == "__main__":
    main()
