"""A track is a track however it is cut (DOMAIN section 2): cuts, joints and turnouts on one of two tracks only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl
import pytest

from schemas.arrays import Floats, floats
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site
from tests.stages.matching.ladder import gauss_markov

LENGTH_M = 6000.0
APART_M = 4.0


def double_track(
    cuts: int, turnouts: bool, sigma_m: float | None, shift: np.random.Generator | None = None, side: float = 1.0
) -> Site:
    """A in so many pieces, a turnout leading away from both tracks at each joint if asked for; B in one, 4 m beside."""
    ends = np.linspace(0.0, LENGTH_M, cuts + 1)
    wrong_m = [0.0 if shift is None else (sigma_m or 1.0) * shift.uniform(-1.0, 1.0) for _ in range(cuts + 1)]
    elements = {"B": line((0, side * (APART_M + wrong_m[-1])), (LENGTH_M, side * (APART_M + wrong_m[-1])), 20.0)}
    links: list[Link] = []
    for k in range(cuts):
        elements[f"A{k}"] = line((ends[k], side * wrong_m[k]), (ends[k + 1], side * wrong_m[k]), 20.0)
        if k:
            links.append((f"A{k - 1}", 1, f"A{k}", 0, "both"))
        if k and turnouts:
            x = np.linspace(0.0, 600.0, 31)
            aside = 2.5e-4 * np.minimum(x, 200.0) ** 2 + 0.1 * np.maximum(x - 200.0, 0.0)
            elements[f"T{k}"] = np.column_stack([ends[k] + x, side * (wrong_m[k] - aside)])
            links.append((f"A{k - 1}", 1, f"T{k}", 0, "both"))
    return site(elements, links, sigma_m=sigma_m)


def ride(place: Site, y_m: Floats | float = 0.0, stated_m: float = 1.0) -> pl.DataFrame:
    x = 50.0 + 20.0 * np.arange(280.0)
    return matched(run(x, np.zeros(280) + y_m, sigma_m=stated_m), place, odometer(x)).epochs.table


def on_a(epochs: pl.DataFrame, name: str) -> Floats:
    """Probability of A where it is A or B, both having been possible all the time."""
    claim = floats(epochs, f"{name}_probability")
    return np.where((epochs["netelement_id"] == "B").to_numpy(), 1.0 - claim, claim)


KINDS = [(1, False), (3, False), (9, False), (7, True)]


@pytest.mark.parametrize("sigma_m", [0.3, 1.0, None])
def test_where_a_track_is_cut_changes_no_probability(sigma_m: float | None) -> None:
    """In one piece P(A) was 0.94, in nine 1e-5, and with six turnouts 2e-4: B was claimed all along."""
    whole = ride(double_track(1, False, sigma_m))
    for cuts, turnouts in KINDS[1:]:
        epochs = ride(double_track(cuts, turnouts, sigma_m))
        for name in ("path", "gate"):
            # About a turnout its branch may claim a share for itself.
            rows = slice(None) if not turnouts else np.r_[0:30, 70:75, 275:280]
            np.testing.assert_allclose(on_a(epochs, name)[rows], on_a(whole, name)[rows], atol=1e-3)
        assert not (epochs["netelement_id"] == "B").any()


@pytest.mark.parametrize(("cuts", "turnouts"), KINDS)
@pytest.mark.parametrize("sigma_m", [0.3, 1.0, None])
def test_elements_that_are_surveyed_aside_do_not_claim_their_neighbour(
    cuts: int, turnouts: bool, sigma_m: float | None
) -> None:
    """Each element aside by up to its sigma; positions exactly on A."""
    for seed in range(2):
        for stated_m in (0.3, 1.0):
            place = double_track(cuts, turnouts, sigma_m, np.random.default_rng(seed))
            epochs = ride(place, stated_m=stated_m)
            for name in ("gate", "path"):
                assert not (
                    epochs.filter(pl.col("netelement_id").str.head(1) == "B")[f"{name}_probability"] >= 0.99
                ).any()


@pytest.mark.parametrize("sigma_m", [0.3, 1.0, None])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("start_m", "steps"), [(5950.0, 280), (2900.0, 100), (2650.0, 100)])
def test_turnouts_that_join_a_track_do_not_move_it(
    sigma_m: float | None, seed: int, start_m: float, steps: int
) -> None:
    """The track took over by how much the branch had come nearer: at 1 m survey P(A) was 0.004 where it is 0.39."""
    x = start_m - 20.0 * np.arange(float(steps))
    y = 2.5 + np.random.default_rng(seed).normal(0.0, 0.1, steps)
    fixes = run(x, y)
    joined = on_a(matched(fixes, double_track(7, True, sigma_m), odometer(x)).epochs.table, "gate")
    alone = on_a(matched(fixes, double_track(7, False, sigma_m), odometer(x)).epochs.table, "gate")
    # A branch is a way to have come on A, so A may be likelier by it; it says nothing of B.
    assert (joined - alone).max() < 0.15
    assert (joined - alone).min() > -0.02


@pytest.mark.parametrize(("cuts", "turnouts"), KINDS)
def test_left_and_right_are_alike(cuts: int, turnouts: bool) -> None:
    y_m = gauss_markov(np.random.default_rng(5), 280, 1.0, 0.8, 50.0)
    sides = [
        ride(double_track(cuts, turnouts, 0.3, np.random.default_rng(3), side), side * y_m) for side in (1.0, -1.0)
    ]
    assert sides[0]["netelement_id"].to_list() == sides[1]["netelement_id"].to_list()
    for name in ("path", "gate"):
        np.testing.assert_allclose(on_a(sides[0], name), on_a(sides[1], name), atol=1e-4)


@dataclass
class Drawing:
    """Elements as points in metres and links between their ends, to be cut and joined at will."""

    elements: dict[str, Floats]
    links: list[Link] = field(default_factory=list)

    def cut(self, name: str, vertex: int) -> None:
        points = self.elements.pop(name)
        one, other = f"{name}<", f"{name}>"
        self.elements[one], self.elements[other] = points[: vertex + 1], points[vertex:]
        new = {0: one, 1: other}
        self.links = [self._renamed(link, name, new) for link in self.links]
        self.links.append((one, 1, other, 0, "both"))

    def reverse(self, name: str) -> None:
        self.elements[name] = self.elements[name][::-1]
        turned = {(name, 0): 1, (name, 1): 0}
        self.links = [(a, turned.get((a, p), p), b, turned.get((b, q), q), way) for a, p, b, q, way in self.links]

    def shuffle(self, rng: np.random.Generator) -> None:
        """Rows in another order, under other names."""
        names = list(self.elements)
        order = rng.permutation(len(names)).tolist()
        new = {names[k]: f"n{number:02d}" for number, k in enumerate(order)}
        self.elements = {new[names[k]]: self.elements[names[k]] for k in rng.permutation(len(names)).tolist()}
        self.links = [(new[b], q, new[a], p, way) for a, p, b, q, way in self.links]
        rng.shuffle(self.links)

    @staticmethod
    def _renamed(link: Link, name: str, new: dict[int, str]) -> Link:
        a, p, b, q, way = link
        return (new[p] if a == name else a), p, (new[q] if b == name else b), q, way


def curve(length_m: float, start: Sequence[float], turn: float) -> Floats:
    """Points every 10 m from (x, y, heading), turning evenly."""
    x, y, heading = start
    steps = int(length_m / 10.0)
    headings = heading + turn * (np.arange(steps) + 0.5) / steps
    way = np.column_stack([np.cos(headings), np.sin(headings)]) * 10.0
    return np.array([x, y]) + np.vstack([np.zeros((1, 2)), np.cumsum(way, axis=0)])


def network(rng: np.random.Generator) -> tuple[Drawing, Floats]:
    """Two tracks beside each other on a curve, a switch from the first to a branch; and the way of a train."""
    middle = curve(3000.0, (0.0, 0.0, rng.uniform(-3.0, 3.0)), rng.uniform(-0.8, 0.8))
    left = np.gradient(middle, axis=0)[:, ::-1] * [-1.0, 1.0]
    left /= np.linalg.norm(left, axis=1)[:, None]
    apart_m = rng.uniform(3.8, 6.0) * rng.choice([-1.0, 1.0])
    switch = int(rng.integers(60, 200))
    heading = np.arctan2(*(middle[switch + 1] - middle[switch])[::-1])
    branch = curve(600.0, (*middle[switch], heading), -np.sign(apart_m) * rng.uniform(0.15, 0.3))
    drawing = Drawing(
        {"a": middle[: switch + 1], "b": middle[switch:], "c": middle + apart_m * left, "d": branch},
        [("a", 1, "b", 0, "both"), ("a", 1, "d", 0, "both")],
    )
    return drawing, middle


def changed(drawing: Drawing, rng: np.random.Generator) -> Drawing:
    new = Drawing(dict(drawing.elements), list(drawing.links))
    for _ in range(5):
        name = str(rng.choice(list(new.elements)))
        if len(new.elements[name]) > 3:
            new.cut(name, int(rng.integers(1, len(new.elements[name]) - 1)))
        new.reverse(str(rng.choice(list(new.elements))))
    new.shuffle(rng)
    return new


@pytest.mark.parametrize("seed", range(6))
def test_cutting_reversing_renaming_and_shuffling_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawing, way = network(rng)
    at_m = np.arange(50.0, 2900.0, 12.0)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    error = np.column_stack([gauss_markov(rng, len(at_m), 1.0, 0.7, 60.0) for _ in range(2)])
    places = np.column_stack([np.interp(at_m, along, column) for column in way.T]) + error
    fixes, distance = run(*places.T, sigma_m=0.7), odometer(at_m)
    found = [
        matched(fixes, site(one.elements, one.links, sigma_m=0.3), distance) for one in (drawing, changed(drawing, rng))
    ]
    for name in ("path", "gate"):
        claims = [floats(one.epochs.table, f"{name}_probability") for one in found]
        np.testing.assert_array_equal(claims[0] >= 0.99, claims[1] >= 0.99)
    moved = [np.diff(floats(one.epochs.table, "path_m")) for one in found]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-3)
    crosses = [floats(one.epochs.table, "cross_track_m") for one in found]
    np.testing.assert_allclose(crosses[0], crosses[1], atol=1e-3)


def test_of_two_surveys_the_smoother_one_does_not_win() -> None:
    """The train's own track winds by a third of a metre about every 300 m in its survey; the one beside is straight."""
    x = np.linspace(0.0, LENGTH_M, 601)
    winding = np.column_stack([x, 0.35 * np.sin(2.0 * np.pi * x / 300.0)])
    place = site({"A": winding, "B": line((0, APART_M), (LENGTH_M, APART_M))}, sigma_m=0.3)
    assert on_a(ride(place, stated_m=0.3), "path").min() > 0.5


