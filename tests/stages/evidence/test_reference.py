"""The tracks of a reference: a set that knows no favourite and no cut."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.evidence.evidence import NOTHING
from pipeline.stages.reference import ReferencePath, reference_stretches
from pipeline.stages.track.network import network_in_pieces, site_network
from schemas.arrays import Floats
from schemas.config import Configuration
from schemas.run import Site
from tests.stages.evidence.worlds import known
from tests.stages.matching.builders import Link, line, site, times
from tests.stages.matching.ladder import degrees

X_M = np.linspace(20.0, 2980.0, 1500)


def samples(x_m: Floats, y_m: Floats, sigma_m: float | None = 0.05, seed: int = 0) -> pl.DataFrame:
    """A reference at 10 Hz whose noise is that of 5 cm, whatever it states."""
    noise = 0.05 * np.random.default_rng(seed).standard_normal((2, x_m.size))
    latitude, longitude = degrees(x_m + noise[0], y_m + noise[1])
    columns = {"latitude_deg": latitude, "longitude_deg": longitude}
    unknown = pl.Series("height_m", [None] * x_m.size, dtype=pl.Float64)
    sigma = pl.Series("sigma_m", [sigma_m] * x_m.size, dtype=pl.Float64)
    return pl.DataFrame({"t": times(x_m.size, 10.0), **columns}).with_columns(unknown, sigma)


def tracks(place: Site, frame: pl.DataFrame) -> list[set[tuple[str, ...]]]:
    """Per stretch the net elements of each way, along it."""
    network = site_network(place)
    found, _ = reference_stretches(frame, network_in_pieces(place), network.track.index, Configuration())

    def names(path: ReferencePath) -> tuple[str, ...]:
        named = [network.track.ids[one] for route in path.legs for one in route.element.tolist()]
        return min(tuple(named), tuple(named[::-1]))

    return [{names(path) for path in stretch.paths} for stretch in found]


def double(pieces: int, sigma_m: float | None, turnouts: bool = False, turned: bool = False) -> Site:
    """Track a along y = 0 in so many pieces, b 4 m beside it in one; turnouts lead away from a."""
    ends = np.linspace(0.0, 3000.0, pieces + 1)
    elements = {f"a{n}": line((ends[n], 0.0), (ends[n + 1], 0.0)) for n in range(pieces)}
    links: list[Link] = []
    for n in range(pieces - 1):
        links.append((f"a{n}", 1, f"a{n + 1}", 0, "both"))
        if turnouts:
            x_m = np.arange(0.0, 301.0, 10.0)
            elements[f"t{n}"] = np.column_stack([ends[n + 1] + x_m, -x_m * x_m / 600.0])
            links.append((f"a{n}", 1, f"t{n}", 0, "both"))
    if turned:
        elements["a0"] = elements["a0"][::-1]
        links = [(a, 0 if a == "a0" else p, b, q, way) for a, p, b, q, way in links]
    return site({**elements, "b": line((0.0, 4.0), (3000.0, 4.0))}, links, sigma_m=sigma_m)


@pytest.mark.parametrize("sigma_m", [0.3, 1.0, None])
@pytest.mark.parametrize(("pieces", "turnouts", "turned"), [(1, False, False), (9, False, False), (7, True, True)])
def test_a_reference_nearer_to_one_track_is_on_it_however_that_is_cut(
    sigma_m: float | None, pieces: int, turnouts: bool, turned: bool
) -> None:
    """0.6 m from a, 3.4 m from b: out with a survey of 0.3 m, possible at 3.56 sigma with one of 1 m."""
    ways = tracks(double(pieces, sigma_m, turnouts, turned), samples(X_M, np.full(X_M.size, 0.6)))
    beside = set() if sigma_m == 0.3 else {("b",)}
    assert ways == [{tuple(f"a{n}" for n in range(pieces)), *beside}]


@pytest.mark.parametrize(("pieces", "turnouts"), [(1, False), (9, False), (7, True)])
def test_where_the_survey_lets_both_be_both_are(pieces: int, turnouts: bool) -> None:
    """1.5 m from a and 2.5 m from b, surveyed to 1 m: neither has more claim."""
    ways = tracks(double(pieces, 1.0, turnouts), samples(X_M, np.full(X_M.size, 1.5)))
    assert ways == [{tuple(f"a{n}" for n in range(pieces)), ("b",)}]


def test_beside_every_track_is_silence_and_nothing_is_known() -> None:
    """The mean of the whole way is within 3.56 roots of 0.3 m on the track's own: 1.08 m."""
    assert tracks(double(1, 0.3), samples(X_M, np.full(X_M.size, -1.0))) == [{("a0",)}]
    place = double(1, 0.3)
    assert tracks(place, samples(X_M, np.full(X_M.size, -1.55))) == []
    found = known(place, of_reference=samples(X_M, np.full(X_M.size, -1.55)))
    assert set(found.at(found.reads_ns).kind.tolist()) == set()
    assert found.stretches == ()
    assert len(found.off_track) == 1


