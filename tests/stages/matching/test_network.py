"""Which way the train went, on small networks where it is known."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.matching.match import travelled_route
from schemas.errors import InputError
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site, times
from tests.stages.matching.ladder import ROUTES, journey, ladder, lateral_m

# A switch at 1000 m: `s` leads to the straight `m` and to `d`, which bends away to the left (north).
D = np.array([(1000.0 + x, x * x / 1200.0) for x in np.arange(0.0, 601.0, 10.0)])
SWITCH = {"s": line((0, 0), (1000, 0)), "m": line((1000, 0), (2000, 0)), "d": D}
SWITCH_LINKS: list[Link] = [("s", 1, "m", 0, "both"), ("s", 1, "d", 0, "both")]
NORMAL = np.random.default_rng(11).normal


def along(points: np.ndarray, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places at distances along a polyline."""
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return np.interp(distance_m, at, points[:, 0]), np.interp(distance_m, at, points[:, 1])


def branch(name: str) -> np.ndarray:
    return np.concatenate([SWITCH["s"], SWITCH[name][1:]])


@pytest.mark.parametrize("name", ["m", "d"])
@pytest.mark.parametrize("with_odometer", [True, False])
def test_either_way_over_a_switch(name: str, with_odometer: bool) -> None:
    distance = np.arange(300.0, 1500.0, 15.0)
    x, y = along(branch(name), distance)
    bias = 1.2
    found = matched(
        run(x, y + bias), site(SWITCH, SWITCH_LINKS), odometer(-1.005 * distance) if with_odometer else None
    )
    assert found.path.element_names() == ["s", name]
    assert found.epochs.table["netelement_id"][-1] == name
    assert np.allclose(found.epochs.table["path_m"], distance, atol=1.5)
    assert (found.epochs.table["path_probability"] >= 0.99).all()


def test_the_gate_doubts_the_branch_until_the_tracks_part() -> None:
    """Causal: right after a switch a train does not know which way it went, the finished run does."""
    distance = np.arange(800.0, 1500.0, 5.0)
    x, y = along(branch("d"), distance)
    found = matched(run(x, y), site(SWITCH, SWITCH_LINKS), odometer(distance))
    gate = found.epochs.table["gate_probability"].to_numpy()
    assert gate[distance < 980].min() >= 0.99
    assert gate[(distance > 1015) & (distance < 1030)].max() < 0.99
    assert gate[distance > 1150].min() >= 0.99
    assert found.epochs.table["path_probability"].min() >= 0.99
    row = found.ambiguous.row(0, named=True)
    assert row["netelement_id"] == "d"
    assert row["gate_probability"] == pytest.approx(gate.min())
    assert row["path_probability"] >= 0.99
    doubted = found.epochs.table.filter(pl.col("gate_probability") < 0.99)["t"]
    assert row["t_start"] == doubted.min()
    assert row["t_end"] == doubted.max()


def test_the_gate_uses_nothing_that_comes_later() -> None:
    distance = np.arange(500.0, 1500.0, 5.0)
    x, y = along(branch("d"), distance)
    place, fixes = site(SWITCH, SWITCH_LINKS), run(x + NORMAL(size=len(x)), y + NORMAL(size=len(x)))
    whole = matched(fixes, place, odometer(distance)).epochs.table["gate_probability"]
    for count in (120, 150):
        cut = matched(fixes[:count], place, odometer(distance)).epochs.table["gate_probability"]
        # The last epoch of a run is a step of its own, and the way on that was not taken yet counts for no path.
        assert np.allclose(cut[:100], whole[:100], atol=1e-9)


def test_trailing_through_a_switch_and_back() -> None:
    """In from the branch, on towards s, and back the same way: one leg, positions fall again."""
    there = np.concatenate([np.arange(1400.0, 700.0, -10.0), np.arange(700.0, 1400.0, 10.0)])
    x, y = along(branch("d"), there)
    travelled = np.concatenate([[0.0], np.cumsum(np.diff(there))])
    found = matched(run(x, y), site(SWITCH, SWITCH_LINKS), odometer(travelled))
    assert found.path.element_names() == ["d", "s"]
    assert len(found.path.legs) == 1
    assert found.epochs.table["path_m"][70] - found.epochs.table["path_m"][0] == pytest.approx(700.0, abs=1.0)
    assert found.epochs.table["path_m"][-1] == pytest.approx(found.epochs.table["path_m"][1], abs=1.0)


