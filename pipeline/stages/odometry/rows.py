"""The way from each row of an odometer to the next: by its distance where that says it, else by its speeds.

Rows may hold the one or the other by turns. Between rows far apart distances lie on curves that a train can drive.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from schemas.arrays import Bools, Floats, Ints
from schemas.config import AlignConfig


class Ways(NamedTuple):
    """Per step: way [m], NaN where not known; whether it is of the recorded distance; doubt over a bridged reset."""

    way_m: Floats
    counted: Bools
    doubt_m: Floats


def ways_between(t_s: Floats, distance_m: Floats, speed_mps: Floats, limit_s: float, config: AlignConfig) -> Ways:
    """Ways between rows at these times [s]; `distance_m` and `speed_mps` as recorded, NaN where not.

    Over a leap of the distance the speeds count, if they agree with the distance elsewhere. By turns, nothing is
    interpolated over more than `limit_s`.
    """
    distance_m = _without_spikes(t_s, distance_m, config)
    leap = leaps(t_s, distance_m, config)
    recorded = np.where(leap, np.nan, np.diff(distance_m))
    driven = _trusted(_driven(t_s, speed_mps), recorded, leap, config)
    way_m = np.where(np.isnan(recorded), driven, recorded)
    unknown = np.isnan(way_m)
    if not unknown.any():
        return Ways(way_m, ~np.isnan(recorded), np.zeros(way_m.size))
    # Rows by turns: fill the gaps of either column between its own rows, then decide again.
    carried_m = _carried(t_s, distance_m, limit_s)
    leap = leaps(t_s, carried_m, config) | _resets(t_s, distance_m, config)
    recorded = np.where(unknown & ~leap, np.diff(carried_m), recorded)
    driven = _trusted(_driven(t_s, _carried(t_s, speed_mps, limit_s)), recorded, leap, config)
    counted = ~np.isnan(recorded)
    way_m = np.where(counted, recorded, driven)
    bridged_m = _over_resets(t_s, way_m, leap, config)
    bridged = np.isnan(way_m) & np.isfinite(bridged_m)
    return Ways(bridged_m, counted, np.where(bridged, _bridge_doubt_m(np.diff(t_s), config), 0.0))


def _bridge_doubt_m(dt_s: Floats, config: AlignConfig) -> Floats:
    """By how much the way over a bridged reset may be off (`_over_resets`).

    At most b dt^2 / 4 by speeds at the two rows; and b dt w / 2 more, as the mean over w on either side stands for
    them, where the acceleration changes from +b to -b just there: 1.8 m in all at 1 Hz, where w is 1.5 s.
    """
    braking_mps2 = config.braking_mps2
    doubt_m: Floats = 0.25 * braking_mps2 * dt_s**2 + 0.5 * braking_mps2 * dt_s * _about_s(dt_s, config)
    return doubt_m


def _about_s(dt_s: Floats, config: AlignConfig) -> Floats:
    """Over how long the speed on either side of a reset is taken: rounded stamps take in the row at its edge."""
    about_s: Floats = config.speed_window_s + 0.5 * dt_s
    return about_s


def _over_resets(t_s: Floats, way_m: Floats, leap: Bools, config: AlignConfig) -> Floats:
    """The ways, at leaps of the counter between rows close together by the mean speed about them.

    Where speeds at the two rows could be off by more than `reset_doubt_m` (b dt^2 / 4), the distance is lost.
    """
    dt_s = np.diff(t_s)
    lost = np.flatnonzero(leap & np.isnan(way_m) & (0.25 * config.braking_mps2 * dt_s**2 <= config.reset_doubt_m))
    filled_m = way_m.copy()
    begins_s = t_s[lost] - _about_s(dt_s[lost], config)
    ends_s = t_s[lost + 1] + _about_s(dt_s[lost], config)
    begins = np.searchsorted(t_s, begins_s).tolist()
    ends = (np.searchsorted(t_s, ends_s) - 1).tolist()
    for step, begin, end in zip(lost.tolist(), begins, ends, strict=True):
        known = np.isfinite(way_m[begin:end])
        if known[: step - begin].any() and known[step + 1 - begin :].any():
            filled_m[step] = way_m[begin:end][known].sum() / dt_s[begin:end][known].sum() * dt_s[step]
    return filled_m


def leaps(t_s: Floats, distance_m: Floats, config: AlignConfig) -> Bools:
    """Steps longer than any train can drive, or back as none can: the counter was reset, overflowed or is wrong."""
    leap: Bools = _too_far(np.diff(distance_m), np.diff(t_s), config) | _resets(t_s, distance_m, config)
    return leap


def _too_far(way_m: Floats, dt_s: Floats, config: AlignConfig) -> Bools:
    """Faster than any train; stamps that came in a bunch are allowed `bunched_stamps_m`."""
    far: Bools = np.abs(way_m) > config.fastest_mps * dt_s + config.bunched_stamps_m
    return far


class _Moves(NamedTuple):
    """Steps between known rows in which the distance changes: first and last row, way [m], time [s]."""

    first: Ints
    last: Ints
    way_m: Floats
    time_s: Floats


def _moves(t_s: Floats, distance_m: Floats) -> _Moves:
    rows = np.flatnonzero(np.isfinite(distance_m))
    moves = np.flatnonzero(np.diff(distance_m[rows]))
    first = rows[moves]
    last = rows[moves + 1]
    return _Moves(first, last, distance_m[last] - distance_m[first], t_s[last] - t_s[first])


def _resets(t_s: Floats, distance_m: Floats, config: AlignConfig) -> Bools:
    """Steps from a move back, longer than a train can brake, turn, brake and turn again, to where it counts on."""
    resets = np.zeros(t_s.size - 1, dtype=np.bool_)
    moves = _moves(t_s, distance_m)
    way_m = moves.way_m
    back = (way_m[1:] * way_m[:-1] < 0.0) & (np.abs(way_m[1:]) > _turned_m(moves.time_s[1:], config))
    for move in (np.flatnonzero(back) + 1).tolist():
        resets[moves.first[move] : _counts_on(moves, move, t_s, distance_m, config)] = True
    return resets


def _counts_on(moves: _Moves, back: int, t_s: Floats, distance_m: Floats, config: AlignConfig) -> int:
    """The row from which a counter counts on that was reset in the move `back`; the first row of that if it was not.

    The next move is like the one before: a single wrong row makes one of them longer by as much as it is off.
    """
    begin = int(moves.first[back])
    before_m = moves.way_m[back - 1]
    both_s = t_s[moves.last[back]] - t_s[moves.first[back - 1]]
    # Where it undoes the move before, that was to a wrong row: none but the very next move shows a reset.
    undone = abs(before_m + moves.way_m[back]) <= _turned_m(both_s, config)
    reach = 1 if undone else config.reset_moves
    for after in range(back + 1, min(back + 1 + reach, moves.way_m.size)):
        end = int(moves.last[after - 1])
        most_m = _turned_m(t_s[end] - t_s[begin], config)
        if moves.way_m[after] * before_m > 0.0 and abs(moves.way_m[after] - before_m) <= most_m:
            # Where the train has just driven on over these moves, they are of a few wrong rows.
            driven_m = before_m / moves.time_s[back - 1] * (t_s[end] - t_s[begin])
            return end if abs(distance_m[end] - distance_m[begin] - driven_m) > most_m else begin
    return begin


def _turned_m(dt_s: Floats, config: AlignConfig) -> Floats:
    """The farthest that a distance falls without a reset: by the fixed error, and from rest to rest."""
    return config.reset_back_m + 0.25 * config.braking_mps2 * dt_s**2


def _without_spikes(t_s: Floats, distance_m: Floats, config: AlignConfig) -> Floats:
    """The distance without single rows from which it leaps back to where it was."""
    leap = _too_far(np.diff(distance_m), np.diff(t_s), config)
    if not leap.any():
        return distance_m
    over = leap[1:] & leap[:-1] & ~_too_far(distance_m[2:] - distance_m[:-2], t_s[2:] - t_s[:-2], config)
    cleaned = distance_m.copy()
    cleaned[1:-1][over] = np.nan
    return cleaned


def _trusted(driven_m: Floats, recorded_m: Floats, leap: Bools, config: AlignConfig) -> Floats:
    """None over leaps if speeds and counter disagree elsewhere (a wrong unit, sign or sensor)."""
    both = np.isfinite(recorded_m) & np.isfinite(driven_m)
    if not leap.any() or not both.any():
        return driven_m
    recorded = recorded_m[both]
    driven = driven_m[both]
    apart_m = abs(recorded.sum() - driven.sum())
    most_m = config.speed_agreement * np.abs(recorded).sum()
    return driven_m if apart_m <= most_m else np.where(leap, np.nan, driven_m)


def _driven(t_s: Floats, speed_mps: Floats) -> Floats:
    """By trapezoids [m]."""
    steps: Floats = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s)
    return steps


def _carried(t_s: Floats, values: Floats, limit_s: float) -> Floats:
    """Interpolated between known rows no farther apart than the limit; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return values
    after = np.searchsorted(known, np.arange(values.size)).clip(1, known.size - 1)
    near = t_s[known[after]] - t_s[known[after - 1]] <= limit_s
    inside = (t_s >= t_s[known[0]]) & (t_s <= t_s[known[-1]])
    return np.where(
        np.isfinite(values), values, np.where(near & inside, np.interp(t_s, t_s[known], values[known]), np.nan)
    )


