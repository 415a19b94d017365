"""Runs and sites at the edge of what makes sense."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site
from tests.stages.matching.ladder import SPACING_M, ladder
from tests.stages.matching.test_network import SWITCH, SWITCH_LINKS

PLACES = {"chain": site({"e": line((0, 0), (1000, 0))}), "network": site(SWITCH, SWITCH_LINKS)}


@pytest.mark.parametrize("kind", PLACES)
def test_one_epoch_only(kind: str) -> None:
    found = matched(run(np.array([100.0]), np.array([1.0])), PLACES[kind])
    assert found.epochs.table["path_m"].to_list() == pytest.approx([100.0], abs=1e-3)
    assert found.epochs.table["on_track"].to_list() == [True]


@pytest.mark.parametrize("kind", PLACES)
def test_one_place_only(kind: str) -> None:
    found = matched(run(np.full(50, 100.0), np.zeros(50)), PLACES[kind], odometer(np.zeros(50)))
    assert np.allclose(found.epochs.table["path_m"], 100.0, atol=1e-3)


def test_elements_without_any_relation() -> None:
    place = site({"a": line((0, 0), (1000, 0)), "b": line((0, 20), (1000, 20)), "c": line((0, 500), (1000, 500))})
    x = np.arange(100.0, 900.0, 10.0)
    found = matched(run(x, np.full(80, 19.0)), place, odometer(x))
    assert found.path.element_names() == ["b"]
    assert found.ambiguous.is_empty()


def test_an_odometer_of_speeds_and_one_that_ends_early() -> None:
    x = np.arange(300.0, 1500.0, 15.0)
    fixes = run(x, np.where(x > 1000, 0.0, 0.0))
    whole = odometer(x)
    speeds = whole.with_columns(distance_m=pl.lit(None, dtype=pl.Float64))
    short = whole[:30]
    for distance in (speeds, short, whole[:1]):
        found = matched(fixes, PLACES["network"], distance)
        assert found.path.element_names() == ["s", "m"]
        assert np.allclose(found.epochs.table["path_m"], x, atol=1e-2)


def test_columns_that_a_log_does_not_hold() -> None:
    fixes = run(np.arange(100.0, 200.0, 10.0), np.zeros(10)).drop("cov_ee_m2", "cov_en_m2", "cov_nn_m2")
    assert matched(fixes, PLACES["chain"]).epochs.table["sigma_source"].cast(str).unique().to_list() == ["table"]


def test_the_antimeridian_is_no_edge() -> None:
    place = site({"e": line((0, 0), (1000, 0))})
    fixes = run(np.arange(100.0, 900.0, 50.0), np.full(16, 2.0))

    def moved(frame: pl.DataFrame) -> pl.DataFrame:
        turned = pl.col("longitude_deg") - 14.0 + 179.995
        return frame.with_columns(longitude_deg=(turned + 180.0) % 360.0 - 180.0)

    found = matched(moved(fixes), Site(moved(place.track), place.links)).epochs.table
    assert np.allclose(found["path_m"], np.arange(100.0, 900.0, 50.0), atol=2e-2)
    assert np.allclose(found["cross_track_m"], 2.0, atol=1e-3)


PIECES = 7


def random_ladder(seed: int) -> tuple[dict[str, np.ndarray], list[Link], list[str]]:
    """Two tracks in pieces of random length and sense, crossovers both ways, and a random way through."""
    rng = np.random.default_rng(seed)
    cuts = np.concatenate([[0.0], np.cumsum(rng.uniform(150.0, 500.0, size=PIECES))])
    from_a, turned = rng.integers(2, size=PIECES) > 0, rng.integers(2, size=(PIECES, 3)) > 0
    elements: dict[str, np.ndarray] = {}
    forward: dict[str, bool] = {}
    for k in range(PIECES):
        y_start = 0.0 if from_a[k] else SPACING_M
        lines = {"a": (0.0, 0.0), "b": (SPACING_M, SPACING_M), "x": (y_start, SPACING_M - y_start)}
        for number, (track, (y0, y1)) in enumerate(lines.items()):
            points = line((cuts[k], y0), (cuts[k + 1], y1))
            forward[f"{track}{k}"] = not turned[k, number]
            elements[f"{track}{k}"] = points[::-1] if turned[k, number] else points
    pairs = [(f"{track}{k}", f"{track}{k + 1}") for k in range(PIECES - 1) for track in "ab"]
    pairs += [(f"{'a' if from_a[k] else 'b'}{k - 1}", f"x{k}") for k in range(1, PIECES)]
    pairs += [(f"x{k}", f"{'b' if from_a[k] else 'a'}{k + 1}") for k in range(PIECES - 1)]
    links: list[Link] = [(p, int(forward[p]), q, int(not forward[q]), "both") for p, q in pairs]
    return elements, links, random_way(rng, from_a)


def random_way(rng: np.random.Generator, from_a: np.ndarray) -> list[str]:
    """Along track a from the first piece on, over some of the crossovers that lead away from where it is."""
    way, track = ["a0"], "a"
    for k in range(1, PIECES):
        leads_away = (track == "a") == from_a[k] and not way[-1].startswith("x")
        crossing = leads_away and bool(rng.integers(2))
        way.append(f"x{k}" if crossing else f"{track}{k}")
        if crossing:
            track = "b" if track == "a" else "a"
    return way


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.booleans(), st.booleans())
def test_exact_positions_give_the_exact_way(seed: int, backwards: bool, with_odometer: bool) -> None:
    elements, links, way = random_ladder(seed)
    points = np.concatenate([np.array(sorted(elements[name].tolist())) for name in way])
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    distance = np.arange(20.0, at[-1] - 20.0, 4.0)
    x, y = np.interp(distance, at, points[:, 0]), np.interp(distance, at, points[:, 1])
    if backwards:
        x, y, way = x[::-1], y[::-1], way[::-1]
    fixes = run(x, y, sigma_m=0.3)
    found = matched(fixes, site(elements, links), odometer(0.995 * distance) if with_odometer else None)
    assert found.path.element_names() == way
    assert np.allclose(np.diff(found.epochs.table["path_m"]), 4.0, atol=0.02)
    assert np.abs(found.epochs.table["cross_track_m"]).max() < 0.01


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_positions_give_probabilities_and_the_same_ones_again(seed: int) -> None:
    """Whatever the positions, nothing breaks: gaps, wild jumps, standstill, epochs off every track."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.choice([0.0, 5.0, 15.0, -200.0, 300.0], size=120, p=[0.3, 0.3, 0.36, 0.02, 0.02]))
    x = 1500.0 + (x - x.mean())
    y = rng.choice([0.0, 2.0, 4.0, 80.0], size=120, p=[0.4, 0.28, 0.3, 0.02]) + rng.normal(size=120)
    fixes = run(x, y, fix=rng.choice(["sbas", "none"], size=120, p=[0.9, 0.1]))
    distance = odometer(np.cumsum(rng.normal(8.0, 8.0, size=120)))
    first, again = (matched(fixes, ladder(), distance) for _ in range(2))
    assert first.epochs.table.equals(again.epochs.table)
    for name in ("path_probability", "gate_probability"):
        values = first.epochs.table[name].drop_nulls()
        assert values.is_between(0.0, 1.0).all()
        # Off the network there is none on the track either.
        assert first.epochs.table.filter(~pl.col("on_track"))[name].is_null().all()
    floats = first.epochs.table.select(pl.col(pl.Float64))
    assert not any(column.is_nan().any() or column.is_infinite().any() for column in floats)
    known = first.epochs.table.filter(pl.col("fix_valid"))
    assert known.select("leg", "path_m", "measure_m", "netelement_id", "cross_track_m").null_count().row(0) == (0,) * 5
