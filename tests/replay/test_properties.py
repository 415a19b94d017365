"""What must hold for every run: shifts of time, mirrored axes, way back, parts of a run, other solutions."""

from __future__ import annotations

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from schemas.config import Configuration
from schemas.run import RunLog, Site
from tests.replay.journeys import PLACES_M, QUIET, VEHICLE, journey, replay, replayed, seconds
from tests.stages.alignment.straight import NO_NOISE

JUMP = {"kind": "step", "size_m": 1000.0, "start_s": 120.0, "duration_s": 5.0}
OFFSET = {"kind": "step", "size_m": -45.0, "start_s": 180.0, "duration_s": 60.0}
RAMP = {"kind": "ramp", "rate_mps": 0.8, "start_s": 90.0, "duration_s": 60.0, "returns": True}
DAY = pl.duration(days=1, nanoseconds=123_456_789)


def times_of(frame):
    return [name for name, kind in frame.schema.items() if kind == pl.Datetime("ns", "UTC")]


def later(run):
    streams = {
        name: frame.with_columns(pl.col(times_of(frame)) + DAY)
        for name in ("gnss", "odometer", "reference", "balise_reads")
        if (frame := run.stream(name)) is not None
    }
    return run.with_streams(**streams)


def test_a_constant_on_all_times_changes_nothing_else():
    run, site = journey(JUMP, OFFSET)
    one, other = replay(run, site, VEHICLE), replay(later(run), site, VEHICLE)
    assert one.hazards.height == 3
    for name in ("hazards", "passages", "alarms", "epochs"):
        expected = getattr(one, name).with_columns(pl.col(times_of(getattr(one, name))) + DAY)
        assert_frame_equal(getattr(other, name), expected, check_exact=True)
    figures = pl.all().exclude("t_start", "t_end", "partial_until", "input_digest")
    assert_frame_equal(other.runs.select(figures), one.runs.select(figures))


def flipped(site):
    """Each element surveyed from its other end."""
    length = site.track.group_by("netelement_id").agg(length_m=pl.col("measure_m").max())
    track = site.track.join(length, on="netelement_id", maintain_order="left")
    track = track.with_columns(measure_m=pl.col("length_m") - pl.col("measure_m")).drop("length_m")
    balises = site.balises.join(length, on="netelement_id", maintain_order="left")
    balises = balises.with_columns(measure_m=pl.col("length_m") - pl.col("measure_m")).drop("length_m")
    links = site.links.with_columns(position_a=1 - pl.col("position_a"), position_b=1 - pl.col("position_b"))
    return Site(track.sort("netelement_id", "measure_m"), links, balises=balises), dict(length.iter_rows())


def test_elements_surveyed_from_their_other_ends_only_mirror_the_measures():
    run, site = journey(JUMP, OFFSET)
    other_site, length = flipped(site)
    one, other = replay(run, site, VEHICLE), replay(run, other_site, VEHICLE)
    for name in ("hazards", "passages"):
        expected, found = getattr(one, name), getattr(other, name)
        mirrored = expected["netelement_id"].replace_strict(length, return_dtype=pl.Float64) - expected["measure_m"]
        assert (found["measure_m"] - mirrored).abs().max() < 1e-6
        kept = ("solution", "balise_id", "status", "hazard", "balise_ids", "timing", "detected", "linking_error")
        same = [column for column in kept if column in expected.columns]
        assert_frame_equal(found.select(same), expected.select(same))


def backwards(run):
    """The same film run backwards: every stream mirrored about one instant, the odometer counting on."""
    pivot = pl.lit(run.gnss["t"].max()) + (pl.lit(run.gnss["t"].min()) - pl.col("t"))
    gnss = run.gnss.with_columns(t=pivot, vel_e_mps=-pl.col("vel_e_mps"), vel_n_mps=-pl.col("vel_n_mps"))
    odometer = run.odometer.with_columns(t=pivot, distance_m=-pl.col("distance_m"))
    return run.with_streams(
        gnss=gnss.with_columns(vel_u_mps=-pl.col("vel_u_mps")).sort("t"),
        odometer=odometer.sort("t"),
        reference=run.reference.with_columns(t=pivot).sort("t"),
        balise_reads=run.balise_reads.with_columns(t=pivot).sort("t"),
    )


def test_a_run_backwards_mirrors_its_tables():
    run, site = journey(JUMP)
    one, other = replay(run, site, VEHICLE), replay(backwards(run), site, VEHICLE)
    assert other.hazards["hazard"].to_list() == one.hazards["hazard"].to_list() == ["VB_JUMP_1B"] * 2
    # The jump forward over VB3 and back became one backward and forward again over the same.
    assert other.hazards["balise_ids"].to_list() == one.hazards["balise_ids"].to_list()
    assert other.hazards["size_m"].to_list() == pytest.approx((-one.hazards["size_m"]).to_list(), abs=1.5)
    clean, _ = journey()
    there, back = replay(clean, site, VEHICLE), replay(backwards(clean), site, VEHICLE)
    names = there.passages["balise_id"].to_list()
    assert back.passages["balise_id"].to_list() == names[::-1]
    for tables in (there, back):
        assert set(tables.passages["status"]) == {"accepted"}
        assert tables.alarms.height == tables.hazards.height == 0
    error = there.passages["location_error_m"].reverse() + back.passages["location_error_m"]
    assert error.abs().max() < 0.2


