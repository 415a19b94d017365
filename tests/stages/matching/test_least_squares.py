"""Which path of the set is shown: the one with the least squares of the residuals, continuous over relations."""

from __future__ import annotations

import numpy as np
import pytest

from tests.stages.matching.builders import Link, line, matched, odometer, run, site
from tests.stages.matching.test_network import along

# A line that parts at 500 m into a straight way and a detour of 60 m more, both coming together at 1500 m.
DETOUR = np.array([(500.0, 0.0), (700.0, 120.0), (900.0, 165.0), (1100.0, 165.0), (1300.0, 120.0), (1500.0, 0.0)])
WAYS = {"in": line((0, 0), (500, 0)), "a": line((500, 0), (1500, 0)), "b": DETOUR, "out": line((1500, 0), (2500, 0))}
LINKS: list[Link] = [(one, 1, other, 0, "both") for one in ("in",) for other in "ab"]
LINKS += [(one, 1, "out", 0, "both") for one in "ab"]


@pytest.mark.parametrize("name", ["a", "b"])
def test_over_an_outage_the_odometer_tells_which_way_was_taken(name: str) -> None:
    points = np.concatenate([WAYS["in"], WAYS[name][1:], WAYS["out"][1:]])
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    at = np.arange(50.0, length - 50.0, 20.0)
    x, y = along(points, at)
    has_fix = (x < 480.0) | (x > 1520.0)
    fixes = run(x, y, fix=np.where(has_fix, "sbas", "none"))
    found = matched(fixes, site(WAYS, LINKS), odometer(at))
    assert found.path.element_names() == ["in", name, "out"]
    known = found.epochs.table["path_m"].is_not_null().to_numpy()
    assert np.allclose(found.epochs.table["path_m"].to_numpy()[known], at[known], atol=2.0)


@pytest.mark.parametrize(("y_m", "name"), [(1.9, "a"), (2.1, "b")])
def test_of_two_tracks_that_no_position_tells_apart_the_nearer_is_shown_and_not_claimed(y_m: float, name: str) -> None:
    """4 m apart: the sum of squares is 1.9^2 against 2.1^2 at each step."""
    place = site({"a": line((0, 0), (2000, 0)), "b": line((0, 4), (2000, 4))})
    x = np.arange(20.0, 1980.0, 10.0)
    found = matched(run(x, np.full(len(x), y_m)), place, odometer(x))
    assert found.path.element_names() == [name]
    assert found.epochs.table["path_probability"].max() < 0.99


def test_a_coarse_survey_does_not_win_by_being_coarse() -> None:
    """1.5 m from a track surveyed to 0.1 m, 2.5 m from one surveyed to 2 m: the former has the smaller residual."""
    good = site({"a": line((0, 0), (2000, 0)), "b": line((0, 4), (2000, 4))}, sigma_m=0.1)
    tracks = good.track.with_columns(sigma_m=np.where(good.track["netelement_id"] == "b", 2.0, 0.1))
    x = np.arange(20.0, 1980.0, 10.0)
    found = matched(run(x, np.full(len(x), 1.5)), type(good)(tracks, good.links), odometer(x))
    assert found.path.element_names() == ["a"]


def test_what_the_whole_run_refutes_is_not_shown_however_near_it_is() -> None:
    """Positions lie nearer the siding b for 15 s, and move as on a; b, that a switch leads to, bends away later."""
    x = np.linspace(0.0, 600.0, 61)
    siding = np.column_stack([1000.0 + x, np.minimum(x * x / 8000.0, 2.0) + np.maximum(x - 250.0, 0.0) * 0.2])
    place = site(
        {"s": line((0, 0), (1000, 0)), "a": line((1000, 0), (2500, 0)), "b": siding},
        [("s", 1, "a", 0, "both"), ("s", 1, "b", 0, "both")],
    )
    at = np.arange(50.0, 2400.0, 10.0)
    y = np.where((at > 1130.0) & (at < 1250.0), 1.3, 0.6)
    found = matched(run(at, y, sigma_m=1.0), place, odometer(at))
    assert found.path.element_names() == ["s", "a"]
    assert not (found.epochs.table["netelement_id"] == "b").any()


@pytest.mark.parametrize(("away_s", "names"), [(20, ["a"]), (45, ["a", "c"])])
def test_a_track_to_which_nothing_leads_is_shown_only_if_the_train_stays_there(away_s: int, names: list[str]) -> None:
    """The last seconds of a run lie on a track 20 m aside; half a minute is the limit (`matching.break_s`)."""
    place = site({"a": line((0, 0), (3000, 0)), "c": line((0, 20), (3000, 20))})
    x = np.arange(20.0, 2900.0, 10.0)
    y = np.where(np.arange(len(x)) >= len(x) - away_s, 20.0, 0.0)
    found = matched(run(x, y, sigma_m=0.5), place, odometer(x))
    assert found.path.element_names() == names


def test_off_every_track_the_path_goes_on_over_the_elements_between() -> None:
    """For 40 s the position lies 30 m aside, where the line passes four elements: the error stays an error across."""
    elements = {name: line((400.0 * k, 0), (400.0 * k + 400, 0)) for k, name in enumerate("abcdef")}
    place = site(elements, [(p, 1, q, 0, "both") for p, q in zip("abcde", "bcdef", strict=True)])
    x = np.arange(20.0, 2380.0, 20.0)
    y = np.where((x > 700.0) & (x < 1500.0), 30.0, 0.0)
    found = matched(run(x, y, sigma_m=0.5), place, odometer(x))
    assert found.path.element_names() == list("abcdef")
    assert np.allclose(found.epochs.table["path_m"], x, atol=0.1)
    assert np.allclose(found.epochs.table["cross_track_m"], y, atol=0.1)
