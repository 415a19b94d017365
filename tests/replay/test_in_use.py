"""Wrong time in use, whatever the log looks like: rows without a position, thinned logs, slow jumps back.

A straight track of 6 km, positions with an exact reference. What may be said follows from the errors put in.
"""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.one_run import replay
from schemas.config import Configuration, Vehicle
from schemas.inputs import BaliseReads, Balises, Gnss, Odometer, Reference
from schemas.run import RunLog, RunTables, Site
from tests.replay.test_shunting import stream
from tests.stages.matching import builders
from tests.stages.matching.builders import line
from tests.stages.matching.ladder import degrees

RATE_HZ = 10.0
TIME_S = np.arange(0.0, 140.0, 1.0 / RATE_HZ)
CHAINAGE_M = 200.0 + 30.0 * np.clip(TIME_S - 5.0, 0.0, None)
KNOWN = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.005)
COMPLETE = Configuration.model_validate({"evidence": {"survey_complete": True}})


def balises(*rows: tuple[str, str, float, str]):
    frame = pl.DataFrame(rows, schema=["balise_id", "netelement_id", "measure_m", "kind"], orient="row")
    return Balises.validate(
        frame.with_columns(
            location_accuracy_m=12.0, linked=True, link_reaction=pl.lit("service_brake"), direction=pl.lit("both")
        ),
        cast=True,
    )


SITE = Site(
    builders.site({"a": line((0, 0), (6000, 0))}).track,
    builders.site({"a": line((0, 0), (6000, 0))}).links,
    balises=balises(*((f"V{km}", "a", 1000.0 * km, "virtual") for km in range(1, 6))),
)


def gnss(error_m, chainage_m=CHAINAGE_M):
    noise_m = 0.3 * np.convolve(
        np.random.default_rng(5).standard_normal(chainage_m.size), np.ones(200) / 200.0**0.5, "same"
    )
    return stream(Gnss, builders.run(chainage_m + error_m + noise_m, np.zeros(chainage_m.size), RATE_HZ))


def reference(keep=slice(None), aside_m: float = 0.0, chainage_m=CHAINAGE_M, sigma_m: float = 0.05):
    latitude, longitude = degrees(chainage_m, np.full(chainage_m.size, aside_m))
    frame = pl.DataFrame(
        {"t": builders.times(chainage_m.size, RATE_HZ), "latitude_deg": latitude, "longitude_deg": longitude}
    )
    kept = np.zeros(chainage_m.size, dtype=bool)
    kept[keep] = True
    return stream(Reference, frame.with_columns(sigma_m=sigma_m).filter(pl.Series(kept)))


def counted(distance_m):
    return stream(Odometer, builders.odometer(distance_m, RATE_HZ))


def row(tables: RunTables):
    return tables.runs.row(0, named=True)


def test_a_slow_jump_back_counts_as_time_in_use():
    """100 m ahead at 54 s, back over 3 s: beyond 20 m for 2.4 s."""
    back = 100.0 * np.where(TIME_S < 54.0, 0.0, np.clip(1.0 - (TIME_S - 54.0) / 3.0, 0.0, 1.0))
    found = row(replay(RunLog("back", gnss(back), reference=reference()), SITE))
    assert found["failure_hazardous_s"] == [pytest.approx(2.4, abs=0.11)]
    assert (found["failures_within_budget"], found["verdict"]) == (0, "unsafe")


