"""What a vehicle recorded, as a line: without standing, without second passes, thinned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from pipeline.make.survey.pieces import LinePiece, Survey
from pipeline.stages.track.geodesy import distance_along_m
from schemas.arrays import Bools, Floats, Ints, spans_of
from schemas.config import SurveyConfig

# Douglas and Peucker take time quadratic in the worst case: on so many points at once it stays linear.
_BLOCK = 2000


def clean_traces(survey: Survey, config: SurveyConfig) -> Survey:
    """Recorded pieces cleaned, in order; each pass adds only track that none before it has. Others stay as they are."""
    # Lines of one point, or none, as loggers write: `make_network` leaves them out with a note.
    short = [piece for piece in survey.pieces if len(piece) < 2]
    surveyed = [piece for piece in survey.pieces if not piece.recorded and len(piece) > 1]
    cleaned = replace(survey, pieces=list(surveyed))
    for piece in survey.pieces:
        if piece.recorded and len(piece) > 1:
            moving = piece.take(_moving_rows(piece, config))
            for number, part in enumerate(_split_at_gaps(moving, cleaned, config), start=1):
                name = f"{piece.name}/{number}" if number > 1 else piece.name
                cleaned.pieces += _new_track(part, name, cleaned, config)
    cleaned.pieces = [*_thin_all(cleaned.pieces, len(surveyed), config.shape_m), *short]
    return cleaned


def _thin_all(pieces: list[LinePiece], surveyed: int, shape_m: float) -> list[LinePiece]:
    """All but the first `given` thinned; where a branch leaves another piece, both keep the point."""
    counts = Counter(place for piece in pieces for place in _coordinates(piece))
    shared = [np.array([counts[place] > 1 for place in _coordinates(piece)], dtype=np.bool_) for piece in pieces]
    thinned = [
        _thin_piece(piece, held, shape_m) for piece, held in zip(pieces[surveyed:], shared[surveyed:], strict=True)
    ]
    return [*pieces[:surveyed], *thinned]


def _coordinates(piece: LinePiece) -> list[tuple[float, float]]:
    """Latitude and longitude of each point."""
    return list(zip(piece.latitude_deg.tolist(), piece.longitude_deg.tolist(), strict=True))


def _moving_rows(piece: LinePiece, config: SurveyConfig) -> Ints:
    """Rows that are a step away from the one kept before."""
    places = piece.surface
    sigma_m = piece.sigma_m[np.isfinite(piece.sigma_m)]
    step_m = max(config.stop_m, config.stop_sigmas * float(np.median(sigma_m)) if len(sigma_m) else 0.0)
    kept = [0] if len(places) else []
    for row in range(1, len(places)):
        if np.linalg.norm(places[row] - places[kept[-1]]) >= step_m:
            kept.append(row)
    return np.array(kept, dtype=np.int64)


def _split_at_gaps(piece: LinePiece, survey: Survey, config: SurveyConfig) -> Iterator[LinePiece]:
    """Parts of a recorded line between gaps."""
    steps = np.linalg.norm(np.diff(piece.surface, axis=0), axis=1)
    usual_m = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > max(config.gap_m, config.gap_steps * usual_m))
    for gap in gaps:
        text = f"nothing was recorded for {steps[gap]:.0f} m from {piece.place_words(int(gap))}"
        survey.report("warning", f"track: {piece.name}", text, "Survey the missing piece.")
    for rows in np.split(np.arange(len(piece)), gaps + 1):
        yield piece.take(rows)


def _new_track(piece: LinePiece, name: str, survey: Survey, config: SurveyConfig) -> list[LinePiece]:
    """The stretches of a pass that no earlier one covers, itself included, thinned, each with its switch toe."""
    parts: list[LinePiece] = []
    known = list(survey.pieces)
    for single_pass in _split_at_repeats(piece, config):
        covered = _are_covered(single_pass.surface, known, config.same_track_m)
        distance_m = distance_along_m(single_pass.surface)
        for first, last in spans_of(~covered):
            if distance_m[last] - distance_m[first] >= config.toe_m:
                parts.append(_with_switch_toes(single_pass, first, last, known, config.toe_m))
        known = [*survey.pieces, *parts]
        if covered.any():
            share = float(np.mean(covered))
            survey.report("note", f"track: {name}", f"{share:.0%} of a pass lies on track that is known: not doubled")
    named = [f"{name}-{number}" if number > 1 else name for number in range(1, len(parts) + 1)]
    return [replace(part, name=own, recorded=False) for part, own in zip(parts, named, strict=True)]


def _split_at_repeats(piece: LinePiece, config: SurveyConfig) -> Iterator[LinePiece]:
    """A pass cut where it turns back or comes to where it was, so that each single pass covers a place once."""
    places = piece.surface
    distance_m = distance_along_m(places)
    rows = np.arange(len(piece))
    if not rows.size:
        return
    unit = np.diff(places, axis=0)
    turned = np.flatnonzero(np.einsum("ij,ij->i", unit[:-1], unit[1:]) < 0) + 2
    tree = cKDTree(places)
    near = tree.query_ball_point(places, config.same_track_m, return_sorted=True)
    # An earlier row, more than two switch toes back along the path, lies within a step of this one.
    again = np.array([distance_m[row] - distance_m[first] > 2 * config.toe_m for row, (first, *_) in enumerate(near)])
    starts = np.flatnonzero(again & ~np.append(False, again[:-1]))
    for part in np.split(rows, np.unique(np.concatenate([turned, starts]))):
        low = max(int(part[0]) - 1, 0)
        yield piece.take(np.arange(low, int(part[-1]) + 1))


def _are_covered(places: Floats, known: list[LinePiece], same_track_m: float) -> np.ndarray:
    """Which places lie on track that is known."""
    if not known:
        return np.zeros(len(places), dtype=bool)
    tree = cKDTree(np.concatenate([_densify(piece.surface) for piece in known]))
    return np.asarray(tree.query(places)[0] <= same_track_m)


def _with_switch_toes(
    single_pass: LinePiece, first: int, last: int, known: list[LinePiece], switch_toe_m: float
) -> LinePiece:
    """The stretch, led back over the pass to where the branch left what is known, and on to where it comes back."""
    part = single_pass.take(np.arange(first, last + 1))
    if first > 0 and (switch_toe := _switch_toe(single_pass, first, -1, known, switch_toe_m)) is not None:
        part = replace(switch_toe.followed_by(part), name=single_pass.name)
    if (
        last < len(single_pass) - 1
        and (switch_toe := _switch_toe(single_pass, last, 1, known, switch_toe_m)) is not None
    ):
        part = part.followed_by(switch_toe)
    return part


def _switch_toe(
    single_pass: LinePiece, row: int, step: int, known: list[LinePiece], switch_toe_m: float
) -> LinePiece | None:
    """The end of known track that the row goes on from; else the known vertex nearest to where the train was a toe's
    length before (-1) or after (1) the row.
    """
    places = single_pass.surface
    for piece in known:
        line = piece.surface
        for end, before in ((0, 1), (len(line) - 1, len(line) - 2)):
            ahead = places[row] - line[end]
            nearest = np.linalg.norm(line - places[row], axis=1).argmin() == end
            if nearest and np.linalg.norm(ahead) < switch_toe_m and ahead @ (line[end] - line[before]) > 0:
                return piece.take([end])
    beyond = row
    while 0 <= beyond + step < len(single_pass) and np.linalg.norm(places[beyond] - places[row]) < switch_toe_m:
        beyond += step
    best: tuple[float, LinePiece | None] = (switch_toe_m, None)
    for piece in known:
        apart_m = np.linalg.norm(piece.surface - places[beyond], axis=1)
        if len(apart_m) and apart_m.min() < best[0]:
            best = float(apart_m.min()), piece.take([int(np.argmin(apart_m))])
    return best[1]


def _densify(places: Floats) -> Floats:
    """Points at most a metre apart along a line, earth-centred [m]."""
    if len(places) < 2:
        return places
    distance_m = distance_along_m(places)
    at = np.linspace(0.0, distance_m[-1], int(distance_m[-1]) + 2)
    return np.column_stack([np.interp(at, distance_m, places[:, axis]) for axis in range(3)])


def _thin_piece(piece: LinePiece, held: Bools, shape_m: float) -> LinePiece:
    """The piece without points whose leaving out moves the line by less than `shape_m`; those held stay."""
    places = piece.positions_3d
    kept = held.copy()
    kept[[*range(0, len(places), _BLOCK), len(places) - 1]] = True
    spans = [tuple(pair) for pair in zip(np.flatnonzero(kept)[:-1], np.flatnonzero(kept)[1:], strict=True)]
    while spans:
        low, high = spans.pop()
        away = _off_chord_m(places[low : high + 1])
        worst = int(np.argmax(away))
        if away[worst] > shape_m:
            kept[low + worst] = True
            spans += [(low, low + worst), (low + worst, high)]
    return piece.take(np.flatnonzero(kept))


def _off_chord_m(places: Floats) -> Floats:
    """Distance of points from the chord between the first and the last [m]."""
    chord = places[-1] - places[0]
    share = (places - places[0]) @ chord / max(float(chord @ chord), 1e-12)
    foot = places[0] + np.clip(share, 0.0, 1.0)[:, None] * chord
    return np.asarray(np.linalg.norm(places - foot, axis=1))
