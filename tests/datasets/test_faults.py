"""What faults do, hand-worked, and which fault files are refused."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.faults import (
    FaultSpec,
    fault_offset_m,
    faults_table,
    in_sector,
    odometer_increments,
    odometer_speeds,
    position_effect,
)
from schemas.config import settings_from
from schemas.errors import ConfigError


def fault(**values: object) -> FaultSpec:
    return FaultSpec.model_validate({"start_s": 2.0, **values})


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


SECONDS = np.arange(8.0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"kind": "step", "size_m": 30.0, "duration_s": 3.0}, [0, 0, 30, 30, 30, 0, 0, 0]),
        ({"kind": "bias", "size_m": -5.0}, [0, 0, -5, -5, -5, -5, -5, -5]),
        ({"kind": "ramp", "rate_mps": 2.0, "duration_s": 3.0}, [0, 0, 0, 2, 4, 6, 6, 6]),
        ({"kind": "ramp", "rate_mps": 2.0, "duration_s": 3.0, "returns": True}, [0, 0, 0, 2, 4, 0, 0, 0]),
        ({"kind": "ramp", "rate_mps": -1.0}, [0, 0, 0, -1, -2, -3, -4, -5]),
    ],
)
def test_offsets_over_time(values: dict[str, object], expected: list[float]) -> None:
    assert fault_offset_m(fault(**values), SECONDS, rng()).tolist() == expected


def test_noise_bursts_have_their_sigma_and_end() -> None:
    t_s = np.arange(0.0, 4000.0)
    burst = fault_offset_m(fault(kind="noise", sigma_m=3.0, duration_s=3000.0), t_s, rng())
    assert burst[2:3002].std() == pytest.approx(3.0, rel=0.05)
    assert not burst[:2].any()
    assert not burst[3002:].any()


def test_position_faults_add_up_on_their_axes() -> None:
    faults = [
        fault(kind="step", size_m=1.0),
        fault(kind="bias", size_m=2.0),
        fault(kind="step", target="up", size_m=3.0),
        fault(kind="latency", latency_s=0.4, duration_s=1.0),
        fault(kind="outage", duration_s=2.0),
        fault(kind="outage", target="G05"),
    ]
    effect = position_effect(faults, SECONDS, rng())
    assert effect.along_m.tolist() == [0, 0, 3, 3, 3, 3, 3, 3]
    assert effect.up_m[2:].tolist() == [3.0] * 6
    assert effect.latency_s.tolist() == [0, 0, 0.4, 0, 0, 0, 0, 0]
    assert np.flatnonzero(effect.lost).tolist() == [2, 3]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        # 10 m per step of 1 s; slip adds 3 m, slide takes off 4 m, at most all; scale multiplies.
        ({"kind": "slip", "rate_mps": 3.0, "duration_s": 2.0}, [0, 10, 10, 13, 13, 10, 10, 10]),
        ({"kind": "slide", "rate_mps": 4.0, "duration_s": 2.0}, [0, 10, 10, 6, 6, 10, 10, 10]),
        ({"kind": "slide", "rate_mps": 40.0, "duration_s": 2.0}, [0, 10, 10, 0, 0, 10, 10, 10]),
        ({"kind": "scale", "scale": 1.5, "duration_s": 2.0}, [0, 10, 10, 15, 15, 10, 10, 10]),
    ],
)
def test_odometer_faults(values: dict[str, object], expected: list[float]) -> None:
    steps = np.array([0.0, 10, 10, 10, 10, 10, 10, 10])
    assert odometer_increments([fault(**values)], SECONDS, steps).tolist() == expected
    backwards = odometer_increments([fault(**values)], SECONDS, -steps)
    assert np.abs(backwards).tolist() == expected
    assert (backwards <= 0.0).all()


def test_odometer_faults_between_its_rows() -> None:
    steps = np.array([0.0, 10, 10, 10, 10, 10, 10, 10])
    slip = fault(kind="slip", start_s=2.25, duration_s=1.5, rate_mps=4.0)
    assert odometer_increments([slip], SECONDS, steps).tolist() == [0, 10, 10, 13, 13, 10, 10, 10]
    scale = fault(kind="scale", start_s=2.25, duration_s=1.5, scale=1.4)
    assert odometer_increments([scale], SECONDS, steps) == pytest.approx([0, 10, 10, 13, 13, 10, 10, 10])
    speeds = odometer_speeds([slip], SECONDS, np.full(8, 10.0))
    assert speeds.tolist() == [10, 10, 10, 14, 10, 10, 10, 10]
    assert odometer_speeds([slip], SECONDS, np.full(8, -10.0)).tolist() == (-speeds).tolist()


def test_sectors_wrap_around_north() -> None:
    svs = ["G01", "G02", "E01"]
    azimuth, elevation = np.array([[350.0, 20.0, 180.0]]), np.array([[10.0, 40.0, 10.0]])

    def hit(**values: object) -> list[bool]:
        return in_sector(fault(kind="bias", size_m=1.0, **values), svs, azimuth, elevation)[0].tolist()

    assert hit(target="satellites") == [True, True, True]
    assert hit(target="gps") == [True, True, False]
    assert hit(target="galileo") == [False, False, True]
    assert hit(target="G02") == [False, True, False]
    assert hit(target="satellites", azimuth_deg=(300.0, 60.0)) == [True, True, False]
    assert hit(target="satellites", azimuth_deg=(300.0, 60.0), below_deg=20.0) == [True, False, False]


def test_faults_stream() -> None:
    faults = [
        fault(kind="outage", start_s=5.0, duration_s=2.0),
        fault(kind="ramp", rate_mps=0.5, duration_s=4.0),
        fault(kind="slip", rate_mps=6.0, duration_s=0.5),
        fault(kind="step", size_m=30.0, duration_s=100.0, start_s=3.0),
    ]
    rows = faults_table(faults, 0, 10_000_000_000).rows(named=True)
    seconds = [(row["t_start"].timestamp(), row["t_end"].timestamp()) for row in rows]
    # A ramp that stays lasts to the end of the run, and nothing lasts longer.
    assert seconds == [(2.0, 10.0), (2.0, 2.5), (3.0, 10.0), (5.0, 7.0)]
    recorded = [(row["kind"], row["target"], row["size"], row["rate"]) for row in rows]
    assert recorded == [
        ("ramp", "along", 2.0, 0.5),
        ("slip", "odometer", 3.0, 6.0),
        ("step", "along", 30.0, None),
        ("outage", "position", None, None),
    ]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "step"}, "needs size_m"),
        ({"kind": "ramp", "size_m": 3.0}, "needs rate_mps"),
        ({"kind": "step", "size_m": 3.0, "rate_mps": 1.0}, "needs size_m"),
        ({"kind": "outage", "size_m": 3.0}, "needs no quantity"),
        ({"kind": "slip", "rate_mps": 1.0, "target": "along"}, "target odometer"),
        ({"kind": "latency", "latency_s": 1.0, "target": "G01"}, "target position"),
        ({"kind": "step", "size_m": 1.0, "target": "sideways"}, "target"),
        ({"kind": "step", "size_m": 1.0, "below_deg": 20.0}, "below_deg"),
        ({"kind": "explosion"}, "kind"),
        ({"kind": "step", "size_m": 1.0, "durration_s": 3.0}, "durration_s"),
        ({"kind": "step", "size_m": float("nan")}, "size_m"),
    ],
)
def test_faults_that_say_nothing_clear_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings_from({"start_s": 0.0, **values}, FaultSpec, "faults.toml")


@pytest.mark.parametrize("size", [{"size_m": 1e308, "kind": "step"}, {"rate_mps": 1e308, "kind": "slip"}])
def test_what_no_train_can_have_is_refused(size: dict[str, object]) -> None:
    """Positions would be no numbers, and the run would be written all the same."""
    with pytest.raises(ValueError, match="less than or equal to 10000000"):
        FaultSpec.model_validate({"start_s": 1.0, **size})
    with pytest.raises(ValueError, match="less than or equal to 10000000"):
        FaultSpec.model_validate({"kind": "outage", "start_s": 1.0, "duration_s": 1e308})