def test_a_zig_zag_over_the_switch_is_a_new_leg_with_the_same_position() -> None:
    """From the branch onto s, then reversing out onto the straight track."""
    inward, outward = np.arange(1400.0, 700.0, -10.0), np.arange(700.0, 1600.0, 10.0)
    x_in, y_in = along(branch("d"), inward)
    x_out, y_out = along(branch("m"), outward)
    distance = np.concatenate([inward, outward])
    fixes = run(np.concatenate([x_in, x_out]), np.concatenate([y_in, y_out]))
    found = matched(fixes, site(SWITCH, SWITCH_LINKS), odometer(distance - distance[0]))
    assert [[found.path.track.ids[v.element] for v in leg.visits] for leg in found.path.legs] == [
        ["d", "s"],
        ["m", "s"],
    ]
    moved = found.epochs.table["path_m"] - found.epochs.table["path_m"][0]
    assert np.allclose(moved, -(distance - distance[0]), atol=1.0)
    assert found.epochs.table["leg"][0] == 0
    assert found.epochs.table["leg"][-1] == 1
    assert (found.epochs.table["path_probability"] >= 0.99).all()
    on_s = [leg.entry_m([found.path.track.ids[v.element] for v in leg.visits].index("s")) for leg in found.path.legs]
    assert on_s[0] == pytest.approx(on_s[1], abs=1e-9)


def test_a_tunnel_is_bridged_and_elements_without_fixes_are_there() -> None:
    elements = {name: line((400.0 * k, 0), (400.0 * k + 400, 0)) for k, name in enumerate("abcde")}
    elements["side"] = line((400, 0), (800, 300))
    links: list[Link] = [(p, 1, q, 0, "both") for p, q in ("ab", "bc", "cd", "de")]
    links.append(("a", 1, "side", 0, "both"))
    x = np.arange(100.0, 1900.0, 20.0)
    has_fix = (x < 350) | (x > 1650)
    fixes = run(x, np.zeros(len(x)), fix=np.where(has_fix, "sbas", "none"))
    for distance in (odometer(x), None):
        found = matched(fixes, site(elements, links), distance)
        assert found.path.element_names() == list("abcde")
        assert found.epochs.table["path_m"].drop_nulls()[-1] == pytest.approx(x[-1], abs=0.1)