APART = site({"a": line((0.0, 0.0), (3000.0, 0.0)), "b": line((0.0, 12.0), (3000.0, 12.0))}, sigma_m=1.0)


def known_aside(*y_m: float) -> list[tuple[float, float, set[str]]]:
    """Where a reference is known that lies so far aside of a up to 1400 m, to 2200 m, and behind that.

    Surveyed to 1 m: an offset of 8 s is refuted at 4.3 m, a movement of as long at 6.1 m; samples lie beside a track up
    to 5.3 m.
    """
    return spans_and_tracks(X_M, np.interp(X_M, [1400.0, 1420.0, 2200.0, 2220.0], np.repeat(y_m, 2)[1:-1]), 0.05, APART)


def test_a_reference_is_known_again_once_a_movement_has_led_it_back() -> None:
    """By 7.5 m there and back; nobody knows how long before it had been wrong."""
    ((begin, end, names),) = known_aside(2.5, -5.0, 2.5)
    # Back at 2220 m, and there for two means of 8 s at 20 m/s.
    assert 2220.0 <= begin <= 2220.0 + 2 * 8 * 20.0
    assert (end, names) == (X_M[-1], {"a"})


@pytest.mark.parametrize("y_m", [(2.5, -5.0, -5.0), (2.5, -5.0, 1.0), (0.9, -5.0, 0.9), (2.5, -5.0, 4.5)])
def test_a_reference_that_has_not_come_back_is_silent_to_its_end(y_m: tuple[float, ...]) -> None:
    """It stays, comes elsewhere, or comes back by no more than the survey explains."""
    assert known_aside(*y_m) == []


def test_a_mean_is_not_a_sample() -> None:
    """A tenth of the samples 1.3 m beside the track."""
    aside = np.where(np.arange(X_M.size) % 10 == 0, 1.3, 0.0)
    assert tracks(double(3, 0.3), samples(X_M, aside)) == [{("a0", "a1", "a2")}]


SWITCH = site(
    {
        "s": line((0.0, 0.0), (500.0, 0.0)),
        "a": line((500.0, 0.0), (1000.0, 0.0)),
        "b": np.array([[500.0, 0.0], [550.0, 2.0], [600.0, 8.0], [1000.0, 100.0]]),
    },
    [("s", 1, "a", 0, "both"), ("s", 1, "b", 0, "both")],
)


@pytest.mark.parametrize("turn_m", [400.0, 495.0])
def test_a_train_that_turns_before_a_switch_comes_back_on_the_other_branch(turn_m: float) -> None:
    x_m = np.concatenate([np.linspace(900.0, turn_m, 500), np.linspace(turn_m, 900.0, 500)])
    y_m = np.concatenate([np.zeros(500), np.interp(x_m[500:], [0, 500, 550, 600, 1000], [0, 0, 2, 8, 100])])
    assert tracks(SWITCH, samples(x_m, y_m)) == [{("b", "s", "a", "s")}]


