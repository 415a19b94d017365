"""The surveyed track as arrays: net elements with their vertices, measures and lengths; and in pieces.

Elements that turn round come in pieces that do not. A balloon loop whose ends join the same switch, a ring, a ramp that
crosses itself, a line that returns parallel to itself: the nearest place on the whole element may be the wrong one of
two, that on a piece never is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import earth_centred_m, place_distances_m, point_distances_m
from schemas.arrays import Floats, Ints, floats, ints
from schemas.frozen import frozen

# Both belong to how a site is read, as the limits of its check do: a site is the same for every run and configuration.
# A gap between linked ends that is more than survey noise [m]; it counts as straight track.
GAP_COUNTS_M = 0.5
# A balise this far beyond its element's end is still on it: surveys and balise lists round [m].
MEASURE_TOLERANCE_M = 0.5
# An element's direction is taken over so much of it [m]: single vertices may lie a centimetre apart. Numerics: where
# in a turn of a right angle a piece ends changes no place on it.
_DIRECTION_OVER_M = 10.0


@frozen(eq=False)
class SurveyedTrack:
    """Net elements, each a run of vertices `first[e] : first[e + 1]`, in the order of the survey.

    Degrees, metres; `height_m` is NaN on a 2-D element (as a whole), `sigma_m` NaN where not known.
    """

    ids: tuple[str, ...]
    index: dict[str, int]
    first: Ints
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    measure_m: Floats
    sigma_m: Floats
    length_m: Floats

    @cached_property
    def begin_m(self) -> Floats:
        """Measure at which each element begins [m]."""
        return self.measure_m[self.first[:-1]]

    @cached_property
    def end_m(self) -> Floats:
        """Measure at which each element ends [m]."""
        return self.measure_m[self.first[1:] - 1]

    @cached_property
    def surface(self) -> Floats:
        """Earth-centred places of the vertices at height zero [m]."""
        return earth_centred_m(self.latitude_deg, self.longitude_deg, np.zeros(len(self.latitude_deg)))

    @cached_property
    def geometric_m(self) -> Floats:
        """Distance of each vertex from the first of its element, along the element [m]: 3-D where it has heights."""
        places = self.surface
        known = np.flatnonzero(np.isfinite(self.height_m))
        if len(known):
            places = places.copy()
            places[known] = earth_centred_m(self.latitude_deg[known], self.longitude_deg[known], self.height_m[known])
        step_m = place_distances_m(places)
        measure_m = np.zeros(len(self.latitude_deg))
        points = np.diff(self.first)
        for count in np.unique(points).tolist():
            # Elements of as many points as rows of one table, each summed up from its first point on.
            begin = self.first[:-1][points == count][:, None]
            measure_m[begin + np.arange(1, count)] = np.cumsum(step_m[begin + np.arange(count - 1)], axis=1)
        return measure_m

    def with_measures(self, measure_m: Floats) -> SurveyedTrack:
        """The same elements with these measures [m]."""
        length_m = measure_m[self.first[1:] - 1] - measure_m[self.first[:-1]]
        again = replace(self, measure_m=measure_m, length_m=length_m)
        # Places and distances do not depend on measures.
        vars(again).update(surface=self.surface, geometric_m=self.geometric_m)
        return again

    def distance_from_entry_m(self, oriented: int, measure_m: float) -> float:
        """Distance from where the oriented element (`Network`) is entered to a measure [m]."""
        element, against = divmod(oriented, 2)
        return float(self.end_m[element] - measure_m if against else measure_m - self.begin_m[element])

    def elements_holding(self, balises: pl.DataFrame) -> tuple[Ints, Ints]:
        """Pairs of balise (its row) and net element on which it lies, half a metre beyond an end included.

        Of an element in pieces each piece that holds the balise.
        """
        elements = pl.DataFrame(
            {
                "netelement_id": pl.Series(self.ids, dtype=pl.String),
                "_low": self.begin_m - MEASURE_TOLERANCE_M,
                "_high": self.end_m + MEASURE_TOLERANCE_M,
            }
        )
        pairs = (
            balises.select("netelement_id", "measure_m")
            .with_row_index("_balise")
            .join(elements.with_row_index("_element"), on="netelement_id", maintain_order="left_right")
            .filter(pl.col("measure_m").is_between("_low", "_high"))
        )
        return ints(pairs["_balise"]), ints(pairs["_element"])

    def vertex_range(self, element: int) -> slice:
        """The vertices of an element."""
        return slice(int(self.first[element]), int(self.first[element + 1]))

    def end_vertex(self, element: int, position: int) -> int:
        """Vertex at an end of an element: 0 its start, 1 its end."""
        return int(self.first[element]) if position == 0 else int(self.first[element + 1]) - 1

    def element_at(self, name: str, measure_m: float) -> int | None:
        """The net element of a name if it holds the measure, as `elements_holding` has it; none where it does not."""
        if (element := self.index.get(name)) is None:
            return None
        low_m = float(self.begin_m[element])
        high_m = float(self.end_m[element])
        return element if low_m - MEASURE_TOLERANCE_M <= measure_m <= high_m + MEASURE_TOLERANCE_M else None

    def elements(self) -> Iterator[tuple[int, str, slice]]:
        """Number, name and vertices of each element."""
        for element, name in enumerate(self.ids):
            yield element, name, self.vertex_range(element)


def track_of(frame: pl.DataFrame) -> SurveyedTrack:
    """The track of a site's `track` table; points of an element stay in their order."""
    frame = sort_by_element(frame)
    runs = frame["netelement_id"].rle().struct
    names = tuple(runs.field("value").to_list())
    first = np.append(0, np.cumsum(ints(runs.field("len"))))
    columns = {name: floats(frame, name) for name in _NUMBERS}
    columns["height_m"] = _complete_heights_m(columns["height_m"], first)
    length_m = columns["measure_m"][first[1:] - 1] - columns["measure_m"][first[:-1]]
    index = {name: number for number, name in enumerate(names)}
    return SurveyedTrack(ids=names, index=index, first=first, length_m=length_m, **columns)


