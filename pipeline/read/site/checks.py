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
    SurveyedTrack,
    end_places,
)
from schemas.arrays import Bools, Floats, Ints, ints
from schemas.config import SiteConfig
from schemas.enums import Navigability
from schemas.run import BALISE_PLACE, Finding


@dataclass
class SiteRemarks:
    """Findings, fatal breaches, and the links without those to nowhere; what is either is configuration."""

    links: pl.DataFrame
    config: SiteConfig
    findings: list[Finding] = field(default_factory=list)
    breaches: list[str] = field(default_factory=list)


def check_site(
    track: SurveyedTrack,
    links: pl.DataFrame,
    balises: pl.DataFrame | None,
    route: pl.DataFrame | None,
    declared_length_m: dict[str, float],
    config: SiteConfig,
) -> SiteRemarks:
    """All checks over the tables of a site."""
    known, findings = relations_to_nowhere(track, links)
    related = _related_ends(track, known)
    inward = directions_inward(track).reshape(-1, 3)
    passable, turning = _relations_that_turn_back(known, related, inward)
    collected = SiteRemarks(passable, config, [*findings, *_relations_that_differ(known, related), *turning])
    _check_elements(track, declared_length_m, collected)
    _check_kinks(track, known, related, inward, collected)
    _check_gaps(track, related, collected)
    collected.findings += _near_miss_findings(track, related, inward, config)
    if balises is not None:
        _check_balises(track, balises, collected)
    if route is not None:
        collected.breaches += route_breaches(track, route, config)
    return collected


def drop_repeated_points(file: str, frame: pl.DataFrame, breaches: list[str]) -> tuple[pl.DataFrame, list[Finding]]:
    """A point that repeats its predecessor adds nothing but a segment of no length: dropped, and reported.

    `frame`: the points of an element follow each other.
    """
    names = ("netelement_id", "latitude_deg", "longitude_deg")
    element = frame["netelement_id"].rle_id().to_numpy()
    repeats = np.zeros(frame.height, dtype=np.bool_)
    repeats[1:] = np.all([(of[1:] == of[:-1]) for of in (element, *(frame[name].to_numpy() for name in names[1:]))], 0)
    points = np.bincount(element)
    repeated = np.bincount(element, repeats).astype(np.int64)
    first = np.cumsum(points) - points
    notes = []
    for number in np.flatnonzero((repeated > 0) | (points < 2)).tolist():
        name = frame["netelement_id"][int(first[number])]
        left = int(points[number] - repeated[number])
        if left < 2:
            breaches.append(f"{file}: element {name} has {left} distinct points; expected at least 2")
        if repeated[number]:
            remedy = "Remove them from the survey." if repeated[number] > 1 else "Remove it from the survey."
            text = f"{repeated[number]} of {points[number]} points repeat the one before and are left out"
            notes.append(Finding("warning", f"{file}: element {name}", text, remedy))
    return frame.filter(pl.Series(~repeats)), notes


def drop_scattered_points(file: str, frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Finding]]:
    """A point from which the line turns back, half a metre or less from its neighbour: scatter of a survey, no track.

    Left in, it would cut the element in two pieces of opposite directions. Dropped, and reported; ends stay.
    """
    places = points_of(*(frame[name].to_numpy() for name in ("latitude_deg", "longitude_deg"))).surface
    element = frame["netelement_id"].rle_id().to_numpy()
    step = np.diff(places, axis=0)
    inner = (element[2:] == element[:-2]) & (np.einsum("ij,ij->i", step[1:], step[:-1]) < 0.0)
    length_m = np.linalg.norm(step, axis=1)
    back_m = np.minimum(length_m[1:], length_m[:-1])
    rows = np.flatnonzero(inner & (back_m <= GAP_COUNTS_M))
    # Of a point out and back again only the first is one.
    rows = rows[np.diff(rows, prepend=-2) > 1] + 1
    findings = []
    for number in np.unique(element[rows]).tolist():
        own = rows[element[rows] == number]
        name = frame["netelement_id"][int(own[0])]
        text = f"the line turns back over {back_m[own - 1].max():.2f} m at {len(own)} points, which are left out"
        findings.append(Finding("warning", f"{file}: element {name}", text, "Remove them from the survey."))
    kept = np.ones(frame.height, dtype=np.bool_)
    kept[rows] = False
    return frame.filter(pl.Series(kept)), findings


