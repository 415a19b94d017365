"""Each key of `[plausibility]` decides what is said of some recording."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks.plausibility import applies
from benchmarks.plausibility_trips import trip
from benchmarks.plausibility_wrongs import WRONGS
from pipeline.stages.clean.clean import clean
from pipeline.studies.plausibility.check import Check
from pipeline.studies.plausibility.fit import fit_run
from pipeline.studies.plausibility.pairs import clock_lag
from pipeline.studies.plausibility.records import Places, Record
from schemas.config import Configuration, PlausibilityConfig, Vehicle
from schemas.run import RunLog, Site

Case = tuple[RunLog, Site, Vehicle]
_WRONGS = {wrong.name: wrong for wrong in WRONGS}
# Key, another value, the recording that it decides on (a wrong of the benchmark, or a seed), other keys of both fits.
REACH: tuple[tuple[str, float, str, dict[str, float]], ...] = (
    ("scale_limit", 0.8, "distance: yards", {}),
    ("scale_told", 0.5, "distance: yards", {"scale_limit": 0.8}),
    ("lag_limit_s", 12.0, "odometer 10 s later", {}),
    ("lag_told_s", 4.0, "odometer 3 s later", {}),
    ("shift_told_m", 0.8, "27", {}),
    ("moving_mps", 0.1, "27", {}),
    ("speed_s", 1.0, "27", {}),
    ("bridged_periods", 1e-3, "27", {"speed_s": 0.45}),
    ("overlap_s", 900.0, "odometer later: GPS time", {}),
    ("speed_change", 0.9, "odometer later: GPS time", {}),
    ("speeds_agree", 0.1, "odometer later: GPS time", {}),
    ("speed_alike_share", 0.9, "odometer 10 s later", {}),
    ("speed_alike_usual", 0.9, "odometer later: GPS time", {}),
    ("speed_lag_s", 0.05, "odometer later: GPS time", {}),
    ("slow_share", 0.9, "27", {}),
    ("window_m", 1500.0, "27", {}),
    ("window_least_s", 40.0, "27", {}),
    ("window_most_s", 9.0, "27", {"window_m": 1500.0}),
    ("window_agrees", 1e-4, "odometer speed: km/h", {}),
    ("lag_sigma_s", 1e-4, "27", {}),
    ("told_sigmas", 1e4, "distance: yards", {}),
    ("heading_s", 200.0, "27", {}),
    ("heading_way", 1e-3, "27", {}),
    ("heading_cosine", 0.99999, "27", {}),
    ("passing_s", 1e-3, "reads 1 h later", {}),
    ("passing_share", 0.999, "reference later: GPS time", {}),
    ("unit_share", 1e-9, "odometer speed: km/h", {}),
    ("unit_windows", 0.999, "odometer speed: km/h", {"window_agrees": 0.01}),
    ("pulses_windows", 0.999, "distance: pulses", {"window_agrees": 0.005, "unit_windows": 0.01}),
    ("pulses_factor", 100.0, "distance: pulses", {}),
    ("clock_near_s", 8.5, "odometer 10 s later", {}),
    ("same_clock_s", 1e-4, "GNSS in GPS time", {}),
    ("file_sigmas", 1e4, "vehicle file: 2 % more", {}),
    ("file_scale", 0.5, "vehicle file: 2 % more", {}),
    ("same_place_m", 1e-3, "reference later: GPS time", {}),
    ("read_m", 1e-3, "reads 1 h later", {}),
    ("same_line_m", 1e-3, "27", {}),
    ("velocity_share", 1e-3, "27", {}),
    ("velocity_mps", 200.0, "27", {}),
    ("velocity_turned", 0.99, "velocity: east", {}),
    ("velocity_explained", 1e-3, "velocity: axes", {}),
    ("climb_agrees", 0.999, "27", {}),
    ("climb_mps", 50.0, "27", {}),
    ("one_heading", 0.9, "survey 15 m aside", {}),
    ("shift_leaves", 1e-3, "survey 15 m aside", {}),
    ("shift_positions", 0.9999, "survey 60 m askew, with faults", {}),
    ("datum_near_m", 1e-3, "survey in EPSG:4314", {"datum_near_share": 1e-6}),
    ("datum_near_share", 1e-6, "survey in EPSG:4314", {"datum_near_m": 1e-3}),
)
# Asked of two clocks below, and of copies in `test_copies.py`.
_ELSEWHERE = {"overlap_share", "lag_rival", "copy_share", "copy_chance", "same_stamp_s", "without_error"}


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


def two_clocks(from_s: float, **keys: float) -> tuple[float, str]:
    """The lag of a counter that is stamped 18 s later and knows the first 800 s of a journey whose speed comes back.

    The positions are known from `from_s` on.
    """
    config = PlausibilityConfig(**keys)
    t_s = np.arange(0.0, 1200.0)
    way = np.cumsum(15.0 + 10.0 * np.sin(t_s / 19.1) + 3.0 * np.sin(t_s / 31.0))
    flat = np.zeros_like(way)
    at, known, counted = np.column_stack([way, flat, flat]), t_s >= from_s, t_s < 800.0
    gnss = Places(t_s[known], at[known], config, flat[known], flat[known], flat[known])
    return clock_lag(gnss, Record(t_s[counted] + 18.0, way[counted], config))


def test_keys_of_two_clocks() -> None:
    lag_s, reason = two_clocks(0.0)
    assert (round(lag_s), reason) == (18, "")
    assert "several shifts" in two_clocks(0.0, lag_rival=0.9)[1]
    assert two_clocks(400.0, overlap_share=0.9) != two_clocks(400.0), "half of the shorter record is in common"
