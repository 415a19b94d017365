"""Chains of net elements and their coordinate, on a line of three elements that is worked out by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.evidence.anchors import read_anchors
from pipeline.stages.evidence.gaps import chains_between, extend_chain
from pipeline.stages.track.network import Network, network_of
from pipeline.stages.track.path import Chain, Place, RoutePath
from pipeline.stages.track.survey import track_of
from schemas.config import HazardConfig

LENGTHS_M = {"a": 100.0, "b": 100.0, "c": 50.0}
DEG_PER_M = np.degrees(1.0 / 6378137.0)  # east along the equator


def line(last_way: str) -> Network:
    """Elements a, b and c behind each other along the equator; trains run from b to c as `last_way` says."""
    start_m = dict(zip(LENGTHS_M, (0.0, 100.0, 200.0), strict=True))
    points = [(name, at_m, start_m[name] + at_m) for name, length in LENGTHS_M.items() for at_m in (0.0, length)]
    names, measures, along = zip(*points, strict=True)
    places = {"netelement_id": names, "measure_m": measures, "longitude_deg": np.array(along) * DEG_PER_M}
    unknown = pl.lit(None, pl.Float64)
    track = pl.DataFrame(places).with_columns(latitude_deg=pl.lit(0.0), height_m=unknown, sigma_m=unknown)
    links = pl.DataFrame(
        {
            "netelement_a": ["a", "b"], "position_a": [1, 1], "netelement_b": ["b", "c"], "position_b": [0, 0],
            "navigability": ["both", last_way],
        }
    )  # fmt: skip
    return network_of(track_of(track), links)


def names(chains: list[Chain] | None) -> list[str]:
    assert chains is not None
    return ["".join("abc"[one // 2] for one in chain.oriented) for chain in chains]


@pytest.mark.parametrize(("back", "found"), [(False, []), (True, ["abc"])])
def test_a_way_is_run_only_as_its_links_allow(back: bool, found: list[str]) -> None:
    """c may be left for b, not reached from it: 50 m of a, all of b, 10 m of c."""
    network = line("BA")
    assert names(chains_between(network, 0, Place(0, 50.0), Place(2, 10.0), (155.0, 165.0), back, 64)) == found


def test_a_chain_of_another_length_is_none_and_too_many_are_not_weighed() -> None:
    network = line("both")
    places = Place(0, 50.0), Place(2, 10.0)
    assert names(chains_between(network, 0, *places, (161.0, 170.0), False, 64)) == []
    assert chains_between(network, 0, *places, (155.0, 165.0), False, 1) is None  # three steps, one allowed


def test_a_chain_goes_on_over_what_trains_may_run_in_either_sense() -> None:
    """From 20 m into b, 30 m back and 90 m ahead; the entry of b is 0."""
    network = line("BA")
    (found,) = extend_chain(network, Chain((2,), (0.0,)), -30.0, 110.0, 64) or []
    assert (names([found]), found.entry_m) == (["abc"], (-100.0, 0.0, 100.0))
    route = found.as_route(network)
    element, measure_m, sense = route.locate(np.array([-30.0, 20.0, 110.0]))
    assert (element.tolist(), sense.tolist()) == ([0, 1, 2], [1, 1, 1])
    assert measure_m == pytest.approx([70.0, 20.0, 10.0], abs=1e-6)


def test_of_two_visits_the_one_that_holds_the_measure_counts_else_the_nearer() -> None:
    """Element 0 is run over to 50 m, and 500 m later from there on."""
    route = RoutePath(
        element=np.array([0, 0]), forward=np.array([True, True]), entry_m=np.array([0.0, 500.0]),
        low_m=np.array([0.0, 50.0]), high_m=np.array([50.0, 100.0]),
    )  # fmt: skip
    at_m, sense = route.coordinates_of(
        np.zeros(4, np.int64), np.array([60.0, 45.0, 50.0, 50.0]), np.array([0.0, 490.0, 20.0, 480.0])
    )
    assert at_m.tolist() == [510.0, 45.0, 50.0, 500.0]
    assert sense.tolist() == [1, 1, 1, 1]


def test_a_read_counts_where_its_balise_lies_on_its_element() -> None:
    """a is 100 m long; lists round to half a metre."""
    stamps = pl.Series("t", [3, 1, 2, 4], dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    reads = pl.DataFrame({"t": stamps, "balise_id": ["beyond", "end", "before", "off"]})
    balises = pl.DataFrame(
        {
            "balise_id": ["end", "before", "beyond", "off", "virtual"],
            "netelement_id": ["a", "a", "a", "z", "a"],
            "measure_m": [100.4, -0.4, 100.6, 1.0, 1.0],
            "kind": ["physical"] * 4 + ["virtual"],
        }
    )
    found = read_anchors(reads, balises, line("both").track, HazardConfig())
    assert [(anchor.t_ns, anchor.places) for anchor in found] == [(1, (Place(0, 100.4),)), (2, (Place(0, -0.4),))]
