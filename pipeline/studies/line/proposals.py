"""Balises to place: virtual ones on suitable pieces, physical ones over the rest, at several distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.read.site.alike import window_findings
from pipeline.stages.run_row.bounds import clopper_pearson
from pipeline.stages.track.network import Network, network_of
from pipeline.studies.line.classes import KEYS
from pipeline.studies.line.pieces import Pieces
from pipeline.studies.line.spans import SpanState
from schemas.arrays import Bools
from schemas.config import LdsConfig
from schemas.conform import conform, dtypes
from schemas.enums import BaliseDirection, BaliseKind, Reaction
from schemas.frozen import frozen
from schemas.line import LineBalises, LineCriteria, LineDirection, LineProposals, PieceClass
from schemas.run import Site

# Directions of travel, ahead along the chains that the elements form or against it.
MODES = {"both": (True, False), "ahead": (True,), "back": (False,)}


@frozen
class LineEvidence:
    """What a proposal is made of: classes and counts per piece, the chains, the points to serve."""

    site: Site
    pieces: Pieces
    table: pl.DataFrame
    passes: pl.DataFrame
    points: pl.DataFrame
    criteria: LineCriteria
    lds: LdsConfig


_CHAIN_COLUMNS = {"piece": pl.Int64, "at_m": pl.Float64, "growing": pl.Boolean}
"""A chain: pieces in the order of a train, their middles from its begin; `growing`: with their measure."""
_PLACED: dict[str, pl.DataType | type[pl.DataType]] = {
    "piece": pl.Int64,
    "growing": pl.Boolean,
    "virtual": pl.Boolean,
    "distance_m": pl.Float64,
    "since": pl.List(pl.Int64),
}
"""A balise on a piece of a chain; `distance_m` from the one before, over the pieces `since` that one."""


def propose_balises(line: LineEvidence) -> tuple[pl.DataFrame, pl.DataFrame]:
    """`LineProposals` and `LineBalises`; none where no piece is suitable."""
    rows = []
    balises = [pl.DataFrame(schema=dtypes(LineBalises))]
    chains = _chains(line)
    growing = np.ones(len(line.pieces.element), dtype=np.bool_)
    for chain in chains:
        growing[chain["piece"].to_numpy()] = chain["growing"].to_numpy()
    near = _nearest_points(line)
    for mode, sides in MODES.items():
        allowed = _are_allowed(line, sides, growing)
        if not allowed.any():
            continue
        for spacing_m in line.criteria.spacings_m:
            name = f"{mode}-{spacing_m:g}m"
            walked = [
                row
                for chain in chains
                for row in _place_along(chain, allowed, near["near_m"], spacing_m, line.criteria)
            ]
            placed = _without_overlaps(line, _with_places(line, walked, sides, near["near"]))
            balises.append(_balise_rows(line, name, placed))
            rows.append(_proposal_figures(line, name, spacing_m, mode, placed, growing))
    table = pl.DataFrame(rows, schema=dtypes(LineProposals))
    return conform(table, LineProposals), conform(pl.concat(balises), LineBalises)


def site_balises(balises: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """A proposal as the `balises` table of a site.

    Args:
        balises: a proposal.
        criteria: location accuracy of its balises [m].

    Returns:
        Rows of `balises.parquet` (CONTRACT section 2).
    """
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


def _are_allowed(line: LineEvidence, sides: Sequence[bool], growing: Bools) -> Bools:
    """Pieces suitable in every one of these directions along their chains."""
    suitable = (line.table["piece_class"].cast(pl.String) == PieceClass.SUITABLE.value).to_numpy()
    rising = suitable[0::2]
    falling = suitable[1::2]
    good = {True: np.where(growing, rising, falling), False: np.where(growing, falling, rising)}
    allowed: Bools = np.logical_and.reduce([good[ahead] for ahead in sides])
    return allowed


def _chains(line: LineEvidence) -> list[pl.DataFrame]:
    """The pieces of the travelled net elements in chains that trains can run (`_CHAIN_COLUMNS`), each element once."""
    network = network_of(line.pieces.track, line.site.links)
    passed = line.passes.filter(pl.col("state") != int(SpanState.WRONG_TRACK))["piece"].unique()
    wanted = {int(element) for element in np.unique(line.pieces.element[passed.to_numpy()])}
    chains = []
    while wanted:
        start = min(
            (2 * piece + side for piece in wanted for side in (0, 1)),
            key=lambda oriented: _chain_order(network, oriented, wanted),
        )
        chains.append(
            pl.DataFrame(list(_chain(network, line.pieces, start, wanted)), schema=_CHAIN_COLUMNS, orient="row")
        )
    return chains


def _chain_order(network: Network, oriented: int, wanted: set[int]) -> tuple[int, int]:
    """First those elements that nothing wanted leads to: ends of the line."""
    entries = sum(edge.to // 2 in wanted for edge in network.successors[oriented ^ 1])
    return min(entries, 1), oriented


def _chain(network: Network, pieces: Pieces, start: int, wanted: set[int]) -> Iterator[tuple[int, float, bool]]:
    """Rows of `_CHAIN_COLUMNS` from an oriented element on, over wanted elements only; takes these out of `wanted`."""
    oriented: int | None = start
    entry_m = 0.0
    while oriented is not None:
        element, against = divmod(oriented, 2)
        wanted.discard(element)
        numbers = range(int(pieces.first[element]), int(pieces.first[element + 1]))
        begin_m = float(pieces.from_m[numbers[0]])
        end_m = float(pieces.to_m[numbers[-1]])
        for number in reversed(numbers) if against else numbers:
            middle_m = float(pieces.middle_measures_m[number])
            yield number, entry_m + (end_m - middle_m if against else middle_m - begin_m), not against
        edges = [edge for edge in network.successors[oriented] if edge.to // 2 in wanted]
        entry_m += network.length_m(oriented) + (edges[0].gap_m if edges else 0.0)
        oriented = edges[0].to if edges else None


def _nearest_points(line: LineEvidence) -> pl.DataFrame:
    """`near, near_m`: per piece the nearest station or signal of the same net element; else "" and infinite."""
    pieces = line.pieces
    names = np.full(len(pieces.element), "", dtype=object)
    nearest_m = np.full(len(pieces.element), np.inf)
    for name, element_name, measure_m in line.points.select("name", "netelement_id", "measure_m").iter_rows():
        away_m = np.abs(pieces.middle_measures_m - measure_m)
        here = pieces.element == pieces.track.index[element_name]
        nearer = here & (away_m <= line.criteria.near_m) & (away_m < nearest_m)
        names[nearer] = name
        nearest_m[nearer] = away_m[nearer]
    return pl.DataFrame({"near": pl.Series(names.tolist(), dtype=pl.String), "near_m": nearest_m})


def _place_along(
    chain: pl.DataFrame, allowed: Bools, near_m: pl.Series, spacing_m: float, criteria: LineCriteria
) -> Iterator[tuple[object, ...]]:
    """Rows of `_PLACED`: at each step the best piece about a spacing on; where none is allowed a physical one.

    Best is near a station or signal, then at the spacing itself.
    """
    piece, at_m, growing = (chain[name].to_numpy() for name in _CHAIN_COLUMNS)
    away_m = near_m.to_numpy()[piece]
    spacing_m = min(spacing_m, criteria.longest_m)
    play_m = criteria.spacing_play * spacing_m
    longest_m = min(spacing_m + play_m, criteria.longest_m)
    last_m = float(at_m[0]) - spacing_m
    begun = False
    while last_m + spacing_m <= at_m[-1]:
        off_m = np.abs(at_m - (last_m + spacing_m))
        inside = (at_m >= last_m + spacing_m - play_m) & (at_m <= last_m + longest_m)
        virtual = np.flatnonzero(inside & allowed[piece])
        index = virtual[np.lexsort((off_m[virtual], away_m[virtual]))[0]] if virtual.size else int(off_m.argmin())
        here_m = float(at_m[index])
        since = piece[(at_m > last_m) & (at_m <= here_m)].tolist()
        yield int(piece[index]), bool(growing[index]), virtual.size > 0, here_m - last_m if begun else None, since
        last_m = max(here_m, last_m + spacing_m - play_m)
        begun = True


def _with_places(
    line: LineEvidence, walked: Sequence[tuple[object, ...]], sides: Sequence[bool], near: pl.Series
) -> pl.DataFrame:
    """`_PLACED` with place, kind, the direction in which a virtual one serves its travel, and what it is near."""
    placed = pl.DataFrame(walked, schema=_PLACED, orient="row")
    piece = placed["piece"].to_numpy()
    one_direction = pl.col("virtual") & (len(sides) == 1)
    along = pl.when(pl.col("growing") == sides[0]).then(pl.lit(BaliseDirection.AB.value))
    return placed.with_columns(
        netelement_id=pl.Series([line.pieces.element_names[number] for number in piece], dtype=pl.String),
        measure_m=np.round(line.pieces.middle_measures_m[piece], 3),
        kind=pl.when("virtual").then(pl.lit(BaliseKind.VIRTUAL.value)).otherwise(pl.lit(BaliseKind.PHYSICAL.value)),
        direction=pl.when(one_direction)
        .then(along.otherwise(pl.lit(BaliseDirection.BA.value)))
        .otherwise(pl.lit(BaliseDirection.BOTH.value)),
        near=near.gather(piece),
    )


def _without_overlaps(line: LineEvidence, placed: pl.DataFrame) -> pl.DataFrame:
    """The balises but for the later of two whose windows linking cannot tell apart, as where chains meet."""
    while True:
        # Announced in one list, whatever their kind.
        balises = placed.select(
            pl.format("B{}", "piece").alias("balise_id"),
            *("netelement_id", "measure_m", "direction"),
            kind=pl.lit(BaliseKind.VIRTUAL.value),
        )
        clashes = window_findings(replace(line.site, balises=site_balises(balises, line.criteria)), line.lds)
        if not clashes:
            return placed
        order = balises["balise_id"].to_list()
        gone = max(clashes[0].place.removeprefix("balises ").split(", "), key=order.index)
        placed = placed.filter(balises["balise_id"] != gone)


def _balise_rows(line: LineEvidence, name: str, placed: pl.DataFrame) -> pl.DataFrame:
    """`LineBalises` of one proposal."""
    why = pl.format("{} {}: {}", "direction", "piece_class", "cause").str.join(", ")
    of_pieces = line.table.group_by("piece").agg(why=why, error_m=pl.col("largest_undetected_m").max()).sort("piece")
    proved = _are_allowed(line, MODES["both"], np.ones(len(line.pieces.element), dtype=np.bool_))
    virtual = pl.col("virtual")
    number = pl.int_range(1, pl.len() + 1).over("virtual").cast(pl.String).str.zfill(3)
    errors = [of_pieces["error_m"].gather(since).max() for since in placed["since"]]
    return placed.with_columns(
        proposal=pl.lit(name),
        balise_id=pl.when(virtual).then(pl.lit("VB")).otherwise(pl.lit("PB")) + number,
        why=pl.when(virtual).then(pl.lit("")).otherwise(of_pieces["why"].gather(placed["piece"])),
        odometer_confidence_m=line.lds.odometer_fixed_m + line.lds.odometer_share * pl.col("distance_m"),
        largest_undetected_m=pl.Series(errors, dtype=pl.Float64),
        proved=virtual & pl.Series(proved[placed["piece"].to_numpy()]),
    ).select(pl.col(column).cast(dtype) for column, dtype in dtypes(LineBalises).items())


def _proposal_figures(
    line: LineEvidence, name: str, spacing_m: float, mode: str, placed: pl.DataFrame, growing: Bools
) -> dict[str, object]:
    """The figures of one proposal, as a row of the result."""
    virtual = placed.filter("virtual")
    sides = [(piece, bool(growing[piece]) == ahead, ahead) for piece in virtual["piece"] for ahead in MODES[mode]]
    schema = {"piece": pl.Int64, "growing": pl.Boolean, "ahead": pl.Boolean}
    wanted = pl.DataFrame(sides, schema=schema, orient="row")
    sided = line.table.with_columns(growing=pl.col("direction").cast(pl.String) == LineDirection.GROWING.value)
    lost = wanted.join(sided, on=KEYS).group_by("ahead").agg(pl.col("loss_share", "loss_high").sum())
    decided = (pl.col("state") >= int(SpanState.UNKNOWN)) | (pl.col("state") == int(SpanState.RIGHT))
    judged = line.passes.filter(decided).join(wanted, on=KEYS)
    # What the evidence should have judged and did not may have been wrong.
    maybe = pl.col("state").is_in([int(SpanState.UNKNOWN), int(SpanState.WRONG_IN_USE)])
    wrong = judged.group_by("run_id").agg(wrong=maybe.any())["wrong"]
    longest_m = max(placed["distance_m"].drop_nulls().to_list(), default=None)
    confidence_m = None if longest_m is None else line.lds.odometer_fixed_m + line.lds.odometer_share * longest_m
    return {
        "proposal": name,
        "spacing_m": spacing_m,
        "directions": mode,
        "virtual": virtual.height,
        "physical": placed.height - virtual.height,
        "longest_distance_m": longest_m,
        "odometer_confidence_m": confidence_m,
        "expected_lost": lost["loss_share"].max(),
        "expected_lost_high": lost["loss_high"].max(),
        "journeys": len(wrong),
        "unsafe_high": clopper_pearson(int(wrong.sum()), len(wrong), line.criteria.confidence).high,
        "points_served": virtual.filter(pl.col("near") != "")["near"].n_unique(),
        "points": line.points.height,
    }
