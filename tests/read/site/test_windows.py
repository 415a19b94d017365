"""Which balises of a site linking cannot tell apart: 400 m behind the reference the next needs 103.2 m (Q = 12 m)."""

from __future__ import annotations

from typing import Any

import polars as pl

from pipeline.read.site.alike import window_findings
from schemas.config import LdsConfig, SiteConfig
from schemas.inputs import Balises
from schemas.run import Site
from tests.stages.matching import builders
from tests.stages.matching.builders import line

LONG = {"A": line((0, 0), (3000, 0))}
# Three pieces in a row, the middle one surveyed from its far end.
PIECES = {"A": line((0, 0), (450, 0)), "B": line((900, 0), (450, 0)), "C": line((900, 0), (1350, 0))}
ROW = [("A", 1, "B", 1, "both"), ("B", 0, "C", 0, "both")]


def site_of(elements: Any, links: Any, places: dict[str, tuple[str, float]], **columns: Any) -> Site:
    bare = builders.site(elements, links)
    defaults = {
        "kind": "virtual",
        "location_accuracy_m": 12.0,
        "linked": True,
        "link_reaction": "service_brake",
        "direction": "both",
    }
    values = {
        name: given if isinstance(given, list) else [given] * len(places)
        for name, given in (defaults | columns).items()
    }
    frame = pl.DataFrame(
        {
            "balise_id": list(places),
            "netelement_id": [name for name, _ in places.values()],
            "measure_m": [measure_m for _, measure_m in places.values()],
            **values,
        }
    )
    return Site(bare.track, bare.links, balises=Balises.validate(frame, cast=True))


def findings_of(site: Site) -> list[tuple[str, str]]:
    return [(finding.place, finding.message) for finding in window_findings(site)]


def on_a(**places: float) -> dict[str, tuple[str, float]]:
    return {name: ("A", measure_m) for name, measure_m in places.items()}


def test_pairs_closer_than_the_minimal_spacing_are_named_once() -> None:
    """From V1 on and from V4 back: V2 and V3 are 100 m apart."""
    (finding,) = findings_of(site_of(LONG, [], on_a(V1=100.0, V2=500.0, V3=600.0, V4=1000.0)))
    assert finding[0] == "balises V2, V3"
    assert "measured from V1 overlap: 100.0 m apart, 103.2 m needed" in finding[1]


def test_balises_of_opposite_directions_are_never_expected_together() -> None:
    """Ahead V3 does not exist, back V2 does not; among those for one direction 100 m are too few as ever."""
    places = on_a(V1=100.0, V2=500.0, V3=600.0, V4=1000.0)
    assert findings_of(site_of(LONG, [], places, direction=["both", "AB", "BA", "both"])) == []
    assert len(findings_of(site_of(LONG, [], places, direction=["both", "AB", "AB", "both"]))) == 1


def test_wide_enough_is_no_finding() -> None:
    assert findings_of(site_of(LONG, [], on_a(V1=100.0, V2=500.0, V3=604.0, V4=1004.0))) == []


def test_each_balise_counts_with_its_own_accuracy() -> None:
    """With Q = 5 m for all 73.7 m are enough, with Q = 5 m for the first two 80 m with 12 m for the next are."""
    places = on_a(V1=100.0, V2=500.0, V3=576.0)
    assert findings_of(site_of(LONG, [], places, location_accuracy_m=5.0)) == []
    (finding,) = findings_of(site_of(LONG, [], places, location_accuracy_m=[5.0, 5.0, 12.0]))
    # (400 + 15) / 0.95 * 1.05 + 22 - 400 = 80.7 m.
    assert "76.0 m apart, 80.7 m needed" in finding[1]


def test_over_the_borders_of_net_elements() -> None:
    """At 100, 500 and 580 m of the line: the second on B, 50 m from its end, the third 320 m from its start."""
    places = {"V1": ("A", 100.0), "V2": ("B", 400.0), "V3": ("B", 320.0)}
    assert [place for place, _ in findings_of(site_of(PIECES, ROW, places))] == ["balises V2, V3"]
    across = {"V1": ("A", 440.0), "V2": ("B", 10.0), "V3": ("C", 60.0)}
    assert "70.0 m apart" in findings_of(site_of(PIECES, ROW, across))[0][1]
    assert findings_of(site_of(PIECES, [], across)) == []
    assert window_findings(site_of(PIECES, ROW, across), LdsConfig(), SiteConfig(announced_m=5.0)) == []


def test_only_ways_that_a_train_may_run_count() -> None:
    """V1 and V2 are close for a train that comes from V3, which navigability forbids."""
    places = {"V1": ("A", 100.0), "V2": ("A", 180.0), "V3": ("C", 300.0)}
    assert [place for place, _ in findings_of(site_of(PIECES, ROW, places))] == ["balises V2, V1"]
    one_way = [(a, i, b, j, "AB") for a, i, b, j, _ in ROW]
    assert findings_of(site_of(PIECES, one_way, places)) == []


def test_every_branch_of_a_switch_counts() -> None:
    elements = {"A": line((0, 0), (450, 0)), "L": line((450, 0), (950, 30)), "R": line((450, 0), (950, -30))}
    links = [("A", 1, "L", 0, "both"), ("A", 1, "R", 0, "both")]
    places = {"V0": ("A", 30.0), "V1": ("A", 430.0), "L1": ("L", 50.0), "R1": ("R", 400.0)}
    ((place, _),) = findings_of(site_of(elements, links, places))
    assert place == "balises V1, L1"


def test_what_is_not_announced_is_left_out_and_kinds_are_kept_apart() -> None:
    places = on_a(A=0.0, B=400.0, X=420.0, P=440.0, C=520.0)
    kinds = ["virtual", "virtual", "virtual", "physical", "virtual"]
    assert findings_of(site_of(LONG, [], places, linked=[True, True, False, True, True], kind=kinds)) == []


def test_no_balises_no_findings() -> None:
    assert window_findings(builders.site(LONG)) == []