def test_a_way_against_a_relation_is_none() -> None:
    """From a to b over the switch without turning: no train does that; the longer part stays, the rest is silence."""
    x_m = np.concatenate([np.linspace(900.0, 510.0, 400), np.linspace(510.0, 700.0, 190)])
    y_m = np.concatenate([np.zeros(400), np.interp(x_m[400:], [500, 550, 600, 1000], [0, 2, 8, 100]) + 20.0])
    assert tracks(SWITCH, samples(x_m, y_m)) == [{("a",)}]


def test_one_sample_does_not_put_the_true_neighbour_out() -> None:
    """4.5 m apart at 1 m of survey, half-way between; every sample judged by itself lost a track once an hour."""
    place = site({"a": line((0.0, 0.0), (3000.0, 0.0)), "b": line((0.0, 4.5), (3000.0, 4.5))}, sigma_m=1.0)
    y_m = np.full(X_M.size, 2.0)
    y_m[700] = 6.0
    assert tracks(place, samples(X_M, y_m)) == [{("a",), ("b",)}]


def test_ways_that_came_together_long_ago_are_both_kept() -> None:
    """A loop 4 m beside the line, half-way between the two, and twelve minutes of single line in pieces behind it."""
    loop = np.array([(200.0, 0.0), (260.0, 4.0), (500.0, 4.0), (560.0, 0.0)])
    elements = {"w": line((0.0, 0.0), (200.0, 0.0)), "m": line((200.0, 0.0), (560.0, 0.0)), "l": loop}
    elements |= {f"e{k}": line((560.0 + 500.0 * k, 0.0), (1060.0 + 500.0 * k, 0.0)) for k in range(8)}
    pairs = [("w", "m"), ("w", "l"), ("m", "e0"), ("l", "e0"), *((f"e{k}", f"e{k + 1}") for k in range(7))]
    place = site(elements, [(a, 1, b, 0, "both") for a, b in pairs], sigma_m=2.0)
    x_m = np.arange(20.0, 4500.0, 0.5)
    (ways,) = tracks(place, samples(x_m, np.interp(x_m, loop[:, 0], loop[:, 1] / 2.0)))
    behind = tuple(f"e{k}" for k in reversed(range(8)))
    assert ways == {(*behind, "m", "w"), (*behind, "l", "w")}


def test_a_route_limits_the_elements() -> None:
    place = double(1, 0.3)
    given = Site(place.track, place.links, route=pl.DataFrame({"netelement_id": ["b"], "direction": ["AB"]}))
    assert tracks(given, samples(X_M, np.full(X_M.size, 3.9))) == [{("b",)}]
    assert tracks(given, samples(X_M, np.full(X_M.size, 0.1))) == []


def test_pauses_part_stretches_and_lost_samples_are_silence() -> None:
    """A second each; none from 3 to 6 s, and one at 8 s far beside the track."""
    frame = samples(100.0 + 10.0 * np.arange(20.0), np.zeros(20)).with_columns(t=times(20, 1.0))
    frame = frame.with_row_index().filter(~pl.col("index").is_in([4, 5])).drop("index")
    latitude, _ = degrees(np.zeros(1), np.full(1, 300.0))
    eight = pl.col("t").dt.epoch("s") == 8
    frame = frame.with_columns(latitude_deg=pl.when(eight).then(latitude[0]).otherwise("latitude_deg"))
    found = known(double(1, 0.3), of_reference=frame)
    assert [one.t_ns.size for one in found.stretches] == [4, 2, 11]
    at_s = np.array([2.5, 4.5, 7.0, 7.5, 8.5, 9.0])
    kinds = found.at((at_s * 1e9).astype(np.int64)).kind
    assert (kinds != NOTHING).tolist() == [True, False, True, False, False, True]


SIDING = site(
    {"m": line((0.0, 0.0), (4000.0, 0.0)), "s": line((0.0, 4.5), (1000.0, 4.5))},
    sigma_m=0.3,
)


