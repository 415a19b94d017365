"""What is doubtful about a network made of a survey, beside what every site is checked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from pipeline.survey.network import Network
from pipeline.survey.pieces import Piece
from pipeline.track.geodesy import points_of
from pipeline.track.survey import Track, track_of
from schemas.arrays import Floats
from schemas.run import Finding

# No track turns by so much at a point; a sideways step of so much on a curve of so small a radius is none either.
_KINK_DEG = 20.0
_LEAST_RADIUS_M = 60.0
_STEP_ASIDE_M = 0.3
# Tracks lie 3.5 m apart; the branches of the longest switches (radius 1,200 m) part by a metre within 50 m.
_DOUBLE_M = 1.0
_DOUBLE_OVER_M = 100.0
_SAMPLE_M = 2.0
_NEAR_TRACK_M = 5.0
_KM_TOLERANCE_M = 20.0
_KM_TOLERANCE = 0.05


def doubts(network: Network) -> list[Finding]:
    """Kinks, tracks that were surveyed twice, open ends beside other track, heights and kilometres that do not fit."""
    track = track_of(network.track())
    found = [*_heights(network.elements), *_doubled(track), *_open_ends(network, track)]
    for element in network.elements:
        found += [*_kinks(element), *_kilometres(element)]
    return found


def _heights(elements: list[Piece]) -> Iterator[Finding]:
    flat = [np.isnan(element.height_m).all() for element in elements]
    if all(flat):
        text = "no point has a height: the site is 2-D, and nothing is diagnosed in height"
        yield Finding("note", "track: column height_m", text)
        return
    for element in elements:
        missing = int(np.isnan(element.height_m).sum())
        if 0 < missing < len(element):
            text = f"{missing} of {len(element)} points have no height: the element is taken as 2-D"
            yield Finding("warning", f"track: {element.name}", text, "Survey all or none.")
    text = "heights are taken as ellipsoidal (WGS 84); maps and many programs give them above sea level"
    yield Finding("note", "track: column height_m", text, "Leave them out with --flat if you are not sure.")


def _kinks(element: Piece) -> Iterator[Finding]:
    surface = points_of(element.latitude_deg, element.longitude_deg).surface
    steps = np.diff(surface, axis=0)
    length = np.linalg.norm(steps, axis=1)
    if len(steps) < 2:
        return
    unit = steps / length[:, None]
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", unit[:-1], unit[1:]), -1.0, 1.0))
    short = np.minimum(length[:-1], length[1:])
    sharp = (turn > np.radians(8.0)) & (short / np.maximum(turn, 1e-9) < _LEAST_RADIUS_M)
    # A corner within centimetres is how dense surveys scatter.
    kinks = np.flatnonzero(
        (short * np.sin(np.minimum(turn, np.pi / 2)) > _STEP_ASIDE_M) & (sharp | (turn > np.radians(_KINK_DEG)))
    )
    if len(kinks):
        worst = kinks[int(np.argmax(turn[kinks]))] + 1
        where = f"{element.latitude_deg[worst]:.6f}, {element.longitude_deg[worst]:.6f}"
        text = f"{len(kinks)} kinks; the sharpest turns by {np.degrees(turn[worst - 1]):.0f} degrees at {where}"
        yield Finding("warning", f"track: {element.name}", text, "Look whether a point is wrong or out of order.")


def _kilometres(element: Piece) -> Iterator[Finding]:
    known = np.flatnonzero(np.isfinite(element.line_km))
    if len(known) < 2:
        return
    surface = points_of(element.latitude_deg, element.longitude_deg).surface
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(surface, axis=0), axis=1))])[known]
    by_km = np.diff(element.line_km[known]) * 1000.0
    sign = 1.0 if by_km.sum() >= 0 else -1.0
    off = np.abs(sign * by_km - np.diff(way))
    wrong = np.flatnonzero(off > np.maximum(_KM_TOLERANCE_M, _KM_TOLERANCE * np.diff(way)))
    if len(wrong):
        row = wrong[int(np.argmax(off[wrong]))]
        text = (
            f"line kilometre goes from {element.line_km[known[row]]:.3f} to {element.line_km[known[row + 1]]:.3f} "
            f"over {np.diff(way)[row]:.0f} m of track ({len(wrong)} such places)"
        )
        yield Finding("warning", f"track: {element.name}", text, "A jump of the kilometres, or points out of order.")


def _samples(track: Track) -> tuple[Floats, np.ndarray, Floats]:
    """Places every two metres along all elements, the element of each, and its distance from the nearer end."""
    places, owner, from_end = [], [], []
    for element, _, part in track.elements():
        surface = points_of(track.latitude_deg[part], track.longitude_deg[part]).surface
        measure = track.measure_m[part]
        at = np.linspace(measure[0], measure[-1], int((measure[-1] - measure[0]) / _SAMPLE_M) + 2)
        places.append(np.column_stack([np.interp(at, measure, surface[:, axis]) for axis in range(3)]))
        owner.append(np.full(len(at), element))
        from_end.append(np.minimum(at - measure[0], measure[-1] - at))
    return np.concatenate(places), np.concatenate(owner), np.concatenate(from_end)


def _doubled(track: Track) -> Iterator[Finding]:
    places, owner, _ = _samples(track)
    # Two samples of parallel tracks are at most half a spacing apart along the track.
    pairs = cKDTree(places).query_pairs(float(np.hypot(_DOUBLE_M, _SAMPLE_M / 2)), output_type="ndarray")
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    if not len(pairs):
        return
    both = np.unique(np.column_stack([pairs[:, 0], owner[pairs[:, 1]]]), axis=0)
    named, count = np.unique(np.column_stack([owner[both[:, 0]], both[:, 1]]), axis=0, return_counts=True)
    for (one, other), samples in zip(named.tolist(), count.tolist(), strict=True):
        if samples * _SAMPLE_M > _DOUBLE_OVER_M:
            text = f"lies within {_DOUBLE_M:g} m of {track.ids[other]} over {samples * _SAMPLE_M:.0f} m"
            yield Finding("warning", f"track: {track.ids[one]}", text, "Look whether one track was surveyed twice.")


def _open_ends(network: Network, track: Track) -> Iterator[Finding]:
    """Ends that lie beside the middle of another element: a switch without its node. Ends near ends: `site.checks`."""
    places, owner, from_end = _samples(track)
    tree = cKDTree(places)
    count = np.bincount(network.ends.ravel())
    for element, pair in enumerate(network.ends.tolist()):
        for position, node in enumerate(pair):
            row = track.end(element, position)
            if count[node] > 1:
                continue
            end = points_of(track.latitude_deg[row : row + 1], track.longitude_deg[row : row + 1]).surface[0]
            near = np.array(tree.query_ball_point(end, _NEAR_TRACK_M), dtype=np.int64)
            near = near[(owner[near] != element) & (from_end[near] > _NEAR_TRACK_M)]
            for other in np.unique(owner[near]).tolist():
                away = float(np.linalg.norm(places[near[owner[near] == other]] - end, axis=1).min())
                text = f"end {position} lies {away:.1f} m from the middle of {track.ids[other]} and is not joined to it"
                remedy = "Give both lines a point in common there, if it is a switch."
                yield Finding("warning", f"track: {track.ids[element]}", text, remedy)
