"""Random worlds with what recorders do to their evidence: one seed, one of four kinds.

`lost`: the counter is silent for some seconds of the ride and begins again at zero. `clocks`: the reference is stamped
up to half a second off, the reads, too few to measure their clock, up to a tenth (DOMAIN 5.1). `aside`: the reference
steps aside for 40 s, which no assumption allows. `two`: a second odometer that errs by itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from tests.stages.judge.random_worlds import Draw, random_journey
from tests.stages.judge.sensors import START_NS, Counter, odometer
from tests.stages.judge.world import Journey, make_journey

KINDS = ("lost", "clocks", "aside", "two")
SECOND_S = 1_000_000_000


def crooked_journey(seed: int) -> Journey:
    """The random journey of the seed with one more crookedness, by turns."""
    draw, kind = Draw(np.random.default_rng([seed, 34])), KINDS[seed % len(KINDS)]
    journey = random_journey(seed)
    if kind == "lost":
        return _lost(draw, journey)
    if kind == "clocks":
        return _clocks(draw, journey)
    if kind == "aside":
        return _aside(draw, journey, seed)
    return _two(draw, journey)


def _with(journey: Journey, kind: str, **streams: pl.DataFrame | None) -> Journey:
    return replace(journey, name=f"{journey.name} {kind}", run=journey.run.with_streams(**streams))


def _lost(draw: Draw, journey: Journey) -> Journey:
    """The distance of 2 to 15 s is lost; what is counted after it begins at zero."""
    rows = journey.run.odometer
    assert rows is not None
    begin_s = draw.between(40.0, journey.ride.length_s - 60.0)
    begin, end = (pl.lit(START_NS + round(at * SECOND_S)) for at in (begin_s, begin_s + draw.between(2.0, 15.0)))
    t = pl.col("t").dt.epoch("ns")
    zero = rows.filter(t >= end)["distance_m"][0]
    left = pl.when(t >= end).then(pl.col("distance_m") - zero).otherwise("distance_m")
    return _with(journey, "lost", odometer=rows.with_columns(distance_m=left).filter((t < begin) | (t >= end)))


def _clocks(draw: Draw, journey: Journey) -> Journey:
    moved: dict[str, pl.DataFrame | None] = {}
    for name, most_s in (("reference", 0.5), ("balise_reads", 0.1)):
        frame = getattr(journey.run, name)
        late = pl.duration(nanoseconds=round(draw.between(-most_s, most_s) * SECOND_S), time_unit="ns")
        moved[name] = None if frame is None else frame.with_columns(t=pl.col("t") + late)
    return _with(journey, "clocks", **moved)


def _aside(draw: Draw, journey: Journey, seed: int) -> Journey:
    better = journey.world.better
    assert better is not None
    begin_s = draw.between(40.0, journey.ride.length_s - 90.0)
    aside = (begin_s, begin_s + 40.0, draw.sign() * draw.between(15.0, 60.0))
    world = replace(journey.world, better=replace(better, aside=aside))
    return make_journey(world, seed, f"{journey.name} aside")


def _two(draw: Draw, journey: Journey) -> Journey:
    """The second one has a scale and noise of its own, and no slip."""
    first = journey.run.odometer
    counter = journey.world.counter
    assert first is not None
    assert counter is not None
    scale = counter.scale * (1.0 + draw.between(-2e-4, 2e-4))
    other = odometer(draw.rng, journey.ride, Counter(draw.one(1.0, 5.0, 10.0), scale, 0.05, counter.polarity))
    return _with(journey, "two", odometer=pl.concat([first, other.with_columns(sensor=pl.lit("radar"))]))
