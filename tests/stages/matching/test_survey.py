"""Survey errors that many runs reveal, and the figures of a site."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.read.site.describe import describe_site
from pipeline.read.site.survey_findings import survey_findings
from schemas.run import Site
from tests.stages.matching.builders import line, matched, odometer, run, site
from tests.stages.matching.ladder import gauss_markov, ladder

CHAIN = {"a": line((0, 0), (1000, 0)), "b": line((2000, 0), (1000, 0))}
LINKS = [("a", 1, "b", 1, "both")]


def runs(shift_b_m: float, count: int = 12, sigma_m: float = 0.5) -> list[pl.DataFrame]:
    """Runs in both directions; the true track of `b` lies `shift_b_m` north of its survey."""
    frames = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        x = np.arange(50.0, 1950.0, 10.0)[:: 1 if seed % 2 else -1]
        y = np.where(x > 1000, shift_b_m, 0.0) + gauss_markov(rng, len(x), 1.0, sigma_m, 100.0)
        distance = np.abs(x - x[0])
        frames.append(matched(run(x, y, sigma_m=sigma_m), site(CHAIN, LINKS), odometer(distance)).epochs.table)
    return frames


def test_an_element_off_its_survey_is_named() -> None:
    table = survey_findings(runs(1.5), site(CHAIN, LINKS).track)
    row = table.row(0, named=True)
    assert (row["netelement_id"], row["axis"], row["runs"], row["inconsistent"]) == ("b", "cross", 12, True)
    # `b` points west: north of it is to its right.
    assert row["residual_m"] == pytest.approx(-1.5, abs=3 * row["sigma_m"])
    assert table.filter(pl.col("netelement_id") == "a")["inconsistent"].to_list() == [False]


def test_solutions_of_one_run_are_one_observation() -> None:
    frames = runs(1.5, count=4)
    twice = [pl.concat([frame, frame.with_columns(solution=pl.lit("gps"))]) for frame in frames]
    keys, same = ("netelement_id", "axis"), ("runs", "residual_m", "sigma_m", "ratio")
    one, two = (survey_findings(part).sort(keys) for part in (frames, twice))
    for name in same:
        assert two[name].to_list() == pytest.approx(one[name].to_list())
    assert two["epochs"].to_list() == [2 * count for count in one["epochs"]]


def test_a_good_survey_is_consistent() -> None:
    assert not survey_findings(runs(0.0))["inconsistent"].any()


def test_a_survey_that_claims_little_is_not_blamed() -> None:
    track = site(CHAIN, LINKS).track.with_columns(sigma_m=pl.lit(1.0))
    assert not survey_findings(runs(1.5), track)["inconsistent"].any()


def test_heights_are_judged_where_there_are_any() -> None:
    heights = {"a": np.full(101, 100.0), "b": np.full(101, 100.0)}
    x = np.arange(50.0, 1950.0, 10.0)
    fixes = run(x, np.zeros(len(x))).with_columns(height_m=pl.Series(np.where(x < 1000, 112.0, 100.0)))
    place = site(CHAIN, LINKS, heights_m=heights)
    table = survey_findings([matched(fixes, place).epochs.table], place.track)
    worst = table.row(0, named=True)
    assert (worst["netelement_id"], worst["axis"]) == ("a", "vertical")
    assert worst["residual_m"] == pytest.approx(12.0, abs=0.01)
    assert worst["inconsistent"]


def test_no_runs_give_an_empty_table() -> None:
    assert survey_findings([]).is_empty()


def test_figures_of_a_site() -> None:
    place = ladder()
    found = describe_site(Site(place.track, place.links))
    assert [found[name] for name in ("elements", "parts", "switches", "open_ends")] == [5, 1, 2, 4]
    assert found["relations"] == {"both": 4}
    assert found["length_m"] == pytest.approx(6060.0, abs=1.0)
    assert [found[name] for name in ("dimensions", "sigma_median_m", "without_sigma")] == ["2-D", 0.02, 0]
    assert found["spacing_max_m"] == pytest.approx(5.0)
