"""Pieces of line to net elements and net relations: cut where lines share a node, linked as given, else by angle."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.make.survey.pieces import COLUMNS, LinePiece, Relation, Survey
from pipeline.read.site.checks import directions_inward, relations_to_nowhere
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.survey import geometric_measures_m, track_of
from schemas.arrays import Floats, Ints, spans_of
from schemas.config import SurveyConfig
from schemas.enums import Navigability
from schemas.frozen import frozen
from schemas.inputs import Links

# OpenStreetMap writes seven decimals of a degree: equal positions are the same node.
_NODE_DEG = 1e-7


@frozen
class SurveyNetwork:
    """Net elements with the nodes at their two ends, and the links between ends.

    `track`: the table of their points, with `line_km` beside the contract's columns.
    """

    elements: list[LinePiece]
    ends: Ints
    links: pl.DataFrame
    track: pl.DataFrame


_NOTHING = SurveyNetwork([], np.zeros((0, 2), dtype=np.int64), Links.create_empty(), pl.DataFrame())


def make_network(survey: Survey, join_m: float | None, config: SurveyConfig) -> SurveyNetwork:
    """Net elements of all pieces; ends within `join_m` (else: in one place) of a vertex of another piece meet it.

    Net elements of a network with relations stay as they are, and meet where it says. What is doubtful about it is
    added to the survey's findings.
    """
    pieces = [piece for piece in survey.pieces if len(piece) > 1]
    if (short := len(survey.pieces) - len(pieces)) > 0:
        survey.report("note", "survey", f"{short} lines with fewer than two points are left out")
    if not pieces:
        return _NOTHING
    nodes = _node_numbers(pieces, config.same_place_m if join_m is None else join_m, survey.relations)
    if pieces[0].whole:
        ends = np.array([piece_nodes[[0, -1]] for piece_nodes in nodes])
        return _with_links(pieces, ends, set(), set(), survey, config)
    pieces, nodes = _without_repeated_stretches(pieces, nodes, survey)
    if not pieces:
        return _NOTHING
    switches = _nodes_at(pieces, nodes, survey.switches_deg, config)
    crossings = _crossing_nodes(pieces, nodes, switches, survey, config)
    return _with_links(*_cut_at_nodes(pieces, nodes, crossings), crossings, switches, survey, config)


def _with_links(
    elements: list[LinePiece], ends: Ints, crossings: set[int], switches: set[int], survey: Survey, config: SurveyConfig
) -> SurveyNetwork:
    """A network with its links between net elements."""
    track = _track_table(elements)
    return SurveyNetwork(elements, ends, _link_table(track, ends, crossings, switches, survey, config), track)


def _track_table(elements: list[LinePiece]) -> pl.DataFrame:
    """Points of the elements in order, measures along their geometry; null for what is not known."""
    measures = [geometric_measures_m(line.latitude_deg, line.longitude_deg, line.height_m) for line in elements]
    columns = {name: np.concatenate([getattr(element, name) for element in elements]) for name in COLUMNS}
    names = list(itertools.chain.from_iterable([element.name] * len(element) for element in elements))
    return pl.DataFrame({"netelement_id": names, "measure_m": np.concatenate(measures), **columns}, nan_to_null=True)


def _node_numbers(pieces: list[LinePiece], join_m: float, relations: list[Relation]) -> list[Ints]:
    """A number per point; points that are one node have the same: near each other, or joined by a relation."""
    latitude = np.concatenate([piece.latitude_deg for piece in pieces])
    longitude = np.concatenate([piece.longitude_deg for piece in pieces])
    last = np.cumsum([len(piece) for piece in pieces])
    keys = np.rint(np.column_stack([latitude, longitude]) / _NODE_DEG).astype(np.int64)
    node = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    piece_of = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    ends = np.unique(np.concatenate([last - [len(piece) for piece in pieces], last - 1]))
    pairs = list(_meeting_points(points_of(latitude, longitude).surface, piece_of, ends, join_m))
    end_row = {(piece.name, 1): int(row) - 1 for piece, row in zip(pieces, last, strict=True)}
    end_row |= {(piece.name, 0): int(row) - len(piece) for piece, row in zip(pieces, last, strict=True)}
    pairs += [
        (end_row[a, a_end], end_row[b, b_end])
        for a, a_end, b, b_end, navigability in relations
        if navigability != Navigability.NONE.value and (a, a_end) in end_row and (b, b_end) in end_row
    ]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    count = int(node.max()) + 1
    same = coo_array((np.ones(len(rows)), (node[rows], node[columns])), shape=(count, count))
    joined = connected_components(same, directed=False)[1][node]
    return [np.asarray(part) for part in np.split(joined, last[:-1])]


def _meeting_points(surface: Floats, piece_of: Ints, ends: Ints, join_m: float) -> Iterator[tuple[int, int]]:
    """The nearest vertex of another piece within reach of each end, or an end of its own (a ring)."""
    tree = cKDTree(surface)
    at_end = np.zeros(len(surface), dtype=bool)
    at_end[ends] = True
    for end, near in zip(ends, tree.query_ball_point(surface[ends], join_m), strict=True):
        others = [row for row in near if row != end and (piece_of[row] != piece_of[end] or at_end[row])]
        if others:
            apart_m = np.linalg.norm(surface[others] - surface[end], axis=1)
            yield int(end), others[int(np.argmin(apart_m))]


def _without_repeated_stretches(
    pieces: list[LinePiece], nodes: list[Ints], survey: Survey
) -> tuple[list[LinePiece], list[Ints]]:
    """Pieces with each stretch between two nodes once: the first line that has it keeps it."""
    known: set[tuple[int, int]] = set()
    kept = []
    kept_nodes = []
    for piece, piece_nodes in zip(pieces, nodes, strict=True):
        edges = [(min(ends), max(ends)) for ends in itertools.pairwise(piece_nodes.tolist())]
        new = np.array([edge not in known and edge[0] != edge[1] for edge in edges])
        doubled = sum(edge in known for edge in edges)
        known.update(edges)
        if doubled:
            text = f"{doubled} of its {len(edges)} segments stand in the survey already and are left out"
            survey.report("warning", f"track: {piece.name}", text, "Look whether one track was given twice.")
        for first, last in spans_of(new):
            kept.append(piece.take(np.arange(first, last + 2)))
            kept_nodes.append(piece_nodes[first : last + 2])
    return kept, kept_nodes


def _crossing_nodes(
    pieces: list[LinePiece], nodes: list[Ints], switches: set[int], survey: Survey, config: SurveyConfig
) -> set[int]:
    """Nodes where tracks cross without a switch: those named so, and those where two lines just run through.

    Nobody can take such a node of two lines for a slip by its geometry; a survey that names it a switch is believed.
    """
    inner = np.concatenate([piece_nodes[1:-1] for piece_nodes in nodes])
    at_ends = np.unique(np.concatenate([piece_nodes[[0, -1]] for piece_nodes in nodes]))
    through, count = np.unique(inner, return_counts=True)
    named = _nodes_at(pieces, nodes, survey.crossings_deg, config)
    by_form = set(np.setdiff1d(through[count == 2], at_ends).tolist()) - switches
    _report_crossings(pieces, nodes, by_form - named, survey)
    return named | by_form


def _report_crossings(pieces: list[LinePiece], nodes: list[Ints], unnamed: set[int], survey: Survey) -> None:
    """One note for each pair of lines that cross."""
    names: dict[int, set[str]] = {node: set() for node in unnamed}
    for piece, piece_nodes in zip(pieces, nodes, strict=True):
        for node in piece_nodes[np.isin(piece_nodes, list(unnamed))].tolist():
            names[node].add(piece.name)
    for pair, count in sorted(Counter(tuple(sorted(both)) for both in names.values()).items()):
        times = f" ({count} times)" if count > 1 else ""
        text = f"cross where neither ends{times}: taken as a crossing without a switch"
        remedy = "Where trains turn off (a slip), name the node `railway=switch`, or end the lines there."
        survey.report("note", f"track: {', '.join(pair)}", text, remedy)


def _nodes_at(
    pieces: list[LinePiece], nodes: list[Ints], places_deg: list[tuple[float, float]], config: SurveyConfig
) -> set[int]:
    """The nodes at places (latitude, longitude)."""
    if not places_deg:
        return set()
    tree = cKDTree(np.concatenate([piece.surface for piece in pieces]))
    wanted = points_of(*np.array(places_deg).T).surface
    row = tree.query(wanted, distance_upper_bound=config.same_place_m)[1]
    return set(np.concatenate(nodes)[row[row < tree.n]].tolist())


def _cut_at_nodes(pieces: list[LinePiece], nodes: list[Ints], crossings: set[int]) -> tuple[list[LinePiece], Ints]:
    """Elements from node to node; the parts of a piece are named `id.1`, `id.2` along it."""
    passing = np.bincount(np.concatenate(nodes))
    parts: list[LinePiece] = []
    ends = []
    for piece, piece_nodes in zip(pieces, nodes, strict=True):
        is_cut = [passing[node] > 1 and node not in crossings for node in piece_nodes.tolist()]
        inner = [row for row in range(1, len(piece_nodes) - 1) if is_cut[row]]
        for first, last in itertools.pairwise([0, *inner, len(piece_nodes) - 1]):
            parts.append(piece.take(np.arange(first, last + 1)))
            ends.append(piece_nodes[[first, last]])
    count = Counter(part.name for part in parts)
    number: Counter[str] = Counter()
    elements = []
    for part in parts:
        number[part.name] += 1
        elements.append(part if count[part.name] == 1 else replace(part, name=f"{part.name}.{number[part.name]}"))
    return elements, np.array(ends, dtype=np.int64).reshape(-1, 2)


def arms_of(ends: Ints) -> dict[int, list[tuple[int, int]]]:
    """Elements and their ends at each node."""
    arms: dict[int, list[tuple[int, int]]] = {}
    for (element, position), node in np.ndenumerate(ends):
        arms.setdefault(int(node), []).append((element, position))
    return arms


def _link_table(
    table: pl.DataFrame, ends: Ints, crossings: set[int], switches: set[int], survey: Survey, config: SurveyConfig
) -> pl.DataFrame:
    """The relations given, as they are; of ends that none of them names every pair at a node, by its angle.

    By angle a pair is navigable in both directions where a train can take that branch, else not at all.
    """
    track = track_of(table)
    relations = survey.relations
    directions = directions_inward(track)
    names = track.ids
    named = {end for a, a_end, b, b_end, _ in relations for end in ((a, a_end), (b, b_end))}
    rows = list(relations)
    guessed = []
    for node, meeting in arms_of(ends).items():
        here = [(names[element], position) for element, position in meeting]
        unsaid = [pair for pair in itertools.combinations(range(len(here)), 2) if not {here[k] for k in pair} <= named]
        if len(here) > 1 and not unsaid:
            continue
        units = [directions[arm] / max(float(np.linalg.norm(directions[arm])), 1e-9) for arm in meeting]
        pairs = _navigable_pairs(units, node in crossings, node in switches, config.switch_deg)
        for pair in unsaid:
            navigability = Navigability.BOTH if pair in pairs else Navigability.NONE
            first, second = (here[k] for k in pair)
            rows.append((*first, *second, navigability.value))
        guessed += [here] * bool(unsaid)
        if node not in crossings | switches:
            _report_dead_ends([name for name, _ in here], pairs, survey)
    _report_guesses(guessed, len(rows) - len(relations), bool(relations), survey)
    links = Links.validate(pl.DataFrame(rows, schema=list(Links.columns()), orient="row"), cast=True)
    known, findings = relations_to_nowhere(track, links)
    survey.findings += findings
    return known


def _report_guesses(nodes: list[list[tuple[str, int]]], pairs: int, some_given: bool, survey: Survey) -> None:
    """A finding where relations are made by angle; a warning where the survey gives relations elsewhere."""
    if not nodes:
        return
    first = " and ".join(f"end {position} of {name}" for name, position in nodes[0])
    text = f"the survey gives no relation at {len(nodes)} nodes ({first}{', ...' if len(nodes) > 1 else ''})"
    text += f": {pairs} relations are by the angles between the lines"
    survey.report("warning" if some_given else "note", "links", text, "Look whether trains can run so.")


def _navigable_pairs(units: list[Floats], crossing: bool, switch: bool, switch_deg: float) -> set[tuple[int, int]]:
    """Pairs of arms that a train can take; at a crossing each arm goes on straight only.

    Two arms that meet two are a crossing, unless the survey names a switch (a slip) there.
    """
    turns = {
        (first, second): float(np.degrees(np.arccos(np.clip(-units[first] @ units[second], -1.0, 1.0))))
        for first, second in itertools.combinations(range(len(units)), 2)
    }
    # A train bends by its curve alone, 57 degrees over the 20 m that an end's direction is taken from and the sharpest
    # tram curve of 20 m.
    most = 90.0 if len(units) == 2 else switch_deg
    possible = {pair for pair, turn in turns.items() if turn <= most}
    partners = [sum(arm in pair for pair in possible) for arm in range(len(units))]
    two_by_two = partners == [2, 2, 2, 2]
    if not (crossing or (two_by_two and not switch)):
        return possible
    straight: set[tuple[int, int]] = set()
    for pair in sorted(possible, key=lambda pair: turns[pair]):
        if not {arm for joined in straight for arm in joined} & set(pair):
            straight.add(pair)
    return straight


def _report_dead_ends(names: list[str], pairs: set[tuple[int, int]], survey: Survey) -> None:
    """Report net elements at a node from which no train gets on."""
    place = f"links: {', '.join(names)}"
    lonely = [name for arm, name in enumerate(names) if len(names) > 1 and not any(arm in pair for pair in pairs)]
    if lonely:
        text = f"no train gets from {', '.join(lonely)} to another of these: the corner is too sharp"
        survey.report("warning", place, text, "Mend the survey there, or the relation.")
    if len(names) > 3:
        kind = "a crossing without a switch" if len(pairs) == len(names) / 2 else "switches, by their angles"
        text = f"{len(names)} ends meet at one node, which the survey does not name: taken as {kind}"
        survey.report("note", place, text, "Name the node `railway=switch` or `railway=railway_crossing`.")