def sort_by_element(frame: pl.DataFrame) -> pl.DataFrame:
    """Points element by element, in the order in which elements come up first."""
    name = frame["netelement_id"]
    if (runs := name.rle().struct.field("value")).n_unique() == len(runs):
        return frame
    ordered = frame.with_columns(_first=pl.int_range(pl.len()).min().over("netelement_id"))
    return ordered.sort("_first", maintain_order=True).drop("_first")


@frozen
class TrackPlaces:
    """Places along all elements, in order: element number and measure [m] of each, degrees."""

    element: Ints
    measure_m: Floats
    latitude_deg: Floats
    longitude_deg: Floats


def places_along(track: SurveyedTrack, spacing_m: float) -> TrackPlaces:
    """Places about so far apart on every element, its two ends among them."""
    columns: list[list[Floats]] = [[], [], [], []]
    for number, _, part in track.elements():
        low = float(track.measure_m[part][0])
        high = float(track.measure_m[part][-1])
        at_m = np.linspace(low, high, max(2, round((high - low) / spacing_m) + 1))
        degrees = (np.interp(at_m, track.measure_m[part], of[part]) for of in (track.latitude_deg, track.longitude_deg))
        for column, values in zip(columns, (np.full(len(at_m), float(number)), at_m, *degrees), strict=True):
            column.append(values)
    element, *others = (np.concatenate(column) for column in columns)
    return TrackPlaces(element.astype(np.int64), *others)


