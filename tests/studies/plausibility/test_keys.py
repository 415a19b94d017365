"""Each key of `[plausibility]` decides what is said of some recording."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks.truth.plausibility import applies
from pipeline.stages.clean.clean import clean
from pipeline.stages.track.geodesy import points_of
from pipeline.studies.plausibility.check import Check
from pipeline.studies.plausibility.fit import fit_run
from pipeline.studies.plausibility.pairs import clock_lag
from pipeline.studies.plausibility.records import Places, Record
from schemas.config import Configuration, PlausibilityConfig, Vehicle
from schemas.run import RunLog, Site
from tests.studies.plausibility.trips import trip
from tests.studies.plausibility.wrongs import WRONGS

Case = tuple[RunLog, Site, Vehicle]
_WRONGS = {wrong.name: wrong for wrong in WRONGS}
# Key, another value, the recording that it decides on (a wrong of the benchmark, or a seed), other keys of both fits.
REACH: tuple[tuple[str, float, str, dict[str, float]], ...] = (
    ("scale_limit", 0.8, "distance: yards", {}),
    ("reported_scale", 0.5, "distance: yards", {"scale_limit": 0.8}),
    ("lag_limit_s", 12.0, "odometer 10 s later", {}),
    ("reported_lag_s", 4.0, "odometer 3 s later", {}),
    ("reported_shift_m", 0.8, "27", {}),
    ("file_sigmas", 1e4, "vehicle file: 2 % more", {}),
    ("file_scale", 0.5, "vehicle file: 2 % more", {}),
    ("same_line_m", 1e-3, "27", {}),
)
# Asked of copies in `test_copies.py`.
_ELSEWHERE = {"copy_share", "copy_chance"}


@cache
def case(name: str) -> Case:
    """A trip with a wrong in it, or as it is; one has faults besides, which spoil some of its positions."""
    wrong, faults = _WRONGS.get(name.partition(",")[0]), "faults" in name
    if wrong is None:
        drawn = trip(int(name), faulty=False)
        return clean(drawn.run, Configuration())[0], drawn.site, Vehicle()
    if faults:
        drawn = trip(4)
    elif wrong.place is not None:
        drawn = trip(0, place=wrong.place)
    else:
        drawn = next(one for one in (trip(seed, faulty=False) for seed in (27, 26, 29, 7)) if applies(wrong, one))
    vehicle = wrong.vehicle(drawn.scale, drawn.latency_s) if wrong.vehicle else Vehicle()
    site = wrong.site(drawn.site) if wrong.site else drawn.site
    return clean(wrong.change(drawn.run), Configuration())[0], site, vehicle


@cache
def said(name: str, keys: tuple[tuple[str, float], ...]) -> tuple[Check, ...]:
    run, site, vehicle = case(name)
    return fit_run(run, "primary", vehicle, PlausibilityConfig(**dict(keys)), site).checks


def test_every_key_is_tried() -> None:
    assert {key for key, *_ in REACH} | _ELSEWHERE == set(PlausibilityConfig.model_fields)


@pytest.mark.parametrize(("key", "value", "name", "other"), REACH, ids=[key for key, *_ in REACH])
def test_a_key_decides_what_is_said(key: str, value: float, name: str, other: dict[str, float]) -> None:
    assert said(name, tuple((other | {key: value}).items())) != said(name, tuple(other.items()))


def two_clocks(from_s: float) -> tuple[float, str]:
    """The lag of a counter that is stamped 18 s later and knows the first 800 s of a journey whose speed comes back.

    The positions are known from `from_s` on.
    """
    t_s = np.arange(0.0, 1200.0)
    way = np.cumsum(15.0 + 10.0 * np.sin(t_s / 19.1) + 3.0 * np.sin(t_s / 31.0))
    flat = np.zeros_like(way)
    at, known, counted = np.column_stack([way, flat, flat]), t_s >= from_s, t_s < 800.0
    gnss = Places(t_s[known], at[known], points_of(flat[known], flat[known]), flat[known])
    return clock_lag(gnss, Record(t_s[counted] + 18.0, way[counted]))


def test_two_clocks() -> None:
    lag_s, reason = two_clocks(0.0)
    assert (round(lag_s), reason) == (18, "")
