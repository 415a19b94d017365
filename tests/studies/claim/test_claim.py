"""Requirements held against small tables whose answers are worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cli
from pipeline.results import store
from pipeline.studies.claim import assess_claim, load_profile, read_areas
from pipeline.studies.claim.claim import claim_table
from pipeline.studies.claim.front import FrontEnd, front_end_of, speed_errors
from pipeline.studies.claim.requirements import ClaimJourney, requirements, tallies
from pipeline.studies.claim.tally import ALWAYS, Demand, Kind, Tally, count_claims, group_lengths_s
from pipeline.studies.tally import Compliance, Shown, trials_needed
from schemas.config import Configuration
from schemas.errors import ConfigError, SiteError
from schemas.inputs import Areas, Links, Track
from schemas.run import RunTables, Site
from schemas.tables import Alarms, Hazards, Runs
from tests.tables import NS, epochs, passages, table

PROFILE = load_profile("lu-2023")
RUN: dict[str, Any] = {"latency_sigma_s": 0.0, "vehicle": "file"}
AREAS = pl.DataFrame(
    {
        "netelement_id": ["A", "A", "A"],
        "from_m": [0.0, 100.0, 200.0],
        "to_m": [100.0, 200.0, 1000.0],
        "area_type": ["mainline", "node", "precise"],
        "track_speed_kmh": [None, None, None],
    },
    schema={name: column.dtype for name, column in Areas.columns().items()},
)
SITE = Site(
    track=table(Track, 2, netelement_id="A", measure_m=[0.0, 1000.0], latitude_deg=[50.0, 50.01], longitude_deg=14.0),
    links=Links.create_empty(),
)


def of_share(tally: Tally, share: float) -> Shown:
    return Demand(Kind.SHARE, share).assess(tally)


def of_rate(tally: Tally, rate_per_h: float) -> Shown:
    return Demand(Kind.RATE, rate_per_h).assess(tally)


def of_availability(tally: Tally, share: float, outside_s: float) -> Shown:
    return Demand(Kind.AVAILABILITY, share, outside_s=outside_s).assess(tally)


def front(t_s: list[float], areas: pl.DataFrame | None = AREAS, run: dict[str, Any] = RUN, **columns: Any) -> FrontEnd:
    """The train of the tables: 20 m each second along net element A."""
    frame = epochs(t_s, **({"netelement_id": "A", "measure_m": [20.0 * t for t in t_s]} | columns))
    return front_end_of(frame, passages(), run, Configuration(), PROFILE.method, areas)


def ten() -> FrontEnd:
    """Five seconds on a main line, four in a node, and one without a position."""
    judgement = ["right"] * 4 + ["wrong", "right", "unknown", "right", "wrong", "unknown"]
    return front(
        [float(second) for second in range(10)],
        judgement=judgement,
        error_low_m=[-1.0, 4.0, 6.0, 9.0, 31.0, -12.0, 11.0, 0.0, 0.0, None],
        error_high_m=[1.0, 6.0, 8.0, 11.0, 33.0, -11.0, 13.0, 0.5, 1.0, None],
        confidence_m=[8.0] * 7 + [12.0, 8.0, None],
        in_use=[True] * 9 + [False],
    )


def test_ten_epochs_by_hand() -> None:
    found = ten()
    limit = ClaimJourney("run", found, epochs([]), passages(), PROFILE).limit_m
    assert limit[:9].tolist() == [30.0] * 5 + [10.0] * 4
    # Kept 1, not known 0, broken -1. Epoch 8 is on the wrong track; of epoch 6 the evidence says nothing.
    assert found.codes_within_m(limit, np.inf)[:9].tolist() == [1, 1, 1, 1, -1, 1, 0, 1, -1]
    assert found.codes_within_m(np.inf, limit)[:9].tolist() == [1, 1, 1, 1, 0, -1, 0, 1, -1]
    assert found.codes_within_m(found.over_m, found.under_m).tolist() == [1, 1, 1, -1, -1, -1, 0, 1, -1, 0]
    assert found.codes_within_m(5.0, 5.0)[:5].tolist() == [1, 0, -1, -1, -1]
    assert found.codes_within_m(1.0, 1.0)[5:9].tolist() == [-1, 0, 1, -1]
    assert found.has_output.tolist() == [True] * 9 + [False]


def test_ten_epochs_as_counts() -> None:
    found = tallies(ClaimJourney("run", ten(), epochs([float(second) for second in range(10)]), passages(), PROFILE))
    hand = {  # events, seconds, seconds known, worst
        ("mapo_claimed", "mainline"): (0, 5.0, 5.0, 8.0),
        ("mapo", "mainline"): (1, 5.0, 5.0, 31.0),
        ("mapu", "mainline"): (0, 5.0, 4.0, 1.0 - 2.0),
        ("mapo_claimed", "node"): (1, 4.0, 4.0, 12.0),
        ("mapu", "node"): (1, 4.0, 3.0, 11.0),
        ("safe_front_end", "mainline"): (1, 5.0, 5.0, 31.0),
        ("safe_front_end", "all"): (1, 9.0, 8.0, 31.0),
        ("front_accuracy", "precise"): (0, 0.0, 0.0, None),
    }
    for key, (events, held_s, known_s, worst) in hand.items():
        counts = found[key]
        counted = (counts.events, counts.held_s, counts.known_s)
        assert counted == (events, held_s, known_s), key
        if key != ("mapu", "mainline"):
            assert counts.worst == worst, key


def test_figures_of_the_profile() -> None:
    """Every figure as published: OCORA-TWS01-101 v3.1, EUG 22E126 v1.2, 22E135 v2.0."""
    assert PROFILE.sources == ("OCORA-TWS01-101 v3.1 (2023)", "EUG 22E126 v1.2 (2023)", "EUG 22E135 v2.0 (2023)")
    by_area = {
        kind.value: (one.limit_m, one.way_s, one.limit_clause, one.accuracy_m, one.accuracy_share, one.accuracy_clause)
        for kind, one in PROFILE.areas.items()
    }
    line = (30.0, 1.0, "OCORA-7239", 5.0, 0.954, "OCORA-7240")
    close = (10.0, 0.0, "OCORA-7239", 1.0, 0.954, "OCORA-7240")
    assert by_area == {"mainline": line, "dense_line": line, "node": close, "precise": close}
    assert PROFILE.slow.model_dump() == {
        "below_kmh": 30.0,
        "area_types": ("precise",),
        "limit_m": 1.0,
        "accuracy_m": 0.5,
        "accuracy_share": 0.9998,
        "clause": "OCORA-7241",
    }
    assert PROFILE.after_balise.model_dump() == {
        "below_kmh": 40.0,
        "fixed_m": 0.20,
        "offset_m": 0.15,
        "per_mps_s": 0.0011,
        "to_kmh": 500.0,
        "share": 0.998,
        "clause": "OCORA-7242, SUBSET-036 4.2.10.3",
    }
    safe = {"low_kmh": 2.0, "below_kmh": 30.0, "high_kmh": 12.0, "at_kmh": 500.0, "clause": "OCORA-7247"}
    assert PROFILE.safe_speed.model_dump() == safe
    assert PROFILE.speed.model_dump() == {
        "fixed_kmh": 1.0,
        "to_kmh": 100.0,
        "above_share": 0.01,
        "share": 0.954,
        "clause": "OCORA-7248",
    }
    start = PROFILE.start
    assert (start.last_position_s, start.cold_movement_s, start.nothing_s) == (60.0, 5 * 60.0, 20 * 60.0)
    assert PROFILE.cold_movement.model_dump() == {"detected_h": 72.0, "clause": "OCORA-987"}
    available = {"share": 0.99998, "outside_s": 60.0, "within_s": 2 * 3600.0, "clause": "22E126 7.4.3"}
    assert PROFILE.availability.model_dump() == available
    assert PROFILE.way.model_dump() == {"without_balise_m": 30_000.0, "clause": "22E126 7.5.1.4"}
    rate = {"aim_per_h": 1e-10, "bound_per_h": 0.67e-9, "clause": "22E135 8.1.1.5"}
    assert PROFILE.failure_rate.model_dump() == rate


def test_limits_that_grow_with_speed() -> None:
    at = np.array([0.0, 39.9, 40.0, 500.0, 501.0])
    after = PROFILE.after_balise.limit_m(at / 3.6)
    assert after[:4] == pytest.approx([0.20, 0.20, 0.15 + 0.0011 * 11.1111, 0.15 + 0.0011 * 138.8889], abs=1e-6)
    assert np.isnan(after[4])
    safe = PROFILE.safe_speed.limit_kmh(np.array([0.0, 30.0, 265.0, 500.0, 501.0]))
    assert safe[:4] == pytest.approx([2.0, 2.0, 7.0, 12.0])
    assert np.isnan(safe[4])
    assert PROFILE.speed.limit_kmh(np.array([50.0, 100.0, 200.0])) == pytest.approx([1.0, 1.0, 2.0])
    # 160 km/h is 44.4 m in a second; where the track speed is not known, the smaller limit.
    area = PROFILE.areas["mainline"]  # type: ignore[index]
    assert area.limits_m(np.array([160.0, 80.0, np.nan]) / 3.6) == pytest.approx([44.4444, 30.0, 30.0], abs=1e-4)


def test_what_few_runs_show() -> None:
    # 0.025^(1/78) = 0.95381 and 0.025^(1/79) = 0.95439: seventy-nine runs without exception.
    assert of_share(Tally(trials=78, kept=78, held_s=7800.0), 0.954).finding is Compliance.NOT_SHOWN
    assert of_share(Tally(trials=79, kept=79), 0.954).finding is Compliance.MET
    assert trials_needed(0, 70, 1.0 - 0.954) == 9
    # One of them not known counts as broken; ten broken of ten cannot be 95.4 %.
    assert of_share(Tally(trials=79, kept=78), 0.954).finding is Compliance.NOT_SHOWN
    assert of_share(Tally(trials=10, broken=10), 0.954).finding is Compliance.NOT_MET
    # Zero events: 2.9957/T one-sided; 1e-10 /h takes 3.0e10 h.
    assert of_rate(Tally(held_s=3600.0, known_s=3600.0), 1e-10).finding is Compliance.NOT_SHOWN
    assert of_rate(Tally(held_s=3600.0, known_s=3600.0), 1e-10).needed == pytest.approx(2.9957e10, rel=1e-4)
    assert of_rate(Tally(held_s=3600.0, known_s=3600.0), 3.0).finding is Compliance.MET
    assert of_rate(Tally(held_s=3600.0, known_s=3600.0), 2.99).finding is Compliance.NOT_SHOWN
    assert of_rate(Tally(events=1, possible=1, held_s=3600.0, known_s=3600.0), 1e-10).finding is Compliance.NOT_MET
    assert ALWAYS.assess(Tally(held_s=1e12, known_s=1e12)).finding is Compliance.NOT_SHOWN
    assert ALWAYS.assess(Tally(events=1)).finding is Compliance.NOT_MET
    # Five of five runs lost 60 s of at most an hour: at least 0.478 of the runs, 0.8 % of the time.
    lost = of_availability(Tally(trials=5, broken=5, held_s=9000.0, known_s=8000.0, longest_s=3600.0), 0.99998, 60.0)
    assert lost.finding is Compliance.NOT_MET
    assert lost.bounds.high == pytest.approx(1 - 0.47818 / 60, abs=1e-6)
    assert of_availability(Tally(trials=999, held_s=1e9, known_s=1e9), 0.99998, 60.0).finding is Compliance.NOT_SHOWN


def test_exceedances_close_to_each_other_are_one_event() -> None:
    t_ns = np.array([0, 10, 310, 611]) * NS
    assert group_lengths_s(t_ns, t_ns, 300.0) == [310.0, 0.0]
    code = np.array([-1, 0, 0, -1])
    counts = count_claims("run", t_ns, np.ones(4), code, 300.0)
    # What is not known between them may hold another event.
    assert (counts.events, counts.possible, counts.trials, counts.known_s) == (2, 3, 1, 2.0)


def test_a_gap_of_the_log_is_time_of_which_nobody_knows() -> None:
    """100 runs of 100 s, each with 60 s without epochs: two in five draws are kept, and nothing is met."""
    seconds = [float(second) for second in (*range(20), *range(80, 101))]
    frame = epochs(seconds, netelement_id="A", measure_m=5.0, error_low_m=0.0, error_high_m=0.0)
    found = front_end_of(frame, passages(), RUN, Configuration(), PROFILE.method, AREAS)
    for one in requirements(PROFILE):
        if one.key not in (("front_accuracy", "mainline"), ("speed_accuracy", "all")):
            continue
        total = sum(
            (one.count(ClaimJourney(str(run), found, frame, passages(), PROFILE)) for run in range(100)), Tally()
        )
        assert total.trials == 100
        assert 25 <= total.kept <= 55, one.key
        assert (total.broken, total.events, total.possible) == (0, 0, 100)
        assert of_share(total, 0.954).finding is Compliance.NOT_SHOWN


def test_a_balise_without_a_first_estimate_is_not_known() -> None:
    """Balises at 2 s, in a gap from 5 s to 15 s, and after the log's end."""
    seconds = [float(second) for second in (*range(6), *range(15, 20))]
    frame = epochs(seconds, error_low_m=0.0, error_high_m=0.0)
    balises = passages(3, status="accepted", kind="physical", t_offered=[2 * NS, 8 * NS, 30 * NS])
    found = front_end_of(frame, balises, RUN, Configuration(), PROFILE.method)
    asked = next(one for one in requirements(PROFILE) if one.key == ("after_balise", "physical"))
    total = sum((asked.count(ClaimJourney(str(run), found, frame, balises, PROFILE)) for run in range(60)), Tally())
    assert (total.trials, total.broken) == (60, 0)
    assert 10 <= total.kept <= 30


