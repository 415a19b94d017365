"""What is broken and what is remarkable in a site (findings), before any run is replayed on it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.segments import SAMPLE_SPACING_M
from pipeline.stages.track.survey import (
    GAP_COUNTS_M,
    MEASURE_TOLERANCE_M,
    Track,
    end_places,
    geometric_measures_m,
    track_of,
)
from schemas.arrays import Bools, Floats
from schemas.config import SiteConfig
from schemas.enums import Navigability
from schemas.run import BALISE_PLACE, Finding


@dataclass
class Remarks:
    """Findings, fatal breaches, and the links without those to nowhere; what is either is configuration."""

    links: pl.DataFrame
    config: SiteConfig
    findings: list[Finding] = field(default_factory=list)
    breaches: list[str] = field(default_factory=list)


def remarks(
    frame: pl.DataFrame,
    links: pl.DataFrame,
    balises: pl.DataFrame | None,
    route: pl.DataFrame | None,
    declared_length_m: dict[str, float],
    config: SiteConfig,
) -> Remarks:
    """All checks over the tables of a site."""
    track = track_of(frame)
    known, findings = relations_to_nowhere(track, links)
    passable, turning = _relations_that_turn_back(track, known)
    found = Remarks(passable, config, [*findings, *_relations_that_differ(known), *turning])
    _check_elements(track, declared_length_m, found)
    _check_gaps(track, found)
    found.findings += _near_misses(track, known, config)
    if balises is not None:
        _check_balises(track, balises, found)
    if route is not None:
        found.breaches += route_breaches(track, route, config)
    return found


def drop_repeated_points(file: str, frame: pl.DataFrame, breaches: list[str]) -> tuple[pl.DataFrame, list[Finding]]:
    """A point that repeats its predecessor adds nothing but a segment of no length: dropped, and reported."""
    same = pl.all_horizontal(
        (pl.col(name) == pl.col(name).shift(1)).fill_null(False).over("netelement_id")
        for name in ("latitude_deg", "longitude_deg")
    )
    marked = frame.with_columns(same.alias("_repeats"))
    counts = marked.group_by("netelement_id", maintain_order=True).agg(
        pl.len().alias("points"), pl.col("_repeats").sum().alias("repeats")
    )
    notes = []
    for name, points, repeats in counts.iter_rows():
        if points - repeats < 2:
            breaches.append(f"{file}: element {name} has {points - repeats} distinct points; expected at least 2")
        if repeats:
            remedy = "Remove them from the survey." if repeats > 1 else "Remove it from the survey."
            text = f"{repeats} of {points} points repeat the one before and are left out"
            notes.append(Finding("warning", f"{file}: element {name}", text, remedy))
    return marked.filter(~pl.col("_repeats")).drop("_repeats"), notes


def relations_to_nowhere(track: Track, links: pl.DataFrame) -> tuple[pl.DataFrame, list[Finding]]:
    """The relations between elements that there are; of each other one a finding."""
    ids = list(track.ids)
    known = links["netelement_a"].is_in(ids) & links["netelement_b"].is_in(ids)
    findings = [
        Finding("warning", "links", f"relation {row[0]} - {row[2]} is not used: it names an element not in the track")
        for row in links.filter(~known).iter_rows()
    ]
    return links.filter(known), findings


def _relations_that_differ(links: pl.DataFrame) -> Iterator[Finding]:
    """Two ends that are related more than once, and not alike: `network_of` allows what either allows."""
    said: dict[tuple[tuple[str, int], tuple[str, int]], list[str]] = {}
    for a, a_end, b, b_end, way in links.iter_rows():
        one = (a, a_end)
        other = (b, b_end)
        from_other = {Navigability.AB.value: Navigability.BA.value, Navigability.BA.value: Navigability.AB.value}
        pair, word = ((one, other), way) if one <= other else ((other, one), from_other.get(way, way))
        said.setdefault(pair, []).append(word)
    for ((a, a_end), (b, b_end)), words in said.items():
        if len(set(words)) > 1:
            text = f"end {a_end} of {a} and end {b_end} of {b} are related as {' and as '.join(dict.fromkeys(words))}"
            yield Finding("warning", "links", f"{text}: what either allows counts", "Correct the relations.")


def _relations_that_turn_back(track: Track, links: pl.DataFrame) -> tuple[pl.DataFrame, list[Finding]]:
    """No train gets round a corner of less than a right angle: such a relation, as between the two branches of a
    switch, is not navigable, whatever it says.
    """
    directions = outward(track)
    back = [
        way != Navigability.NONE.value
        and bool(directions[track.index[a], position_a] @ directions[track.index[b], position_b] > 0.0)
        for a, position_a, b, position_b, way in links.iter_rows()
    ]
    findings = [
        Finding(
            "warning",
            "links",
            f"end {a_end} of {a} and end {b_end} of {b} are linked as navigable ({way}), but a train would have to "
            "turn by more than 90 degrees there: taken as not navigable",
            "Correct the relation.",
        )
        for a, a_end, b, b_end, way in links.filter(pl.Series(back, dtype=pl.Boolean)).iter_rows()
    ]
    closed = pl.when(pl.Series(back, dtype=pl.Boolean)).then(pl.lit(Navigability.NONE.value))
    return links.with_columns(closed.otherwise("navigability").alias("navigability")), findings


def outward(track: Track) -> np.ndarray:
    """Direction from each end into its element, earth-centred and not normed: `[element, 0 start or 1 end]`."""
    directions = np.zeros((len(track.ids), 2, 3))
    for element, _, part in track.elements():
        surface = points_of(track.latitude_deg[part], track.longitude_deg[part]).surface
        for position, line in ((0, surface), (1, surface[::-1])):
            way = np.linalg.norm(line - line[0], axis=1)
            # Single vertices may lie a centimetre apart.
            inside = int(np.argmax(way >= SAMPLE_SPACING_M)) or int(np.argmax(way))
            directions[element, position] = line[inside] - line[0]
    return directions


def _check_elements(track: Track, declared_length_m: dict[str, float], found: Remarks) -> None:
    """Length, declared length, height and vertex spacing of each element."""
    for element, name, part in track.elements():
        place = f"track: element {name}"
        latitude = track.latitude_deg[part]
        longitude = track.longitude_deg[part]
        height = track.height_m[part]
        geometric = geometric_measures_m(latitude, longitude, height)
        length = float(geometric[-1])
        if length < GAP_COUNTS_M:
            found.findings.append(Finding("warning", place, f"is only {length:.2f} m long"))
        for declared in (float(track.length_m[element]), declared_length_m.get(name, float("nan"))):
            if abs(declared - length) > max(MEASURE_TOLERANCE_M, found.config.length_share * length):
                text = f"the declared length is {declared:.1f} m, the geometry is {length:.1f} m long"
                found.findings.append(Finding("warning", place, text, "Correct the measures or the geometry."))
        error = chord_errors_m(track, part).max(initial=0.0)
        if error > found.config.chord_m:
            spacing = float(np.diff(geometric).max())
            text = f"points up to {spacing:.0f} m apart: straight lines between them leave the curve by {error:.2f} m"
            found.findings.append(Finding("note", place, text, "Survey curves with closer points."))
    _check_heights(track, found)


def _check_heights(track: Track, found: Remarks) -> None:
    flat = [name for _, name, part in track.elements() if np.isnan(track.height_m[part]).any()]
    if flat and len(flat) < len(track.ids):
        text = (
            f"{len(flat)} of {len(track.ids)} elements lack heights and are taken as 2-D ({', '.join(flat[:3])}, ...)"
        )
        remedy = "Give heights for all elements, or for none."
        found.findings.append(Finding("warning", "track: column height_m", text, remedy))


def chord_errors_m(track: Track, part: slice) -> np.ndarray:
    """How far the curve may lie off each segment's chord [m]: length times turn angle over 8 (sagitta).

    Of the turns at its two ends the smaller one: the other may be that of a curve which only begins there.
    """
    surface = points_of(track.latitude_deg[part], track.longitude_deg[part]).surface
    steps = np.diff(surface, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    units = steps / lengths[:, None]
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", units[:-1], units[1:]), -1.0, 1.0))
    at_ends = np.concatenate([turn[:1], turn, turn[-1:]]) if len(turn) else np.zeros(2)
    return np.asarray(lengths * np.minimum(at_ends[:-1], at_ends[1:]) / 8.0)


def _check_gaps(track: Track, found: Remarks) -> None:
    """Ends that a relation joins must meet, in place and, where both have one, in height."""
    places = end_places(track)
    for a, position_a, b, position_b, navigability in found.links.iter_rows():
        one = places[track.index[a], position_a]
        other = places[track.index[b], position_b]
        gap = float(np.linalg.norm(one - other))
        text = f"end {position_a} of {a} and end {position_b} of {b} are linked but {gap:.1f} m apart"
        if gap > found.config.joined_m and navigability != Navigability.NONE.value:
            found.breaches.append(f"links: {text}; expected at most {found.config.joined_m:g} m")
        elif gap > GAP_COUNTS_M:
            remedy = "The straight line between them counts as track; survey the missing piece."
            found.findings.append(Finding("warning", "links", text, remedy))
        ends = [track.end(track.index[a], position_a), track.end(track.index[b], position_b)]
        step = float(np.abs(np.diff(track.height_m[ends])[0]))
        if step > GAP_COUNTS_M:
            text = f"end {position_a} of {a} and end {position_b} of {b} differ by {step:.1f} m in height"
            found.findings.append(Finding("warning", "links", text, "Correct the heights."))


def _near_misses(track: Track, links: pl.DataFrame, config: SiteConfig) -> Iterator[Finding]:
    """Free ends from which a train could go on: to a near end of another element, or to one that faces it."""
    ends = [(name, position) for name in track.ids for position in (0, 1)]
    joined = {(row[0], row[1]) for row in links.iter_rows()} | {(row[2], row[3]) for row in links.iter_rows()}
    free = np.array([end not in joined for end in ends])
    places = end_places(track).reshape(-1, 3)
    inward = outward(track).reshape(-1, 3)
    inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-9)[:, None]
    for one, other, gap in _nearly_met(places, inward, free, config):
        (a, position_a) = ends[one]
        (b, position_b) = ends[other]
        if a != b:
            text = f"end {position_a} of {a} and end {position_b} of {b} are {gap:.2f} m apart and not linked"
            remedy = "Survey the missing piece, or add the relation, if trains run there."
            yield Finding("warning", "links", text, remedy)


def _pairs_within(places: Floats, reach_m: float) -> npt.NDArray[np.int64]:
    """Pairs of places near each other: neighbours along one axis are compared. A search tree takes long to load."""
    order = np.argsort(places[:, 0], kind="stable")
    along = places[order, 0]
    counts = np.searchsorted(along, along + reach_m, side="right") - np.arange(len(along)) - 1
    first = np.repeat(np.arange(len(along)), counts)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    pairs: npt.NDArray[np.int64] = order[np.column_stack([first, second])]
    near: Bools = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1) <= reach_m
    return pairs[near]


def _nearly_met(places: Floats, inward: Floats, free: np.ndarray, config: SiteConfig) -> list[tuple[int, int, float]]:
    """Pairs of ends, and how far apart they are."""
    near = _pairs_within(places, config.near_ends_m)
    onward = np.einsum("ij,ij->i", inward[near[:, 0]], inward[near[:, 1]]) < 0.0
    near = near[onward & free[near].any(axis=1)]
    alone = np.flatnonzero(free)
    far = alone[_pairs_within(places[alone], config.facing_m)]
    way = places[far[:, 1]] - places[far[:, 0]]
    gap = np.linalg.norm(way, axis=1)
    ahead = [sign * np.einsum("ij,ij->i", inward[far[:, side]], way) for side, sign in ((0, -1.0), (1, 1.0))]
    facing = (gap > config.near_ends_m) & (np.minimum(*ahead) > gap * config.facing_cosine)
    nearest: dict[int, int] = {}
    for row in np.flatnonzero(facing)[np.argsort(gap[facing], kind="stable")].tolist():
        for end in far[row].tolist():
            nearest.setdefault(end, row)
    both = [far[row] for row in set(nearest.values()) if all(nearest[end] == row for end in far[row].tolist())]
    pairs = sorted({(int(min(pair)), int(max(pair))) for pair in [*near, *both]})
    return [(one, other, float(np.linalg.norm(places[one] - places[other]))) for one, other in pairs]


def _check_balises(track: Track, balises: pl.DataFrame, found: Remarks) -> None:
    repeated = balises.filter(pl.col("balise_id").is_duplicated())["balise_id"].unique().sort().to_list()
    if repeated:
        found.breaches.append(f"balises: column balise_id: {', '.join(repeated[:3])} occur more than once")
    off = [
        Finding("error", f"{BALISE_PLACE}{name}", *what)
        for name, element, measure in balises.select("balise_id", "netelement_id", "measure_m").iter_rows()
        if (what := _off_the_track(track, element, measure)) is not None
    ]
    found.findings += off
    if off and len(off) == balises.height:
        found.breaches.append(f"balises: none lies on a net element of the track; {off[0].place} {off[0].message}")


def _off_the_track(track: Track, element: str, measure_m: float) -> tuple[str, str] | None:
    """Why no run will pass a balise, and what to mend."""
    if element not in track.index:
        return f"lies on element {element}, which is not in the track: no run will pass it", "Correct netelement_id."
    if track.element_at(element, measure_m) is not None:
        return None
    number = track.index[element]
    low = float(track.begin_m[number])
    high = float(track.end_m[number])
    text = f"measure {measure_m:.1f} m is off element {element} ({low:.1f} to {high:.1f} m): no run will pass it"
    return text, "Correct measure_m."


def route_breaches(track: Track, route: pl.DataFrame, config: SiteConfig) -> list[str]:
    """A route must be one continuous run over elements that exist, within each `leg` where it has that column."""
    columns = ["netelement_id", "direction"]
    rows = route.select(*columns, leg="leg" if "leg" in route.columns else pl.lit(0)).rows()
    unknown = [name for name, _, _ in rows if name not in track.index]
    if unknown or not rows:
        return [f"route: names {', '.join(unknown[:3])}, not in the track" if unknown else "route: is empty"]
    places = end_places(track)
    breaches = []
    for (a, direction_a, leg), (b, direction_b, other_leg) in itertools.pairwise(rows):
        end = places[track.index[a], 1 if direction_a == "AB" else 0]
        start = places[track.index[b], 0 if direction_b == "AB" else 1]
        gap = float(np.linalg.norm(end - start))
        if gap > config.joined_m and leg == other_leg:
            text = f"{a} ({direction_a}) ends {gap:.0f} m from where {b} ({direction_b}) begins"
            breaches.append(f"route: {text}; expected at most {config.joined_m:g} m")
    return breaches
