"""Topologies that break matchers: stations, passing loops, crossings, bridges, balloon loops, shuttles."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.topologies import WORLDS, judge
from schemas.arrays import Floats
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site, times
from tests.stages.matching.test_network import along

RATE_HZ = 2.0


def ride(points: Floats, at_m: Floats, seed: int, sigma_m: float = 0.5) -> pl.DataFrame:
    """Positions along a polyline with a bias to the left and noise that lasts."""
    rng = np.random.default_rng(seed)
    x, y = along(points, at_m)
    lasting = np.convolve(rng.normal(size=(len(at_m) + 199)), np.full(200, 200.0**-0.5), "valid") * sigma_m
    return run(x + lasting[::-1] * 0.5, y + 0.4 + 0.5 * lasting, RATE_HZ, sigma_m=sigma_m)


def station(tracks: int = 8, spacing_m: float = 4.5) -> tuple[Site, dict[str, Floats]]:
    """A line that fans out into parallel tracks of 400 m and comes together again: `in`, `t0` ..., `out`."""
    elements = {"in": line((0, 0), (500, 0)), "out": line((1300, 0), (1800, 0))}
    links: list[Link] = []
    for number in range(tracks):
        y = spacing_m * (number - tracks // 2)
        ramp = np.linspace(0.0, 1.0, 41)
        smooth = 3.0 * ramp**2 - 2.0 * ramp**3
        into = np.column_stack([500.0 + 200.0 * ramp, y * smooth])
        elements[f"t{number}"] = np.concatenate([into, line((700, y), (1100, y))[1:], into[::-1] * [-1, 1] + [1800, 0]])
        elements[f"t{number}"] = elements[f"t{number}"][np.argsort(elements[f"t{number}"][:, 0], kind="stable")]
        keep = np.concatenate([[True], np.diff(elements[f"t{number}"][:, 0]) > 0.1])
        elements[f"t{number}"] = elements[f"t{number}"][keep]
        links += [("in", 1, f"t{number}", 0, "both"), (f"t{number}", 1, "out", 0, "both")]
    return site(elements, links), elements


@pytest.mark.parametrize("number", range(8))
def test_a_station_with_eight_tracks(number: int) -> None:
    """The track taken, or one beside it and then not claimed; before and behind nothing is in doubt."""
    place, elements = station()
    points = np.concatenate([elements[name] for name in ("in", f"t{number}", "out")])
    at = np.arange(50.0, 1750.0, 8.0)
    found = matched(ride(points, at, number), place, odometer(at, RATE_HZ))
    names = found.path.element_names()
    assert (names[0], names[-1], len(names)) == ("in", "out", 3)
    if names[1] != f"t{number}":
        assert found.epochs.table.filter(pl.col("netelement_id") == names[1])["path_probability"].max() < 0.9
    assert found.epochs.table.filter(pl.col("netelement_id").is_in(["in", "out"]))["path_probability"].min() >= 0.99


def test_the_bias_of_the_line_before_tells_the_track_in_the_station() -> None:
    """1.8 m aside for 3 km of single line, and as much in the station, nearly half-way to the next track."""
    tracks = {"in": line((0, 0), (3000, 0)), "t": line((3000, 0), (4000, 0)), "u": line((3000, 4.5), (4000, 4.5))}
    place = site(tracks, [("in", 1, "t", 0, "both"), ("in", 1, "u", 0, "both")])
    at = np.arange(0.0, 3990.0, 20.0)
    found = matched(run(at, np.full(len(at), 1.8), 1.0, sigma_m=0.5), place, odometer(at))
    assert found.epochs.table.filter(pl.col("netelement_id") == "t")["path_probability"].tail(20).min() >= 0.99


def test_a_single_line_with_a_passing_loop() -> None:
    """The loop bends away by 4.2 m: bending with it or not tells which of both was taken."""
    ramp = np.linspace(0.0, 1.0, 31)
    bow = np.concatenate([
        np.column_stack([1000.0 + 90.0 * ramp, 4.2 * (3 * ramp**2 - 2 * ramp**3)]),
        line((1090, 4.2), (1600, 4.2))[1:],
        np.column_stack([1600.0 + 90.0 * ramp, 4.2 * (1 - 3 * ramp**2 + 2 * ramp**3)])[1:],
    ])  # fmt: skip
    elements = {
        "w": line((0, 0), (1000, 0)),
        "m": line((1000, 0), (1690, 0)),
        "l": bow,
        "e": line((1690, 0), (2500, 0)),
    }
    links: list[Link] = [(a, 1, b, 0, "both") for a, b in (("w", "m"), ("w", "l"), ("m", "e"), ("l", "e"))]
    at = np.arange(30.0, 2450.0, 10.0)
    for name in ("m", "l"):
        points = np.concatenate([elements["w"], elements[name][1:], elements["e"][1:]])
        found = matched(ride(points, at, 3, sigma_m=0.3), site(elements, links), odometer(at, RATE_HZ))
        assert found.path.element_names() == ["w", name, "e"]
        assert found.ambiguous["resolved_by"].is_in(["switch", "positions"]).all()


@pytest.mark.parametrize("angle_deg", [6.0, 30.0, 90.0])
@pytest.mark.parametrize("heights", [False, True], ids=["diamond", "bridge"])
def test_tracks_that_cross_are_not_changed(angle_deg: float, heights: bool) -> None:
    """At grade or over each other: nothing leads from one to the other, and the train keeps its own."""
    away = 1000.0 * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    elements = {
        "a": line((-1000, 0), (0, 0)), "b": line((0, 0), (1000, 0)),
        "c": line((-away[0], -away[1]), (0, 0)), "d": line((0, 0), (away[0], away[1])),
    }  # fmt: skip
    links: list[Link] = [("a", 1, "b", 0, "both"), ("c", 1, "d", 0, "both")]
    levels = {name: np.full(len(elements[name]), 7.0 if name in "cd" else 0.0) for name in elements}
    place = site(elements, links, heights_m=levels if heights else None)
    at = np.arange(50.0, 1950.0, 10.0)
    for names in (["a", "b"], ["c", "d"]):
        points = np.concatenate([elements[names[0]], elements[names[1]][1:]])
        found = matched(ride(points, at, 5), place, odometer(at, RATE_HZ))
        assert found.path.element_names() == names
        assert found.epochs.table["path_probability"].min() >= 0.99


def arc(centre: tuple[float, float], radius_m: float, begin_deg: float, end_deg: float) -> Floats:
    """Points every metre or so on a circle, angles counter-clockwise from east."""
    angle = np.radians(np.linspace(begin_deg, end_deg, int(radius_m * abs(np.radians(end_deg - begin_deg))) + 1))
    return np.column_stack([centre[0] + radius_m * np.cos(angle), centre[1] + radius_m * np.sin(angle)])


def balloon() -> tuple[Site, Floats]:
    """A line into a loop of two elements that leads back onto it turned round: right, left all round, right again."""
    far = 1000.0 + float(np.sqrt(600.0**2 - 300.0**2))
    out = arc((1000, -300), 300, 90, 30)
    loop = np.concatenate([out, arc((far, 0), 300, -150, 150)[1:], (out[::-1] * [1, -1])[1:]])
    half = len(loop) // 2
    elements = {"s": line((0, 0), (1000, 0)), "r": loop[: half + 1], "q": loop[half:]}
    place = site(elements, [("s", 1, "r", 0, "both"), ("r", 1, "q", 0, "both"), ("q", 1, "s", 1, "both")])
    return place, np.concatenate([line((0, 0), (1000, 0)), loop[1:], line((1000, 0), (0, 0))[1:]])


@pytest.mark.parametrize("seed", range(3))
def test_a_balloon_loop_brings_the_train_back_turned_round(seed: int) -> None:
    place, points = balloon()
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    at = np.arange(50.0, length - 50.0, 10.0)
    found = matched(ride(points, at, seed), place, odometer(at, RATE_HZ))
    assert found.path.element_names() in (["s", "r", "q", "s"], ["s", "q", "r", "s"])
    moved = found.epochs.table["path_m"].to_numpy() - found.epochs.table["path_m"][0]
    assert np.abs(moved - (at - at[0])).max() < 5.0


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_by_chance(name: str) -> None:
    """Short form of `python -m benchmarks.truth.topologies`, whose seeds are others."""
    found = [judge(name, seed) for seed in (71, 72)]
    assert max(one.sure_and_wrong for one in found) == 0.0
    assert max(one.path_off_m for one in found) < 25.0
    # On two tracks beside each other all the way nothing may be claimed.
    assert sum(one.claimed for one in found) > 1.0 or name in ("one-sided turnouts", "ladder")


@pytest.mark.parametrize("height_m", [300.0, 308.0])
def test_heights_show_tracks_over_each_other_and_claim_none(height_m: float) -> None:
    """8 m apart in height alone."""
    place = site(
        {"low": line((0, 0), (2000, 0)), "high": line((0, 0), (2000, 0))},
        heights_m={"low": np.full(201, 300.0), "high": np.full(201, 308.0)},
    )
    x = np.arange(20.0, 1980.0, 20.0)
    found = matched(run(x, 0.0 * x, height_m=np.full(len(x), height_m + 1.0)), place).epochs.table
    assert found["netelement_id"].unique().to_list() == ["low" if height_m == 300.0 else "high"]
    assert found["path_probability"].max() < 0.99


def test_a_shuttle_turns_four_times_on_one_leg() -> None:
    elements = {name: line((600.0 * k, 0), (600.0 * k + 600, 0)) for k, name in enumerate("abc")}
    elements["side"] = line((600, 0), (1200, 80))
    links: list[Link] = [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both"), ("a", 1, "side", 0, "both")]
    once = np.arange(100.0, 1700.0, 10.0)
    at = np.concatenate([once, once[::-1], once, once[::-1], once])
    found = matched(ride(line((0, 0), (1800, 0)), at, 7), site(elements, links), odometer(at, RATE_HZ))
    assert found.path.element_names() == list("abc")
    assert len(found.path.legs) == 1
    assert np.abs(found.epochs.table["path_m"].to_numpy() - at).max() < 5.0


def test_what_ended_a_doubt_is_named() -> None:
    """A read on one of two parallel tracks; without it nothing ever tells."""
    place = site({"a": line((0, 0), (2000, 0)), "b": line((0, 4), (2000, 4))})
    balises = pl.DataFrame({
        "balise_id": ["r"], "netelement_id": ["a"], "measure_m": [1000.0], "kind": ["physical"],
        "location_accuracy_m": [5.0], "linked": [True], "link_reaction": ["none"], "direction": ["both"],
    })  # fmt: skip
    x = np.arange(0.0, 1990.0, 10.0)
    fixes = run(x, np.full(len(x), 1.9), 1.0)
    assert matched(fixes, place).ambiguous["resolved_by"].to_list() == ["nothing"]
    reads = pl.DataFrame({"t": times(200, 1.0)[100:101], "balise_id": ["r"]})
    found = matched(fixes, Site(place.track, place.links, balises=balises), reads=reads)
    assert found.ambiguous["resolved_by"].to_list() == ["read"]
    assert found.epochs.table["path_probability"].min() >= 0.99
    assert found.epochs.table["gate_probability"][:99].max() < 0.9