def test_runs_of_one_day_are_one_trial_by_option(result: Path) -> None:
    method = PROFILE.method.model_copy(update={"independent": "day"})
    found = assess_claim(result, PROFILE.model_copy(update={"method": method}), areas=AREAS).table
    node = found.filter((pl.col("requirement") == "front_accuracy") & (pl.col("applies_to") == "node"))
    assert node.select("trials", "hours").row(0) == (1, pytest.approx(2 * 5 / 3600))
    always = found.filter((pl.col("demanded") == "always") & (pl.col("hours") > 0) & (pl.col("finding") != "not met"))
    assert always.height > 0
    assert always["reason"].str.contains("no number of hours|no recording|no evidence for it").all()


CODES = st.lists(st.tuples(st.sampled_from([1, 0, -1]), st.booleans()), min_size=1, max_size=12)
RUNS_OF = st.lists(CODES, min_size=1, max_size=6)


@given(RUNS_OF, st.integers(1, 40))
def test_weaker_evidence_never_shows_what_stronger_refutes(runs: list[list[tuple[int, bool]]], times: int) -> None:
    strong, weak = Tally(), Tally()
    for number, run in enumerate(runs * times):
        t_ns, held = np.arange(len(run)) * 200 * NS, np.full(len(run), 200.0)
        full = np.array([code for code, _ in run])
        less = np.array([0 if hidden else code for code, hidden in run])
        strong += count_claims(str(number), t_ns, held, full, 300.0)
        weak += count_claims(str(number), t_ns, held, less, 300.0)
    fault_free = Tally(trials=1, kept=1, held_s=3600.0, known_s=3600.0)
    for shown in (lambda c: of_share(c, 0.6), lambda c: of_rate(c, 8.0), ALWAYS.assess):
        findings = (shown(strong).finding, shown(weak).finding)
        assert findings not in {
            (Compliance.NOT_MET, Compliance.MET),
            (Compliance.MET, Compliance.NOT_MET),
        }
        for counts in (strong, weak):
            after = shown(counts + fault_free).finding
            assert shown(counts).finding is not Compliance.MET or after is Compliance.MET


