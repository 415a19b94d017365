"""The track in pieces of about one length, element by element."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.results.places import GroundPositions, ground_of, origin_of, plane_m
from pipeline.stages.track.survey import SurveyedTrack, track_of
from schemas.arrays import Floats, Ints
from schemas.frozen import frozen
from schemas.run import Site


@frozen
class Pieces:
    """Pieces of all net elements, numbered in the order of the survey; element e has `first[e] : first[e + 1]`."""

    track: SurveyedTrack
    first: Ints
    element: Ints
    from_m: Floats
    to_m: Floats

    def pieces_at(self, element: int, measure_m: Floats) -> Ints:
        """The piece that holds each measure; beyond an end the last one there."""
        last = int(self.first[element + 1]) - 1
        begin = int(self.first[element])
        piece = begin + np.searchsorted(self.from_m[begin : last + 1], measure_m, side="right") - 1
        return np.clip(piece, begin, last).astype(np.int64)

    def piece_holding(self, netelement_id: str | None, measure_m: float | None) -> int | None:
        """The piece at a place; None without one, or on an element of another survey."""
        if netelement_id not in self.track.index or measure_m is None:
            return None
        return int(self.pieces_at(self.track.index[netelement_id], np.array([measure_m]))[0])

    @property
    def middle_measures_m(self) -> Floats:
        """Measure of the middle of each piece [m]."""
        middle: Floats = 0.5 * (self.from_m + self.to_m)
        return middle

    @property
    def element_names(self) -> list[str]:
        """Net element of each piece."""
        return [self.track.ids[number] for number in self.element]


def pieces_of(site: Site, piece_m: float) -> Pieces:
    """Elements cut into equal pieces, as near to `piece_m` as can be."""
    track = track_of(site.track)
    counts = np.maximum(1, np.rint(track.length_m / piece_m)).astype(np.int64)
    element = np.repeat(np.arange(len(counts)), counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    number = np.arange(len(element)) - first[element]
    begin_m = track.measure_m[track.first[:-1]][element]
    step_m = (track.length_m / counts)[element]
    return Pieces(track, first, element, begin_m + number * step_m, begin_m + (number + 1) * step_m)


def middles_in_plane_m(site: Site, pieces: Pieces) -> Floats:
    """East and north of each piece's middle [m], `[piece, 2]`."""
    return places_in_plane_m(
        site, ground_of(site.track, pl.Series(pieces.element_names, dtype=pl.String), pieces.middle_measures_m)
    )


def places_in_plane_m(site: Site, ground: GroundPositions) -> Floats:
    """Places as rows of east and north [m]."""
    return np.column_stack(plane_m(ground, origin_of(site)))
