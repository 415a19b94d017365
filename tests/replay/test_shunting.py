"""A zig-zag over a switch: balises on an element that several legs share are seen each time they are passed."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.one_run import replay
from schemas.config import Vehicle
from schemas.inputs import Balises, Gnss, Odometer
from schemas.run import RunLog, Site
from tests.stages.matching import builders
from tests.stages.matching.builders import line

KNOWN = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.005)
SPEED_MPS, RATE_HZ = 20.0, 10.0
_UNSAID = {"sensor": "primary"}


def moved(distance_m):
    """A stretch from standstill to standstill, 0.5 m/s2, at the epochs [m]."""
    duration_s = distance_m / SPEED_MPS + SPEED_MPS / 0.5
    t = np.arange(0.0, duration_s, 1.0 / RATE_HZ)
    speed = np.clip(np.minimum(0.5 * t, 0.5 * (duration_s - t)), 0.0, SPEED_MPS)
    return np.cumsum(speed) / RATE_HZ


def zigzag():
    """In on `a`, over the switch at 0 to `b`, back over it to `c` (2500 m to the west), and again to `b`.

    Way along: 3900 m ahead, 3000 m back, 3000 m ahead; `x` counts along the track from the switch.
    """
    ahead, back = moved(3900.0), moved(3000.0)
    way = np.concatenate([np.zeros(100), ahead, np.full(300, ahead[-1]), ahead[-1] - back])
    way = np.concatenate([way, np.full(300, way[-1]), way[-1] + back, np.full(50, way[-1] + back[-1])])
    x = way - 2900.0
    on_c = (x < 0.0) & (np.arange(way.size) > 100 + ahead.size)
    toward_c = np.array([-2500.0, -300.0]) / np.hypot(2500.0, 300.0)
    return way, np.where(on_c, -x * toward_c[0], x), np.where(on_c, -x * toward_c[1], 0.0)


def shunting():
    elements = {"a": line((-3000, 0), (0, 0)), "b": line((0, 0), (1500, 0)), "c": line((0, 0), (-2500, -300))}
    bare = builders.site(elements, [("a", 1, "b", 0, "both"), ("b", 0, "c", 0, "both")])
    balises = pl.DataFrame(
        [("A1", "a", 1000.0), ("A2", "a", 2500.0), ("B1", "b", 300.0), ("B2", "b", 700.0), ("C1", "c", 1500.0)],
        schema=["balise_id", "netelement_id", "measure_m"],
        orient="row",
    ).with_columns(
        kind=pl.lit("virtual"),
        location_accuracy_m=pl.lit(12.0),
        linked=pl.lit(True),
        link_reaction=pl.lit("service_brake"),
        direction=pl.lit("both"),
    )
    way, x, y = zigzag()
    noise = np.random.default_rng(3).standard_normal((3, way.size))
    slow = [np.convolve(part, np.ones(200) / 200.0**0.5, "same") for part in noise]
    gnss = stream(Gnss, builders.run(x + 0.5 * slow[0], y + 0.3 * slow[1], RATE_HZ))
    odometer = stream(Odometer, builders.odometer(way + 0.05 * np.cumsum(noise[2]) / RATE_HZ**0.5, RATE_HZ))
    site = Site(bare.track, bare.links, balises=Balises.validate(balises, cast=True))
    return RunLog("shunting", gnss, odometer=odometer), site


def stream(schema, frame):
    columns = schema.columns()
    missing = [pl.lit(_UNSAID.get(name)).alias(name) for name in columns if name not in frame.columns]
    return schema.validate(frame.with_columns(missing).select(list(columns)), cast=True)


def test_each_passage_of_a_shared_element_is_seen():
    tables = replay(*shunting(), KNOWN)
    rows = tables.passages.select("balise_id", "direction", "status").rows()
    expected = [("A1", 1), ("A2", 1), ("B1", 1), ("B2", 1), ("B2", -1), ("B1", -1), ("C1", -1), ("C1", 1)]
    expected += [("B1", 1), ("B2", 1)]
    names = {1: "growing", -1: "falling"}
    assert rows == [(name, names[sense], "accepted") for name, sense in expected]
    assert tables.alarms.height == 0
    assert tables.hazards.height == 0