TWO_EPOCHS = front([0.0, 1.0], error_low_m=[0.0, 0.0], error_high_m=[0.0, 0.0])


@given(st.floats(-50, 50), st.floats(0, 10), st.floats(0, 30), st.floats(0, 30), st.floats(0.1, 40))
def test_a_wider_interval_says_the_same_or_nothing(
    middle: float, half: float, more: float, other: float, limit: float
) -> None:
    low, high = [middle - half, middle - half - more], [middle + half, middle + half + other]
    strong, weak = replace(TWO_EPOCHS, low_m=np.array(low), high_m=np.array(high)).codes_within_m(limit, limit).tolist()
    assert weak in (0, strong)


def test_the_odometer_goes_on_where_no_position_is_in_use() -> None:
    """A balise at 100 m; from 6 s on GNSS is 50 m ahead and negated; the odometer stays right, then loses 40 m."""
    seconds = [float(second) for second in range(10)]
    true = np.array([20.0 * second for second in seconds])
    ahead = np.where(np.arange(10) >= 6, 50.0, 0.0)
    odometer = true - np.where(np.arange(10) >= 9, 40.0, 0.0)
    frame = epochs(
        seconds,
        path_m=(true + ahead).tolist(),
        odometer_m=odometer.tolist(),
        in_use=[True] * 6 + [False] * 4,
        judgement=["right"] * 6 + ["wrong"] * 4,
        error_low_m=(ahead - 0.5).tolist(),
        error_high_m=(ahead + 0.5).tolist(),
        lrvb_id=[None] * 5 + ["b"] * 5,
        distance_from_lrvb_m=[None] * 5 + (odometer[5:] - 100.0).tolist(),
        doubt_over_m=[None] * 5 + [17.0, 18.0, 19.0, 20.0, 21.0],
        doubt_under_m=[None] * 5 + [17.0, 18.0, 19.0, 20.0, 21.0],
    )
    crossed = passages(1, balise_id="b", status="accepted", path_m=100.0, kind="virtual")
    found = front_end_of(frame, crossed, RUN, Configuration(), PROFILE.method)
    assert found.path_m == pytest.approx([*true[:9], 140.0])
    assert found.over_m[6:].tolist() == [18.0, 19.0, 20.0, 21.0]
    assert found.low_m[[6, 9]] == pytest.approx([-0.5, -40.5])
    # Where GNSS is wrong the report of the odometer is never proved, but its error is seen.
    assert found.codes_within_m(found.over_m, found.under_m).tolist() == [1] * 6 + [0, 0, 0, -1]