@pytest.mark.parametrize("jump_m", [250.0, -250.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_jump_along_the_track_makes_no_detour(jump_m: float, seed: int) -> None:
    """Across the crossover and back: the track is the same afterwards, and the jump is in the positions."""
    trip = journey(seed)
    epochs = trip.fixes.height
    rows = np.arange(epochs)
    x = 50.0 + 10.0 * rows
    inside = (x > 900) & (x < 1000)
    raw = x + np.where(inside, jump_m, 0.0)
    y = np.full(epochs, 0.5)
    found = matched(run(raw, y, rate_hz=2.0), ladder(), odometer(x, rate_hz=2.0))
    assert found.path.element_names() == ["A1", "A2"]
    assert len(found.path.legs) == 1
    assert np.allclose(found.epochs.table["path_m"], raw, atol=0.01)
    # Half a metre aside on tracks 4 m apart never proves more; the jump takes nothing off.
    assert found.epochs.table["path_probability"].min() == pytest.approx(
        found.epochs.table["path_probability"].max(), abs=0.02
    )


def test_a_jump_onto_the_other_track_for_a_while_is_not_followed() -> None:
    x = 50.0 + 10.0 * np.arange(280.0)
    y = np.where((x > 1500) & (x < 1800), 4.0, 0.0)
    found = matched(run(x, y, rate_hz=2.0), ladder(), odometer(x, rate_hz=2.0))
    assert found.path.element_names() == ["A1", "A2"]
    assert np.allclose(found.epochs.table["cross_track_m"], y, atol=0.01)


def test_relations_that_are_not_navigable_lead_nowhere() -> None:
    """The positions lie between both ways; only the one that is navigable is possible."""
    distance = np.arange(300.0, 1200.0, 10.0)
    x, y = along(branch("d"), distance)
    place = site(SWITCH, [("s", 1, "m", 0, "both"), ("s", 1, "d", 0, "BA")])
    assert matched(run(x, 0.5 * y), place, odometer(distance)).path.element_names() == ["s", "m"]
    closed = site(SWITCH, [("s", 1, "m", 0, "both"), ("s", 1, "d", 0, "none")])
    assert matched(run(x, 0.5 * y), closed, odometer(distance)).path.element_names() == ["s", "m"]


def test_one_way_relations_hold_for_the_way_back_too() -> None:
    distance = np.arange(1200.0, 300.0, -10.0)
    x, y = along(branch("d"), distance)
    place = site(SWITCH, [("s", 1, "m", 0, "AB"), ("s", 1, "d", 0, "BA")])
    assert matched(run(x, 0.5 * y), place, odometer(distance)).path.element_names() == ["d", "s"]


def test_a_given_route_overrides_the_positions() -> None:
    trip = next(trip for trip in map(journey, range(20)) if trip.route == ROUTES["A"])
    given = Site(
        ladder().track, ladder().links, route=pl.DataFrame({"netelement_id": ["B1", "B2"], "direction": ["AB", "AB"]})
    )
    found = matched(trip.fixes, given, trip.odometer)
    assert found.path.element_names() == ["B1", "B2"]
    assert found.epochs.table["cross_track_m"].median() == pytest.approx(-4.0, abs=3.0)
    assert (found.epochs.table["path_probability"] == 1.0).all()


def test_a_route_against_the_run_is_turned() -> None:
    place = site(SWITCH, SWITCH_LINKS, route=[("d", "BA"), ("s", "BA")])
    distance = np.arange(300.0, 1400.0, 10.0)
    x, y = along(branch("d"), distance)
    found = matched(run(x, y), place, odometer(distance))
    assert found.path.element_names() == ["s", "d"]
    assert np.allclose(found.epochs.table["path_m"], distance, atol=0.1)


def test_balise_reads_pin_the_track() -> None:
    """Positions in the middle between two tracks; a read on one of them decides, from then on at once."""
    x = 50.0 + 10.0 * np.arange(200.0)
    names = ["on_b"]
    balises = pl.DataFrame(
        {
            "balise_id": names, "netelement_id": ["B1"], "measure_m": [500.0], "kind": ["physical"],
            "location_accuracy_m": [5.0], "linked": [True], "link_reaction": ["none"], "direction": ["both"],
        }
    )  # fmt: skip
    place = Site(ladder().track, ladder().links, balises=balises)
    reads = pl.DataFrame({"t": times(200, 2.0)[45:46], "balise_id": names})
    free = matched(run(x, np.full(200, 2.0), rate_hz=2.0), place, odometer(x, rate_hz=2.0))
    pinned = matched(run(x, np.full(200, 2.0), rate_hz=2.0), place, odometer(x, rate_hz=2.0), reads=reads)
    assert free.epochs.table["gate_probability"][60] < 0.9
    assert pinned.path.element_names() == ["B1", "B2"]
    assert pinned.epochs.table["gate_probability"][44] < 0.9
    assert pinned.epochs.table["gate_probability"][47:90].min() >= 0.99


def circle(radius: float, start: float, end: float) -> np.ndarray:
    angle = np.linspace(start, end, 200)
    return np.column_stack([radius * np.sin(angle), radius - radius * np.cos(angle)])


@pytest.mark.parametrize("pieces", [1, 2])
def test_laps_of_a_ring_add_up(pieces: int) -> None:
    """A test ring of one or two elements, run round two and a half times."""
    radius = 300.0
    cuts = np.linspace(0.0, 2.0 * np.pi, pieces + 1)
    names = [f"r{k}" for k in range(pieces)]
    elements = {name: circle(radius, cuts[k], cuts[k + 1]) for k, name in enumerate(names)}
    links: list[Link] = [(names[k], 1, names[(k + 1) % pieces], 0, "both") for k in range(pieces)]
    distance = np.arange(100.0, 5.0 * np.pi * radius, 10.0)
    x, y = radius * np.sin(distance / radius), radius - radius * np.cos(distance / radius)
    found = matched(run(x, y), site(elements, links), odometer(distance))
    moved = found.epochs.table["path_m"] - found.epochs.table["path_m"][0]
    assert np.allclose(moved, distance - distance[0], atol=0.5)
    assert len(found.path.legs) == 1
    assert travelled_route(found).height == 2.5 * pieces + (0.5 if pieces == 1 else 0)


def test_a_given_route_may_pass_an_element_twice() -> None:
    ring = {"r": circle(300.0, 0.0, 2.0 * np.pi), "in": line((-500, 0), (0, 0)), "out": line((0, 0), (500, 0))}
    links: list[Link] = [("in", 1, "r", 0, "both"), ("r", 1, "r", 0, "both"), ("r", 1, "out", 0, "both")]
    place = site(ring, links, route=[("in", "AB"), ("r", "AB"), ("r", "AB"), ("out", "AB")])
    around = np.concatenate([ring["in"], ring["r"][1:], ring["r"][1:], ring["out"][1:]])
    distance = np.arange(100.0, 4600.0, 10.0)
    x, y = along(around, distance)
    found = matched(run(x, y), place, odometer(distance))
    assert found.path.element_names() == ["in", "r", "out"]
    assert found.path.legs[0].end_m == pytest.approx(float(np.hypot(*np.diff(around, axis=0).T).sum()), abs=0.1)
    assert np.allclose(found.epochs.table["path_m"], distance, atol=1.0)


def test_a_network_in_pieces_is_crossed_with_a_break() -> None:
    """Nothing links the two pieces: a new leg, with the position carried on by the distance between."""
    elements = {"w": line((0, 0), (500, 0)), "e": line((1200, 0), (700, 0)), "x": line((500, 0), (400, 300))}
    place = site(elements, [("w", 1, "x", 0, "both")])
    whole = np.arange(100.0, 1100.0, 10.0)
    has_fix = (whole < 500.0) | (whole >= 700.0)
    found = matched(run(whole, np.zeros(len(whole))).filter(pl.Series(has_fix)), place, odometer(whole))
    assert [leg.visits[0].forward for leg in found.path.legs] == [True, False]
    assert np.allclose(found.epochs.table["path_m"], whole[has_fix], atol=15.0)
    assert found.epochs.table["netelement_id"].unique().sort().to_list() == ["e", "w"]


def test_gaps_between_linked_ends_count_as_track() -> None:
    elements = {"a": line((0, 0), (500, 0)), "b": line((506, 0), (1000, 0)), "c": line((506, 0), (900, 200))}
    place = site(elements, [("a", 1, "b", 0, "both"), ("a", 1, "c", 0, "both")])
    x = np.arange(100.0, 900.0, 10.0)
    found = matched(run(x, np.zeros(len(x))), place, odometer(x))
    assert found.path.element_names() == ["a", "b"]
    assert np.allclose(found.epochs.table["path_m"], x, atol=0.1)


def test_a_survey_that_goes_on_beside_where_it_ended_has_no_way_in_between() -> None:
    elements = {"a": line((0, 0), (500, 0)), "b": line((500, 1.5), (1000, 1.5)), "c": line((503, 1.5), (900, 200))}
    place = site(elements, [("a", 1, "b", 0, "both"), ("a", 1, "c", 0, "both")])
    x = np.arange(100.0, 900.0, 10.0)
    found = matched(run(x, np.where(x < 500.0, 0.0, 1.5)), place, odometer(x))
    assert found.path.element_names() == ["a", "b"]
    assert np.allclose(found.epochs.table["path_m"], x, atol=0.1)


def test_standstill_beside_a_switch_adds_nothing() -> None:
    """Twenty minutes of noise at the switch between driving in and driving on."""
    rng = np.random.default_rng(3)
    x = np.concatenate([np.arange(500.0, 1003.0, 5.0), np.full(600, 1003.0), np.arange(1003.0, 1500.0, 5.0)])
    noise = 0.5 * rng.normal(size=(len(x), 2))
    found = matched(run(x + noise[:, 0], noise[:, 1]), site(SWITCH, SWITCH_LINKS), odometer(x))
    assert found.path.element_names() == ["s", "m"]
    assert len(found.path.legs) == 1
    assert np.allclose(found.epochs.table["path_m"], x, atol=3.0)


def test_off_the_network_for_a_while() -> None:
    x = np.arange(100.0, 1900.0, 20.0)
    y = np.where((x > 600) & (x < 900), 400.0, 0.0)
    found = matched(run(x, y), site(SWITCH, SWITCH_LINKS), odometer(x))
    away = (x > 600) & (x < 900)
    assert found.epochs.table["on_track"].to_list() == (~away).tolist()
    assert found.epochs.table["gate_probability"].is_null().to_list() == away.tolist()
    assert found.path.element_names() == ["s", "m"]
    with pytest.raises(InputError, match="off the track"):
        matched(run(x, np.full(len(x), 400.0)), site(SWITCH, SWITCH_LINKS))


def test_an_unknown_track_error_is_no_certainty() -> None:
    """The same run over the same tracks: where the survey's sigma is not known, claims are weaker."""
    trip = journey(1)
    known, unknown = (matched(trip.fixes, ladder(sigma), trip.odometer) for sigma in (0.02, None))
    assert unknown.epochs.table["gate_probability"].mean() < known.epochs.table["gate_probability"].mean()


def test_reversed_runs_take_the_same_elements() -> None:
    for seed in range(6):
        trip = journey(seed)
        there = matched(trip.fixes, ladder(), trip.odometer)
        back_fixes = trip.fixes.reverse().with_columns(t=trip.fixes["t"])
        distance = trip.odometer.reverse().with_columns(t=trip.odometer["t"])
        back = matched(back_fixes, ladder(), distance)
        assert back.path.element_names() == there.path.element_names()[::-1]
        length = there.path.legs[-1].end_m
        assert np.allclose(back.epochs.table["path_m"].reverse(), length - there.epochs.table["path_m"], atol=1e-6)
        assert np.allclose(
            back.epochs.table["cross_track_m"].reverse(), -there.epochs.table["cross_track_m"], atol=1e-6
        )


def test_the_crossover_s_own_shape() -> None:
    assert lateral_m(np.array([1000.0, 1030.0, 1060.0])).tolist() == [0.0, 2.0, 4.0]