@pytest.mark.parametrize("every", [5, 10])
@pytest.mark.parametrize("driven", [True, False], ids=["odometer", "no_odometer"])
def test_rows_without_a_position_change_no_time_in_use(every: int, driven: bool):
    """30 m ahead from 55.45 to 59.55 s; the logger writes 10 rows a second, the receiver fewer positions."""
    at_position = pl.Series(np.arange(TIME_S.size) % every == 0)
    written = gnss(30.0 * ((TIME_S > 55.45) & (TIME_S < 59.55)))
    places = [pl.when(at_position).then(pl.col(name)).alias(name) for name in ("latitude_deg", "longitude_deg")]
    fix = pl.when(at_position).then(pl.col("fix").cast(pl.String)).otherwise(pl.lit("none"))
    others = {"reference": reference(), "odometer": counted(CHAINAGE_M - 200.0) if driven else None}
    logs = [
        written.filter(at_position),
        written.with_columns(places),
        written.with_columns(fix=fix.cast(written["fix"].dtype)),
    ]
    names = ("verdict", "failures", "failures_within_budget", "failure_hazardous_s", "gnss_rate_hz")
    found = [row(replay(RunLog("r", log, **others), SITE)) for log in logs]
    left_out, *rows = ([one[name] for name in names] for one in found)
    assert rows == [left_out, left_out]
    if not driven:
        assert left_out[3][0] >= 4.0
    assert left_out[4] == RATE_HZ / every


@pytest.mark.parametrize("step", [9, 12, 20])
def test_unknown_time_of_a_thinned_log_counts(step: int):
    """After 60 s the reference ends and few positions are left, which drift away undetected."""
    kept = pl.Series((TIME_S < 60.0) | (np.arange(TIME_S.size) % step == 0))
    log = gnss(np.clip(TIME_S - 65.0, 0.0, 60.0)).filter(kept)
    found = row(replay(RunLog("thin", log, reference=reference(slice(0, 600))), SITE))
    assert found["share_unknown"] > 0.4
    assert found["verdict"] == "unproven"


@pytest.mark.parametrize("aside_m", [8.0, 12.0])
def test_a_reference_beside_every_track_tells_nothing(aside_m: float):
    log = RunLog("aside", gnss(np.zeros(TIME_S.size)), reference=reference(aside_m=aside_m, sigma_m=0.1))
    tables = replay(log.with_streams(odometer=counted(CHAINAGE_M - 200.0)), SITE)
    assert row(tables)["verdict"] == "unproven"
    assert "right" not in tables.epochs["judgement"].cast(pl.String).to_list()


def test_errors_are_signed_by_the_train_and_not_by_the_odometer():
    """An odometer that counts up while the train reverses; from the turn on the position is 40 m ahead."""
    speed = np.interp(np.arange(0.0, 200.0, 0.1), [0, 5, 45, 85, 100, 120, 160, 200], [0, 0, 20, 20, 0, 0, -15, -15])
    chainage_m = 800.0 + np.cumsum(speed) / RATE_HZ
    ahead = np.where(np.arange(chainage_m.size) < 1250, 0.0, -40.0)
    log = RunLog("turns", gnss(ahead, chainage_m), reference=reference(chainage_m=chainage_m))
    wrong = [
        replay(
            log.with_streams(odometer=counted(np.cumsum(np.abs(speed) if up else speed) / RATE_HZ)), SITE
        ).epochs.filter(pl.col("judgement").cast(pl.String) == "wrong")["error_along_m"]
        for up in (False, True)
    ]
    for errors in wrong:
        assert errors.len() > 500
        assert errors.mean() == pytest.approx(40.0, abs=1.0)