def test_the_report_of_an_outage_is_compared_with_the_place_of_the_train() -> None:
    """Train at 0, 20, ... 180 m on A, measure is path; no position from 120 m on, odometer 40 m short at 180 m."""
    seconds = [float(second) for second in range(10)]
    true = np.array([20.0 * second for second in seconds])
    odometer = true - np.where(np.arange(10) >= 9, 40.0, 0.0)
    lost = [None] * 4
    frame = epochs(
        seconds,
        netelement_id=["A"] * 6 + lost,
        measure_m=[*true[:6].tolist(), *lost],
        path_m=[*true[:6].tolist(), *lost],
        odometer_m=odometer.tolist(),
        in_use=[True] * 6 + [False] * 4,
        judgement=["right"] * 6 + ["unknown"] * 4,
        error_low_m=[-0.5] * 6 + lost,
        error_high_m=[0.5] * 6 + lost,
        true_netelement_ids=[["A"]] * 8 + [["A", "B"], ["A"]],
        true_measure_low_m=(true - 0.5).tolist(),
        true_measure_high_m=(true + 0.5).tolist(),
        lrvb_id=[None] * 5 + ["b"] * 5,
        distance_from_lrvb_m=[None] * 5 + (odometer[5:] - 100.0).tolist(),
        doubt_over_m=[None] * 5 + [17.0, 18.0, 19.0, 20.0, 21.0],
        doubt_under_m=[None] * 5 + [17.0, 18.0, 19.0, 20.0, 21.0],
    )
    crossed = passages(1, balise_id="b", status="accepted", path_m=100.0, kind="virtual")
    front = front_end_of(frame, crossed, RUN, Configuration(), PROFILE.method)
    assert front.low_m[[6, 7, 9]] == pytest.approx([-0.5, -0.5, -40.5])
    assert front.high_m[[6, 7, 9]] == pytest.approx([0.5, 0.5, -39.5])
    # Kept where the place is known, unknown on one of two net elements, beyond its interval at the end.
    assert front.codes_within_m(front.over_m, front.under_m).tolist() == [1] * 8 + [0, -1]