def filled_in(
    t_s: Floats, distance_m: Floats, speed_mps: Floats, rows: Ints, config: AlignConfig
) -> tuple[Floats, Floats, Ints]:
    """Samples with finer ones between the given rows and the next, on cubic curves: times, distances, row of each.

    Slopes at the rows are the speeds where these agree with the way between, else of a monotone curve (PCHIP), and at
    most three times the mean slope, so that the cubic does not turn back (Fritsch and Carlson).
    """
    from scipy.interpolate import PchipInterpolator  # hardly a log needs it, and it takes long to load

    smooth = PchipInterpolator(t_s, distance_m).derivative()(t_s)
    slopes = np.where(np.isfinite(speed_mps), speed_mps, smooth)
    span = t_s[rows + 1] - t_s[rows]
    way = distance_m[rows + 1] - distance_m[rows]
    # With acceleration and braking up to b, mean speed x dt differs from the way by at most b dt^2 / 4.
    true = np.abs(0.5 * (slopes[rows] + slopes[rows + 1]) * span - way) <= 0.25 * config.braking_mps2 * span**2
    low = np.minimum(0.0, 3.0 * way)
    high = np.maximum(0.0, 3.0 * way)
    start, end = (np.clip(np.where(true, slopes[at], smooth[at]) * span, low, high) for at in (rows, rows + 1))
    # Three points in each `straight_s`: the error of a straight line falls with the square of its length, to a ninth.
    fine = np.ceil(3.0 * span / config.straight_s).astype(np.int64)
    which = np.repeat(np.arange(rows.size), fine - 1)
    part = np.concatenate([np.arange(1, count) / count for count in fine.tolist()])
    rest = 1.0 - part
    # Cubic Hermite polynomial.
    curve = part**2 * (3.0 - 2.0 * part) * way[which] + part * rest * (rest * start[which] - part * end[which])
    at_s = np.concatenate([t_s, t_s[rows][which] + part * span[which]])
    order = np.argsort(at_s, kind="stable")
    source = np.concatenate([np.arange(t_s.size), rows[which]])[order]
    return at_s[order], np.concatenate([distance_m, distance_m[rows][which] + curve])[order], source