def relations_to_nowhere(track: SurveyedTrack, links: pl.DataFrame) -> tuple[pl.DataFrame, list[Finding]]:
    """The relations between elements that there are; of each other one a finding."""
    ids = pl.Series(track.ids, dtype=pl.String).implode()
    known = links["netelement_a"].is_in(ids) & links["netelement_b"].is_in(ids)
    findings = [
        Finding("warning", "links", f"relation {row[0]} - {row[2]} is not used: it names an element not in the track")
        for row in links.filter(~known).iter_rows()
    ]
    return links.filter(known), findings


def _relations_that_differ(links: pl.DataFrame, related: tuple[Ints, Ints]) -> Iterator[Finding]:
    """Two ends that are related more than once, and not alike: `network_of` allows what either allows."""
    ends = np.sort(np.column_stack(related), axis=1)
    _, same, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    repeated = links.filter(pl.Series(times[same.ravel()] > 1, dtype=pl.Boolean))
    words: dict[tuple[tuple[str, int], tuple[str, int]], list[str]] = {}
    from_other = {Navigability.AB.value: Navigability.BA.value, Navigability.BA.value: Navigability.AB.value}
    for a, a_end, b, b_end, navigability in repeated.iter_rows():
        if (a, a_end) <= (b, b_end):
            words.setdefault(((a, a_end), (b, b_end)), []).append(navigability)
        else:
            words.setdefault(((b, b_end), (a, a_end)), []).append(from_other.get(navigability, navigability))
    for ((a, a_end), (b, b_end)), kinds in words.items():
        if len(set(kinds)) > 1:
            text = f"end {a_end} of {a} and end {b_end} of {b} are related as {' and as '.join(dict.fromkeys(kinds))}"
            yield Finding("warning", "links", f"{text}: what either allows counts", "Correct the relations.")


def _related_ends(track: SurveyedTrack, links: pl.DataFrame) -> tuple[Ints, Ints]:
    """The two ends of each relation, as rows of `[element, 0 start or 1 end]` taken flat."""
    numbers = pl.DataFrame({"name": track.ids, "number": np.arange(len(track.ids))})
    sides = []
    for side in ("a", "b"):
        element = links.select(name=f"netelement_{side}").join(numbers, on="name", how="left", maintain_order="left")
        sides.append(2 * ints(element["number"]) + ints(links[f"position_{side}"]))
    return sides[0], sides[1]


def _relations_that_turn_back(
    links: pl.DataFrame, related: tuple[Ints, Ints], inward: Floats
) -> tuple[pl.DataFrame, list[Finding]]:
    """No train gets round a corner of less than a right angle: such a relation, as between the two branches of a
    switch, is not navigable, whatever it says.
    """
    side_a, side_b = related
    acute = pl.Series(np.einsum("ij,ij->i", inward[side_a], inward[side_b]) > 0.0, dtype=pl.Boolean)
    back = acute & (links["navigability"] != Navigability.NONE.value)
    findings = [
        Finding(
            "warning",
            "links",
            f"end {a_end} of {a} and end {b_end} of {b} are linked as navigable ({navigability}), but a train would "
            "have to turn by more than 90 degrees there: taken as not navigable",
            "Correct the relation.",
        )
        for a, a_end, b, b_end, navigability in links.filter(back).iter_rows()
    ]
    closed = pl.when(back).then(pl.lit(Navigability.NONE.value))
    return links.with_columns(navigability=closed.otherwise("navigability")), findings