def test_the_front_end_decides_on_the_area() -> None:
    """Antenna at 0, 20, ... 180 m, front end 30 m ahead: in the node from 80 m on; before moving, at the antenna."""
    frame = epochs(
        [float(second) for second in range(10)],
        netelement_id="A",
        measure_m=[20.0 * second for second in range(10)],
        direction=[None] * 5 + [1] * 5,
        error_low_m=0.0,
        error_high_m=0.0,
    )
    found = front_end_of(frame, passages(), RUN, Configuration(), PROFILE.method, AREAS, ahead_m=30.0)
    assert ClaimJourney("run", found, frame, passages(), PROFILE).limit_m.tolist() == [30.0] * 5 + [10.0] * 5
    assert found.has_output.all()
    assert found.codes_within_m(5.0, 5.0).tolist() == [1] * 10


def test_latency_widens_the_safe_front_end() -> None:
    """At 20 m/s, K 6.18: 6.18 · 0.01 s is 1.236 m; a learned latency of 0.1 s puts the train up to 2 m ahead."""
    run = {"latency_sigma_s": 0.01, "vehicle": "learned"}
    found = front([0.0, 1.0], run=run, latency_s=0.1)
    assert found.under_m == pytest.approx([8.0 + 1.236 + 2.0] * 2)
    assert found.over_m == pytest.approx([8.0] * 2)
    widened = front([0.0, 1.0], run=run | {"vehicle": "file"}, latency_s=0.1)
    assert widened.under_m == pytest.approx([8.0 + 1.236] * 2)


