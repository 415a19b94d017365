"""Properties that hold whatever the fault: shifted in time, mirrored, scaled up, with more evidence."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from pipeline.hazards import Case, classify, establish_truth
from schemas.config import Configuration
from schemas.tables import Alarms, Hazards, Passages
from tests.hazards.synthetic import Journey, judge, locate

BASE = Journey(duration_s=100.0, rate_hz=5.0)
READS = tuple(np.arange(50.0, 2000.0, 500.0))

steps = st.builds(
    lambda begin, lasts, size, sign: BASE.but(steps=((float(begin), float(begin + lasts), sign * size),)),
    st.integers(20, 60),
    st.integers(2, 60),
    st.floats(25.0, 700.0),
    st.sampled_from((-1.0, 1.0)),
)
ramps = st.builds(
    lambda begin, lasts, rate, sign: BASE.but(ramps=((float(begin), float(begin + lasts), sign * rate),)),
    st.integers(20, 60),
    st.integers(10, 40),
    st.floats(0.4, 3.0),
    st.sampled_from((-1.0, 1.0)),
)
faulty = st.one_of(steps, ramps)
quick = settings(max_examples=25, deadline=None, derandomize=True)


def alarmed(journey):
    """Raw monitor at the step, slow monitor once a ramp has reached 10 m."""
    if journey.steps:
        begin, end, _ = journey.steps[0]
        return journey.but(fails={"along_raw": ((begin + 0.2, begin + 0.4), (end, end + 0.2))})
    begin, end, rate = journey.ramps[0]
    return journey.but(fails={"along_ewma_0p01": ((begin + round(10.0 / abs(rate), 1), end + 20.0),)})


def accepted_all(journey):
    """Every VB accepted where the position crosses it first."""
    path = journey.truth_m() + journey.error_m()
    rows = []
    for index, place in enumerate(journey.balises_m):
        beyond = np.flatnonzero(path >= place)
        if beyond.size and beyond[0] > 0:
            k = int(beyond[0])
            share = (place - path[k - 1]) / (path[k] - path[k - 1])
            rows.append({"balise_id": f"V{index}", "t_offered": (k - 1 + share) / journey.rate_hz})
    return rows


@quick
@given(faulty)
def test_tables_keep_their_contract(journey):
    journey = alarmed(journey)
    result = judge(journey, journey.passages(accepted_all(journey)))
    Hazards.validate(result.hazards)
    Alarms.validate(result.alarms)
    Passages.validate(result.passages)
    for frame in (result.hazards, result.alarms, result.passages, result.epochs_columns):
        for column in frame.select(pl.selectors.float()).columns:
            assert not frame[column].is_nan().any(), column


@quick
@given(faulty, st.integers(-(10**15), 10**15))
def test_adding_a_constant_to_all_times_changes_nothing_else(journey, shift_ns):
    journey = alarmed(journey)
    shift = pl.duration(nanoseconds=shift_ns)

    def shifted(frame):
        return frame.with_columns(pl.selectors.datetime() + shift)

    passages = journey.passages(accepted_all(journey))
    before = judge(journey, passages)
    config = Configuration()
    epochs, moved = shifted(journey.epochs()), shifted(passages)
    truth = establish_truth(epochs, shifted(journey.reference_frame()), None, moved, config)
    after = classify(Case("primary", epochs, truth, moved, journey.balises(), None, locate, config))
    for name in ("hazards", "alarms", "passages", "epochs_columns"):
        wanted = shifted(getattr(before, name))
        assert_frame_equal(getattr(after, name), wanted, abs_tol=1e-6, rel_tol=0.0)


def mirrored(journey):
    """The same journey with the path laid from the other end."""
    length_m = 3000.0
    return journey.but(
        speed_mps=-journey.speed_mps,
        start_m=length_m - journey.start_m,
        balises_m=tuple(length_m - place for place in journey.balises_m),
        steps=tuple((a, b, -size) for a, b, size in journey.steps),
        ramps=tuple((a, b, -rate) for a, b, rate in journey.ramps),
    )


@quick
@given(faulty)
def test_mirror_image_has_the_same_hazards(journey):
    # VBs half a metre off the epochs' places: on them "at" and "beyond" differ by the direction of the path.
    journey = alarmed(journey.but(balises_m=tuple(place + 0.513 for place in journey.balises_m), start_m=0.0))
    one, other = judge(journey).hazards, judge(mirrored(journey)).hazards
    plain = [name for name in one.columns if name not in ("path_m", "measure_m")]
    assert_frame_equal(other.select(plain), one.select(plain), abs_tol=1e-6, rel_tol=0.0)
    assert np.allclose(other["path_m"].to_numpy(), 3000.0 - one["path_m"].to_numpy(), atol=1e-6)


@quick
@given(faulty, st.floats(1.0, 3.0))
def test_fault_scaled_up_is_never_judged_later(journey, factor):
    larger = journey.but(
        steps=tuple((a, b, factor * size) for a, b, size in journey.steps),
        ramps=tuple((a, b, factor * rate) for a, b, rate in journey.ramps),
    )
    before, after = judge(journey).hazards, judge(larger).hazards
    if before.height:
        assert after.height
        assert after["t_onset"].min() <= before["t_onset"].min()
        failure, sooner = before["t_failure"].min(), after["t_failure"].min()
        assert failure is None or (sooner is not None and sooner <= failure)
        assert abs(after["size_m"][0]) >= abs(before["size_m"][0]) - 1e-6


@quick
@given(faulty)
def test_more_evidence_never_removes_a_hazard(journey):
    # No VB accepted under the fault, as under a working diagnosis.
    begin = (journey.steps or journey.ramps)[0][0]
    sound = [row for row in accepted_all(journey) if row["t_offered"] < begin - 1.0 / journey.rate_hz]
    passages = journey.passages(sound)
    by_odometer = journey.but(reference=False)
    by_balises = by_odometer.but(reads=READS)
    found = [judge(one, passages).hazards for one in (by_odometer, by_balises, journey)]
    for less, more in pairwise(found):
        for row in less.iter_rows(named=True):
            near = more.filter((pl.col("t_onset") <= row["t_end"]) & (pl.col("t_end") >= row["t_onset"]))
            assert set(row["balise_ids"]) <= {balise for ids in near["balise_ids"] for balise in ids}


@quick
@given(faulty)
def test_row_order_of_passages_and_balises_does_not_matter(journey):
    journey = alarmed(journey)
    passages = journey.passages(accepted_all(journey))
    config = Configuration()
    epochs = journey.epochs()
    truth = establish_truth(epochs, journey.reference_frame(), None, passages, config)
    forward = classify(Case("primary", epochs, truth, passages, journey.balises(), None, locate, config))
    backward = classify(
        Case("primary", epochs, truth, passages.reverse(), journey.balises().reverse(), None, locate, config)
    )
    assert backward.hazards.equals(forward.hazards)
    assert backward.passages.reverse().equals(forward.passages)
