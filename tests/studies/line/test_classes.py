"""Classes of pieces: known bad places are found with their causes, and nothing good is said that was not judged."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.studies.line.classes import piece_classes
from pipeline.studies.line.spans import SpanState
from pipeline.studies.tally import trials_needed, without_repeated_journeys
from schemas.line import LineCriteria
from schemas.run import Site
from tests.studies.line.tables import (
    CRITERIA,
    PLACES,
    chainage,
    epochs_of,
    ground_of_line,
    line_site,
    nowhere,
    passes_over,
)

RUNS = 84  # 42 in each direction
NO_ERRORS = pl.DataFrame(schema={"piece": pl.Int64, "largest_undetected_m": pl.Float64})


def classes(passes: pl.DataFrame, site: Site, criteria: LineCriteria = CRITERIA) -> pl.DataFrame:
    pieces = ground_of_line(site, criteria).pieces
    return piece_classes(passes, NO_ERRORS, pieces, criteria).with_columns(
        chainage=chainage(pieces), word=pl.col("piece_class").cast(pl.String), why=pl.col("cause").cast(pl.String)
    )


@pytest.fixture(scope="module")
def site() -> Site:
    return line_site()


@pytest.fixture(scope="module")
def passes(site: Site) -> pl.DataFrame:
    return passes_over([epochs_of(number) for number in range(RUNS)], site)


@pytest.fixture(scope="module")
def table(passes: pl.DataFrame, site: Site) -> pl.DataFrame:
    return classes(passes, site)


@pytest.mark.parametrize("name", PLACES)
def test_bad_places_are_found_with_their_causes(name: str, table: pl.DataFrame) -> None:
    begin, end, causes = PLACES[name]
    inner = table.filter(pl.col("chainage").is_between(begin, end) & (pl.col("netelement_id") != "P"))
    found = inner.filter((pl.col("word") == "unsuitable") & pl.col("why").is_in(list(causes)))
    assert inner.filter(pl.col("word") == "suitable").is_empty()
    assert found["direction"].n_unique() == 2
    if name != "roof":  # an alarm counts where it begins
        assert found.height == inner.height


def test_no_bad_place_is_invented(table: pl.DataFrame) -> None:
    # A span reaches from one epoch to the next, 25 m, a wrong claim 30 m farther, a piece is 50 m.
    far = pl.lit(value=True)
    for begin, end, _ in PLACES.values():
        far &= ~pl.col("chainage").is_between(begin - 80.0, end + 80.0)
    clear = table.filter(far & pl.col("chainage").is_between(100.0, 5900.0))
    assert clear.filter(pl.col("word") == "unsuitable").is_empty()
    ringing = clear.filter(pl.col("word") != "suitable")
    assert set(ringing["why"]) == {"after_alarm"}
    assert ringing["chainage"].is_between(2800.0, 3250.0).all()


def test_a_position_on_a_wrong_track_condemns_both_tracks(table: pl.DataFrame) -> None:
    beside = table.filter((pl.col("netelement_id") == "P") & pl.col("chainage").is_between(5025.0, 5275.0))
    assert set(beside["word"]) == {"unsuitable"}
    assert set(beside["why"]) == {"wrong_track"}


def test_halves_predict_each_other(passes: pl.DataFrame, site: Site) -> None:
    number = pl.col("run_id").str.slice(1).cast(pl.Int64)
    one, other = (classes(passes.filter((number // 2) % 2 == half), site) for half in (0, 1))
    both = one.join(other, on=["piece", "direction"], suffix="_2").filter(pl.min_horizontal("passes", "passes_2") > 0)
    outside = ~pl.col("loss_share").is_between("loss_low_2", "loss_high_2")
    assert both.height > 150
    # 95 % bounds, each piece once; edges of bad places are hit by some phases of the epochs only.
    assert both.filter(outside).height <= 0.05 * both.height


def test_more_passes_never_widen_a_bound(passes: pl.DataFrame, table: pl.DataFrame, site: Site) -> None:
    twice = classes(pl.concat([passes, passes.with_columns(run_id=pl.col("run_id") + "b")]), site)
    width = pl.col("loss_high") - pl.col("loss_low")
    before, after = (frame.filter(pl.col("passes") > 0).select(width).to_series() for frame in (table, twice))
    assert (after < before).all()


def test_a_right_pass_never_raises_and_a_lost_one_never_lowers_a_bound(site: Site) -> None:
    good = [epochs_of(number, (), falling=False) for number in range(8)]
    bad = [epochs_of(number, ("cutting",), falling=False) for number in range(8, 12)]
    several = [classes(passes_over(runs, site), site) for runs in (good, good + good[:1], good + bad[:1])]
    at = (pl.col("chainage") == 625.0) & (pl.col("direction") == "growing")
    first, more_right, more_lost = (table.row(by_predicate=at, named=True) for table in several)
    assert more_right["loss_high"] < first["loss_high"]
    assert more_lost["loss_low"] > first["loss_low"]


def test_unknown_epochs_make_nothing_suitable(site: Site) -> None:
    runs = [epochs_of(number, ()).with_columns(judgement=pl.lit("unknown")) for number in range(2)]
    passed = passes_over(runs, site)
    table = classes(pl.concat(passed.with_columns(run_id=pl.lit(str(number))) for number in range(RUNS)), site)
    assert set(table["word"]) == {"unknown"}
    assert table["passes"].sum() == 0
    assert "not_judged" in set(table["why"])


def test_what_the_reference_lost_counts_against_a_piece(site: Site) -> None:
    """40 right passes show 10 %; four more whose truth was lost at 1025 m may hide anything: (4, 44) reaches 21.7 %."""
    right = passes_over([epochs_of(0, (), falling=False)], site)
    at = pl.col("path_m").is_between(1000.0, 1050.0)
    lost = epochs_of(0, (), falling=False).with_columns(
        judgement=pl.when(at).then(pl.lit("unknown")).otherwise("judgement"),
        error_low_m=pl.when(~at).then("error_low_m"),
        error_high_m=pl.when(~at).then("error_high_m"),
        **{name: pl.when(at).then(lost).otherwise(name) for name, lost in nowhere().items()},
    )
    parts = [right] * 40 + [passes_over([lost], site)] * 4
    many = pl.concat(part.with_columns(run_id=pl.lit(str(number))) for number, part in enumerate(parts))
    place = (pl.col("chainage") == 1025.0) & (pl.col("direction") == "growing")
    found = classes(many, site).row(by_predicate=place, named=True)
    assert (found["word"], found["why"], found["right"], found["unjudged"]) == ("unknown", "not_judged", 40, 4)
    assert found["loss_high"] == pytest.approx(0.2167, abs=1e-4)
    assert found["loss_low"] == 0.0
    # Where the evidence is of reads they are no trials.
    not_covered = many.with_columns(pl.col("state").replace(int(SpanState.UNKNOWN), int(SpanState.NOT_COVERED)))
    assert classes(not_covered, site).row(by_predicate=place, named=True)["word"] == "suitable"


def test_a_wrong_position_after_a_gap_is_wrong_there_and_not_along_it(site: Site) -> None:
    """No epoch from 1500 to 1800 m, then one wrong position in use: the gap is an outage."""
    run = epochs_of(0, (), falling=False).filter(~pl.col("path_m").is_between(1500.0, 1800.0))
    first = pl.int_range(pl.len()) == run.filter(pl.col("path_m") < 1500.0).height
    wrong = run.with_columns(
        path_m=pl.when(first).then(pl.col("path_m") + 30.0).otherwise("path_m"),
        judgement=pl.when(first).then(pl.lit("wrong")).otherwise("judgement"),
        **{name: pl.when(first).then(pl.col(name) + 30.0).otherwise(name) for name in ("error_low_m", "error_high_m")},
    )
    table = classes(passes_over([wrong], site), site).filter(pl.col("direction") == "growing")
    in_gap = table.filter(pl.col("chainage").is_between(1500.0, 1740.0))
    assert in_gap.select(pl.col("lost_outage").sum(), pl.col("wrong_in_use").sum()).row(0) == (5, 0)
    assert table.filter(pl.col("chainage") == 1825.0)["wrong_in_use"].to_list() == [1]


def test_one_journey_counts_once() -> None:
    """A log under two names, the second replayed with another verdict; and another journey."""
    runs = pl.DataFrame(
        {
            "run_id": ["a", "b", "c"],
            "solution": "primary",
            "verdict": ["safe", "unsafe", "safe"],
            "t_start": 0,
            "t_end": [60, 60, 61],
            "distance_m": [1000.0, 1001.0, 1000.0],
        }
    )
    kept, said = without_repeated_journeys(runs)
    assert kept["run_id"].to_list() == ["b", "c"]
    assert [text.partition(" runs ")[0] for text in said] == ["1", "1"]
    assert "begin and end together with another run" in said[0]
    assert "overlap in time" in said[1]
    once, said = without_repeated_journeys(kept.filter(pl.col("run_id") != "c"))
    assert (once["run_id"].to_list(), said) == (["b"], [])


def test_two_trains_logged_over_the_same_hour_are_two_journeys() -> None:
    runs = pl.DataFrame(
        {"run_id": ["a", "b"], "solution": "primary", "verdict": "safe", "t_start": 0, "t_end": 3600}
    ).with_columns(distance_m=pl.Series([30_000.0, 24_000.0]))
    assert without_repeated_journeys(runs)[0]["run_id"].to_list() == ["a", "b"]


@pytest.mark.parametrize(("begin", "overlapping"), [(59, ["1"]), (60, []), (61, [])])
def test_runs_that_overlap_in_time_are_remarked_on(begin: int, overlapping: list[str]) -> None:
    """Pieces of one recording would be several journeys; two solutions of one run are not."""
    runs = pl.DataFrame(
        {
            "run_id": ["a", "b", "a"],
            "solution": ["primary", "primary", "gps"],
            "verdict": "safe",
            "t_start": [0, begin, 0],
            "t_end": [60, 120, 60],
            "distance_m": 1000.0,
        }
    )
    kept, said = without_repeated_journeys(runs)
    assert kept.height == 3
    assert [text.partition(" runs overlap")[0] for text in said] == overlapping


def test_positions_whose_place_nobody_knows_say_nothing(site: Site) -> None:
    lost = pl.lit(None, pl.Float64)
    runs = [epochs_of(number).with_columns(error_low_m=lost, error_high_m=lost, **nowhere()) for number in range(10)]
    runs = [run.with_columns(judgement=pl.lit("unknown")) for run in runs]
    assert passes_over(runs, site).is_empty()


def test_one_wrong_position_in_use_is_enough(site: Site) -> None:
    good = passes_over([epochs_of(77, (), falling=False)], site)
    many = pl.concat(good.with_columns(run_id=pl.lit(f"good{number}")) for number in range(1000))
    wrong = passes_over([epochs_of(77, ("facade",), falling=False)], site)
    # B is surveyed against the line.
    table = classes(pl.concat([many, wrong]), site).filter(pl.col("direction") == "falling")
    inner = table.filter(pl.col("chainage").is_between(4000.0, 4100.0))
    assert set(inner["word"]) == {"unsuitable"}
    assert set(inner["wrong_in_use"]) == {1}
    assert set(inner["passes"]) == {1001}


def test_the_place_is_the_trains_not_the_positions(site: Site) -> None:
    """A position 500 m ahead that is not in use: lost where the train was, nothing where it claimed to be."""
    shifted = [
        run.with_columns(
            path_m=pl.when(at).then(pl.col("path_m") + 500.0).otherwise("path_m"),
            error_low_m=pl.when(at).then(499.0).otherwise("error_low_m"),
            error_high_m=pl.when(at).then(503.0).otherwise("error_high_m"),
            judgement=pl.when(at).then(pl.lit("wrong")).otherwise("judgement"),
            in_use=~at,
        )
        for run in (epochs_of(number, (), falling=False) for number in range(0, 80, 2))
        for at in [pl.col("path_m").is_between(1000.0, 1100.0)]
    ]
    table = classes(passes_over(shifted, site), site).filter(pl.col("direction") == "growing")
    there = table.filter(pl.col("chainage").is_between(1025.0, 1075.0))
    assert there.select("word", "why").unique().rows() == [("unsuitable", "wrong")]
    assert set(table.filter(pl.col("chainage").is_between(1400.0, 1700.0))["word"]) == {"suitable"}


def test_few_satellites_are_named_where_a_run_tells_them(passes: pl.DataFrame, site: Site) -> None:
    """Every other run tells none: more than half of the lost passes must have few, of days one that tells is enough."""
    number = pl.col("run_id").str.slice(1).cast(pl.Int64) // 2
    cutting = pl.col("chainage").is_between(525.0, 675.0)
    for recorded, cause in ((number % 3 < 2, "few_satellites"), (number % 3 < 1, "confidence")):
        some = passes.with_columns(satellites=pl.when(recorded).then("satellites"))
        assert set(classes(some, site).filter(cutting)["why"]) == {cause}
        by_day = classes(some, site, LineCriteria(independent="day", loss_limit=0.01)).filter(cutting)
        assert set(by_day["why"]) == {"few_satellites"}
    # As many as ever: the interval was too wide for another reason.
    usual = passes.with_columns(satellites=pl.lit(12.0))
    assert set(classes(usual, site).filter(cutting)["why"]) == {"confidence"}


def test_passes_of_one_day_count_as_one_by_option(passes: pl.DataFrame, site: Site) -> None:
    table = classes(passes, site, LineCriteria(independent="day"))
    # 84 runs an hour apart lie on four days; hours of the day are those of all passes.
    assert table["passes"].max() == 4
    assert table["hours"].max() == 12
    assert "suitable" not in set(table["word"])


@pytest.mark.parametrize(("bad", "number", "needed"), [(0, 0, 36), (0, 30, 6), (0, 50, 0), (1, 0, 54)])
def test_trials_needed(bad: int, number: int, needed: int) -> None:
    """1 - 0.025^(1/36) = 0.0974 keeps 10 %, 1 - 0.025^(1/35) = 0.10003 does not."""
    assert trials_needed(bad, number, CRITERIA.loss_limit) == needed


def test_hours_may_be_asked_for(passes: pl.DataFrame, site: Site) -> None:
    table = classes(passes, site, LineCriteria(hours_least=24))
    assert "suitable" not in set(table["word"])
    # Runs of one direction start every second hour.
    assert set(table.filter(pl.col("why") == "few_hours")["hours"]) == {12}