def test_speed_against_the_evidence() -> None:
    """Ten seconds at 20 m/s, odometer 21 m/s, evidence to ± 0.5 m: 1 m/s ± 0.1, that is 3.24 to 3.96 km/h too fast."""
    seconds = [float(second) for second in range(11)]
    found = speed_errors(front(seconds, speed_mps=21.0, error_low_m=-0.5, error_high_m=0.5), 10.0)
    assert found.fastest_kmh == pytest.approx([75.6])
    assert (found.low_kmh[0], found.high_kmh[0]) == pytest.approx((3.24, 3.96))
    limit = PROFILE.safe_speed.limit_kmh(found.fastest_kmh)  # 2 + 45.6 / 47 = 2.970 km/h
    assert found.codes_within_kmh(limit, limit).tolist() == [-1]
    wide = speed_errors(front(seconds, speed_mps=21.0, error_low_m=-3.0, error_high_m=3.0), 10.0)
    assert wide.codes_within_kmh(limit, limit).tolist() == [0]


def test_a_limit_of_speed_is_that_of_the_fastest_instant() -> None:
    """20 to 200 km/h and back in 10 s, 4.2 km/h too fast: 2 + 170 / 47 = 5.6 is allowed at 200, 3.7 at 110 km/h."""
    seconds = [float(second) for second in range(11)]
    speed_mps = (200.0 - 36.0 * np.abs(np.arange(11) - 5.0)) / 3.6
    travelled_m = np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]))])
    true_m = (travelled_m - 4.2 / 3.6 * np.array(seconds)).tolist()
    found = speed_errors(
        front(seconds, speed_mps=speed_mps.tolist(), path_m=true_m, error_low_m=-0.1, error_high_m=0.1), 10.0
    )
    assert found.fastest_kmh == pytest.approx([200.0])
    limit = PROFILE.safe_speed.limit_kmh(found.fastest_kmh)
    assert found.codes_within_kmh(limit, limit).tolist() == [1]
    at_mean = PROFILE.safe_speed.limit_kmh(np.array([110.0]))
    assert found.codes_within_kmh(at_mean, at_mean).tolist() == [-1]