class TestReadsThatNoTrainCanMake:
    """Two tracks 8 m apart without a link; of the second one a balise is read soon after one of the first."""

    BOTH = builders.site({"a": line((0, 0), (6000, 0)), "b": line((0, 8), (6000, 8))}, sigma_m=0.1)
    BALISES = balises(
        *((f"V{km}", "a", 1000.0 * km, "virtual") for km in range(1, 6)),
        ("A", "a", 1000.0, "physical"), ("B", "a", 2500.0, "physical"), ("X", "b", 2510.0, "physical"),
        ("C", "a", 4000.0, "physical"),
    )  # fmt: skip

    def replayed(self, *reads: tuple[str, float]) -> RunTables:
        log = RunLog("reads", gnss(np.zeros(TIME_S.size)), odometer=counted(CHAINAGE_M - 200.0))
        stamps = [5.0 + (chainage_m - 200.0) / 30.0 for _, chainage_m in reads]
        t = pl.Series("t", np.round(1e9 * np.array(stamps)).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))
        frame = pl.DataFrame([t, pl.Series("balise_id", [name for name, _ in reads])])
        site = Site(self.BOTH.track, self.BOTH.links, balises=self.BALISES)
        return replay(log.with_streams(balise_reads=stream(BaliseReads, frame)), site, KNOWN)

    def test_right_reads_judge_the_positions(self):
        tables = self.replayed(("A", 1000.0), ("B", 2500.0), ("C", 4000.0))
        assert "right" in tables.epochs["judgement"].cast(pl.String).to_list()
        assert "cannot be reached from the one before" not in tables.runs["notes"][0]

    @pytest.mark.parametrize("apart_m", [0.0, 1.0, 30.0])
    def test_a_read_of_the_other_track_leaves_the_gaps_around_it_unknown(self, apart_m: float):
        tables = self.replayed(("A", 1000.0), ("B", 2500.0), ("X", 2500.0 + apart_m), ("C", 4000.0))
        chainage_m = 200.0 + 30.0 * (tables.epochs["t"].dt.timestamp("ns") / 1e9 - 5.0)
        between = tables.epochs.filter((chainage_m > 1001.0) & (chainage_m < 3999.0))
        assert between.height > 900
        assert set(between["judgement"].cast(pl.String)) == {"unknown"}
        assert (row(tables)["unsafe_accepted"], row(tables)["odometer_contradicted"]) == (0, 0)
        assert "cannot be reached from the one before" in tables.runs["notes"][0]


def test_a_lag_between_reference_and_odometer_belongs_to_nobody():
    """At 35 m/s 0.4 s are 14 m: positions up to 34 m off could be called right, with a vehicle file and without."""
    speed = np.interp(
        np.arange(0.0, 240.0, 0.1), [0, 5, 40, 80, 110, 150, 180, 230, 240], [0, 0, 35, 35, 15, 35, 35, 0, 0]
    )
    chainage_m = 200.0 + np.cumsum(speed) / RATE_HZ
    log = RunLog("clocks", gnss(np.zeros(chainage_m.size), chainage_m), odometer=counted(chainage_m - 200.0))
    verdicts = {}
    for late_s in (0.0, 0.4):
        truth = reference(chainage_m=chainage_m).with_columns(
            pl.col("t") + pl.duration(milliseconds=round(1000 * late_s))
        )
        tables = [replay(log.with_streams(reference=truth), SITE, vehicle, COMPLETE) for vehicle in (KNOWN, Vehicle())]
        verdicts[late_s] = [row(found)["verdict"] for found in tables]
        widest_m = [(found.epochs["error_high_m"] - found.epochs["error_low_m"]).max() for found in tables]
        for width_m in widest_m:
            assert (width_m > 14.0) == (late_s > 0.0)
    assert verdicts[0.0][0] == "safe"


@pytest.mark.parametrize(("cut", "verdict"), [(False, "safe"), (True, "unproven")])
def test_reads_cut_to_whole_seconds_prove_nothing(cut: bool, verdict: str):
    """At 30 m/s a read stamped at the begin of its second lies up to 30 m behind the train."""
    names = [f"P{number}" for number in range(19)]
    places = [(name, "a", 250.0 + 217.0 * number, "physical") for number, name in enumerate(names)]
    site = Site(SITE.track, SITE.links, balises=balises(("V", "a", 2000.0, "virtual"), *places))
    stamps = np.array([5.0 + (measure_m - 200.0) / 30.0 for _, _, measure_m, _ in places])
    t = pl.Series("t", np.round(1e9 * (np.floor(stamps) if cut else stamps)).astype(np.int64)).cast(
        pl.Datetime("ns", "UTC")
    )
    reads = stream(BaliseReads, pl.DataFrame([t, pl.Series("balise_id", names)]))
    log = RunLog("cut", gnss(np.zeros(CHAINAGE_M.size)), odometer=counted(CHAINAGE_M - 200.0), balise_reads=reads)
    found = row(replay(log, site, KNOWN, COMPLETE))
    assert found["verdict"] == verdict
    assert ("are whole seconds" in (found["notes"] or "")) == cut


