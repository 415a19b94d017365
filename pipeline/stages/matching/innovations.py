"""How the position moves across the tracks, but for what their survey may be wrong (DOMAIN section 2).

Of tracks beside each other the one with the smoother survey would always win. So all of them are judged on one
movement, that of the track against which the position moves least. By how much the surveyed distance of another one
has changed meanwhile is an error of the survey up to `survey_sigmas` √2 sigma, and tells nothing; what goes beyond
does: such tracks part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.arrays import Floats, Ints


@dataclass(frozen=True)
class Innovations:
    """Per state [m]: the movement that all tracks share, in the state's own sense of left, and error of the survey.

    `shared_m` since the step before. `survey_m` is what has been taken for an error of the survey: offset less that
    is the level of the position beside the track as it would be without.
    """

    shared_m: Floats
    survey_m: Floats


def innovations_of(
    first: Ints, offset_m: Floats, heading_rad: Floats, tolerance_m: Floats, before: Ints, keep: Floats
) -> Innovations:
    """Follow every state of the search from step to step.

    `before`: the state of the step before that a state goes on from, -1 for none. `keep`: per step the share of an
    error of the survey that goes on, the rest being its mean by then.
    """
    step = np.repeat(np.arange(len(first) - 1), np.diff(first))
    begun = before < 0
    own_m = np.where(begun, 0.0, offset_m - offset_m[before])
    least = np.lexsort((np.abs(own_m), begun, step))[first[:-1]][step]
    # Elements that are surveyed in opposite senses have opposite sides to their left.
    sense = np.where(np.cos(heading_rad - heading_rad[least]) >= 0.0, 1.0, -1.0)
    shared_m = np.where(begun, 0.0, sense * own_m[least])
    parted_m = sense * (own_m - shared_m)
    return Innovations(shared_m, _errors_m(first, parted_m, tolerance_m, sense, before, keep))


def _errors_m(first: Ints, parted_m: Floats, tolerance_m: Floats, sense: Floats, before: Ints, keep: Floats) -> Floats:
    """What of the movements that differ from the shared one has been taken for an error of the survey [m].

    What is common to all errors nobody can tell from an error of the position: only differences count. So each step all
    are shifted to their median, by no more than it takes: a track that leads aside on its own moves no other. By the
    smallest error a crossover became the measure of both tracks, and lifted them by as much as it led aside.
    """
    parted = parted_m.tolist()
    limit = tolerance_m.tolist()
    side = sense.tolist()
    origin = before.tolist()
    errors = [0.0] * len(parted)
    begins = first.tolist()
    kept = keep.tolist()
    for step in range(1, len(kept) if parted_m.any() else 0):
        rows = [row for row in range(begins[step], begins[step + 1]) if origin[row] >= 0]
        grown = [side[row] * errors[origin[row]] + parted[row] for row in rows]
        if any(grown):
            taken = [min(max(error, -limit[row]), limit[row]) for row, error in zip(rows, grown, strict=True)]
            # As far as no other leaves its tolerance: that would be a parting that counts nowhere.
            lowest = max(error - limit[row] for row, error in zip(rows, taken, strict=True))
            highest = min(error + limit[row] for row, error in zip(rows, taken, strict=True))
            shift = min(max(_common_m(taken, limit[rows[0]]), lowest), highest)
            for row, error in zip(rows, taken, strict=True):
                errors[row] = kept[step] * side[row] * (error - shift)
    return np.array(errors)


def _common_m(errors_m: list[float], limit_m: float) -> float:
    """What of these errors counts as common: their median, as near to nothing as it may be.

    Off every track (no limit) errors are as large as the yard is wide, and its middle measures nothing: the smallest.
    """
    if np.isinf(limit_m):
        return min(errors_m, key=abs)
    ordered = sorted(errors_m)
    lower = ordered[(len(ordered) - 1) // 2]
    upper = ordered[len(ordered) // 2]
    return min(max(0.0, lower), upper)


def movements_m(innovations: Innovations, offset_m: Floats, tolerance_m: Floats, one: Ints, other: Ints) -> Floats:
    """Movement from states to others [m]: the shared one, and what no error of the survey explains."""
    shared_m = innovations.shared_m[other]
    error_m = innovations.survey_m[one] + offset_m[other] - offset_m[one] - shared_m
    limit_m = tolerance_m[other]
    return np.asarray(shared_m + error_m - np.clip(error_m, -limit_m, limit_m))