def test_a_mean_speed_is_late_while_the_train_speeds_up() -> None:
    """At 1 m/s2 a mean over the second before is 0.5 m/s too slow, which is the program's doing: not known."""
    seconds = [float(second) for second in range(11)]
    true_m = [10.0 * t + 0.5 * t * t for t in seconds]
    found = speed_errors(
        front(seconds, speed_mps=[9.5 + t for t in seconds], path_m=true_m, error_low_m=-0.1, error_high_m=0.1), 10.0
    )
    # 0.5 m/s ± 0.02 by the evidence ± 1 s · 10 m/s / 10 s.
    assert (found.low_kmh[0] / 3.6, found.high_kmh[0] / 3.6) == pytest.approx((-1.52, 0.52))
    limit = PROFILE.speed.limit_kmh(found.fastest_kmh)
    assert found.codes_within_kmh(limit, limit).tolist() == [0]


def test_means_of_speed_call_no_accuracy_met() -> None:
    """300 runs whose mean speed is right: nothing is seen of the instants. 300 that are 2 km/h too fast are not met."""
    seconds = [float(second) for second in range(11)]
    asked = next(one for one in requirements(PROFILE) if one.name == "speed_accuracy")
    for speed_mps, finding in ((20.0, "not shown"), (20.0 + 2.0 / 3.6, "not met")):
        columns = {"speed_mps": speed_mps, "error_low_m": -0.1, "error_high_m": 0.1}
        found = front(seconds, **columns)
        frame, nothing = epochs(seconds), passages()
        rides = [ClaimJourney(f"{number}", found, frame, nothing, PROFILE) for number in range(300)]
        counts = sum((asked.count(journey) for journey in rides), Tally())
        assert (counts.trials, counts.kept, counts.broken) in ((300, 300, 0), (300, 0, 300))
        assert asked.demand.assess(counts).finding == finding


def test_after_a_balise_start_and_availability() -> None:
    """Balise at 2 s: estimate 0.3 m off, 0.15 + 0.0011 · 20 = 0.172 m allowed; then 90 s without output."""
    seconds = [float(second) for second in range(200)]
    lost = [50 <= second < 140 for second in seconds]
    frame = epochs(seconds, in_use=[not gone for gone in lost], error_low_m=0.29, error_high_m=0.31, tvb=False)
    balise = passages(1, status="accepted", kind="physical", t_offered=[2 * NS])
    found = tallies(
        ClaimJourney("run", front_end_of(frame, balise, RUN, Configuration(), PROFILE.method), frame, balise, PROFILE)
    )
    assert found["after_balise", "physical"].broken == 1
    assert found["after_balise", "virtual"].trials == 0
    assert (found["availability", "all"].worst, found["availability", "all"].broken) == (90.0, 1)
    # Nothing was linked in 200 s: no proof that it takes more than twenty minutes.
    assert (found["start", "nothing known"].worst, found["start", "nothing known"].broken) == (None, 0)
    assert found["way_without_balise", "all"].worst == pytest.approx(197 * 20.0)


def test_a_run_without_epochs_says_nothing() -> None:
    nothing = epochs([], t=[], path_m=[], odometer_m=[])
    found = tallies(
        ClaimJourney(
            "run", front_end_of(nothing, passages(), RUN, Configuration(), PROFILE.method), nothing, passages(), PROFILE
        )
    )
    table = claim_table({"primary": found}, PROFILE)
    assert set(table["finding"]) == {"not shown"}
    assert table["events"].sum() == 0


def areas_file(folder: Path, *rows: str) -> Path:
    text = "\n".join(["netelement_id,from_m,to_m,area_type", *rows])
    (folder / "areas.csv").write_text(text + "\n", encoding="utf-8")
    return folder


def test_areas_that_cannot_be_meant(tmp_path: Path) -> None:
    assert read_areas(tmp_path, SITE) is None
    good = read_areas(areas_file(tmp_path, "A,0,500,mainline", "A,500,900,node"), SITE)
    assert good is not None
    assert good["track_speed_kmh"].null_count() == 2
    for row, said in {
        "A,400,900,node": "begins before another ends, at 500 m",
        "A,600,900,station": "expected one of mainline dense_line node precise",
        "A,900,600,node": "expected an end behind the begin",
        "Z,0,10,node": "no net element of the track is called Z",
    }.items():
        with pytest.raises(SiteError, match=r"areas\.csv") as refused:
            read_areas(areas_file(tmp_path, "A,0,500,mainline", row), SITE)
        assert said in str(refused.value)


