"""Where the train was at given instants, on tables of a few rows worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.evidence import Evidence
from pipeline.evidence.anchors import Coverage, ReferencePlaces
from pipeline.evidence.carrying import Anchor
from pipeline.evidence.evidence import KINDS, NOTHING
from pipeline.evidence.gaps import gaps_of
from pipeline.odometry import odometry_of
from pipeline.track.path import Place, Route
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import Configuration, Vehicle
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


def test_gaps_are_before_between_and_after_what_is_known() -> None:
    """The odometer counts from 0 to 10 s; the reference tells from 2 to 5 s and from 7 to 9 s."""
    at_m: Floats = np.arange(0.0, 110.0, 10.0)
    counted = odometry_of(odometer(at_m), Vehicle(), Configuration())
    assert counted is not None
    a, b, c, d = (anchor(counted.epoch_ns / NS_PER_S + t_s, 10.0 * t_s) for t_s in (2, 5, 7, 9))
    found = gaps_of([(a, b), (c, d)], set(), counted, line("both"), Configuration())
    ends = [((gap.begin_ns - counted.epoch_ns) / NS_PER_S, (gap.end_ns - counted.epoch_ns) / NS_PER_S) for gap in found]
    assert ends == [(0.0, 2.0), (5.0, 7.0), (9.0, 10.0)]
    assert [(gap.begin, gap.end) for gap in found] == [(None, a), (b, c), (d, None)]