def test_a_balise_accepted_wrong_exceeds_every_service_level():
    """40 m ahead for 0.35 s, over a balise: shorter than any allowed T_D, and accepted all the same."""
    at_s = 5.0 + (3000.0 - 200.0) / 30.0 - 0.9
    ahead = 40.0 * ((at_s <= TIME_S) & (at_s + 0.35 > TIME_S))
    found = row(replay(RunLog("blip", gnss(ahead), reference=reference()), SITE))
    assert (found["unsafe_accepted"], found["failure_accepted"], found["verdict"]) == (1, ["wrong"], "unsafe")
    assert found["failure_hazardous_s"][0] < min(found["level_allowed_s"])
    assert (set(found["level_within"]), set(found["level_verdict"])) == ({0}, {"exceeded"})


def test_two_positions_of_one_stamp_prove_nothing():
    """40 m apart for 4 s; which one the train would have used nobody knows."""
    clean = gnss(np.zeros(TIME_S.size))
    twice = gnss(np.full(TIME_S.size, 40.0)).filter(pl.Series((TIME_S > 60.0) & (TIME_S < 64.0)))
    both = pl.concat([clean, twice]).sort("t", maintain_order=True)
    log = RunLog("twice", both, odometer=counted(CHAINAGE_M - 200.0), reference=reference())
    assert row(replay(log.with_streams(gnss=clean), SITE, KNOWN))["verdict"] == "safe"
    assert row(replay(log, SITE, KNOWN))["verdict"] == "unproven"


def of(tables: RunTables, *names: str):
    return tuple(row(tables)[name] for name in names)


def test_pulses_are_one_failure_and_not_hundreds_in_time():
    """60 m for 0.3 s in each second from 20 s on, no odometer: each pulse alone is within 0.5025 s."""
    pulses = 60.0 * ((TIME_S >= 20.0) & ((TIME_S + 1e-6) % 1.0 < 0.25))
    tables = replay(RunLog("pulses", gnss(pulses), reference=reference()), SITE)
    assert of(tables, "failures", "failures_within_budget", "verdict") == (1, 0, "unsafe")
    assert "failure_beyond_budget" in row(tables)["reasons"]
    assert row(tables)["hazardous_s"] == pytest.approx(0.3 * 120, abs=0.11)
    hit = tables.hazards["hazardous_s"].to_list()
    assert hit
    assert set(hit) == {row(tables)["hazardous_s"]}


def test_positions_without_diagnosis_prove_nothing():
    """No odometer: every position is right by the reference, and nothing would have seen one that is not."""
    tables = replay(RunLog("blind", gnss(np.zeros(TIME_S.size)), reference=reference()), SITE)
    assert of(tables, "verdict", "reasons", "share_p3") == ("unproven", ["not_diagnosed", "clock_assumed"], 1.0)
    assert row(tables)["balises_accepted"] > 0


@pytest.mark.parametrize("gap_s", [0.3, 0.5, 0.9])
def test_a_fault_behind_a_gap_may_be_as_old_as_the_gap(gap_s: float):
    """40 m ahead behind a gap at 60 s, found at its first epoch, negated one later: since 59.9 s wrong in use."""
    kept = pl.Series((TIME_S < 60.0) | (60.0 + gap_s <= TIME_S))
    log = gnss(40.0 * (TIME_S >= 60.0)).filter(kept)
    log = RunLog("gap", log, odometer=counted(CHAINAGE_M - 200.0), reference=reference())
    tables = replay(log, SITE, KNOWN)
    assert row(tables)["failure_hazardous_s"] == [pytest.approx(gap_s + 0.2, abs=0.01)]
    assert row(tables)["failures_within_budget"] == (1 if gap_s == 0.3 else 0)
    assert (row(tables)["verdict"] == "unsafe") == (gap_s > 0.3)