def spans_and_tracks(
    x_m: Floats, y_m: Floats, sigma_m: float, place: Site = SIDING
) -> list[tuple[float, float, set[str]]]:
    """From where to where each stretch of the reference goes, and the tracks of it."""
    frame = samples(x_m, y_m, sigma_m)
    network = site_network(place)
    found, _ = reference_stretches(frame, network_in_pieces(place), network.track.index, Configuration())
    t_ns = frame["t"].to_physical().to_numpy()
    return [
        (
            float(x_m[np.searchsorted(t_ns, one.t_ns[0])]),
            float(x_m[np.searchsorted(t_ns, one.t_ns[-1])]),
            {network.track.ids[e] for path in one.paths for route in path.legs for e in route.element.tolist()},
        )
        for one in found
    ]


@pytest.mark.parametrize("outward", [True, False])
def test_behind_the_open_end_of_a_siding_its_neighbour_is_not_known(outward: bool) -> None:
    """A siding surveyed to 1000 m goes on beside the main track; a reference of 2 m cannot tell the two apart."""
    x_m = np.linspace(20.0, 3000.0, 1500)
    x_m = x_m if outward else x_m[::-1]
    for y_m in (4.5, 0.0, 2.0):
        found = spans_and_tracks(x_m, np.full(x_m.size, y_m), 2.0)
        assert [names for *_, names in found] == ([{"m", "s"}, {"m"}] if outward else [{"m"}, {"m", "s"}])
        span = (found[0][1], found[1][0]) if outward else (found[1][0], found[0][1])
        assert span == pytest.approx((1000.0, 2000.0), abs=5.0)


def test_a_reference_that_excludes_the_siding_knows_its_track_behind_the_open_end() -> None:
    x_m = np.linspace(20.0, 3000.0, 1500)
    assert spans_and_tracks(x_m, np.zeros(x_m.size), 0.5) == [(20.0, 3000.0, {"m"})]
    # The end of the survey itself, with no other track near.
    assert spans_and_tracks(np.linspace(3000.0, 4004.0, 500), np.zeros(500), 2.0)[0][2] == {"m"}


@pytest.mark.parametrize("outward", [True, False])
@pytest.mark.parametrize(("aside_m", "left_m"), [(0.0, 3004.0), (0.45, 2890.0)])
def test_where_it_left_over_a_switch_that_the_survey_lacks_it_is_unknown(
    outward: bool, aside_m: float, left_m: float
) -> None:
    """The train leaves the main track at 3000 m by a siding at 1:12 that nobody surveyed; a root is 0.304 m.

    It lies on no track beyond 5.33 roots, 1.62 m aside: 19.5 m behind the switch. Up to one root, 3.6 m behind it, the
    two are one. Of a reference that lies 1.5 roots aside all the time, no sample is within one root: 120 m before it
    lies on no track.
    """
    x_m = np.linspace(1500.0, 3400.0, 1500)
    y_m = -aside_m - np.clip((x_m - 3000.0) / 12.0, 0.0, 5.0)
    if not outward:
        x_m, y_m = x_m[::-1], y_m[::-1]
    (begin_m, end_m, names), *more = spans_and_tracks(x_m, y_m, 0.05)
    assert names == {"m"}
    assert not more
    assert sorted((begin_m, end_m)) == pytest.approx([1500.0, left_m], abs=8.0)


def test_a_pause_of_the_reference_is_no_leaving() -> None:
    """A root and a half aside, and no sample for 4 s."""
    x_m = np.linspace(1500.0, 3400.0, 1500)
    frame = samples(x_m, np.full(x_m.size, -0.45))
    late = pl.col("t") + pl.duration(seconds=4)
    frame = frame.with_columns(t=pl.when(pl.int_range(pl.len()) < 700).then("t").otherwise(late))
    network = site_network(SIDING)
    found, _ = reference_stretches(frame, network_in_pieces(SIDING), network.track.index, Configuration())
    assert [one.t_ns.size for one in found] == [700, 800]
