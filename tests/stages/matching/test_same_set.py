"""The set of tracks is that of the network and the positions: not of names, order, direction, place, time or cuts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import polars as pl
import pytest

from pipeline.stages.matching import Match
from schemas.arrays import Floats, floats
from tests.stages.matching.builders import Link, line, matched, odometer, run, site
from tests.stages.matching.ladder import gauss_markov

RATE_MPS = 20.0


@dataclass(frozen=True)
class Drawn:
    """Elements and links in metres, the places of a run, and which name each element has in the world drawn first."""

    elements: dict[str, Floats]
    links: list[Link]
    x_m: Floats
    y_m: Floats
    chainage_m: Floats
    begin_ns: int = 0
    first_names: dict[str, str] = field(default_factory=dict)

    def first(self, name: str) -> str:
        return self.first_names.get(name, name)


def drawn(seed: int) -> Drawn:
    """Two tracks with a loop or a crossover between them, and a run over one way with noise and bias."""
    rng = np.random.default_rng([seed, 49])
    apart = float(rng.uniform(4.0, 6.0))
    ends = [0.0, 900.0, 1000.0, 2400.0, 2500.0, 3600.0]
    elements = {f"a{k}": line((ends[k], 0.0), (ends[k + 1], 0.0)) for k in range(5)}
    elements |= {f"b{k}": line((ends[k], apart), (ends[k + 1], apart)) for k in range(5)}
    elements |= {"x": line((900.0, 0.0), (1000.0, apart)), "y": line((2400.0, apart), (2500.0, 0.0))}
    links: list[Link] = [(f"{one}{k}", 1, f"{one}{k + 1}", 0, "both") for one in "ab" for k in range(4)]
    links += [("a0", 1, "x", 0, "both"), ("x", 1, "b2", 0, "both")]
    links += [("b2", 1, "y", 0, "both"), ("y", 1, "a4", 0, "both")]
    x = np.arange(50.0, 3550.0, RATE_MPS)
    over = np.interp(x, [900.0, 1000.0, 2400.0, 2500.0], [0.0, apart, apart, 0.0])
    true_m = [np.zeros(x.size), over, np.full(x.size, apart)][seed % 3]
    sigma_m = 0.3
    noise = [gauss_markov(rng, x.size, 1.0, sigma_m, 60.0) for _ in range(2)]
    return Drawn(elements, links, x + noise[0], true_m + noise[1] + rng.normal(), x)


def replayed(world: Drawn) -> Match:
    fixes, way = run(world.x_m, world.y_m, sigma_m=0.3), odometer(world.chainage_m)
    place = site(world.elements, world.links, sigma_m=0.3)
    later = (pl.col("t").cast(pl.Int64) + world.begin_ns).cast(pl.Datetime("ns", "UTC"))
    return matched(fixes.with_columns(later), place, way.with_columns(later))


@cache
def as_drawn(seed: int) -> tuple[Drawn, Match]:
    """A world before any change, and its run on it: made once for all changes."""
    world = drawn(seed)
    return world, replayed(world)


def claimed(world: Drawn, found: Match) -> list[str | None]:
    """Per epoch the track that is claimed, none where none is, "off" off the network."""
    epochs = found.epochs.table
    gate, names = floats(epochs, "gate_probability"), epochs["netelement_id"].to_list()
    return [
        "off" if np.isnan(one) else world.first(name) if one >= 0.99 else None
        for one, name in zip(gate, names, strict=True)
    ]


def possible(world: Drawn, found: Match) -> list[set[str]]:
    """Per step the tracks that no position refutes."""
    ids, parts = found.path.track.ids, found.possible
    spans = zip(parts.first[:-1].tolist(), parts.first[1:].tolist(), strict=True)
    return [{world.first(ids[one]) for one in parts.element[low:high].tolist()} for low, high in spans]


def renamed(world: Drawn) -> Drawn:
    names = {name: f"q{41 * sum(map(ord, name)) % 97}{name[::-1]}" for name in world.elements}
    links = [(names[a], i, names[b], j, way) for a, i, b, j, way in world.links]
    elements = {names[name]: points for name, points in world.elements.items()}
    return replace(world, elements=elements, links=links, first_names={new: old for old, new in names.items()})


def mirrored(world: Drawn) -> Drawn:
    elements = {name: points * [1.0, -1.0] for name, points in world.elements.items()}
    return replace(world, elements=elements, y_m=-world.y_m)


def shifted_in_time(world: Drawn) -> Drawn:
    return replace(world, begin_ns=106_617_607_000_000_000)


def shifted_in_place(world: Drawn) -> Drawn:
    by = np.array([700.0, -450.0])
    elements = {name: points + by for name, points in world.elements.items()}
    return replace(world, elements=elements, x_m=world.x_m + by[0], y_m=world.y_m + by[1])


def reordered(world: Drawn) -> Drawn:
    elements = dict(sorted(world.elements.items(), key=lambda item: item[0][::-1], reverse=True))
    return replace(world, elements=elements, links=world.links[::-1])


def reversed_elements(world: Drawn) -> Drawn:
    turned = {"a2", "b0", "b2", "y"}
    elements = {name: points[::-1] if name in turned else points for name, points in world.elements.items()}
    links = [(a, i ^ (a in turned), b, j ^ (b in turned), way) for a, i, b, j, way in world.links]
    return replace(world, elements=elements, links=links)


def split(world: Drawn) -> Drawn:
    """The long elements between the switches in three pieces each."""
    elements, links, names = dict(world.elements), list(world.links), dict(world.first_names)
    for name in ("a2", "b2"):
        points = elements.pop(name)
        cuts = [0, len(points) // 3, 2 * len(points) // 3, len(points) - 1]
        for k in range(3):
            elements[f"{name}-{k}"] = points[cuts[k] : cuts[k + 1] + 1]
            names[f"{name}-{k}"] = name
        ends = {0: f"{name}-0", 1: f"{name}-2"}
        links = [(ends[i] if a == name else a, i, ends[j] if b == name else b, j, w) for a, i, b, j, w in links]
        links += [(f"{name}-{k}", 1, f"{name}-{k + 1}", 0, "both") for k in range(2)]
    return replace(world, elements=elements, links=links, first_names=names)


CHANGES: list[Callable[[Drawn], Drawn]] = [
    renamed,
    mirrored,
    shifted_in_time,
    shifted_in_place,
    reordered,
    reversed_elements,
    split,
]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("change", CHANGES)
def test_claims_and_sets_are_those_of_the_network_whatever_it_is_called(
    change: Callable[[Drawn], Drawn], seed: int
) -> None:
    world, found = as_drawn(seed)
    changed = change(world)
    found_changed = replayed(changed)
    assert claimed(changed, found_changed) == claimed(world, found)
    assert possible(changed, found_changed) == possible(world, found)


@pytest.mark.parametrize("seed", range(6))
def test_nothing_live_changes_before_a_cut(seed: int) -> None:
    """Neither claims nor any confidence below them."""
    world, found = as_drawn(seed)
    whole = floats(found.epochs.table, "gate_probability")
    for count in (25, 60, 100, 140):
        part = replace(world, x_m=world.x_m[:count], y_m=world.y_m[:count], chainage_m=world.chainage_m[:count])
        assert np.array_equal(floats(replayed(part).epochs.table, "gate_probability"), whole[:count], equal_nan=True)


def test_some_of_these_runs_claim_and_some_doubt() -> None:
    """Else nothing above could fail."""
    claims = [claimed(*as_drawn(seed)) for seed in range(6)]
    assert sum(any(one not in (None, "off") for one in run) for run in claims) >= 3
    assert sum(None in run for run in claims) >= 3
    assert any(len(one) > 1 for seed in range(6) for one in possible(*as_drawn(seed)))
