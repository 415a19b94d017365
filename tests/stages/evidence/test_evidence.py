"""Where the train was at given instants, on tables of a few rows worked out by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.evidence import evidence_of
from pipeline.stages.evidence.anchors import read_anchors
from pipeline.stages.evidence.carrying import SignedOdometer, TrueAnchor, carry_from_accepted
from pipeline.stages.evidence.evidence import KINDS, _are_beyond_stand
from pipeline.stages.evidence.gaps import Gap, GapSearch
from pipeline.stages.odometry import Odometry, odometry_of
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import Configuration, HazardConfig, Vehicle
from schemas.enums import Evidence as Kind
from tests.stages.evidence.test_chains import line
from tests.stages.matching.builders import odometer

REFERENCE = KINDS.index(Kind.REFERENCE)


def seconds(*t_s: float) -> Ints:
    return np.array([round(t * NS_PER_S) for t in t_s], dtype=np.int64)


def anchor(t_s: float, at_m: float) -> TrueAnchor:
    return TrueAnchor(round(t_s * NS_PER_S), (Place(0, at_m),), 1.0, Kind.REFERENCE)


def counting(at_m: Floats) -> Odometry:
    """An odometer that counts so much each second from 0 s on."""
    found = odometry_of(odometer(at_m), Vehicle(), Configuration())
    assert found is not None
    assert found.epoch_ns == 0
    return found


def test_gaps_are_before_between_and_after_what_is_known() -> None:
    """The odometer counts from 0 to 10 s; the reference tells from 2 to 5 s and from 7 to 9 s."""
    a, b, c, d = (anchor(t_s, 10.0 * t_s) for t_s in (2, 5, 7, 9))
    counter = SignedOdometer(counting(np.arange(0.0, 110.0, 10.0)))
    found = GapSearch(counter, line("both"), Configuration()).find_gaps([(a, b), (c, d)])
    assert [(gap.begin_ns, gap.end_ns) for gap in found] == [
        tuple(seconds(*ends)) for ends in ((0, 2), (5, 7), (9, 10))
    ]
    assert [(gap.begin, gap.end) for gap in found] == [(None, a), (b, c), (d, None)]


@pytest.mark.parametrize(("counted_mps", "share", "known"), [(10.0, 0.0, True), (14.0, 0.0, False), (14.0, 0.4, True)])
def test_where_the_odometer_slipped_a_longer_way_is_one_too(counted_mps: float, share: float, known: bool) -> None:
    """60 m in 6 s: 84 m are beyond 5 m, 5 % of the way and 6 m of noise; with 40 % of slip they are not."""
    config = Configuration(hazards=HazardConfig(slip_m=0.0, slip_share=share))
    a, b = anchor(2, 20.0), anchor(8, 80.0)
    counter = SignedOdometer(counting(np.arange(11) * counted_mps))
    _, between, _ = GapSearch(counter, line("both"), config).find_gaps([(a, a), (b, b)])
    assert bool(between.routes) is known


READS = pl.DataFrame({"t": pl.Series([1, 6], dtype=pl.Int64) * NS_PER_S, "balise_id": ["p1", "p2"]}).with_columns(
    pl.col("t").cast(pl.Datetime("ns", "UTC"))
)
BALISES = pl.DataFrame(
    {
        "balise_id": ["p1", "p2"], "netelement_id": ["a", "a"], "measure_m": [10.0, 60.0],
        "kind": ["physical", "physical"],
    }
)  # fmt: skip


def test_between_reads_both_tell_and_beside_them_five_metres_and_five_percent() -> None:
    """10 m each second: reads are true to 3 m at three sigmas and, by a clock of 0.1 s, to a metre more."""
    counted = counting(np.arange(0.0, 110.0, 10.0))
    reads = read_anchors(READS, BALISES, line("both").track, HazardConfig())
    known = evidence_of(([], []), [reads], [counted], line("both"), Vehicle(), Configuration())
    found = known.at(seconds(0, 3, 8))
    assert found.kind.tolist() == [KINDS.index(Kind.BALISE)] * 3
    rows = {int(row): (low, high) for one in found.alternatives for row, low, high in zip(
        one.rows, *(one.route.locate(at_m)[1] for at_m in (one.low_m, one.high_m)), strict=True)}  # fmt: skip
    assert sorted(rows[0]) == pytest.approx([-5.5, 5.5], abs=1e-6)
    assert sorted(rows[2]) == pytest.approx([74.0, 86.0], abs=1e-6)
    least, most = sorted(rows[1])
    assert 25.9 < least < 26.0
    assert 34.0 < most < 34.1


@pytest.mark.parametrize(
    ("stood_s", "ahead", "behind"),
    [
        ((3, 4), [True, True, True, True], [True, False, False, False]),
        ((6, 7), [False, False, True, True], [True, True, True, False]),
        ((0, 1), [False, False, False, False], [False, False, False, False]),
    ],
)
def test_nothing_is_carried_over_a_stand_of_the_odometer(
    stood_s: tuple[int, int], ahead: list[bool], behind: list[bool]
) -> None:
    """From 2 s on, and back from 8 s: what lies beyond the stand, as seen from the anchor, is void."""
    at_ns, stood = seconds(3, 5, 7, 8), [(stood_s[0] * NS_PER_S, stood_s[1] * NS_PER_S)]
    begin, end = 2 * NS_PER_S, 8 * NS_PER_S
    from_begin = _are_beyond_stand(at_ns, Gap(begin, end, anchor(2, 0.0), None, []), stood)
    from_end = _are_beyond_stand(at_ns, Gap(begin, end, None, anchor(8, 0.0), []), stood)
    assert (from_begin.tolist(), from_end.tolist()) == (ahead, behind)


def test_since_an_accepted_balise_nothing_is_carried_over_a_stand() -> None:
    """10 m/s; accepted at 1 s, and again at 6 s; the wheel may have slid from 3 to 4 s. 5 m and 5 % of the way."""
    accepted_ns, path_m = seconds(1, 6), np.array([10.0, 60.0])
    stood = [(3 * NS_PER_S, 4 * NS_PER_S)]
    at_ns = seconds(0, 2, 3, 5, 8)
    counted = counting(np.arange(0.0, 110.0, 10.0))
    low_m, high_m = carry_from_accepted(accepted_ns, path_m, at_ns, counted, stood, Configuration())
    assert low_m == pytest.approx([np.nan, 14.5, np.nan, np.nan, 74.0], nan_ok=True)
    assert high_m == pytest.approx([np.nan, 25.5, np.nan, np.nan, 86.0], nan_ok=True)


def test_an_accepted_balise_that_the_odometer_contradicts_carries_nothing() -> None:
    """10 m/s; those of 3 s and 4 s lie 40 m ahead, that of 5 s where it should; 5 m and 5 % of the way."""
    accepted_ns, path_m = seconds(1, 2, 3, 4, 5, 20), np.array([10.0, 20.0, 70.0, 80.0, 50.0, 200.0])
    counted = counting(np.arange(0.0, 110.0, 10.0))
    low_m, high_m = carry_from_accepted(accepted_ns, path_m, seconds(2, 4, 5, 7), counted, [], Configuration())
    assert low_m == pytest.approx([15.0, 34.0, 45.0, 64.0])
    assert high_m == pytest.approx([25.0, 46.0, 55.0, 76.0])


def test_without_an_accepted_balise_nothing_is_carried() -> None:
    counted = counting(np.arange(0.0, 110.0, 10.0))
    nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    low_m, high_m = carry_from_accepted(*nothing, seconds(2, 4), counted, [], Configuration())
    assert np.isnan(low_m).all()
    assert np.isnan(high_m).all()