def test_unknown_profiles(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean `lu-2023`"):
        load_profile("lu-2032")
    (tmp_path / "own.toml").write_text('name = "own"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="areas"):
        load_profile(str(tmp_path / "own.toml"))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Two runs: one judged by a reference, 40 m wrong for 5 s; one without truth."""
    seconds = [float(second) for second in range(30)]
    wrong = [10 <= second < 15 for second in seconds]
    judged = epochs(
        seconds,
        solution="primary",
        netelement_id="A",
        measure_m=[20.0 * second for second in seconds],
        judgement=["wrong" if bad else "right" for bad in wrong],
        error_low_m=[39.0 if bad else -0.1 for bad in wrong],
        error_high_m=[41.0 if bad else 0.1 for bad in wrong],
    )
    blind = judged.with_columns(
        pl.lit("unknown").cast(judged.schema["judgement"]).alias("judgement"),
        pl.lit(None, dtype=pl.Float64).alias("error_low_m"),
        pl.lit(None, dtype=pl.Float64).alias("error_high_m"),
    )
    for name, frame, evidence in (("judged", judged, "reference"), ("blind", blind, None)):
        runs = table(Runs, 1, solution="primary", status="ok", evidence=evidence, vehicle="file", config_digest=name)
        t_end = datetime(2026, 3, 2, 8, len(name), tzinfo=UTC)
        runs = runs.with_columns(t_start=pl.lit(t_end).dt.truncate("1d"), t_end=pl.lit(t_end)).cast(runs.schema)
        tables = RunTables(name, table(Hazards, 0), passages(), table(Alarms, 0), frame, runs)
        store.write_run(tables, tmp_path / "OUT", {})
    return tmp_path / "OUT"


def test_a_result_with_and_without_areas(result: Path) -> None:
    found = assess_claim(result, PROFILE, areas=AREAS)
    rows = {(row["requirement"], row["applies_to"]): row for row in found.table.iter_rows(named=True)}
    assert set(rows) == {one.key for one in requirements(PROFILE)}
    # The error lies from 200 m on, in the precise area; both runs count their hours, one its evidence.
    assert rows["mapo", "precise"]["finding"] == "not met"
    assert rows["mapu", "precise"]["finding"] == "not shown"
    assert rows["mapo", "node"]["finding"] == "not shown"
    assert rows["safe_front_end", "all"]["events"] == 1
    assert rows["safe_front_end", "all"]["hours"] == pytest.approx(2 * 29 / 3600)
    assert rows["safe_front_end", "all"]["hours_known"] == pytest.approx(29 / 3600)
    assert rows["front_accuracy", "node"]["trials"] == 2
    assert rows["front_accuracy", "node"]["kept"] == 1
    assert rows["mapo", "dense_line"]["reason"] == "nothing recorded to which it applies"
    assert rows["cold_movement", "all"]["reason"] == "a train without power records nothing"
    assert any("1 of 2 runs have neither a reference" in note for note in found.notes)
    assert any("2 settings or vehicle files: trains may differ" in note for note in found.notes)
    without = assess_claim(result, PROFILE)
    assert any("Without areas" in note for note in without.notes)
    by_area = without.table.filter(pl.col("applies_to").is_in(["mainline", "dense_line", "node", "precise"]))
    assert set(by_area["finding"]) == {"not shown"}
    assert without.table.filter(pl.col("requirement") == "safe_front_end")["finding"].to_list()[-1] == "not met"
    # The same runs without the one that has a truth: nothing is met, nothing is refuted by evidence.
    alone = claim_table({"primary": {}}, PROFILE)
    assert set(alone["finding"]) == {"not shown"}


def test_the_command(result: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert cli._run_guarded(["claim", str(result)], debug=False) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("safe_front_end") and "not met" in line for line in lines)
    assert max(map(len, lines[1 : 1 + len(requirements(PROFILE))])) <= 80
    assert cli._run_guarded(["claim", str(result), "--json"], debug=False) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["profile"], answer["version"], len(answer["sources"])) == ("lu-2023", "1", 3)
    assert len(answer["requirements"]) == len(requirements(PROFILE))
    assert cli._run_guarded(["claim", str(result), "--profile", "lu-2050"], debug=False) == 2