def directions_inward(track: SurveyedTrack) -> np.ndarray:
    """Direction from each end into its element, earth-centred and not normed: `[element, 0 start or 1 end]`."""
    surface = track.surface
    start = track.first[:-1]
    stop = track.first[1:]
    directions = np.zeros((len(track.ids), 2, 3))
    for position, end, other_end, step in ((0, start, stop - 1, 1), (1, stop - 1, start, -1)):
        # Single vertices may lie a centimetre apart. A shorter element points to its vertex farthest away.
        inside = end + step
        near = np.arange(len(end))
        while len(near):
            away_m = np.linalg.norm(surface[inside[near]] - surface[end[near]], axis=1)
            near = near[away_m < SAMPLE_SPACING_M]
            at_other_end = inside[near] == other_end[near]
            for element in near[at_other_end].tolist():
                part = surface[track.vertex_range(element)]
                away_m = np.linalg.norm(part - surface[end[element]], axis=1)[::step]
                inside[element] = end[element] + step * int(np.argmax(away_m))
            near = near[~at_other_end]
            inside[near] += step
        directions[:, position] = surface[inside] - surface[end]
    return directions


def _check_elements(track: SurveyedTrack, declared_length_m: dict[str, float], collected: SiteRemarks) -> None:
    """Length, declared length, height and vertex spacing of each element."""
    geometric = track.geometric_m
    length_m = geometric[track.first[1:] - 1]
    stated_m = np.array([declared_length_m.get(name, np.nan) for name in track.ids])
    tolerance_m = np.maximum(MEASURE_TOLERANCE_M, collected.config.length_share * length_m)
    wrong = [np.abs(declared - length_m) > tolerance_m for declared in (track.length_m, stated_m)]
    chord_m = np.maximum.reduceat(chord_errors_m(track), track.first[:-1])
    remarkable = (length_m < GAP_COUNTS_M) | wrong[0] | wrong[1] | (chord_m > collected.config.chord_m)
    for element in np.flatnonzero(remarkable).tolist():
        place = f"track: element {track.ids[element]}"
        length = float(length_m[element])
        if length < GAP_COUNTS_M:
            collected.findings.append(Finding("warning", place, f"is only {length:.2f} m long"))
        for declared, off in zip((track.length_m, stated_m), wrong, strict=True):
            if off[element]:
                text = f"the declared length is {declared[element]:.1f} m, the geometry is {length:.1f} m long"
                collected.findings.append(Finding("warning", place, text, "Correct the measures or the geometry."))
        if chord_m[element] > collected.config.chord_m:
            spacing = float(np.diff(geometric[track.vertex_range(element)]).max())
            text = f"points up to {spacing:.0f} m apart: straight lines between them leave the curve by "
            text += f"{chord_m[element]:.2f} m"
            collected.findings.append(Finding("note", place, text, "Survey curves with closer points."))
    _check_heights(track, collected)


