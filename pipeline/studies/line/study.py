"""`balise line`: classes of pieces and proposals of balises from the runs of a result."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from pipeline.results.store import check_site, complete_runs, completed_runs, read_config, read_table
from pipeline.results.workers import with_progress
from pipeline.studies.line.classes import piece_classes
from pipeline.studies.line.passes import PieceIndex, passes_of
from pipeline.studies.line.pieces import Pieces, middles_in_plane_m, pieces_of
from pipeline.studies.line.proposals import LineEvidence, propose_balises
from pipeline.studies.line.remarks import line_remarks
from pipeline.studies.line.spans import EPOCH_COLUMNS, SpanState
from pipeline.studies.tally import without_repeated_journeys
from schemas.config import Configuration
from schemas.enums import Evidence
from schemas.errors import InputError, UsageError
from schemas.frozen import frozen
from schemas.line import LineCriteria
from schemas.run import Site

POINT_COLUMNS = {"name": pl.String, "netelement_id": pl.String, "measure_m": pl.Float64}


@frozen
class LineResult:
    """What the runs say of a line: classes per piece, proposals and their balises, what cannot be said."""

    line: LineEvidence
    proposals: pl.DataFrame
    balises: pl.DataFrame
    remarks: tuple[str, ...]

    @property
    def pieces(self) -> pl.DataFrame:
        """Classes per piece and direction."""
        return self.line.table

    @property
    def summary(self) -> pl.DataFrame:
        """Length by direction, class and cause."""
        length_km = (pl.col("to_m") - pl.col("from_m")).sum() / 1000.0
        keys = ["direction", "piece_class", "cause"]
        return self.pieces.group_by(keys).agg(pieces=pl.len(), length_km=length_km).sort(keys)


def study_line(
    out: Path, site: Site, criteria: LineCriteria, solution: str | None = None, points: pl.DataFrame | None = None
) -> LineResult:
    """Classify pieces of track by all complete runs of a result, and propose balises.

    Args:
        out: the result of a campaign.
        site: its site.
        criteria: lengths [m], shares and counts by which pieces of track are classified.
        solution: one solution; None for all.
        points: stations and signals (`name, netelement_id, measure_m` [m]), near which balises are wanted.

    Returns:
        Classes of all pieces of track, proposals of balises, and remarks.

    Raises:
        UsageError: the result is of another site.
    """
    runs, twice = without_repeated_journeys(_runs_of_solution(out, site, solution))
    pieces = pieces_of(site, criteria.piece_m)
    ground = PieceIndex.of_pieces(site, pieces, middles_in_plane_m(site, pieces))
    passes, undetected = passes_of_runs(out, runs, ground, criteria)
    table = piece_classes(passes, undetected, pieces, criteria)
    lds = (read_config(out) or Configuration()).lds
    line = LineEvidence(site, pieces, table, passes, _known_points(points, pieces), criteria, lds)
    figures, balises = propose_balises(line)
    return LineResult(line, figures, balises, (*twice, *line_remarks(runs, passes, table, figures, criteria)))


def read_points(path: Path) -> pl.DataFrame:
    """Read stations and signals.

    Args:
        path: a CSV file with `name, netelement_id, measure_m`.

    Returns:
        One row per point; measures [m].

    Raises:
        InputError: the file cannot be read.
    """
    try:
        frame = pl.read_csv(path, infer_schema=False)
        return frame.select(pl.col(name).cast(dtype) for name, dtype in POINT_COLUMNS.items()).drop_nulls()
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"cannot be read: {reason}", place=str(path), expected=f"CSV with {', '.join(POINT_COLUMNS)}"
        ) from None


def _runs_of_solution(out: Path, site: Site, solution: str | None) -> pl.DataFrame:
    """Rows of `runs` of the solution asked for, those that did not fail; every run is of this site."""
    names = complete_runs(out)
    for run, metadata in completed_runs(out).items():
        check_site(site, metadata.get("site_digest"), run)
    rows = read_table(out, "runs").collect().filter(pl.col("status") != "failed")
    known = sorted(rows["solution"].unique().to_list())
    if not known:
        raise UsageError("holds no run that could be replayed", place=str(out), found=f"{len(names)} failed runs")
    chosen = solution or ("primary" if "primary" in known or len(known) > 1 else known[0])
    if chosen not in known:
        raise UsageError("is no solution of these runs", place=chosen, found=", ".join(known), remedy="Use --solution.")
    return rows.filter(pl.col("solution") == chosen).sort("run_id")


def passes_of_runs(
    out: Path, runs: pl.DataFrame, ground: PieceIndex, criteria: LineCriteria
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The passes of all runs with `run_id`; and the largest undetected error by piece, where the tables have it."""
    config = read_config(out) or Configuration()
    parts = []
    errors = []
    for run, solution, evidence in with_progress(runs.select("run_id", "solution", "evidence").rows()):
        of_solution = pl.col("solution") == solution
        epochs = read_table(out, "epochs", run).select(EPOCH_COLUMNS).filter(of_solution).collect()
        passages, alarms = (read_table(out, name, run).filter(of_solution).collect() for name in ("passages", "alarms"))
        passes = passes_of(epochs, passages, alarms, ground, criteria, config)
        if evidence != Evidence.REFERENCE.value:
            # Reads and odometers tell by where they are, not by how good positions are: what they miss hides nothing.
            passes = passes.with_columns(pl.col("state").replace(int(SpanState.UNKNOWN), int(SpanState.NOT_COVERED)))
        parts.append(passes.with_columns(run_id=pl.lit(run)))
        errors.append(_undetected_by_piece(passages, ground.pieces))
    return pl.concat(parts), pl.concat(errors).group_by("piece").agg(pl.col("largest_undetected_m").max())


def _undetected_by_piece(passages: pl.DataFrame, pieces: Pieces) -> pl.DataFrame:
    """Largest undetected error at balises, by piece; empty where it was not computed."""
    largest_m = pl.max_horizontal(pl.col("undetected_ahead_m").abs(), pl.col("undetected_behind_m").abs())
    piece = [pieces.piece_holding(*place) for place in passages.select("netelement_id", "measure_m").iter_rows()]
    return passages.select(piece=pl.Series(piece, dtype=pl.Int64), largest_undetected_m=largest_m).drop_nulls()


def _known_points(points: pl.DataFrame | None, pieces: Pieces) -> pl.DataFrame:
    """The points given, which must lie on net elements of the site."""
    if points is None:
        return pl.DataFrame(schema=POINT_COLUMNS)
    if strange := sorted(set(points["netelement_id"]) - set(pieces.track.index)):
        raise UsageError("are no net elements of the site", place="stations and signals", found=", ".join(strange[:5]))
    return points
