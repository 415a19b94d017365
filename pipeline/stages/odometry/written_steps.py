"""The step in which a recorder writes a quantity down: counts of an odometer, decimals of a coordinate."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Bools, Floats

# Numerics: how far a change may be from a multiple of the step, in steps, since written numbers are rounded.
_TOLERANCE = 0.02
# Fewer changes of the change are chance.
FEWEST_BENDS = 8


def step_of(changes: Floats, single: Floats, least: float, rounded: float) -> float:
    """The step that all these changes are multiples of, in their unit; 0 where there is none of at least `least`.

    `single`: differences of which some are of one step; up to `rounded` is none, as decimal numbers are not whole in
    binary. A change that is always the same shows no step.
    """
    single = np.abs(single)
    single = single[single > rounded]
    if not single.size or (step := float(single.min())) < least:
        return 0.0
    steps, multiples = multiples_of(changes, step)
    return step if multiples.all() and np.count_nonzero(np.diff(steps)) >= FEWEST_BENDS else 0.0


def multiples_of(changes: Floats, step: float) -> tuple[Floats, Bools]:
    """How many steps each change is, and whether it is a whole number of them."""
    counts = changes / step
    steps = np.rint(counts)
    whole: Bools = np.abs(counts - steps) < _TOLERANCE
    return steps, whole
