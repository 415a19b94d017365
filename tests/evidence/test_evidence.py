"""Where the train was at given instants, on tables of a few rows worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipeline.evidence import Evidence, evidence_of
from pipeline.evidence.anchors import Coverage, ReferencePlaces, coverages, facing_of
from pipeline.evidence.carrying import Anchor
from pipeline.evidence.evidence import KINDS, NOTHING, _after_standing
from pipeline.evidence.gaps import Gap, gaps_of
from pipeline.odometry import Odometry, odometry_of
from pipeline.track.path import Place, Route
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import Configuration, HazardConfig, Vehicle
from schemas.enums import Evidence as Kind
from tests.evidence.test_chains import line
from tests.matching.builders import odometer

REFERENCE = KINDS.index(Kind.REFERENCE)


def seconds(*t_s: float) -> Ints:
    return np.array([round(t * NS_PER_S) for t in t_s], dtype=np.int64)


def anchor(t_s: float, at_m: float) -> Anchor:
    return Anchor(round(t_s * NS_PER_S), Place(0, at_m), 1.0, Kind.REFERENCE)


def by_reference() -> Evidence:
    """Samples at 0, 1 and 2 s, 10 m apart from 10 m on; as likely are elements 1 at the first, 2 and 3, then 4."""
    route = Route(*(np.array([value]) for value in (0, True, 0.0, 0.0, 100.0)))
    reference = ReferencePlaces(
        seconds(0, 1, 2), np.zeros(3, np.int64), np.array([10.0, 20.0, 30.0]), np.array([1.0, 2.0, 1.0]), (route,),
        np.array([0, 1, 1, 2]), np.array([1, 2, 3, 4]), seconds(),
    )  # fmt: skip
    covered = Coverage(0, 2, anchor(0, 10.0), anchor(2, 30.0))
    return Evidence(reference, (covered,), (), None, line("both"), Configuration(), 0, (), 0)


def test_a_reference_tells_from_its_first_sample_to_its_last() -> None:
    """Between samples on straight lines, at three times the larger sigma, with the rivals of both."""
    found = by_reference().at(seconds(-1, 0, 0.5, 1, 1.5, 2, 2.5))
    assert found.kind.tolist() == [NOTHING, *[REFERENCE] * 5, NOTHING]
    (told,) = found.alternatives
    assert told.rows.tolist() == [1, 2, 3, 4, 5]
    assert told.low_m == pytest.approx([7.0, 9.0, 14.0, 19.0, 27.0])
    assert told.high_m == pytest.approx([13.0, 21.0, 26.0, 31.0, 33.0])
    pairs = list(zip(found.rival_row.tolist(), found.rival_element.tolist(), strict=True))
    assert pairs == [(1, 1), (2, 1), (2, 2), (2, 3), (3, 2), (3, 3), (4, 2), (4, 3), (4, 4), (5, 4)]


def test_where_nobody_knows_the_reference_tells_nothing() -> None:
    known = replace(by_reference(), unknown=((round(0.4 * NS_PER_S), NS_PER_S),))
    assert known.at(seconds(0, 0.4, 0.5, 1)).kind.tolist() == [REFERENCE, NOTHING, NOTHING, REFERENCE]


def counting(at_m: Floats) -> Odometry:
    """An odometer that counts so much each second from 0 s on."""
    found = odometry_of(odometer(at_m), Vehicle(), Configuration())
    assert found is not None
    assert found.epoch_ns == 0
    return found


def test_gaps_are_before_between_and_after_what_is_known() -> None:
    """The odometer counts from 0 to 10 s; the reference tells from 2 to 5 s and from 7 to 9 s."""
    a, b, c, d = (anchor(t_s, 10.0 * t_s) for t_s in (2, 5, 7, 9))
    found = gaps_of([(a, b), (c, d)], set(), counting(np.arange(0.0, 110.0, 10.0)), line("both"), Configuration())
    assert [(gap.begin_ns, gap.end_ns) for gap in found] == [
        tuple(seconds(*ends)) for ends in ((0, 2), (5, 7), (9, 10))
    ]
    assert [(gap.begin, gap.end) for gap in found] == [(None, a), (b, c), (d, None)]


@pytest.mark.parametrize(("counted_mps", "share", "known"), [(10.0, 0.0, True), (14.0, 0.0, False), (14.0, 0.4, True)])
def test_where_the_odometer_slipped_a_longer_way_is_one_too(counted_mps: float, share: float, known: bool) -> None:
    """60 m in 6 s: 84 m are beyond 5 m, 5 % of the way and 6 m of noise; with 40 % of slip they are not."""
    config = Configuration(hazards=HazardConfig(slip_m=0.0, slip_share=share))
    a, b = anchor(2, 20.0), anchor(8, 80.0)
    _, between, _ = gaps_of([(a, a), (b, b)], set(), counting(np.arange(11) * counted_mps), line("both"), config)
    assert bool(between.ways) is known


def test_a_reference_is_left_where_it_pauses_or_lies_nowhere() -> None:
    """Samples each second; none from 3 to 6 s, and one at 7.5 s on no track. The odometer counts from 1 s to 8 s."""
    t_ns = seconds(0, 1, 2, 3, 6, 7, 8, 9)
    known = by_reference().reference
    assert known is not None
    nothing, leg = np.zeros(0, dtype=np.int64), np.zeros(8, dtype=np.int64)
    reference = replace(
        known, t_ns=t_ns, leg=leg, path_m=t_ns / NS_PER_S, sigma_m=np.ones(8), rival_sample=nothing,
        rival_element=nothing, lost_ns=seconds(7.5),
    )  # fmt: skip
    counted = odometry_of(
        odometer(np.arange(8.0)).with_columns(pl.col("t") + pl.duration(seconds=1)), Vehicle(), Configuration()
    )
    found = coverages(reference, counted, HazardConfig(reference_gap_s=2.0))
    assert [(one.first, one.last) for one in found] == [(0, 3), (4, 5), (6, 7)]
    times = [(one.begin.t_ns, one.end.t_ns) for one in found]
    assert times == [tuple(seconds(*ends)) for ends in ((1, 3), (6, 7), (8, 8))]
    # Without an odometer nothing can be carried from any of them: the outermost samples stand for all.
    silent = coverages(reference, None, HazardConfig(reference_gap_s=2.0))
    assert [(one.begin.t_ns, one.end.t_ns) for one in silent] == [
        tuple(seconds(*ends)) for ends in ((0, 3), (6, 7), (8, 9))
    ]
    assert coverages(replace(reference, t_ns=nothing), counted, HazardConfig()) == []


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
    """10 m each second: two reads are true to 3 m at three sigmas, the way of some seconds to hardly more."""
    counted = counting(np.arange(0.0, 110.0, 10.0))
    known = evidence_of(None, READS, BALISES, counted, line("both"), Configuration())
    found = known.at(seconds(0, 3, 8))
    assert found.kind.tolist() == [KINDS.index(Kind.BALISE)] * 3
    rows = {int(row): (low, high) for one in found.alternatives for row, low, high in zip(
        one.rows, *(one.route.locate(at_m)[1] for at_m in (one.low_m, one.high_m)), strict=True)}  # fmt: skip
    assert sorted(rows[0]) == pytest.approx([-5.5, 5.5], abs=1e-6)
    assert sorted(rows[2]) == pytest.approx([74.0, 86.0], abs=1e-6)
    least, most = sorted(rows[1])
    assert 26.5 < least < 27.0
    assert 33.0 < most < 33.5


def test_reads_are_anchors_where_the_reference_does_not_tell() -> None:
    """The reference tells from 0 to 2 s: the read at 1 s is no anchor, that at 6 s is."""
    counted = counting(np.arange(0.0, 110.0, 10.0))
    moved = by_reference().reference
    assert moved is not None
    reference = replace(moved, path_m=np.array([0.0, 10.0, 20.0]))
    known = evidence_of(reference, READS, BALISES, counted, line("both"), Configuration())
    assert (len(known.covered), known.disputed) == (1, 0)
    kinds = [[(one.t_ns // NS_PER_S, one.kind) for one in gap.anchors] for gap in known.gaps]
    begin, end, read = (0, Kind.REFERENCE), (2, Kind.REFERENCE), (6, Kind.BALISE)
    assert kinds == [[begin], [end, read], [read]]


@pytest.mark.parametrize(
    ("counts", "least_m", "expected"), [(10.0, 15.0, {0}), (-10.0, 15.0, {1}), (10.0, 25.0, set())]
)
def test_the_reference_tells_which_way_the_odometer_counts(counts: float, least_m: float, expected: set[int]) -> None:
    """20 m along growing path from 0 to 2 s: element 0 is run forward as the odometer counts up, or backward."""
    known = by_reference()
    assert known.reference is not None
    odometer = counting(100.0 + counts * np.arange(0.0, 5.0))
    assert facing_of(known.reference, list(known.covered), odometer, least_m) == expected


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
    from_begin = _after_standing(at_ns, Gap(begin, end, anchor(2, 0.0), None, []), stood)
    from_end = _after_standing(at_ns, Gap(begin, end, None, anchor(8, 0.0), []), stood)
    assert (from_begin.tolist(), from_end.tolist()) == (ahead, behind)