def _check_kinks(
    track: SurveyedTrack, links: pl.DataFrame, related: tuple[Ints, Ints], inward: Floats, collected: SiteRemarks
) -> None:
    """Corners at the ends of elements that are shorter than tracks are surveyed, where a train may pass."""
    length_m = track.geometric_m[track.first[1:] - 1]
    unit = inward / np.maximum(np.linalg.norm(inward, axis=1), 1e-12)[:, None]
    turn_deg = np.degrees(
        np.pi - np.arccos(np.clip(np.einsum("ij,ij->i", unit[related[0]], unit[related[1]]), -1.0, 1.0))
    )
    short_m = np.minimum(length_m[related[0] // 2], length_m[related[1] // 2])
    passed = (links["navigability"] != Navigability.NONE.value).to_numpy()
    for row in np.flatnonzero(passed & (short_m < GAP_COUNTS_M) & (turn_deg > collected.config.kink_deg)).tolist():
        a, b = (track.ids[int(side[row]) // 2] for side in related)
        text = f"turns by {turn_deg[row]:.0f} degrees into {b}, over an element of {short_m[row]:.2f} m"
        remedy = "Leave the short element out, or survey it over a longer way."
        collected.findings.append(Finding("warning", f"track: element {a}", text, remedy))


def _check_heights(track: SurveyedTrack, collected: SiteRemarks) -> None:
    """Refuse sites of which only some net elements have heights."""
    # An element has all heights or none.
    flat = [track.ids[element] for element in np.flatnonzero(np.isnan(track.height_m[track.first[:-1]])).tolist()]
    if flat and len(flat) < len(track.ids):
        text = (
            f"{len(flat)} of {len(track.ids)} elements lack heights and are taken as 2-D ({', '.join(flat[:3])}, ...)"
        )
        remedy = "Give heights for all elements, or for none."
        collected.findings.append(Finding("warning", "track: column height_m", text, remedy))


def chord_errors_m(track: SurveyedTrack) -> Floats:
    """How far the curve may lie off the chord that begins at each vertex [m]: length times turn over 8 (sagitta).

    Of the turns at its two ends the smaller one: the other may be that of a curve which only begins there. 0 for an
    element of one chord, and at the last vertex of each element.
    """
    surface = track.surface
    steps = np.diff(surface, axis=0, append=surface[-1:])
    lengths = np.linalg.norm(steps, axis=1)
    units = steps / np.maximum(lengths, 1e-12)[:, None]
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", units[:-1], units[1:]), -1.0, 1.0))
    begins, ends = (np.full(len(surface), np.inf) for _ in range(2))
    begins[1:] = turn
    ends[:-1] = turn
    begins[track.first[:-1]] = np.inf
    ends[track.first[1:] - 2] = np.inf
    least = np.minimum(begins, ends)
    errors = lengths * np.where(np.isfinite(least), least, 0.0) / 8.0
    errors[track.first[1:] - 1] = 0.0
    return np.asarray(errors)


def _check_gaps(track: SurveyedTrack, related: tuple[Ints, Ints], collected: SiteRemarks) -> None:
    """Ends that a relation joins must meet, in place and, where both have one, in height."""
    end_a, end_b = related
    places = end_places(track).reshape(-1, 3)
    gaps = np.linalg.norm(places[end_a] - places[end_b], axis=1)
    heights = track.height_m[np.column_stack([track.first[:-1], track.first[1:] - 1]).ravel()]
    steps = np.abs(heights[end_a] - heights[end_b])
    for row in np.flatnonzero((gaps > GAP_COUNTS_M) | (steps > GAP_COUNTS_M)).tolist():
        a, position_a, b, position_b, navigability = collected.links.row(row)
        ends = f"end {position_a} of {a} and end {position_b} of {b}"
        text = f"{ends} are linked but {gaps[row]:.1f} m apart"
        if gaps[row] > collected.config.joined_m and navigability != Navigability.NONE.value:
            collected.breaches.append(f"links: {text}; expected at most {collected.config.joined_m:g} m")
        elif gaps[row] > GAP_COUNTS_M:
            remedy = "The straight line between them counts as track; survey the missing piece."
            collected.findings.append(Finding("warning", "links", text, remedy))
        if steps[row] > GAP_COUNTS_M:
            text = f"{ends} differ by {steps[row]:.1f} m in height"
            collected.findings.append(Finding("warning", "links", text, "Correct the heights."))


def _near_miss_findings(
    track: SurveyedTrack, related: tuple[Ints, Ints], inward: Floats, config: SiteConfig
) -> Iterator[Finding]:
    """Free ends from which a train could go on: to a near end of another element, or to one that faces it."""
    free = np.ones(2 * len(track.ids), dtype=np.bool_)
    free[np.concatenate(related)] = False
    places = end_places(track).reshape(-1, 3)
    inward = inward / np.maximum(np.linalg.norm(inward, axis=1), 1e-9)[:, None]
    for end_a, end_b, gap in _close_ends(places, inward, free, config):
        element_a, position_a = divmod(end_a, 2)
        element_b, position_b = divmod(end_b, 2)
        if element_a != element_b:
            ends = f"end {position_a} of {track.ids[element_a]} and end {position_b} of {track.ids[element_b]}"
            text = f"{ends} are {gap:.2f} m apart and not linked"
            remedy = "Survey the missing piece, or add the relation, if trains run there."
            yield Finding("warning", "links", text, remedy)


def _pairs_within(places: Floats, reach_m: float) -> npt.NDArray[np.int64]:
    """Pairs of places near each other: those in the same or in neighbouring cells are compared."""
    cell = np.floor(places / reach_m).astype(np.int64)
    cell -= cell.min(axis=0, initial=np.iinfo(np.int64).max)
    # Numbers that wrap around only bring together places that the distance tells apart.
    across, above = (int(size) for size in cell.max(axis=0, initial=0)[1:] + 3)
    number = (cell[:, 0] * across + cell[:, 1]) * above + cell[:, 2]
    order = np.argsort(number, kind="stable")
    number = number[order]
    pairs = []
    for step in _HALF_OF_THE_NEIGHBOURS:
        # The cells below and above a neighbour have the numbers before and after it.
        neighbour = number + (step[0] * across + step[1]) * above
        low = np.searchsorted(number, neighbour - 1, side="left") if any(step) else np.arange(len(number)) + 1
        counts = np.maximum(np.searchsorted(number, neighbour + 1, side="right") - low, 0)
        first = np.repeat(np.arange(len(number)), counts)
        second = np.repeat(low, counts) + np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
        pairs.append(order[np.column_stack([first, second])])
    every: npt.NDArray[np.int64] = np.concatenate(pairs)
    near: Bools = np.linalg.norm(places[every[:, 0]] - places[every[:, 1]], axis=1) <= reach_m
    return every[near]


# Of two neighbouring columns of cells one comes first.
_HALF_OF_THE_NEIGHBOURS = [step for step in itertools.product((-1, 0, 1), repeat=2) if step >= (0, 0)]


def _close_ends(places: Floats, inward: Floats, free: np.ndarray, config: SiteConfig) -> list[tuple[int, int, float]]:
    """Pairs of ends, and how far apart they are."""
    near = _pairs_within(places, config.near_ends_m)
    onward = np.einsum("ij,ij->i", inward[near[:, 0]], inward[near[:, 1]]) < 0.0
    near = near[onward & free[near].any(axis=1)]
    alone = np.flatnonzero(free)
    far = alone[_pairs_within(places[alone], config.facing_m)]
    across = places[far[:, 1]] - places[far[:, 0]]
    gap = np.linalg.norm(across, axis=1)
    ahead = [sign * np.einsum("ij,ij->i", inward[far[:, side]], across) for side, sign in ((0, -1.0), (1, 1.0))]
    opposite = (gap > config.near_ends_m) & (np.minimum(*ahead) > gap * config.facing_cosine)
    nearest: dict[int, int] = {}
    for row in np.flatnonzero(opposite)[np.argsort(gap[opposite], kind="stable")].tolist():
        for end in far[row].tolist():
            nearest.setdefault(end, row)
    both = [far[row] for row in set(nearest.values()) if all(nearest[end] == row for end in far[row].tolist())]
    pairs = sorted({(int(min(pair)), int(max(pair))) for pair in [*near, *both]})
    return [(first, second, float(np.linalg.norm(places[first] - places[second]))) for first, second in pairs]


def _check_balises(track: SurveyedTrack, balises: pl.DataFrame, collected: SiteRemarks) -> None:
    """Refuse balises that a site cannot have."""
    repeated = balises.filter(pl.col("balise_id").is_duplicated())["balise_id"].unique().sort().to_list()
    if repeated:
        collected.breaches.append(f"balises: column balise_id: {', '.join(repeated[:3])} occur more than once")
    off = [
        Finding("error", f"{BALISE_PLACE}{name}", *what)
        for name, element, measure in balises.select("balise_id", "netelement_id", "measure_m").iter_rows()
        if (what := _why_off_track(track, element, measure)) is not None
    ]
    collected.findings += off
    if off and len(off) == balises.height:
        collected.breaches.append(f"balises: none lies on a net element of the track; {off[0].place} {off[0].message}")


def _why_off_track(track: SurveyedTrack, element: str, measure_m: float) -> tuple[str, str] | None:
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


def route_breaches(track: SurveyedTrack, route: pl.DataFrame, config: SiteConfig) -> list[str]:
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
