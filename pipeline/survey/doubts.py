"""What is doubtful about a network made of a survey, beside what every site is checked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from pipeline.matching.candidates import candidates_of, segments_of
from pipeline.site.checks import LIMITS
from pipeline.survey.kilometres import spans
from pipeline.survey.network import Network
from pipeline.survey.pieces import COLUMNS, SAME_TRACK_M, SHAPE_M, Piece
from pipeline.track.geodesy import earth_centred_m, points_of, way_m
from pipeline.track.network import Network as Ground
from pipeline.track.network import network_of
from pipeline.track.segments import SAMPLE_SPACING_M
from pipeline.track.survey import in_pieces, places_along, track_of
from schemas.arrays import Floats
from schemas.enums import Navigability
from schemas.run import Finding

# No track turns by so much at a point; a sideways step of so much on a curve of so small a radius is none either.
_KINK_DEG = 20.0
_LEAST_RADIUS_M = 60.0
_STEP_ASIDE_M = 0.3
# The branches of the longest switches (radius 1,200 m) part as far as that within 60 m.
_DOUBLE_OVER_M = 100.0
# A share of the length that is that of the best odometer scale.
_LONGER = 1e-4
_UNEVEN = 3.0


def doubts(network: Network) -> list[Finding]:
    """Kinks, tracks that were surveyed twice, open ends beside other track, heights and kilometres that do not fit."""
    track = track_of(network.track)
    in_parts = network_of(in_pieces(track), network.links)
    found = [*_heights(network.elements), *_doubled(in_parts), *_open_ends(network_of(track, network.links))]
    for element in network.elements:
        found += [*_kinks(element), *_kilometres(element), *_scattered(element)]
    return [*found, *_corners(network)]


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


def _corners(network: Network) -> Iterator[Finding]:
    """Kinks where two elements meet that a train runs over."""
    ends: dict[int, list[tuple[int, int]]] = {}
    for element, pair in enumerate(network.ends.tolist()):
        for position, node in enumerate(pair):
            ends.setdefault(node, []).append((element, position))
    used = network.links.filter(pl.col("navigability").cast(pl.String) != Navigability.NONE.value)
    passed = set(used.select("netelement_a", "position_a").iter_rows())
    for meeting in ends.values():
        first = network.elements[meeting[0][0]].name, meeting[0][1]
        if len(meeting) == 2 and meeting[0][0] != meeting[1][0] and first in passed:
            one, other = (_last_step(network.elements[element], position) for element, position in meeting)
            columns: dict[str, Any] = {
                name: np.append(getattr(one, name), getattr(other, name)[::-1][1:]) for name in COLUMNS
            }
            yield from _kinks(replace(one, name=f"{one.name}, {other.name}", **columns))


def _last_step(element: Piece, position: int) -> Piece:
    """The last two points before an end, the end last."""
    return element.take(np.array([1, 0]) if position == 0 else np.array([len(element) - 2, len(element) - 1]))


def _kilometres(element: Piece) -> Iterator[Finding]:
    way = way_m(points_of(element.latitude_deg, element.longitude_deg).surface)
    known, off_m, jumps = spans(element.line_km, way)
    if jumps.any():
        row = int(np.argmax(np.where(jumps, off_m, 0.0)))
        first, last = known[row], known[row + 1]
        text = (
            f"line kilometre goes from {element.line_km[first]:.3f} to {element.line_km[last]:.3f} "
            f"over {way[last] - way[first]:.0f} m of track ({jumps.sum()} such places)"
        )
        yield Finding("warning", f"track: {element.name}", text, "A jump of the kilometres, or points out of order.")


def _scattered(element: Piece) -> Iterator[Finding]:
    """Points that lie aside of a smooth line through their neighbours make the element longer than the track is."""
    level = np.zeros(len(element))
    height = level if np.isnan(element.height_m).any() else element.height_m
    flat, solid = (earth_centred_m(element.latitude_deg, element.longitude_deg, h) for h in (level, height))
    way = way_m(flat)
    by_plan = _longer_m(flat, way)
    by_height = max(0.0, min(_longer_m(solid, way) - by_plan, float(way_m(solid)[-1] - way[-1])))
    if by_plan + by_height > max(SHAPE_M, _LONGER * way[-1]):
        what, longer_m, remedy = "positions", by_plan, "Export all decimals; do not draw by hand."
        if by_height > by_plan:
            what, longer_m, remedy = "heights", by_height, "Mend them, or leave them out with --flat."
        text = f"{what} scatter: they make the element about {longer_m:.1f} m longer than the track is"
        yield Finding("warning", f"track: {element.name}", text, remedy)


def _longer_m(places: Floats, way: Floats) -> float:
    """By how much scatter lengthens a line: each point's variance over its spacing.

    The variance is that of its distance from the cubic through two neighbours on either side, which curves and
    transitions follow; points with neighbours at uneven distances cannot be judged.
    """
    if len(way) < 5:
        return 0.0
    at = np.stack([way[shift : len(way) - 4 + shift] for shift in range(5)])
    step = np.diff(at, axis=0)
    even = step.max(axis=0) < _UNEVEN * step.min(axis=0)
    weights = np.stack(
        [
            np.prod([(at[2] - at[k]) / (at[own] - at[k]) for k in (0, 1, 3, 4) if k != own], axis=0)
            for own in (0, 1, 3, 4)
        ]
    )
    beside = np.stack([places[shift : len(way) - 4 + shift] for shift in (0, 1, 3, 4)])
    miss = places[2:-2] - np.einsum("kn,knj->nj", weights, beside)
    variance_m2 = (miss**2).sum(axis=1) / (1.0 + (weights**2).sum(axis=0))
    return float((variance_m2 / step.mean(axis=0))[even].sum())


def _doubled(ground: Ground) -> Iterator[Finding]:
    """Tracks that lie on each other; an element that turns back is in pieces, which are compared like others."""
    track = ground.track
    along = places_along(track, SAMPLE_SPACING_M)
    segments, both = segments_of(track), []
    # So many at once as can be held.
    for rows in np.array_split(np.arange(len(along.element)), 1 + len(along.element) // 100_000):
        points = points_of(along.latitude_deg[rows], along.longitude_deg[rows])
        found = candidates_of(points, ground, segments, SAME_TRACK_M)
        own = along.element[rows][found.step]
        both.append(np.column_stack([own, found.element])[own < found.element])
    pairs, count = np.unique(np.concatenate(both), axis=0, return_counts=True)
    for (one, other), samples in zip(pairs.tolist(), count.tolist(), strict=True):
        if samples * SAMPLE_SPACING_M > _DOUBLE_OVER_M:
            whom = "itself" if track.ids[one] == track.ids[other] else track.ids[other]
            text = f"lies within {SAME_TRACK_M:g} m of {whom} over {samples * SAMPLE_SPACING_M:.0f} m"
            yield Finding("warning", f"track: {track.ids[one]}", text, "Look whether one track was surveyed twice.")


def _open_ends(ground: Ground) -> Iterator[Finding]:
    """Ends that lie beside the middle of another element: a switch without its node. Ends near ends: `site.checks`."""
    track = ground.track
    element, position = np.nonzero(~ground.linked_ends())
    row = np.where(position == 0, track.first[element], track.first[element + 1] - 1)
    points = points_of(track.latitude_deg[row], track.longitude_deg[row])
    # Farther aside is the next track.
    found = candidates_of(points, ground, segments_of(track), 2 * SAME_TRACK_M)
    middle = np.minimum(found.along_m, found.left_m) > LIMITS.near_ends_m
    for near in np.flatnonzero(middle & (found.element != element[found.step])).tolist():
        end, other = int(found.step[near]), track.ids[int(found.element[near])]
        beside = f"{found.distance_m[near]:.1f} m from the middle of {other}"
        text = f"end {position[end]} lies {beside} and is not joined to it"
        remedy = "Give both lines a point in common there, if it is a switch."
        yield Finding("warning", f"track: {track.ids[int(element[end])]}", text, remedy)
