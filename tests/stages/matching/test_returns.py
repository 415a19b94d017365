"""One element that comes back to where it was: ramps over themselves, ways round a block, up and down beside."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from schemas.arrays import Floats
from schemas.inputs import Balises
from schemas.run import Site
from tests.stages.matching.builders import matched, odometer, run, site

RATE_HZ = 5.0


def way(*pieces: tuple[float, float]) -> Floats:
    """Points a metre apart along pieces of (length [m], turn to the left [deg])."""
    heading = np.concatenate([np.linspace(0.0, turn, round(length) + 1)[1:] for length, turn in pieces])
    ends = np.cumsum([0.0] + [turn for _, turn in pieces[:-1]])
    heading += np.repeat(ends, [round(length) for length, _ in pieces])
    steps = np.column_stack([np.cos(np.radians(heading)), np.sin(np.radians(heading))])
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


WAYS = {
    "ramp over itself": way((200, 0), (236, 270), (250, 0)),
    "round a block": way((150, 0), *((14, 90), (60, 0)) * 4, (14, 90), (150, 0)),
    "up and down": way((200, 0), (22, 180), (300, 0)),
    "two loops": way((100, 0), (200, 360), (60, 0), (200, -360), (100, 0)),
}


def place_of(points: Floats) -> Site:
    bare = site({"r": points})
    length = len(points) - 1.0
    balises = pl.DataFrame({"balise_id": ["first", "last"], "measure_m": [60.0, length - 60.0]}).with_columns(
        netelement_id=pl.lit("r"),
        kind=pl.lit("physical"),
        location_accuracy_m=pl.lit(12.0),
        linked=pl.lit(True),
        link_reaction=pl.lit("none"),
        direction=pl.lit("both"),
    )
    return Site(bare.track, bare.links, balises=Balises.validate(balises, cast=True))


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.parametrize("with_odometer", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_a_place_near_two_of_its_own_is_the_one_that_the_train_came_to(
    name: str, with_odometer: bool, seed: int
) -> None:
    points = WAYS[name]
    at = np.arange(20.0, len(points) - 21.0, 2.0)
    rng = np.random.default_rng(seed)
    lasting = np.convolve(rng.normal(size=len(at) + 199), np.full(200, 0.1), "valid")
    x, y = points[at.astype(int)].T
    fixes = run(x + lasting, y - lasting[::-1], RATE_HZ, sigma_m=1.5)
    reads = fixes[[20, -20]].select("t", balise_id=pl.Series(["first", "last"]))
    found = matched(fixes, place_of(points), odometer(at, RATE_HZ) if with_odometer else None, reads=reads)
    assert np.abs(found.epochs.table["path_m"].to_numpy() - at).max() < 8.0
    assert np.allclose(found.epochs.table["measure_m"], found.epochs.table["path_m"], atol=1e-6)
    assert found.path.element_names() == ["r"]
    assert (found.epochs.table["path_probability"] >= 0.99).sum() > 0.95 * len(at)
    assert found.path.balises_on_path(place_of(points).balises)["path_m"].to_list() == pytest.approx(
        [60.0, len(points) - 61.0], abs=0.01
    )


def test_a_jump_along_the_way_stays_a_jump() -> None:
    """150 m ahead for 4 s on a way that crosses itself elsewhere."""
    points = WAYS["ramp over itself"]
    at = np.arange(20.0, 650.0, 2.0)
    shown = at + np.where((np.arange(len(at)) >= 20) & (np.arange(len(at)) < 40), 150.0, 0.0)
    x, y = points[shown.astype(int)].T
    found = matched(run(x, y, RATE_HZ), place_of(points), odometer(at, RATE_HZ))
    assert np.abs(found.epochs.table["path_m"].to_numpy() - shown).max() < 1.0


@pytest.mark.parametrize("back_m", [2560.0, 2600.0, 2640.0])
@pytest.mark.parametrize("seed", range(3))
def test_soon_after_a_jump_the_passage_is_told_by_the_steps_on_both_sides(back_m: float, seed: int) -> None:
    """A wide ramp crosses itself at 700 m and 2714 m; for 200 m the position lies 60 m behind, until shortly before."""
    points = way((1000, 0), (1414, 270), (900, 0))
    at = np.arange(20.0, len(points) - 21.0, 4.0)
    rng = np.random.default_rng(seed)
    lasting = np.convolve(rng.normal(size=len(at) + 199), np.full(200, 0.05), "valid")
    shown = at - 60.0 * ((at >= back_m - 200.0) & (at < back_m))
    x, y = points[shown.astype(int)].T
    fixes = run(x + lasting, y - lasting[::-1], RATE_HZ, sigma_m=0.7)
    epochs = matched(fixes, site({"r": points}), odometer(at, RATE_HZ)).epochs.table
    assert np.abs(epochs["path_m"].to_numpy() - shown).max() < 8.0


@pytest.mark.parametrize("seed", range(4))
def test_a_jump_over_a_crossing_stays_on_the_passage_that_is_nearer(seed: int) -> None:
    """The same ramp; from 2400 m on the position lies 250 m ahead for 200 m and so runs over the crossing at 2714 m."""
    points = way((1000, 0), (1414, 270), (900, 0))
    at = np.arange(20.0, len(points) - 21.0, 2.0)
    rng = np.random.default_rng(seed)
    lasting = np.convolve(rng.normal(size=len(at) + 199), np.full(200, 0.05), "valid")
    shown = at + 250.0 * ((at >= 2400.0) & (at < 2600.0))
    x, y = points[shown.astype(int)].T
    fixes = run(x + lasting, y - lasting[::-1], 10.0, sigma_m=0.7)
    epochs = matched(fixes, site({"r": points}), odometer(at, 10.0)).epochs.table
    assert np.abs(epochs["path_m"].to_numpy() - shown).max() < 8.0
