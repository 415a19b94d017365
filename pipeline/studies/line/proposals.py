"""Balises to place: virtual ones on suitable pieces, physical ones over the rest, at several distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.read.site.alike import window_findings
from pipeline.stages.run_row.bounds import clopper_pearson
from pipeline.stages.track.network import Network, network_of
from pipeline.studies.line.classes import KEYS
from pipeline.studies.line.pieces import Pieces
from pipeline.studies.line.spans import SpanState
from schemas.arrays import Bools, Floats, floats
from schemas.config import LdsConfig
from schemas.conform import conform
from schemas.enums import BaliseDirection, BaliseKind, Reaction
from schemas.line import LineBalises, LineCriteria, LineDirection, LineProposals, PieceClass
from schemas.run import Site

# Directions of travel, ahead along the ways that the elements form or against it.
MODES = {"both": (True, False), "ahead": (True,), "back": (False,)}


@dataclass(frozen=True)
class LineEvidence:
    """What a proposal is made of: classes and counts per piece, the ways, the points to serve."""

    site: Site
    pieces: Pieces
    table: pl.DataFrame
    passes: pl.DataFrame
    points: pl.DataFrame
    criteria: LineCriteria
    lds: LdsConfig


@dataclass(frozen=True)
class _PieceOnWay:
    """A piece on a way, its middle `at_m` from the begin of the way; `growing`: the way runs with its measure."""

    piece: int
    at_m: float
    growing: bool


@dataclass(frozen=True)
class _Proposed:
    """A balise that was placed; `distance_m` from the one before on the way, over the pieces `since` that one.

    `direction`: along its net element, in which it is valid; a physical one in both.
    """

    piece: int
    virtual: bool
    direction: BaliseDirection
    distance_m: float | None
    near: str
    since: tuple[int, ...]


def proposals(line: LineEvidence) -> tuple[pl.DataFrame, pl.DataFrame]:
    """`LineProposals` and `LineBalises`; none where no piece is suitable."""
    rows = []
    balises = []
    ways = _ways(line)
    growing = np.ones(len(line.pieces.element), dtype=np.bool_)
    for place in (place for way in ways for place in way):
        growing[place.piece] = place.growing
    for mode, sides in MODES.items():
        allowed = _allowed(line, sides, growing)
        if not allowed.any():
            continue
        for spacing_m in line.criteria.spacings_m:
            name = f"{mode}-{spacing_m:g}m"
            placed = _disjoint(
                line, [placement for way in ways for placement in _walk(line, way, allowed, sides, spacing_m)]
            )
            balises.append(_balises(line, name, placed))
            rows.append(_figures(line, name, spacing_m, mode, placed, growing))
    empty = {name: pl.Series([], dtype=column.dtype) for name, column in LineBalises.columns().items()}
    table = pl.concat(balises) if balises else pl.DataFrame(empty)
    return _conformed(rows), conform(table, LineBalises)


def _conformed(rows: list[dict[str, object]]) -> pl.DataFrame:
    schema = {name: column.dtype for name, column in LineProposals.columns().items()}
    return conform(pl.DataFrame(rows, schema=schema), LineProposals)


def site_balises(balises: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """A proposal as the `balises` table of a site."""
    return balises.select(
        "balise_id",
        "netelement_id",
        "measure_m",
        "kind",
        location_accuracy_m=pl.lit(criteria.location_accuracy_m),
        linked=pl.lit(value=True),
        link_reaction=pl.lit(Reaction.SERVICE_BRAKE.value),
        direction="direction",
    )


def _travelled(line: LineEvidence) -> Bools:
    """Pieces that some run passed, whatever was found there; `[piece, 0 growing 1 falling]`."""
    seen = np.zeros((len(line.pieces.element), 2), dtype=np.bool_)
    rows = line.passes.filter(line.passes["state"] != int(SpanState.WRONG_TRACK)).select("piece", "growing").unique()
    seen[rows["piece"].to_numpy(), (~rows["growing"]).cast(pl.Int64).to_numpy()] = True
    return seen


def _allowed(line: LineEvidence, sides: Sequence[bool], growing: Bools) -> Bools:
    """Pieces suitable in every one of these directions along their ways."""
    suitable = (line.table["piece_class"].cast(pl.String) == PieceClass.SUITABLE.value).to_numpy()
    rising = suitable[0::2]
    falling = suitable[1::2]
    good = {True: np.where(growing, rising, falling), False: np.where(growing, falling, rising)}
    allowed: Bools = np.logical_and.reduce([good[ahead] for ahead in sides])
    return allowed


def _ways(line: LineEvidence) -> list[list[_PieceOnWay]]:
    """The pieces of the travelled net elements in chains that trains can run, each element once."""
    network = network_of(line.pieces.track, line.site.links)
    seen = _travelled(line).any(axis=1)
    wanted = {int(element) for element in np.unique(line.pieces.element[seen])}
    ways = []
    while wanted:
        start = min(
            (2 * piece + side for piece in wanted for side in (0, 1)), key=lambda way: _rank(network, way, wanted)
        )
        ways.append(list(_chain(network, line.pieces, start, wanted)))
    return ways


def _rank(network: Network, oriented: int, wanted: set[int]) -> tuple[int, int]:
    """First those elements that nothing wanted leads to: ends of the line."""
    entries = sum(edge.to // 2 in wanted for edge in network.successors[oriented ^ 1])
    return min(entries, 1), oriented


def _chain(network: Network, pieces: Pieces, start: int, wanted: set[int]) -> Iterator[_PieceOnWay]:
    oriented: int | None = start
    entry_m = 0.0
    while oriented is not None:
        element = oriented // 2
        wanted.discard(element)
        numbers = range(int(pieces.first[element]), int(pieces.first[element + 1]))
        begin_m = float(pieces.from_m[numbers[0]])
        end_m = float(pieces.to_m[numbers[-1]])
        for number in numbers if oriented % 2 == 0 else reversed(numbers):
            middle_m = 0.5 * float(pieces.from_m[number] + pieces.to_m[number])
            at_m = middle_m - begin_m if oriented % 2 == 0 else end_m - middle_m
            yield _PieceOnWay(number, entry_m + at_m, oriented % 2 == 0)
        edges = [edge for edge in network.successors[oriented] if edge.to // 2 in wanted]
        entry_m += network.length_m(oriented) + (edges[0].gap_m if edges else 0.0)
        oriented = edges[0].to if edges else None


def _walk(
    line: LineEvidence, way: Sequence[_PieceOnWay], allowed: Bools, sides: Sequence[bool], spacing_m: float
) -> Iterator[_Proposed]:
    """At each step the best piece about a spacing on; where none is allowed a physical one.

    Best is near a station or signal, then at the spacing itself.
    """
    at_m = np.array([place.at_m for place in way])
    good = allowed[[place.piece for place in way]]
    spacing_m = min(spacing_m, line.criteria.longest_m)
    near = _near(line)
    play_m = line.criteria.spacing_play * spacing_m
    longest_m = min(spacing_m + play_m, line.criteria.longest_m)
    last_m = float(at_m[0]) - spacing_m
    begun = False
    limit_m = float(at_m[-1])
    while last_m + spacing_m <= limit_m:
        inside = (at_m >= last_m + spacing_m - play_m) & (at_m <= last_m + longest_m)
        choice = _best(way, np.flatnonzero(inside & good), last_m + spacing_m, near)
        virtual = choice is not None
        index = int(np.argmin(np.abs(at_m - last_m - spacing_m))) if choice is None else choice
        distance_m = float(at_m[index]) - last_m if begun else None
        since = tuple(place.piece for place in way if last_m < place.at_m <= at_m[index])
        direction = _direction(way[index], sides) if virtual else BaliseDirection.BOTH
        yield _Proposed(
            way[index].piece, virtual, direction, distance_m, near.get(way[index].piece, ("", 0.0))[0], since
        )
        last_m = max(float(at_m[index]), last_m + spacing_m - play_m)
        begun = True


def _direction(place: _PieceOnWay, sides: Sequence[bool]) -> BaliseDirection:
    """In which direction along its net element a balise serves travel ahead along the way, or against it."""
    if len(sides) > 1:
        return BaliseDirection.BOTH
    return BaliseDirection.AB if place.growing == sides[0] else BaliseDirection.BA


def _best(
    way: Sequence[_PieceOnWay],
    candidates: np.ndarray[tuple[int], np.dtype[np.int64]],
    target_m: float,
    near: dict[int, tuple[str, float]],
) -> int | None:
    def worth(index: int) -> tuple[bool, float, float]:
        served = near.get(way[index].piece)
        return served is None, served[1] if served else 0.0, abs(way[index].at_m - target_m)

    return min((int(index) for index in candidates), key=worth, default=None)


def _near(line: LineEvidence) -> dict[int, tuple[str, float]]:
    """Pieces near stations and signals of the same net element: name and distance [m]."""
    nearest: dict[int, tuple[str, float]] = {}
    middle_m = 0.5 * (line.pieces.from_m + line.pieces.to_m)
    for name, element_name, measure_m in line.points.select("name", "netelement_id", "measure_m").iter_rows():
        element = line.pieces.track.index[element_name]
        for piece in range(int(line.pieces.first[element]), int(line.pieces.first[element + 1])):
            away_m = abs(float(middle_m[piece]) - measure_m)
            if away_m <= line.criteria.near_m and (piece not in nearest or away_m < nearest[piece][1]):
                nearest[piece] = (name, away_m)
    return nearest


def _disjoint(line: LineEvidence, placed: list[_Proposed]) -> list[_Proposed]:
    """Without balises whose windows linking cannot tell apart, as where ways meet; the later one goes."""
    while True:
        named = {f"B{placement.piece}": placement for placement in placed}
        balises = _named(line, placed).with_columns(balise_id=pl.Series(list(named), dtype=pl.String))
        # Announced in one list, whatever their kind.
        table = site_balises(balises, line.criteria).with_columns(kind=pl.lit(BaliseKind.VIRTUAL.value))
        clashes = window_findings(replace(line.site, balises=table), line.lds)
        if not clashes:
            return placed
        gone = {max(clash.place.removeprefix("balises ").split(", "), key=list(named).index) for clash in clashes[:1]}
        placed = [placement for name, placement in named.items() if name not in gone]


def _named(line: LineEvidence, placed: Sequence[_Proposed]) -> pl.DataFrame:
    """Place, kind and direction of each balise."""
    piece = [placement.piece for placement in placed]
    middle_m = 0.5 * (line.pieces.from_m + line.pieces.to_m)[piece]
    names = line.pieces.names
    kind = [(BaliseKind.VIRTUAL if placement.virtual else BaliseKind.PHYSICAL).value for placement in placed]
    columns = {
        "netelement_id": [names[number] for number in piece],
        "measure_m": np.round(middle_m, 3),
        "kind": kind,
        "direction": [placement.direction.value for placement in placed],
    }
    return pl.DataFrame(columns, schema={name: LineBalises.columns()[name].dtype for name in columns})


def _balises(line: LineEvidence, name: str, placed: Sequence[_Proposed]) -> pl.DataFrame:
    why = pl.format("{} {}: {}", "direction", "piece_class", "cause").str.join(", ")
    worst = dict(line.table.group_by("piece").agg(why).iter_rows())
    proved = _allowed(line, MODES["both"], np.ones(len(line.pieces.element), dtype=np.bool_))
    errors = dict(line.table.group_by("piece").agg(pl.col("largest_undetected_m").max()).iter_rows())
    distance = pl.Series([placement.distance_m for placement in placed], dtype=pl.Float64)
    numbers = {True: 0, False: 0}
    ids = []
    for placement in placed:
        numbers[placement.virtual] += 1
        ids.append(f"{'VB' if placement.virtual else 'PB'}{numbers[placement.virtual]:03d}")
    return (
        _named(line, placed)
        .with_columns(
            proposal=pl.lit(name),
            balise_id=pl.Series(ids, dtype=pl.String),
            why=pl.Series(
                ["" if placement.virtual else worst[placement.piece] for placement in placed], dtype=pl.String
            ),
            near=pl.Series([placement.near for placement in placed], dtype=pl.String),
            distance_m=distance,
            odometer_confidence_m=line.lds.odometer_fixed_m + line.lds.odometer_share * distance,
            largest_undetected_m=pl.Series([_largest(errors, placement) for placement in placed], dtype=pl.Float64),
            proved=pl.Series(
                [bool(proved[placement.piece]) and placement.virtual for placement in placed], dtype=pl.Boolean
            ),
        )
        .select(*LineBalises.columns())
    )


def _largest(errors: dict[int, float | None], placement: _Proposed) -> float | None:
    known = (errors.get(piece) for piece in placement.since)
    return max((error for error in known if error is not None), default=None)


def _figures(
    line: LineEvidence, name: str, spacing_m: float, mode: str, placed: Sequence[_Proposed], growing: Bools
) -> dict[str, object]:
    virtual = [placement.piece for placement in placed if placement.virtual]
    sides = [(piece, bool(growing[piece]) == ahead, ahead) for piece in virtual for ahead in MODES[mode]]
    schema = {"piece": pl.Int64, "growing": pl.Boolean, "ahead": pl.Boolean}
    wanted = pl.DataFrame(sides, schema=schema, orient="row")
    sided = line.table.with_columns(growing=pl.col("direction").cast(pl.String) == LineDirection.GROWING.value)
    lost = wanted.join(sided, on=KEYS).group_by("ahead").agg(pl.col("loss_share").sum(), pl.col("loss_high").sum())
    decided = (pl.col("state") >= int(SpanState.UNKNOWN)) | (pl.col("state") == int(SpanState.RIGHT))
    judged = line.passes.filter(decided).join(wanted, on=KEYS)
    # What the evidence should have judged and did not may have been wrong.
    maybe = pl.col("state").is_in([int(SpanState.UNKNOWN), int(SpanState.WRONG_IN_USE)])
    journeys = judged.group_by("run_id").agg(wrong=maybe.any())
    distances: Floats = np.array([placement.distance_m for placement in placed if placement.distance_m is not None])
    longest_m = float(distances.max()) if len(distances) else None
    served = {placement.near for placement in placed if placement.near and placement.virtual}
    return {
        "proposal": name,
        "spacing_m": spacing_m,
        "directions": mode,
        "virtual": len(virtual),
        "physical": len(placed) - len(virtual),
        "longest_distance_m": longest_m,
        "odometer_confidence_m": None
        if longest_m is None
        else line.lds.odometer_fixed_m + line.lds.odometer_share * longest_m,
        "expected_lost": max(floats(lost, "loss_share").tolist(), default=None),
        "expected_lost_high": max(floats(lost, "loss_high").tolist(), default=None),
        "journeys": journeys.height,
        "unsafe_high": clopper_pearson(int(journeys["wrong"].sum()), journeys.height, line.criteria.confidence).high,
        "points_served": len(served),
        "points": line.points.height,
    }
