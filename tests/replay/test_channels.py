"""Several solutions in one run: compared with each other, and composite beside reactive fail-safety (LOC Fig. 3, 4)."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from pipeline.results.store import write_run
from pipeline.show.report import write_report
from pipeline.stages.monitors.single import on_path_of, paired
from pipeline.studies.safety.assessment import assess
from pipeline.studies.safety.side_by_side import side_by_side
from pipeline.studies.safety.tally import COMPOSITE, REACTIVE, add_counts, architecture_figures
from schemas.config import Configuration, LdsConfig
from schemas.errors import InputError
from tests.replay.journeys import VEHICLE, journey, replay
from tests.stages.alignment.straight import NO_NOISE

LDS = LdsConfig()
KNOWN_NOISE = Configuration.model_validate({"monitors": NO_NOISE})
OFFSET = {"kind": "step", "size_m": 45.0, "start_s": 150.0, "duration_s": 60.0}
SLOW = {"kind": "ramp", "rate_mps": 0.3, "start_s": 100.0, "duration_s": 120.0}
THERE_AND_BACK = {
    "start_m": 200.0,
    "phases": [
        {"speed_mps": 30.0},
        {"stop_at_m": 7500.0, "hold_s": 10.0},
        {"speed_mps": -20.0, "hold_m": 4000.0},
        {"speed_mps": 0.0},
    ],
}


def two(first, second):
    """The logs of one journey as two solutions."""
    other = second.gnss.with_columns(solution=pl.lit("galileo"))
    return first.with_streams(gnss=pl.concat([first.gnss, other]).sort("t"))


def rows(tables, config=None):
    settings = config or Configuration()
    found = side_by_side(tables.epochs, tables.hazards, tables.alarms, tables.runs, settings)
    figures = architecture_figures(add_counts([found]))
    return {(row["solution"], row["architecture"]): row for row in figures.iter_rows(named=True)}


def with_reference(name):
    return Configuration.model_validate({"monitors": {"channel_reference": name}})


def test_fault_of_one_solution_is_found_by_both_architectures():
    faulty, site = journey(OFFSET)
    sound, _ = journey(seed=9)
    found = rows(replay(two(faulty, sound), site, VEHICLE, KNOWN_NOISE))
    for key in (("primary", REACTIVE), ("galileo", COMPOSITE)):
        row = found[key]
        assert (row["failures"], row["detected"], row["missed"]) == (1, 1, 0)
        assert row["time_to_detect_max_s"] == pytest.approx(0.0, abs=0.11)
    assert found["galileo", REACTIVE]["alarms"] == found["galileo", COMPOSITE]["false_alarms"] == 0
    # The comparison takes down both channels, the diagnosis the faulty one.
    assert found["galileo", REACTIVE]["availability"] > 0.95
    assert found["galileo", COMPOSITE]["availability"] < 0.75


def test_comparison_with_a_solution_that_the_run_lacks_says_so():
    one, site = journey(OFFSET)
    epochs = replay(one, site, VEHICLE, with_reference("egnos")).epochs
    assert epochs["channel_state"].unique().to_list() == ["not_evaluated"]
    assert epochs["channel_reason"].unique().to_list() == ["the run does not hold the solution to compare with"]


def test_fault_common_to_both_solutions_only_the_diagnosis_finds():
    one, site = journey(OFFSET)
    other, _ = journey(OFFSET, seed=9)
    found = rows(replay(two(one, other), site, VEHICLE))
    for name in ("primary", "galileo"):
        assert (found[name, REACTIVE]["detected"], found[name, REACTIVE]["missed"]) == (1, 0)
    composite = found["galileo", COMPOSITE]
    assert (composite["detected"], composite["missed"], composite["common_missed"]) == (0, 1, 1)


def random_fault(seed):
    """A fault of the position of 25 to 120 m, by step or ramp, somewhere on the way."""
    generator = np.random.default_rng(seed)
    size_m = float(generator.choice([-1.0, 1.0]) * generator.uniform(25.0, 120.0))
    fault = {"start_s": float(generator.uniform(60.0, 200.0)), "duration_s": float(generator.uniform(20.0, 60.0))}
    if generator.random() < 0.5:
        return {"kind": "step", "size_m": size_m, **fault}
    return {"kind": "ramp", "rate_mps": size_m / fault["duration_s"], **fault}


@pytest.mark.parametrize("seed", range(2))
def test_comparison_never_stands_on_a_fault_of_one_and_never_sees_one_of_both(seed):
    """7.5 m apart it fails, long before 20 m; what both share by the same size never parts them."""
    fault = random_fault(seed)
    faulty, site = journey(fault)
    sound, _ = journey(seed=9)
    one = rows(replay(two(faulty, sound), site, VEHICLE))
    row = one["galileo", COMPOSITE]
    assert (row["wrong_in_use_s"], row["missed"], row["false_alarms"]) == (0.0, 0, 0)
    also, _ = journey(fault, seed=9)
    both = rows(replay(two(faulty, also), site, VEHICLE))
    row = both["galileo", COMPOSITE]
    assert (row["alarms"], row["detected"]) == (0, 0)
    for name in ("primary", "galileo"):
        assert row["wrong_in_use_s"] > both[name, REACTIVE]["wrong_in_use_s"]
    assert row["missed"] == row["common_missed"] == row["failures"]


def test_receivers_that_promise_too_much_raise_alarms_in_both_architectures():
    """Stated sigma a fifth of the true one: nothing is ever wrong by 5 m.

    Alarms of the comparison, which looks along the track, are false. Those of the own monitors stand across the track
    too, where positions 2 m aside leave ten stated sigmas: nobody can call these false.
    """
    boastful = {"reported_factor": 0.2}
    one, site = journey(gnss=boastful)
    other, _ = journey(gnss=boastful, seed=9)
    found = rows(replay(two(one, other), site, VEHICLE, KNOWN_NOISE))
    compared = found["galileo", COMPOSITE]
    assert compared["false_alarms"] == compared["alarms"]
    assert compared["false_alarm_rate_per_h"] == pytest.approx(compared["alarms"] / compared["judged_h"])
    for key in (("primary", REACTIVE), ("galileo", REACTIVE), ("galileo", COMPOSITE)):
        assert found[key]["alarms"] > 0
        assert found[key]["hazards"] == 0
        # Where an alarm always stands, no time is left that it could be measured in.
        assert found[key]["wrong_in_use_s"] in (None, 0.0)
    for name in ("primary", "galileo"):
        alone = found[name, REACTIVE]
        assert (alone["false_alarms"], alone["false_alarm_rate_per_h"]) == (0, None)


def without_fix(run):
    """The log of a receiver that never had a position."""
    nothing = pl.lit(None, pl.Float64)
    return run.with_streams(gnss=run.gnss.with_columns(latitude_deg=nothing, longitude_deg=nothing))


@pytest.mark.parametrize(
    ("broken", "reason"),
    [(without_fix, "no epoch has a position"), (lambda run: run.with_streams(gnss=run.gnss[7:8]), "the same time")],
)
def test_a_solution_that_cannot_be_replayed_leaves_the_others_alone(broken, reason, tmp_path):
    run, site = journey(OFFSET)
    together = replay(two(run, broken(run)), site, VEHICLE, with_reference("galileo"))
    alone = replay(run, site, VEHICLE, with_reference("galileo"))
    assert dict(together.runs.select("solution", "status").iter_rows()) == {"galileo": "failed", "primary": "ok"}
    assert reason in together.runs.filter(solution="galileo")["error"].item()
    for name in ("hazards", "passages", "alarms", "epochs"):
        assert_frame_equal(getattr(together, name), getattr(alone, name), check_exact=True)
    assert set(rows(together)) == {("primary", REACTIVE)}
    write_run(together, tmp_path, {})
    assert write_report(tmp_path)
    assert assess(tmp_path).tables["figures"]["solution"].to_list() == ["primary"]
    with pytest.raises(InputError, match=reason):
        replay(broken(run), site, VEHICLE)


def test_slow_drift_of_one_the_comparison_finds_before_it_fails():
    drifting, site = journey(SLOW)
    sound, _ = journey(seed=9)
    found = rows(replay(two(drifting, sound), site, VEHICLE))
    composite = found["galileo", COMPOSITE]
    assert (composite["detected"], composite["missed"]) == (1, 0)
    # 5.3267 sqrt(2) sigma of about 1 m at 0.3 m/s are 25 s, give or take the noise of both.
    assert 10.0 < composite["time_to_detect_max_s"] < 45.0


def test_compared_after_the_fact_is_what_the_monitor_sees():
    faulty, site = journey(OFFSET)
    sound, _ = journey(seed=9)
    run = two(faulty, sound)
    rows = replay(run, site, VEHICLE, with_reference("galileo")).epochs
    fails = rows.filter((pl.col("solution") == "primary") & (pl.col("channel_state") == "fail"))
    tallies = side_by_side(*_tables(replay(run, site, VEHICLE)), Configuration())
    judged = rows.filter((pl.col("solution") == "primary") & (pl.col("channel_state") != "not_evaluated"))
    composite = tallies.row(by_predicate=pl.col("architecture") == COMPOSITE, named=True)
    assert composite["delays_s"] == pytest.approx([(fails["t"][0] - rows["t"][0]).total_seconds() - 150.0])
    # Neither the alarm nor the recovery after it is time in use.
    alarm_s = (fails["t"][-1] - fails["t"][0]).total_seconds() + 30.0
    # In the first second no track is claimed yet.
    assert composite["judged_s"] == pytest.approx(judged.height * 0.1 - alarm_s, abs=1.1)


def _tables(tables):
    return tables.epochs, tables.hazards, tables.alarms, tables.runs


@pytest.mark.parametrize("reference", ["galileo", "primary"])
def test_a_solution_that_begins_on_the_way_back_is_compared_on_the_same_path(reference):
    """Its own path grows the other way; it used to fail the comparison at every epoch."""
    run, site = journey(motion=THERE_AND_BACK)
    begin = run.gnss["t"][0] + pl.duration(seconds=350)
    late, _ = journey(motion=THERE_AND_BACK, seed=9)
    both = two(run, late.with_streams(gnss=late.gnss.filter(pl.col("t") > begin)))
    tables = replay(both, site, VEHICLE, with_reference(reference))
    compared = tables.epochs.filter(pl.col("channel_state") != "not_evaluated")
    assert compared.height > 2000
    assert set(compared["channel_state"]) == {"pass"}
    assert tables.alarms.height == 0


def test_a_path_from_another_origin_against_the_measure_and_over_a_border():
    """Element A of 1000 m, then B; the other solution is on B throughout, and its path runs from 100 m on B back."""
    mine = pl.DataFrame(
        {
            "t": [0, 1, 2, 3],
            "netelement_id": ["A", "A", "A", "B"],
            "measure_m": [970.0, 980.0, 990.0, 5.0],
            "path_m": [970.0, 980.0, 990.0, 1005.0],
        }
    )
    other = pl.DataFrame(
        {
            "t": [0, 1, 2, 3, 9],
            "netelement_id": ["B", "B", "B", "B", "B"],
            "measure_m": [3.0, 2.0, 1.0, 8.0, 20.0],
            "path_m": [97.0, 98.0, 99.0, 92.0, 80.0],
        }
    )
    assert on_path_of(mine, other, LDS)["path_m"].to_list() == [None] * 5  # one epoch on B does not tell its sense
    longer = pl.concat(
        [mine, mine[3:].with_columns(t=pl.lit(9, pl.Int64), measure_m=pl.lit(25.0), path_m=pl.lit(1025.0))]
    )
    # Only the second epoch of both on B tells how the paths stand to each other, and of nothing before.
    assert on_path_of(longer, other, LDS)["path_m"].to_list() == [None, None, None, None, 1020.0]
    apart = other.with_columns(netelement_id=pl.lit("C"))
    assert on_path_of(longer, apart, LDS)["path_m"].to_list() == [None] * 5


def test_pairs_of_epochs_that_were_not_measured_at_one_time():
    """At 1 Hz the train moves 20 m; the last epoch comes after a gap, and the fourth has no position."""
    ms = pl.duration(milliseconds=pl.col("ms"), time_unit="ns")
    start = pl.lit(0).cast(pl.Datetime("ns", "UTC"))
    mine = pl.DataFrame(
        {"ms": [0, 1000, 2000, 3000, 4000, 9000], "path_m": [0.0, 20.0, 40.0, None, 80.0, 180.0]}
    ).with_columns(t=start + ms)
    other = pl.DataFrame({"ms": [0, 900, 950, 2000, 2500, 3500, 8500]}).with_columns(t=start + ms)
    found = paired(mine, other, LDS)
    assert found["row_other"].to_list() == [0, 2, 3, None, None, None]
    assert found["path_m"].to_list() == [0.0, pytest.approx(19.0), 40.0, None, None, None]
    over_gap = paired(mine, other, LdsConfig(crossing_gap_s=5.0))
    assert over_gap["row_other"].to_list() == [0, 2, 3, None, None, 6]
    assert over_gap["path_m"][5] == 170.0  # nine tenths of 5 s from 80 m to 180 m


@pytest.mark.parametrize("behind_ms", [0, 37])
def test_offset_is_seen_whatever_the_stamps_of_the_other_receiver(behind_ms):
    faulty, site = journey(OFFSET)
    sound, _ = journey(seed=9)
    later = sound.with_streams(gnss=_as_of(sound.gnss, behind_ms))
    found = rows(replay(two(faulty, later), site, VEHICLE))
    row = found["galileo", COMPOSITE]
    assert (row["alarms"], row["false_alarms"]) == (1, 0)
    assert row["time_to_detect_max_s"] == pytest.approx(0.0, abs=0.21)


def _as_of(gnss, behind_ms):
    """The same journey measured so much later: each position carried on by the velocity between the epochs."""
    share = behind_ms / 100.0
    places = ("latitude_deg", "longitude_deg", "height_m")
    ahead = [pl.col(name) + share * (pl.col(name).shift(-1) - pl.col(name)) for name in places]
    later = pl.col("t") + pl.duration(milliseconds=behind_ms, time_unit="ns")
    return gnss.with_columns(*ahead, t=later).drop_nulls("latitude_deg")
