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
    """Per state the part of its movement, beyond the shared one, that counts as an error of the survey [m].

    What is common to all errors cannot be told from an error of the position: only differences count. So at each step
    all errors are shifted by their median: a single track that leads aside does not move the others. (By the smallest
    error, a crossover would become the measure of both tracks and shift them as it leads aside.)
    """
    if not parted_m.any():
        return np.zeros(parted_m.size)
    parted = parted_m.tolist()
    limit = tolerance_m.tolist()
    side = sense.tolist()
    origin = before.tolist()
    begins = first.tolist()
    errors = [0.0] * len(parted)
    for step, lasting in enumerate(keep.tolist()[1:], start=1):
        rows = [row for row in range(begins[step], begins[step + 1]) if origin[row] >= 0]
        # In the sense of the track that all are judged on; `side` turns an error into it and back.
        grown = [side[row] * errors[origin[row]] + parted[row] for row in rows]
        if any(grown):
            shifted = _differences_m(grown, [limit[row] for row in rows])
            for row, error in zip(rows, shifted, strict=True):
                errors[row] = lasting * side[row] * error
    return np.array(errors)


def _differences_m(errors_m: list[float], limits_m: list[float]) -> list[float]:
    """Errors of one step within their tolerances, less what is common to them.

    They are shifted only as far as none leaves its tolerance: that would be a parting that counts nowhere.
    """
    clipped = [min(max(error, -limit), limit) for error, limit in zip(errors_m, limits_m, strict=True)]
    lowest = max(error - limit for error, limit in zip(clipped, limits_m, strict=True))
    highest = min(error + limit for error, limit in zip(clipped, limits_m, strict=True))
    shift = min(max(_common_m(clipped, limits_m[0]), lowest), highest)
    return [error - shift for error in clipped]


def _common_m(errors_m: list[float], limit_m: float) -> float:
    """The common part of these errors: their median, of two middle values the nearest to 0 between them.

    Off every track (no limit) errors are as large as the yard is wide, and its middle says nothing: then the smallest.
    """
    if np.isinf(limit_m):
        return min(errors_m, key=abs)
    ordered = sorted(errors_m)
    lower = ordered[(len(ordered) - 1) // 2]
    upper = ordered[len(ordered) // 2]
    return min(max(0.0, lower), upper)


def movements_m(innovations: Innovations, offset_m: Floats, tolerance_m: Floats, before: Ints, after: Ints) -> Floats:
    """Movement across the track between pairs of states [m]: the shared one, plus what the survey cannot explain.

    The change of a track's distance, together with the error so far, counts as an error of the survey within
    `tolerance_m`; only the excess over that is movement.
    """
    shared_m = innovations.shared_m[after]
    error_m = innovations.survey_m[before] + offset_m[after] - offset_m[before] - shared_m
    limit_m = tolerance_m[after]
    return np.asarray(shared_m + error_m - np.clip(error_m, -limit_m, limit_m))