@pytest.mark.parametrize(("rate_mps", "detected_s"), [(0.5, 110.0), (3.0, 50.1)])
def test_a_drift_has_its_time_from_failure_to_detection(rate_mps: float, detected_s: float):
    """Off from 50 s on, no average looks on: a slow one is seen at a jump; T_dsf is given as an interval."""
    drift = np.clip(rate_mps * (TIME_S - 50.0), 0.0, None)
    jump = np.where(TIME_S >= 110.0, 60.0, 0.0)
    log = RunLog("drift", gnss(drift + jump), odometer=counted(CHAINAGE_M - 200.0), reference=reference(sigma_m=1.0))
    averages = [f"{axis}_ewma_{scale}" for axis in ("along", "cross", "up") for scale in ("0p1", "0p01", "0p001")]
    blind = Configuration.model_validate({"monitors": {"disabled": [*averages, "link_distance", "along_doppler"]}})
    hazards = replay(log, SITE, KNOWN, blind).hazards.filter(pl.col("hazard").cast(pl.String) == "VB_SHIFT")
    least_s, most_s = hazards.select("time_since_failure_s", "time_since_failure_may_s").row(0)
    # Beyond 20 m at 50 s + 20 m / rate; certain or possible so much later or earlier: 3 sigma of the reference, and at
    # one speed the clock is assumed, 0.1 s.
    half_m = 3.0 * 1.0 + 0.1 * 30.0
    assert least_s == pytest.approx(detected_s - 50.0 - (20.0 + half_m) / rate_mps, abs=1.0)
    assert most_s == pytest.approx(detected_s - 50.0 - (20.0 - half_m) / rate_mps, abs=1.5)


@pytest.mark.parametrize("driven", [True, False], ids=["odometer", "no_odometer"])
def test_the_share_of_p1_is_the_hazardous_time(driven: bool):
    """Two faults; of the gap of 5 s in the first no more counts than of a step of a second."""
    kept = pl.Series(~((TIME_S > 70.0) & (TIME_S < 75.0)))
    wrong = 50.0 * ((TIME_S > 60.0) & (TIME_S < 80.0)) + 30.0 * (TIME_S > 110.0)
    odometer = {"odometer": counted(CHAINAGE_M - 200.0)} if driven else {}
    tables = replay(RunLog("p1", gnss(wrong).filter(kept), reference=reference(), **odometer), SITE, KNOWN)
    share, held_s, hazardous_s = of(tables, "share_p1", "held_s", "hazardous_s")
    assert share * held_s == pytest.approx(hazardous_s)
    assert hazardous_s == pytest.approx(0.2 * 2 if driven else 50.0 - 5.0 + 1.0, abs=0.5)


def test_a_part_between_the_anchors_has_its_own_verdict():
    """The reference is silent before 30 s and after 110 s: 300 m on, the odometer's 5 m + 5 % reach the limit."""
    log = RunLog(
        "part", gnss(np.zeros(TIME_S.size)), odometer=counted(CHAINAGE_M - 200.0), reference=reference(slice(300, 1101))
    )
    tables = replay(log, SITE, None, COMPLETE)
    assert of(tables, "verdict", "part_verdict") == ("unproven", "safe")
    assert row(tables)["reasons"] == ["accepted_unknown", "unknown_in_use", "clock_assumed"]
    begin, end = (row(tables)[name].timestamp() for name in ("part_from", "part_to"))
    assert (begin % 1000, end % 1000) == (pytest.approx(30.0, abs=1.0), pytest.approx(110.0, abs=1.0))
    assert row(tables)["part_share"] == pytest.approx(80.0 / 135.0, abs=0.02)
