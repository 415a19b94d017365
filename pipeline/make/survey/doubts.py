"""What is doubtful about a network made of a survey, besides what every site is checked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.make.survey.network import SurveyNetwork
from pipeline.make.survey.pieces import LinePiece, kilometre_spans
from pipeline.stages.paths.candidates import candidates_of, segments_of
from pipeline.stages.track.geodesy import distance_along_m, points_of
from pipeline.stages.track.network import Network, network_of
from pipeline.stages.track.segments import SAMPLE_SPACING_M
from pipeline.stages.track.survey import in_pieces, places_along, track_of
from schemas.config import SiteConfig, SurveyConfig
from schemas.run import Finding


def find_doubts(network: SurveyNetwork, config: SurveyConfig, site: SiteConfig) -> list[Finding]:
    """Kinks, tracks that were surveyed twice, open ends next to other track, heights and kilometres that do not fit."""
    track = track_of(network.track)
    in_parts = network_of(in_pieces(track), network.links)
    findings = [*_missing_heights(network.elements), *_tracks_twice(in_parts, config)]
    findings += _ends_beside_track(network_of(track, network.links), config.same_track_m, site.near_ends_m)
    for element in network.elements:
        findings += [*_kinks(element, config), *_kilometre_jumps(element, config)]
    return findings


def _missing_heights(elements: list[LinePiece]) -> Iterator[Finding]:
    """Points without height."""
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


def _kinks(element: LinePiece, config: SurveyConfig) -> Iterator[Finding]:
    """Kinks sharper than track can be."""
    steps = np.diff(element.surface, axis=0)
    length = np.linalg.norm(steps, axis=1)
    unit = steps / length[:, None]
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", unit[:-1], unit[1:]), -1.0, 1.0))
    short = np.minimum(length[:-1], length[1:])
    sharp = (turn > np.radians(config.corner_deg)) & (short / np.maximum(turn, 1e-9) < config.kink_radius_m)
    # A corner within centimetres is how dense surveys scatter.
    aside = short * np.sin(np.minimum(turn, np.pi / 2)) > config.kink_aside_m
    kinks = np.flatnonzero(aside & (sharp | (turn > np.radians(config.kink_deg))))
    if len(kinks):
        worst = kinks[int(np.argmax(turn[kinks]))] + 1
        sharpest = f"{np.degrees(turn[worst - 1]):.0f} degrees at {element.place_words(worst)}"
        text = f"{len(kinks)} kinks; the sharpest turns by {sharpest}"
        yield Finding("warning", f"track: {element.name}", text, "Look whether a point is wrong or out of order.")


def _kilometre_jumps(element: LinePiece, config: SurveyConfig) -> Iterator[Finding]:
    """Jumps of the kilometres against the length of the track."""
    distance_m = distance_along_m(element.surface)
    known, off_m, jumps = kilometre_spans(element.line_km, distance_m, config)
    if jumps.any():
        row = int(np.argmax(np.where(jumps, off_m, 0.0)))
        first = known[row]
        last = known[row + 1]
        text = (
            f"line kilometre goes from {element.line_km[first]:.3f} to {element.line_km[last]:.3f} "
            f"over {distance_m[last] - distance_m[first]:.0f} m of track ({jumps.sum()} such places)"
        )
        yield Finding("warning", f"track: {element.name}", text, "A jump of the kilometres, or points out of order.")


def _tracks_twice(ground: Network, config: SurveyConfig) -> Iterator[Finding]:
    """Tracks that lie on each other; an element that turns back is in pieces, which are compared like others."""
    track = ground.track
    along = places_along(track, SAMPLE_SPACING_M)
    everywhere = segments_of(track).search_in()
    both = []
    # So many at once as can be held.
    for rows in np.array_split(np.arange(len(along.element)), 1 + len(along.element) // 100_000):
        points = points_of(along.latitude_deg[rows], along.longitude_deg[rows])
        candidates = candidates_of(points, ground, everywhere, config.same_track_m)
        element = along.element[rows][candidates.step]
        both.append(np.column_stack([element, candidates.element])[element < candidates.element])
    pairs, count = np.unique(np.concatenate(both), axis=0, return_counts=True)
    for (first, second), samples in zip(pairs.tolist(), count.tolist(), strict=True):
        if samples * SAMPLE_SPACING_M > config.doubled_m:
            whom = "itself" if track.ids[first] == track.ids[second] else track.ids[second]
            text = f"lies within {config.same_track_m:g} m of {whom} over {samples * SAMPLE_SPACING_M:.0f} m"
            yield Finding("warning", f"track: {track.ids[first]}", text, "Look whether one track was surveyed twice.")


def _ends_beside_track(ground: Network, same_track_m: float, near_ends_m: float) -> Iterator[Finding]:
    """Ends that lie next to the middle of another element: a switch without its node.

    Ends near ends: `site.checks`.
    """
    track = ground.track
    element, position = np.nonzero(~ground.have_successors())
    row = np.where(position == 0, track.first[element], track.first[element + 1] - 1)
    points = points_of(track.latitude_deg[row], track.longitude_deg[row])
    # Farther aside is the next track.
    candidates = candidates_of(points, ground, segments_of(track).search_in(), 2 * same_track_m)
    middle = np.minimum(candidates.along_m, candidates.left_m) > near_ends_m
    for near in np.flatnonzero(middle & (candidates.element != element[candidates.step])).tolist():
        end = int(candidates.step[near])
        neighbour = track.ids[int(candidates.element[near])]
        found = f"{candidates.distance_m[near]:.1f} m from the middle of {neighbour}"
        text = f"end {position[end]} lies {found} and is not joined to it"
        remedy = "Give both lines a point in common there, if it is a switch."
        yield Finding("warning", f"track: {track.ids[int(element[end])]}", text, remedy)