# A part would have to measure its noise anew, and be without a diagnosis meanwhile.
GIVEN = Configuration.model_validate({"monitors": NO_NOISE})


def parts_of(run, site, at):
    for keep in (pl.col("t") < at, pl.col("t") >= at):
        logs = {name: run.stream(name).filter(keep) for name in ("gnss", "odometer", "reference", "balise_reads")}
        yield replay(RunLog("part", **logs), site, VEHICLE, GIVEN)


@pytest.mark.parametrize("at_s", [160.0, None])
def test_a_run_split_between_balises_loses_no_hazard(at_s):
    """Also where it is split at the instant at which a balise is passed."""
    run, site = journey(JUMP, OFFSET)
    whole = replay(run, site, VEHICLE, GIVEN)
    passed = whole.passages.filter(pl.col("balise_id") == "VB1")["t_offered"][0]
    at = passed if at_s is None else run.gnss["t"][0] + pl.duration(seconds=at_s)
    parts = list(parts_of(run, site, at))
    columns = ("hazard", "balise_ids", "t_hazard", "t_onset", "timing", "detected", "t_detected")
    assert_frame_equal(pl.concat(part.hazards for part in parts).select(columns), whole.hazards.select(columns))
    # The balise that is passed as the log is cut belongs to neither part, all others to one.
    balises = [row for part in parts for row in part.passages.filter(kind="virtual")["balise_id"].to_list()]
    expected = whole.passages.filter(kind="virtual")["balise_id"].to_list()
    assert balises == [name for name in expected if at_s is not None or name != "VB1"]


@pytest.mark.parametrize("kind", ["step", "ramp"])
def test_a_fault_scaled_up_is_never_detected_later_without_noise(kind):
    delays = []
    for factor in (1.0, 1.5, 4.0):
        fault = {**OFFSET, "size_m": 40.0 * factor} if kind == "step" else {**RAMP, "rate_mps": 0.5 * factor}
        tables = replayed(fault, gnss=QUIET, odometer={"noise_m_per_root_s": 0.0, "speed_sigma_mps": 0.0})
        alarm = tables.alarms["t_start"][0] - tables.epochs["t"][0]
        delays.append(alarm.total_seconds() - fault["start_s"])
    assert delays == sorted(delays, reverse=True)
    assert delays[0] > 0.0 or kind == "step"


def test_two_solutions_never_influence_each_other():
    faulty, site = journey(JUMP)
    sound, _ = journey(seed=9)
    both = pl.concat([faulty.gnss, sound.gnss.with_columns(solution=pl.lit("other"))]).sort("t")
    together = replay(faulty.with_streams(gnss=both), site, VEHICLE)
    alone = replay(faulty, site, VEHICLE)
    for name in ("hazards", "passages", "alarms", "epochs"):
        frame = getattr(together, name).filter(pl.col("solution") == "primary")
        assert_frame_equal(frame, getattr(alone, name), check_exact=True)
    assert together.hazards.filter(pl.col("solution") == "other").height == 0


EARLY = {"kind": "ramp", "rate_mps": 2.5, "at_m": 3450.0, "duration_s": 30.0}
LATE = {"kind": "bias", "size_m": -120.0, "at_m": 3600.0, "duration_s": 90.0}


def hits_of(tables):
    """VBs hit by class and first VB; where the odometer is the evidence an accepted VB hides what comes after it."""
    return {
        (row["hazard"], row["balise_ids"][0]): set(row["balise_ids"]) for row in tables.hazards.iter_rows(named=True)
    }


@pytest.mark.parametrize("faults", [(JUMP, OFFSET), (EARLY,), (LATE,)])
def test_more_evidence_never_removes_a_hazard_that_is_there(faults):
    run, site = journey(*faults)
    weaker = (
        run.with_streams(reference=None, balise_reads=None),
        run.with_streams(reference=None),
        run.with_streams(reference=run.reference.filter(pl.col("t") < run.gnss["t"][1500])),
    )
    full = hits_of(replay(run, site, VEHICLE))
    assert full
    for logs in weaker:
        for hazard, hits in hits_of(replay(logs, site, VEHICLE)).items():
            assert hits <= full[hazard]


def test_the_journey_is_the_one_meant():
    """VB3 lies ahead of the jump, one virtual balise on the way of it."""
    tables = replayed(JUMP)
    begin = seconds(tables, "t_hazard")
    assert begin == pytest.approx([120.0, 125.0], abs=0.11)
    virtual = tables.passages.filter(pl.col("kind") == "virtual")
    assert virtual["balise_id"].n_unique() == len(PLACES_M)
