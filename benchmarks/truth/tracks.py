"""Are claims of a track right, whatever the network?

`python -m benchmarks.truth.tracks [--runs N] [--seed S] [--family F]`.

Families of TRACKS: ladder yards, crossovers, one-sided turnouts, loops, throats, flyovers, junctions; surveys of 0.3 to
2 m, exact, aside per track or per element; receivers of four Gauss-Markov processes (DIAG Table 1). The truth is known;
nothing here uses the program's geometry. A claim is right or wrong where tracks are more than 1.5 m apart.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from benchmarks.truth.calibration import degrees, fixes_at, noise, odometer_at
from benchmarks.truth.topologies import (
    World,
    apart_m,
    bridge,
    draw,
    drive,
    ladder,
    measures,
    one_sided,
    passing_loop,
    ring,
    shuttle,
    station,
    yard,
)
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from pipeline.stages.reference import ReferencePath, reference_stretches
from pipeline.stages.track.network import network_in_pieces, site_network
from schemas.arrays import floats
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import Links, Track
from schemas.run import Site

SURE = 0.99
# Of claims so long at most one in a hundred may be wrong [s]; tracks nearer than this are one [m].
CLAIM_S, ONE_TRACK_M = 5.0, 1.5
# Of runs with a balise of another track accepted at most one in a thousand; one balise on so much of a track [m].
BALISES_M = 200.0


@dataclass(frozen=True)
class Outcome:
    """Of one run: seconds claimed and claimed wrongly, live and in hindsight; all seconds; balises of another track.

    Those passed while that track was claimed live: one every `BALISES_M` of each element, the first after half of that.
    """

    live_s: float
    live_wrong_s: float
    later_s: float
    later_wrong_s: float
    total_s: float
    other_balises: int


def ladder_yard(rng: np.random.Generator) -> World:
    """Tracks 4.5 m apart between ladders of straight pieces; the train takes one of them."""
    world = World()
    count, apart = int(rng.integers(3, 7)), rng.uniform(4.2, 5.0)
    piece = rng.uniform(40.0, 80.0)
    world.elements["in"] = straight((-900.0, 0.0), (0.0, 0.0))
    at = [(k * piece, k * apart) for k in range(count)]
    length = 2.0 * count * piece + rng.uniform(400.0, 1200.0)
    back = [(length - k * piece, k * apart) for k in range(count)]
    world.elements["out"] = straight(back[0], (length + 900.0, 0.0))
    for k in range(count):
        world.elements[f"t{k}"] = straight(at[k], back[k])
        if k + 1 < count:
            world.elements[f"p{k}"] = straight(at[k], at[k + 1])
            world.elements[f"q{k}"] = straight(back[k + 1], back[k])
    for k in range(count):
        before, after = ("in", "out") if k == 0 else (f"p{k - 1}", f"q{k - 1}")
        world.link(before, 1, f"t{k}", 0)
        world.link(f"t{k}", 1, after, 0)
        if k + 1 < count:
            world.link(before, 1, f"p{k}", 0)
            world.link(f"q{k}", 1, after, 0)
    # The last track goes on from the last piece of the ladder.
    own = int(rng.integers(count))
    world.through("in", *(f"p{k}" for k in range(own)), f"t{own}", *(f"q{k}" for k in reversed(range(own))), "out")
    return world


def crossovers(rng: np.random.Generator) -> World:
    """Two tracks, crossovers between them; the train takes none, or one of them."""
    world, apart = World(), rng.uniform(3.8, 5.0)
    starts = np.sort(rng.uniform(600.0, 3400.0, int(rng.integers(1, 4))))
    starts = starts[np.diff(starts, prepend=-1e9) > 250.0]
    reach = apart * rng.uniform(10.0, 20.0)
    facing = rng.random(starts.size) < 0.5
    for track, y in (("a", 0.0), ("b", apart)):
        leads = [x if (track == "a") == bool(up) else x + reach for x, up in zip(starts, facing, strict=True)]
        ends = [0.0, *leads, 4200.0]
        for k in range(len(ends) - 1):
            world.elements[f"{track}{k}"] = straight((ends[k], y), (ends[k + 1], y))
            if k:
                world.link(f"{track}{k - 1}", 1, f"{track}{k}", 0)
    for k, (x, up) in enumerate(zip(starts, facing, strict=True)):
        one, other, y0, y1 = ("a", "b", 0.0, apart) if up else ("b", "a", apart, 0.0)
        world.elements[f"x{k}"] = straight((x, y0), (x + reach, y1))
        world.link(f"{one}{k}", 1, f"x{k}", 0)
        world.link(f"x{k}", 1, f"{other}{k + 1}", 0)
    own = str(rng.choice(["a", "b"]))
    names = [f"{own}0"]
    taken = rng.random() < 0.4
    for k, up in enumerate(facing):
        if taken and (own == "a") == bool(up):
            own, taken = "b" if own == "a" else "a", False
            names.append(f"x{k}")
        names.append(f"{own}{k + 1}")
    world.through(*names)
    return world


def junction(rng: np.random.Generator) -> World:
    """A line that parts at 1:10 to 1:40, its branch beside it or away."""
    world = World()
    world.elements["s"] = draw((-1200, 0, 0, 0), (1200.0, 0.0))
    world.elements["m"] = draw((0, 0, 0, 0), (1800.0, 0.0))
    angle, apart = 1.0 / rng.uniform(10.0, 40.0), rng.uniform(4.2, 6.0)
    bend = 120.0
    if rng.random() < 0.5:
        out = max(apart / np.sin(angle) - bend, 5.0)
        points = draw((0, 0, 0, 0), (bend, angle), (out, 0.0), (bend, -angle), (1700.0 - 2 * bend - out, 0.0))
    else:
        points = draw((0, 0, 0, 0), (bend, angle), (1500.0, 0.0))
    world.elements["d"] = points
    world.link("s", 1, "m", 0)
    world.link("s", 1, "d", 0)
    world.through("s", str(rng.choice(["m", "d"])))
    return world


def straight(begin: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    count = max(2, round(float(np.hypot(end[0] - begin[0], end[1] - begin[1])) / 10.0) + 1)
    return np.column_stack([np.linspace(begin, end, count), np.zeros(count)])


FAMILIES: dict[str, Callable[[np.random.Generator], World]] = {
    "ladder yard": ladder_yard,
    "crossovers": crossovers,
    "one-sided turnouts": one_sided,
    "ladder beside a track": ladder,
    "passing loop": passing_loop,
    "throat": station,
    "flyover": bridge,
    "junction": junction,
    "ring": ring,
    "shuttle": shuttle,
    "zig-zag": yard,
}


def site_of(world: World, survey_m: float, law: str, rng: np.random.Generator) -> Site:
    """The survey: exact, all aside by one error, or each element by its own across it."""
    frames = []
    common = rng.normal() * survey_m
    for name, points in world.elements.items():
        aside_m = {"exact": 0.0, "track": common, "element": rng.normal() * survey_m}[law]
        heading = np.arctan2(*np.gradient(points[:, :2], axis=0).T[::-1])
        x, y = points[:, 0] - aside_m * np.sin(heading), points[:, 1] + aside_m * np.cos(heading)
        latitude, longitude = degrees(x, y)
        columns = {"measure_m": measures(points), "latitude_deg": latitude, "longitude_deg": longitude}
        frames.append(
            pl.DataFrame({"netelement_id": [name] * len(points), **columns, "height_m": points[:, 2] + 300.0})
        )
    relations = pl.DataFrame(world.links, schema=list(Links.columns()), orient="row")
    frame = pl.concat(frames).with_columns(sigma_m=pl.lit(survey_m))
    return Site(conform(frame, Track), conform(relations, Links))


def outcome(family: str, seed: int) -> Outcome:
    """One world by chance, and what is claimed on a ride."""
    rng = np.random.default_rng([seed, list(FAMILIES).index(family)])
    world = FAMILIES[family](rng)
    survey_m = float(rng.choice([0.3, 0.5, 1.0, 2.0]))
    law = str(rng.choice(["exact", "track", "element"]))
    sigma_m, rate_hz = float(rng.choice([0.3, 1.0, 2.5])), float(rng.choice([1.0, 1.0, 1.0, 10.0]))
    truth = drive(world, rng, rate_hz)
    count = len(truth.t_s)
    error = np.column_stack([noise(rng, count, 1.0 / rate_hz, sigma_m) for _ in range(3)])
    place = truth.place + error * [1.0, 1.0, 1.5]
    heading = np.arctan2(*np.gradient(truth.place[:, :2], axis=0).T[::-1])
    bias_m = 1.5 * rng.normal()
    place[:, 0] -= bias_m * np.sin(heading)
    place[:, 1] += bias_m * np.cos(heading)
    fixes = fixes_at(place[:, 0], place[:, 1], truth.t_s, sigma_m)
    fixes = fixes.with_columns(height_m=pl.Series(place[:, 2] + 300.0 + rng.normal()))
    vehicle = Vehicle.model_validate({"odometer_origin": str(rng.choice(["wheel", "unknown"]))})
    way = odometer_at(truth.t_s, truth.chainage_m * (1.0 + 0.003 * rng.normal()))
    odometry = odometry_of(way, vehicle, Configuration())
    found = match(fixes, odometry, site_of(world, survey_m, law, rng), vehicle, MatchingConfig(), FixSigma())
    epochs = found.epochs.table
    names = epochs["netelement_id"].fill_null("").to_numpy()
    wrong = (names != truth.element) & (names != "")
    live = np.nan_to_num(floats(epochs, "gate_probability")) >= SURE
    later = np.nan_to_num(floats(epochs, "path_probability")) >= SURE
    for row in np.flatnonzero(wrong & (live | later)).tolist():
        wrong[row] = apart_m(world, names[row], truth.place[row]) > ONE_TRACK_M
    seconds = [float(np.count_nonzero(one)) / rate_hz for one in (live, live & wrong, later, later & wrong)]
    passed = passed_balises(names, floats(epochs, "measure_m"), live & wrong)
    return Outcome(seconds[0], seconds[1], seconds[2], seconds[3], count / rate_hz, passed)


def passed_balises(names: np.ndarray, measure_m: np.ndarray, chosen: np.ndarray) -> int:
    """Balises between neighbouring epochs, both chosen and on one element."""
    together = chosen[1:] & chosen[:-1] & (names[1:] == names[:-1])
    number = np.floor(measure_m / BALISES_M + 0.5)
    return int(np.abs(np.diff(number))[together].sum())


@dataclass(frozen=True)
class Known:
    """Of a reference the share of samples with a set, with one element in it, and without the truth."""

    heard: float
    resolved: float
    lost: float


def known_by_reference(family: str, seed: int) -> Known:
    """One world by chance, and a reference that states its sigma, 0.05 to 0.5 m, correlated over 10 to 60 s."""
    from scipy.signal import lfilter  # takes long to load

    rng = np.random.default_rng([seed, list(FAMILIES).index(family), 1])
    world = FAMILIES[family](rng)
    survey_m = float(rng.choice([0.1, 0.3, 0.5, 1.0]))
    truth = drive(world, rng, 1.0)
    sigma_m = float(rng.choice([0.05, 0.2, 0.5]))
    keep = np.exp(-1.0 / rng.uniform(10.0, 60.0))
    shocks = rng.normal(size=(len(truth.t_s), 2)) * sigma_m * np.sqrt(1.0 - keep**2)
    shocks[0] = rng.normal(size=2) * sigma_m
    error_m = lfilter([1.0], [1.0, -keep], shocks, axis=0)
    latitude, longitude = degrees(*(truth.place[:, :2] + error_m).T)
    t = pl.Series("t", np.round(truth.t_s * 1e9).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))
    place = site_of(world, survey_m, str(rng.choice(["exact", "track", "element"])), rng)
    network = site_network(place)
    columns = {"t": t, "latitude_deg": latitude, "longitude_deg": longitude, "sigma_m": sigma_m}
    found, _ = reference_stretches(
        pl.DataFrame(columns), network_in_pieces(place), network.track.index, Configuration()
    )
    heard = resolved = lost = 0
    for stretch in found:
        rows = np.searchsorted(t.to_physical().to_numpy(), stretch.t_ns)
        named = [[names_at(path, sample, network.track.ids) for path in stretch.paths] for sample in range(rows.size)]
        for row, names in zip(rows.tolist(), named, strict=True):
            heard += 1
            resolved += len(set(names)) == 1
            near = (apart_m(world, name, truth.place[row]) <= ONE_TRACK_M for name in set(names))
            lost += truth.element[row] not in names and not any(near)
    count = len(truth.t_s)
    return Known(heard / count, resolved / count, lost / count)


def names_at(path: ReferencePath, sample: int, ids: Sequence[str]) -> str:
    """The net element of a way at a sample."""
    route = path.legs[int(path.leg[sample])]
    return ids[int(route.locate(path.at_m[[sample]])[0][0])]


def figures_of_references(runs: int, seed: int, families: list[str]) -> list[Figure]:
    """Per family: references that lost their track, at most one in a hundred; shares of time known and resolved."""
    out = []
    for name in families:
        found = [known_by_reference(name, seed * 100_000 + number) for number in range(runs)]
        lost = float(sum(one.lost > 0.0 for one in found))
        out += [
            Figure(f"{name}, reference: runs of {runs} whose track is not in the set", lost, "", 0.01 * runs),
            Figure(f"{name}, reference: share of time with a set", float(np.mean([one.heard for one in found])), ""),
            Figure(f"{name}, reference: share with one element", float(np.mean([one.resolved for one in found])), ""),
        ]
    return out


def figures(runs: int, seed: int, families: list[str]) -> list[Figure]:
    """Per family: runs with claims and wrong ones of 5 s or more, at most one in a hundred; share of time claimed."""
    out = []
    for name in families:
        found = [outcome(name, seed * 100_000 + number) for number in range(runs)]
        for title, claimed, wrong in (("live", "live_s", "live_wrong_s"), ("hindsight", "later_s", "later_wrong_s")):
            claims = sum(getattr(one, claimed) >= CLAIM_S for one in found)
            wrongs = sum(getattr(one, wrong) >= CLAIM_S for one in found)
            short = sum(0.0 < getattr(one, wrong) < CLAIM_S for one in found)
            share = sum(getattr(one, claimed) for one in found) / sum(one.total_s for one in found)
            out += [
                Figure(f"{name}, {title}: wrong of {claims} claims", float(wrongs), "", 0.01 * claims),
                Figure(f"{name}, {title}: wrong for less than 5 s", float(short), ""),
                Figure(f"{name}, {title}: share of time claimed", share, ""),
            ]
        others = float(sum(one.other_balises > 0 for one in found))
        out.append(Figure(f"{name}: runs of {runs} that accept a balise of another track", others, "", 0.001 * runs))
    return out


def measure(out: Path) -> list[Figure]:
    """All figures over 300 runs of each; nothing is written."""
    return figures(300, 1, list(FAMILIES)) + figures_of_references(300, 1, list(FAMILIES))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", choices=FAMILIES, action="append", help="these families only")
    parser.add_argument("--reference", action="store_true", help="what a reference says of its track")
    options = parser.parse_args()
    made = figures_of_references if options.reference else figures
    for figure in made(options.runs, options.seed, options.family or list(FAMILIES)):
        print(f"{figure.name:<60} {figure.value:8.3f}", flush=True)


if __name__ == "__main__":
    main()