def geometric_measures_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Distance from the first point along one element [m]: 3-D where every height is known."""
    flat = np.zeros_like(latitude_deg)
    heights = flat if np.isnan(height_m).any() else height_m
    return np.concatenate([[0.0], np.cumsum(point_distances_m(latitude_deg, longitude_deg, heights))])


def end_places(track: SurveyedTrack) -> Floats:
    """Earth-centred places [m] of the ends of elements at height zero: `[element, 0 start or 1 end]`."""
    vertices = np.column_stack([track.first[:-1], track.first[1:] - 1]).ravel()
    return track.surface[vertices].reshape(-1, 2, 3)


def gap_lengths_m(left: Floats, entered: Floats) -> Floats:
    """Lengths of gaps between ends that count as track [m]: 0 where it is only survey noise."""
    gap = np.linalg.norm(left - entered, axis=-1)
    return np.where(gap > GAP_COUNTS_M, gap, 0.0)


_NUMBERS = ("latitude_deg", "longitude_deg", "height_m", "measure_m", "sigma_m")


def _complete_heights_m(height_m: Floats, first: Ints) -> Floats:
    """Heights of an element only where all of its points have one: half a profile is no profile."""
    unknown = np.add.reduceat(np.isnan(height_m).astype(np.int64), first[:-1]) > 0
    return np.where(np.repeat(unknown, np.diff(first)), np.nan, height_m)


def in_pieces(track: SurveyedTrack) -> SurveyedTrack:
    """The track with its elements in pieces, each of its element's name and measures, in order."""
    if not any(_cut_vertices(track)):
        return track
    return track_in_parts(track, [(element, part) for element, parts in enumerate(pieces_of(track)) for part in parts])


def pieces_of(track: SurveyedTrack) -> list[list[slice]]:
    """Vertices of each element's pieces in order; neighbours share one.

    A piece ends where it has turned by more than a right angle since its start.
    """
    pieces = []
    for element, inside in enumerate(_cut_vertices(track)):
        whole = track.vertex_range(element)
        ends = [whole.start, *inside, whole.stop - 1]
        pieces.append([slice(begin, end + 1) for begin, end in itertools.pairwise(ends)])
    return pieces


def _cut_vertices(track: SurveyedTrack) -> list[list[int]]:
    """Vertices between the pieces of each element, each of which turns by less than a right angle in all."""
    owner, vertex = _spaced_vertices(track)
    along = np.diff(track.surface[vertex], axis=0)
    same_element = owner[:-1] == owner[1:]
    start = np.searchsorted(owner, np.arange(len(track.ids)))
    # Only elements that turn by a right angle against their first segment can need a cut.
    turned = same_element & (np.einsum("ij,ij->i", along, along[np.minimum(start[owner[:-1]], len(along) - 1)]) < 0.0)
    cuts: list[list[int]] = [[] for _ in track.ids]
    for element in np.unique(owner[:-1][turned]).tolist():
        since = int(start[element])
        for number in range(since, int(np.searchsorted(owner, element, side="right")) - 1):
            if along[number] @ along[since] < 0.0:
                cuts[element].append(int(vertex[number]))
                since = number
    return cuts


def _spaced_vertices(track: SurveyedTrack) -> tuple[Ints, Ints]:
    """Elements and vertices, the first in every so many metres."""
    owner = np.repeat(np.arange(len(track.ids)), np.diff(track.first))
    number = np.floor((track.measure_m - track.measure_m[track.first[owner]]) / _DIRECTION_OVER_M)
    kept = np.flatnonzero((np.diff(number, prepend=-1.0) != 0) | (np.diff(owner, prepend=-1) != 0))
    return owner[kept], kept


def track_in_parts(track: SurveyedTrack, parts: Sequence[tuple[int, slice]]) -> SurveyedTrack:
    """Parts of elements in the given order, as elements; `index` gives the first of each name."""
    rows = np.concatenate([np.arange(part.start, part.stop) for _, part in parts])
    names = tuple(track.ids[element] for element, _ in parts)
    return SurveyedTrack(
        ids=names,
        index={name: number for number, name in reversed(list(enumerate(names)))},
        first=np.concatenate([[0], np.cumsum([part.stop - part.start for _, part in parts])]),
        latitude_deg=track.latitude_deg[rows],
        longitude_deg=track.longitude_deg[rows],
        height_m=track.height_m[rows],
        measure_m=track.measure_m[rows],
        sigma_m=track.sigma_m[rows],
        length_m=np.array([track.measure_m[part.stop - 1] - track.measure_m[part.start] for _, part in parts]),
    )