def test_tracks_that_part_are_told_by_how_the_position_moves() -> None:
    """4 m apart for 3 km, then one of them bends away by 12 m about a platform and comes back."""
    x = np.linspace(0.0, LENGTH_M, 601)
    bow = 12.0 * np.clip((x - 3000.0) / 200.0, 0.0, 1.0) * np.clip((3900.0 - x) / 200.0, 0.0, 1.0)
    place = site({"A": line((0, 0), (LENGTH_M, 0)), "B": np.column_stack([x, APART_M + bow])}, sigma_m=0.3)
    for own, y_m in (("A", 0.0), ("B", APART_M + np.interp(50.0 + 20.0 * np.arange(280.0), x, bow))):
        epochs = ride(place, y_m + 1.0, stated_m=0.5)
        assert epochs["netelement_id"].unique().to_list() == [own]
        assert epochs["gate_probability"][-1] >= 0.99
        assert epochs["gate_probability"][100] < 0.99


@pytest.mark.parametrize("seed", [2, 4])
def test_standing_on_a_switch_does_not_make_its_track_likelier(seed: int) -> None:
    """Ten minutes about the switch of a track, on that track or beside it: as likely as without the branch."""
    rng = np.random.default_rng(seed)
    t = np.arange(700.0)
    x = 50.0 + 20.0 * np.minimum(t, 50.0) + 20.0 * np.maximum(t - 600.0, 0.0)
    error = [gauss_markov(rng, 700, 1.0, 1.0, 100.0) for _ in range(2)]
    away = np.column_stack([np.linspace(1050, 1650, 31), -2.5e-4 * np.linspace(0, 600, 31) ** 2])
    two = {"A0": line((0, 0), (1050, 0)), "A1": line((1050, 0), (4000, 0)), "B": line((0, 4), (4000, 4))}
    joint: list[Link] = [("A0", 1, "A1", 0, "both")]
    places = site(two, joint, sigma_m=0.3), site(two | {"T": away}, [*joint, ("A0", 1, "T", 0, "both")], sigma_m=0.3)
    for y_m in (0.0, 4.0):
        fixes = run(x + error[0], y_m + error[1], sigma_m=1.0)
        without, beside = (on_a(matched(fixes, place, odometer(x)).epochs.table, "gate")[-2] for place in places)
        assert beside == pytest.approx(without, abs=0.02)
