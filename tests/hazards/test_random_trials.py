"""Seeded random faults: what is found against what the definitions say, worked out in continuous time.

Sizes keep more than three sigma (0.3 m of noise) from every limit, VBs as far from the ends of a jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.hazards import Case, classify, establish_truth
from schemas.config import Configuration
from tests.hazards.synthetic import Journey, locate, seconds

NOISE_M = 0.3
LIMIT_M = 20.0
MARGIN_M = 3.0


@dataclass(frozen=True)
class Expected:
    hazard: str
    balise_ids: list[str]
    t_hazard: float
    timing: str
    caused_by: int | None = None


def ids_between(journey, a_m, b_m):
    lo, hi = min(a_m, b_m), max(a_m, b_m)
    names = [f"V{i}" for i, place in enumerate(journey.balises_m) if lo < place <= hi]
    return names if b_m > a_m else names[::-1]


def near_edge(journey, *ends_m):
    """A VB lies where sampling decides whether the position reaches it: within an epoch before an end."""
    epoch_m = journey.speed_mps / journey.rate_hz
    return any(end - epoch_m - MARGIN_M < place < end + MARGIN_M for place in journey.balises_m for end in ends_m)


def jump_class(ids):
    return "VB_JUMP_1A" if len(ids) > 1 else "VB_JUMP_1B"


def expect_step(journey):
    """Hazards of one step in the direction of growing path, or None where a VB lies too near an edge."""
    ((begin, end, size),) = journey.steps
    lasts = end >= journey.duration_s
    end = min(end, journey.duration_s)
    v = journey.speed_mps
    at, until = journey.start_m + v * begin, journey.start_m + v * end
    if near_edge(journey, at, at + size, until, until + size):
        return None
    crossed = ids_between(journey, at, at + size)
    # Offered while the error stays: the position runs from at + size to until + size.
    offered = ids_between(journey, at + size, until + size)
    timing = "early" if size > 0 else "late"
    back = [] if lasts else ids_between(journey, until + size, until)
    if not crossed and not offered:
        return [Expected(jump_class(back), back, end, timing)] if back else []
    ids = list(dict.fromkeys(crossed + offered))
    if crossed:
        first = Expected(jump_class(crossed), ids, begin, timing)
    else:
        place = journey.balises_m[int(offered[0][1:])]
        first = Expected("VB_SHIFT", ids, (place - size - journey.start_m) / v, timing)
    return [first] + ([Expected(jump_class(back), back, end, timing, 0)] if back else [])


def expect_ramp(journey):
    ((begin, end, rate),) = journey.ramps
    v, sign = journey.speed_mps, np.sign(rate)
    hits = []
    for index, place in enumerate(journey.balises_m):
        t = (place - journey.start_m + rate * begin) / (v + rate)
        error = abs(rate * (t - begin))
        if begin < t < end + 0.2 and abs(error - LIMIT_M) < MARGIN_M:
            return None
        if begin < t < end and error > LIMIT_M:
            hits.append((t, f"V{index}"))
    peak = rate * (end - begin)
    until = journey.start_m + v * end
    if near_edge(journey, until, until + peak) or abs(abs(peak) - LIMIT_M) < MARGIN_M:
        return None
    back = ids_between(journey, until + peak, until) if abs(peak) > LIMIT_M else []
    timing = "early" if sign > 0 else "late"
    if not hits:
        return [Expected(jump_class(back), back, end, timing)] if back else []
    first = Expected("VB_SHIFT", [name for _, name in hits], hits[0][0], timing)
    return [first] + ([Expected(jump_class(back), back, end, timing, 0)] if back else [])


def draw(seed):
    rng = np.random.default_rng(seed)
    rate_hz = float(rng.choice([1.0, 5.0, 10.0]))
    spacing = float(rng.uniform(120.0, 420.0))
    base = Journey(
        duration_s=150.0,
        rate_hz=rate_hz,
        speed_mps=float(rng.uniform(8.0, 40.0)),
        balises_m=tuple(np.arange(60.0, 8000.0, spacing)),
        sigma_m=NOISE_M,
    )
    begin = float(rng.integers(30, 80))
    if rng.random() < 0.6:
        size = float(rng.choice([-1.0, 1.0]) * rng.choice([rng.uniform(24.0, 60.0), rng.uniform(60.0, 900.0)]))
        end = float(begin + rng.integers(3, 50)) if rng.random() < 0.8 else 500.0
        return base.but(steps=((begin, end, size),)), rng
    rate = float(rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(np.log(0.3), np.log(4.0))))
    return base.but(ramps=((begin, begin + float(rng.integers(15, 60)), rate),)), rng


def replay(journey, rng):
    config = Configuration()
    epochs = journey.epochs()
    noise = rng.normal(0.0, NOISE_M, epochs.height)
    epochs = epochs.with_columns(path_m=epochs["path_m"] + noise)
    passages = journey.passages()
    truth = establish_truth(epochs, journey.reference_frame(), None, passages, config)
    return classify(
        Case("primary", epochs, truth, passages, journey.balises(), None, locate, config)
    ).hazards.to_dicts()


@pytest.mark.parametrize("block", range(10))
def test_random_faults_are_found_and_nothing_else(block):
    judged = 0
    for seed in range(block * 30, block * 30 + 30):
        journey, rng = draw(seed)
        expected = expect_step(journey) if journey.steps else expect_ramp(journey)
        if expected is None:
            continue
        judged += 1
        found = replay(journey, rng)
        said = [(row["hazard"], row["balise_ids"], row["timing"], row["caused_by"]) for row in found]
        wanted = [(e.hazard, e.balise_ids, e.timing, e.caused_by) for e in expected]
        assert said == wanted, (seed, journey.steps, journey.ramps, journey.speed_mps)
        for row, item in zip(found, expected, strict=True):
            tolerance = 1.0 / journey.rate_hz + 6.0 * NOISE_M / journey.speed_mps
            assert seconds(row["t_hazard"]) == pytest.approx(item.t_hazard, abs=tolerance), seed
    assert judged >= 10
