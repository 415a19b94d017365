"""Which tracks of a site positions alone can never tell apart, and what would."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipeline.read.site.alike import parallel_findings
from pipeline.read.site.neighbours import neighbour_table
from schemas.config import Configuration, SiteConfig
from tests.stages.matching.builders import line, matched, run, site
from tests.stages.matching.ladder import ladder


def found(spacing_m: float, **options: float) -> list[str]:
    place = site({"a": line((0, 0), (2000, 0)), "b": line((0, spacing_m), (2000, spacing_m))}, **options)
    return [f"{one.place}: {one.message}" for one in parallel_findings(place)]


def test_double_track_is_named_once_with_its_extent_and_what_tells_it_apart() -> None:
    (text,) = found(4.0)
    assert text.startswith("element a: 0 to 2000 m: b lies 4.0 m beside it")
    assert "a switch taken tells them apart at a survey of 0.02 m" in text
    # 4.39 · √2 · 1 m, and 0.2 m for paths that merge.
    (text,) = found(4.0, sigma_m=1.0)
    assert "nor does a switch taken at a survey of 1 m, which takes 6.4 m" in text


@pytest.mark.parametrize(("spacing_m", "named"), [(3.4, True), (5.0, True), (5.15, False), (20.0, False)])
def test_tracks_far_enough_apart_are_not(spacing_m: float, named: bool) -> None:
    """3.37 · 1.5 m = 5.06 m."""
    assert bool(found(spacing_m)) == named


def test_a_poor_survey_widens_it() -> None:
    assert found(5.2, sigma_m=1.0)
    assert not found(5.2, sigma_m=0.05)


def test_tracks_that_cross_or_part_are_none() -> None:
    crossing = site({"a": line((0, 0), (2000, 0)), "b": line((900, -500), (1100, 500))})
    assert parallel_findings(crossing) == []


def test_what_would_tell_is_named() -> None:
    place = ladder()
    balises = pl.DataFrame({"balise_id": ["p7"], "netelement_id": ["B1"], "kind": ["physical"]})
    remedies = {one.place: one.remedy for one in parallel_findings(replace(place, balises=balises))}
    assert "route" in remedies["element A2"]
    assert "p7" in remedies["element A1"]
    assert "switch" in remedies["element A1"]
    assert "p7" not in remedies["element A2"]


def test_with_a_route_nothing_is_in_doubt() -> None:
    route = pl.DataFrame({"netelement_id": ["A1", "A2"], "direction": ["AB", "AB"]})
    assert parallel_findings(replace(ladder(), route=route)) == []


def test_how_long_tracks_have_to_be_beside_each_other_is_configuration() -> None:
    place = site({"a": line((0, 0), (2000, 0)), "b": line((0, 4), (2000, 4))})
    assert len(parallel_findings(place, Configuration(site=SiteConfig(parallel_least_m=1900.0)))) == 1
    assert parallel_findings(place, Configuration(site=SiteConfig(parallel_least_m=2100.0))) == []


@pytest.mark.parametrize(("spacing_m", "claimed"), [(4.5, False), (6.5, True)])
def test_a_run_right_on_its_track_claims_it_where_nothing_is_found(spacing_m: float, claimed: bool) -> None:
    x = np.arange(0.0, 2000.0, 10.0)
    place = site({"a": line((0, 0), (2000, 0)), "b": line((0, spacing_m), (2000, spacing_m))})
    claim = matched(run(x, 0.0 * x, sigma_m=0.02), place).epochs.path_probability
    assert (np.nanmax(claim) == 0.99) == claimed


def test_neighbours_are_named_with_what_tells_them_apart_and_where() -> None:
    """b lies 1.5, 4.4 and 6 m beside a, 1 km each: at 0.3 m a switch tells from 2.06 m on, offsets from 5.16 m."""
    b = np.array([(0.0, 1.5), (1000.0, 1.5), (1040.0, 4.4), (2000.0, 4.4), (2040.0, 6.0), (3000.0, 6.0)])
    place = site({"a": line((0, 0), (3000, 0)), "b": b}, sigma_m=0.3)
    table = neighbour_table(place, Configuration())
    assert table["told_apart_by"].to_list() == ["nothing but a route or a read", "a switch taken", "the offset"]
    assert table["apart_m"].to_list() == pytest.approx([1.5, 4.4, 6.0], abs=0.03)
    assert table["from_m"].to_list() == pytest.approx([0.0, 1020.0, 2020.0], abs=30.0)
    assert table["switch_tells_from_m"].to_list() == pytest.approx([2.06] * 3, abs=0.02)
    assert table["offset_tells_from_m"].to_list() == pytest.approx([5.16] * 3, abs=0.02)
    route = pl.DataFrame({"netelement_id": ["a"], "direction": ["AB"]})
    assert neighbour_table(replace(place, route=route), Configuration()).is_empty()
