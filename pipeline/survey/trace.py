"""What a vehicle recorded, as a line: without standing, without second passes, thinned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pipeline.survey.pieces import COLUMNS, SAME_TRACK_M, SHAPE_M, Piece, Survey
from pipeline.track.geodesy import earth_centred_m, points_of, way_m
from schemas.arrays import Floats, Ints, spans_of

# A stop shrinks to one point: the next counts that is as far away, and farther than the noise reaches.
_STEP_M = 1.0
_STEP_SIGMAS = 6.0
# Farther than any train gets in a second or two, and than ten usual steps: nothing was recorded in between.
_GAP_M = 100.0
_GAP_STEPS = 10.0
# Behind a switch of 300 m radius the branch is 1.5 m aside after 30 m: there the toe is looked for. What is shorter is
# the noise of a pass that was left out.
_TOE_M = 30.0
# Douglas and Peucker take time quadratic in the worst case: on so many points at once it stays linear.
_BLOCK = 2000


def clean_traces(survey: Survey) -> Survey:
    """Recorded pieces cleaned, in order; each pass adds only track that none before it has. Others stay as they are."""
    given = [piece for piece in survey.pieces if not piece.recorded]
    cleaned = replace(survey, pieces=list(given))
    for piece in survey.pieces:
        if piece.recorded:
            moving = piece.take(_moving(piece))
            for number, part in enumerate(_gapless(moving, cleaned), start=1):
                cleaned.pieces += _new_track(part, f"{piece.name}/{number}" if number > 1 else piece.name, cleaned)
    cleaned.pieces = _all_thinned(cleaned.pieces, len(given))
    return cleaned


def _all_thinned(pieces: list[Piece], given: int) -> list[Piece]:
    """All but the first `given` thinned; where a branch leaves another piece, both keep the point."""
    places = [np.column_stack([piece.latitude_deg, piece.longitude_deg]) for piece in pieces]
    shared = np.unique(np.concatenate(places), axis=0, return_inverse=True, return_counts=True) if pieces else None
    if shared is None:
        return pieces
    meets = np.split((shared[2] > 1)[shared[1].ravel()], np.cumsum([len(piece) for piece in pieces])[:-1])
    return [piece if number < given else _thinned(piece, meets[number]) for number, piece in enumerate(pieces)]


def _surface(piece: Piece) -> Floats:
    return points_of(piece.latitude_deg, piece.longitude_deg).surface


def _moving(piece: Piece) -> Ints:
    """Rows that are a step away from the one kept before."""
    places = _surface(piece)
    sigma_m = piece.sigma_m[np.isfinite(piece.sigma_m)]
    step_m = max(_STEP_M, _STEP_SIGMAS * float(np.median(sigma_m))) if len(sigma_m) else _STEP_M
    kept = [0] if len(places) else []
    for row in range(1, len(places)):
        if np.linalg.norm(places[row] - places[kept[-1]]) >= step_m:
            kept.append(row)
    return np.array(kept, dtype=np.int64)


def _gapless(piece: Piece, survey: Survey) -> Iterator[Piece]:
    steps = np.linalg.norm(np.diff(_surface(piece), axis=0), axis=1)
    usual_m = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > max(_GAP_M, _GAP_STEPS * usual_m))
    for gap in gaps:
        text = f"nothing was recorded for {steps[gap]:.0f} m from {_place(piece, int(gap))}"
        survey.told("warning", f"track: {piece.name}", text, "Survey the missing piece.")
    for rows in np.split(np.arange(len(piece)), gaps + 1):
        yield piece.take(rows)


def _place(piece: Piece, row: int) -> str:
    return f"{piece.latitude_deg[row]:.6f}, {piece.longitude_deg[row]:.6f}"


def _new_track(piece: Piece, name: str, survey: Survey) -> list[Piece]:
    """The stretches of a pass that no earlier one covers, itself included, thinned, each with the toe of its switch."""
    parts: list[Piece] = []
    known = list(survey.pieces)
    for lap in _laps(piece):
        covered = _covered(_surface(lap), known)
        way = way_m(_surface(lap))
        for first, last in spans_of(~covered):
            if way[last] - way[first] >= _TOE_M:
                parts.append(_with_toes(lap, first, last, known))
        known = [*survey.pieces, *parts]
        if covered.any():
            share = float(np.mean(covered))
            survey.told("note", f"track: {name}", f"{share:.0%} of a pass lies on track that is known: not doubled")
    named = [f"{name}-{number}" if number > 1 else name for number in range(1, len(parts) + 1)]
    return [replace(part, name=own, recorded=False) for part, own in zip(parts, named, strict=True)]


def _laps(piece: Piece) -> Iterator[Piece]:
    """A pass cut where it turns back or comes to where it was, so that each lap covers a place once."""
    places = _surface(piece)
    way = way_m(places)
    rows = np.arange(len(piece))
    if len(piece) < 3:
        yield piece
        return
    unit = np.diff(places, axis=0)
    turned = np.flatnonzero(np.einsum("ij,ij->i", unit[:-1], unit[1:]) < 0) + 2
    tree = cKDTree(places)
    again = [row for row in rows if _was_here(tree, places, way, int(row))]
    starts = [row for number, row in enumerate(again) if number == 0 or again[number - 1] != row - 1]
    for part in np.split(rows, np.unique(np.concatenate([turned, np.array(starts, dtype=np.int64)]))):
        low = max(int(part[0]) - 1, 0)
        yield piece.take(np.arange(low, int(part[-1]) + 1))


def _was_here(tree: cKDTree, places: Floats, way: Floats, row: int) -> bool:
    """Whether an earlier row, more than two toes back along the way, lies within a step of this one."""
    near = np.array(tree.query_ball_point(places[row], SAME_TRACK_M), dtype=np.int64)
    return bool((way[row] - way[near[near < row]] > 2 * _TOE_M).any())


def _covered(places: Floats, known: list[Piece]) -> np.ndarray:
    """Which places lie on track that is known."""
    if not known:
        return np.zeros(len(places), dtype=bool)
    tree = cKDTree(np.concatenate([_dense(_surface(piece)) for piece in known]))
    return np.asarray(tree.query(places)[0] <= SAME_TRACK_M)


def _with_toes(lap: Piece, first: int, last: int, known: list[Piece]) -> Piece:
    """The stretch, led back over the pass to where the branch left what is known, and on to where it comes back."""
    part = lap.take(np.arange(first, last + 1))
    if first > 0:
        part = _joined(_toe(lap, first, -1, known), part)
    if last < len(lap) - 1:
        part = _joined(part, _toe(lap, last, 1, known))
    return part


def _toe(lap: Piece, row: int, step: int, known: list[Piece]) -> Piece | None:
    """The end of known track that the row goes on from; else the known vertex nearest to where the train was a toe's
    length before (-1) or after (1) the row.
    """
    places = _surface(lap)
    for piece in known:
        line = _surface(piece)
        for end, before in ((0, 1), (len(line) - 1, len(line) - 2)):
            ahead = places[row] - line[end]
            nearest = np.linalg.norm(line - places[row], axis=1).argmin() == end
            if nearest and np.linalg.norm(ahead) < _TOE_M and ahead @ (line[end] - line[before]) > 0:
                return piece.take(np.array([end]))
    other = row
    while 0 <= other + step < len(lap) and np.linalg.norm(places[other] - places[row]) < _TOE_M:
        other += step
    best: tuple[float, Piece | None] = (_TOE_M, None)
    for piece in known:
        way = np.linalg.norm(_surface(piece) - places[other], axis=1)
        if len(way) and way.min() < best[0]:
            best = float(way.min()), piece.take(np.array([int(np.argmin(way))]))
    return best[1]


def _joined(one: Piece | None, other: Piece | None) -> Piece:
    given = [piece for piece in (one, other) if piece is not None]
    columns: dict[str, Any] = {name: np.concatenate([getattr(piece, name) for piece in given]) for name in COLUMNS}
    return replace(given[0], **columns)


def _dense(places: Floats) -> Floats:
    """Points at most a metre apart along a line."""
    if len(places) < 2:
        return places
    way = way_m(places)
    at = np.linspace(0.0, way[-1], int(way[-1]) + 2)
    return np.column_stack([np.interp(at, way, places[:, axis]) for axis in range(3)])


def _thinned(piece: Piece, held: np.ndarray) -> Piece:
    """Without points whose leaving out moves the line by less than `SHAPE_M`; those held stay."""
    height = np.zeros(len(piece)) if np.isnan(piece.height_m).any() else piece.height_m
    places = earth_centred_m(piece.latitude_deg, piece.longitude_deg, height)
    kept = held.copy()
    kept[[*range(0, len(places), _BLOCK), len(places) - 1]] = True
    spans = [tuple(pair) for pair in zip(np.flatnonzero(kept)[:-1], np.flatnonzero(kept)[1:], strict=True)]
    while spans:
        low, high = spans.pop()
        away = _off_chord_m(places[low : high + 1])
        worst = int(np.argmax(away))
        if away[worst] > SHAPE_M:
            kept[low + worst] = True
            spans += [(low, low + worst), (low + worst, high)]
    return piece.take(np.flatnonzero(kept))


def _off_chord_m(places: Floats) -> Floats:
    chord = places[-1] - places[0]
    share = (places - places[0]) @ chord / max(float(chord @ chord), 1e-12)
    foot = places[0] + np.clip(share, 0.0, 1.0)[:, None] * chord
    return np.asarray(np.linalg.norm(places - foot, axis=1))
