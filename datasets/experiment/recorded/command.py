"""The whole experiment: runs as recorded, instants, faults and their replays, tables, pictures and the page."""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import polars as pl
import pyarrow.parquet as pq

from datasets.experiment.recorded.baseline import (
    Baseline,
    FaultFree,
    Onset,
    OnsetRoom,
    baseline_of,
    number_onsets,
    onsets_of,
    room_of,
)
from datasets.experiment.recorded.outcome import inject_fault, outcome_row
from datasets.experiment.recorded.page import draw_pictures, recorded_page, remarks_on
from datasets.experiment.recorded.plan import Bank, Cell, RecordedPlan, banks_of, load_plan
from datasets.experiment.recorded.tables import banks_table, cells_table, places_table, pmd_table
from datasets.experiment.tables import Row
from pipeline import storage
from pipeline.campaign import find_runs
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from pipeline.results.software import software_digest
from pipeline.results.workers import map_in_processes
from pipeline.show.terminal import duration_text
from pipeline.storage.described import noted_bytes
from pipeline.storage.parquet import parquet_bytes
from schemas.config import Configuration, Vehicle, digest_of, load_settings, to_toml
from schemas.conform import conform, dtypes
from schemas.enums import RunStatus
from schemas.errors import ConfigError, InputError, UsageError
from schemas.experiment import EXPERIMENT_TABLES, ExperimentInjections, ExperimentRuns
from schemas.frozen import frozen
from schemas.run import Site
from schemas.version import SOFTWARE

# Injections that one process takes on at once, and that are not made again when the command is repeated.
_PIECE = 20
PAGE = "index.html"
_PIECES = "pieces"
_SHOWN = (
    *("bank", "cell", "injections", "passes", "noticed", "time_to_detect_median_s", "failures"),
    *("pmd_at_failure", "pmd_at_failure_high"),
)
_SHOWN_OF_BANKS = (
    *("bank", "hours", "alarms", "alarm_rate_per_h", "alarm_rate_high_per_h", "injections", "passes", "noticed"),
    *("failures", "missed_at_failure", "pmd_at_failure", "pmd_at_failure_high", "in_use_max_m"),
)
_LOST_KEY = "balise.lost"

_LOST = {"bank": pl.String, "cell": pl.String, "reason": pl.String}


def _ignore_text(text: str) -> None:
    """Nobody listens."""


@frozen
class Inputs:
    """What the command names."""

    runs: tuple[tuple[str, str], ...]
    site: str
    vehicle: Path | None
    config: Configuration
    banks: tuple[Bank, ...]
    solution: str
    quiet_s: float
    digest: str


@frozen
class ExperimentResult:
    """The tables by name, the runs that could not be used, with the reason, and what was written, the page first."""

    tables: dict[str, pl.DataFrame]
    failed: dict[str, str]
    files: list[Path]

    @property
    def remarks(self) -> list[str]:
        """What the figures do not prove."""
        return remarks_on(self.tables)


@frozen
class _Surveyed:
    """A run without a fault, by all banks, which took `replays_s`; `error` where it cannot be used."""

    run_id: str
    row: Row
    replays_s: float = 0.0
    room: OnsetRoom | None = None
    fault_free: tuple[FaultFree, ...] = ()
    run_digest: str = ""
    error: InputError | None = None


@frozen
class Part:
    """What became of the injections of a piece; `lost`: bank, cell and reason of those that were not possible."""

    frame: pl.DataFrame
    lost: tuple[tuple[str, str, str], ...]


@frozen
class _Piece:
    """Some injections of one run and bank, and the file that keeps what became of them."""

    inputs: Inputs
    address: str
    bank: Bank
    onsets: tuple[Onset, ...]
    file: Path


def recorded_experiment(
    runs: Sequence[str],
    site: str | None,
    out: Path,
    plan_file: Path | None,
    vehicle: Path | None,
    config: Configuration,
    seed: int | None,
    per_cell: int | None,
    solution: str,
    jobs: int,
    say: Callable[[str], None] = _ignore_text,
) -> ExperimentResult:
    """Run the experiment; what is in `out` of the same inputs is not made again. Writes tables, pictures and a page.

    `say` gets the text of how many injections there are, and how long they will take, before the first of them.
    """
    if not runs or site is None:
        raise UsageError("needs recorded runs and --site", place="experiment recorded")
    plan = load_plan(plan_file)
    given = {"seed": seed, "per_cell": per_cell}
    plan = plan.model_copy(update={name: value for name, value in given.items() if value is not None})
    inputs = _experiment_inputs(runs, site, vehicle, config, solution, plan, banks_of(plan, plan_file, config))
    # An earlier call may have found other runs at these addresses.
    _KEPT.clear()
    surveyed = _without_repeated_runs(map_in_processes(_survey_run, [(inputs, run) for run in inputs.runs], jobs))
    rooms = [one.room for one in surveyed if one.room is not None]
    if not rooms:
        raise next(one.error for one in surveyed if one.error is not None)
    cells = plan.cells(inputs.banks[0].config.hazards.limits.failure_m)
    drawn = onsets_of(rooms, cells, plan)
    _refuse_lack_of_room(cells, drawn, rooms, plan_file)
    digests = {one.run_id: one.run_digest for one in surveyed}
    onsets = number_onsets(cells, drawn)
    pieces = _pieces(inputs, onsets, digests, out)
    say(_estimate_work(onsets, pieces, surveyed, len(inputs.banks), jobs))
    tables = _result_tables(
        map_in_processes(_replay_piece, pieces, jobs), surveyed, cells, plan, [bank.name for bank in inputs.banks]
    )
    files = _write_results(out, tables, plan)
    _remove_other_pieces(pieces, out)
    return ExperimentResult(tables, {one.run_id: str(one.error) for one in surveyed if one.error is not None}, files)


def _experiment_inputs(
    runs: Sequence[str],
    site: str,
    vehicle: Path | None,
    config: Configuration,
    solution: str,
    plan: RecordedPlan,
    banks: tuple[Bank, ...],
) -> Inputs:
    """What the command names; the digest stands for all that decides an outcome but the run and the fault."""
    ground = read_site(site, config.site)
    settings = [(bank.name, digest_of(bank.config, load_settings(bank.vehicle or vehicle, Vehicle))) for bank in banks]
    decides = (_program_digest(), ground.digest, digest_of(config), settings, solution, plan.quiet_s)
    digest = hashlib.sha256(repr(decides).encode()).hexdigest()
    return Inputs(tuple(find_runs(runs).items()), site, vehicle, config, banks, solution, plan.quiet_s, digest)


def _survey_run(task: tuple[Inputs, tuple[str, str]]) -> _Surveyed:
    """One run without a fault, by all banks."""
    inputs, (run_id, address) = task
    begin_s = time.perf_counter()
    try:
        baselines = [_cached_baseline(inputs, address, bank) for bank in inputs.banks]
    except InputError as error:
        return _unusable_run(run_id, error)
    first = baselines[0]
    room = replace(room_of(baselines, inputs.quiet_s), run_id=run_id)
    row = {
        **dict.fromkeys(ExperimentRuns.column_names()),
        "run_id": run_id,
        "status": RunStatus.OK.value,
        "own_error": first.own_error.value,
        "duration_s": first.clock.duration_s,
        **room.seconds_left_out(),
        "longest_watch_s": room.longest_s(),
        "has_odometer": True,
        "has_ranges": room.has_ranges,
    }
    replays_s = time.perf_counter() - begin_s
    return _Surveyed(
        run_id, row, replays_s, room, tuple(base.fault_free() for base in baselines), first.run.input_digest
    )


def _estimate_work(
    onsets: Sequence[Onset], pieces: Sequence[_Piece], surveyed: Sequence[_Surveyed], banks: int, jobs: int
) -> str:
    """How much there is to do: each injection takes as long as its run did without a fault."""
    one_s = {one.run_id: one.replays_s / banks for one in surveyed}
    left = [piece for piece in pieces if not piece.file.exists()]
    count = sum(len(piece.onsets) for piece in left)
    takes_s = sum(one_s[onset.run_id] for piece in left for onset in piece.onsets) / max(1, jobs)
    done = len(onsets) * banks - count
    return f"{count} injections, about {duration_text(takes_s)}" + (f"; {done} are done already" if done else "")


def _unusable_run(run_id: str, error: InputError) -> _Surveyed:
    """A run that cannot be used, with the reason."""
    nothing = dict.fromkeys(ExperimentRuns.column_names())
    row = {**nothing, "run_id": run_id, "status": RunStatus.FAILED.value, "error": str(error), "injections": 0}
    return _Surveyed(run_id, row, error=error)


def _without_repeated_runs(surveyed: Sequence[_Surveyed]) -> list[_Surveyed]:
    """A copy of a run is no further pass, and no further hour."""
    first: dict[str, str] = {}
    kept = []
    for one in surveyed:
        original = first.setdefault(one.run_digest, one.run_id) if one.room is not None else one.run_id
        copy = InputError("is a copy of another run", place=one.run_id, found=f"the same bytes as {original}")
        kept.append(one if original == one.run_id else _unusable_run(one.run_id, copy))
    return kept


_KEPT: dict[tuple[str, str, str], Baseline] = {}
"""The last run and banks of this process: it takes the pieces of a run and bank one after the other."""


def _cached_baseline(inputs: Inputs, address: str, bank: Bank) -> Baseline:
    """A run by one bank without a fault; the last ones are kept."""
    key = (inputs.digest, address, bank.name)
    if key not in _KEPT:
        run = read_run(address, inputs.config.ingest, True)
        vehicle = load_settings(bank.vehicle or inputs.vehicle, Vehicle)
        made = baseline_of(run, _cached_site(inputs.site, inputs.digest, inputs.config), vehicle, bank, inputs.solution)
        while len(_KEPT) > 1:
            _KEPT.pop(next(iter(_KEPT)))
        _KEPT[key] = made
    return _KEPT[key]


_SITES: dict[str, Site] = {}


def _cached_site(address: str, digest: str, config: Configuration) -> Site:
    """Read once by each process."""
    if digest not in _SITES:
        _SITES.clear()
        _SITES[digest] = read_site(address, config.site)
    return _SITES[digest]


def _refuse_lack_of_room(
    cells: Sequence[Cell],
    drawn: dict[str, list[tuple[str, int, float]]],
    rooms: Sequence[OnsetRoom],
    plan_file: Path | None,
) -> None:
    """A plan of the user's is done whole or not at all; the default takes what there is, and says so in `cells`."""
    if not any(drawn.values()):
        longest_s = max(room.longest_s() for room in rooms)
        shortest_s = min(cell.watch_s for cell in cells)
        raise InputError(
            "no run has room for any fault of the plan",
            place=", ".join(room.run_id for room in rooms),
            found=f"at most {longest_s:.0f} s without an alarm from an instant that may be used; "
            + _left_out_words(rooms),
            expected=f"{shortest_s:.0f} s",
            remedy="Give longer runs, or runs in which less is wrong.",
        )
    if plan_file is None:
        return
    for cell in cells:
        count = len(drawn[cell.name])
        if count == cell.count:
            continue
        if not any(room.takes_cell(cell) for room in rooms):
            raise ConfigError("no run has satellites beside its positions", place=f"{plan_file}: {cell.name}")
        raise ConfigError(
            "has no room for so many injections",
            place=f"{plan_file}: {cell.name}",
            found=f"room for {count}, each watched for {cell.watch_s:.0f} s",
            expected=f"{cell.count}",
            remedy="Give more or longer runs, fewer injections, or a smaller `apart_s` or `watch_s`.",
        )


def _left_out_words(rooms: Sequence[OnsetRoom]) -> str:
    """Time that may be used, and why the rest may not."""
    sums: dict[str, float] = {}
    for room in rooms:
        for name, seconds in room.seconds_left_out().items():
            sums[name] = sums.get(name, 0.0) + seconds
    return ", ".join(f"{name.removesuffix('_s')} {seconds:.0f} s" for name, seconds in sums.items() if seconds)


def _pieces(inputs: Inputs, onsets: Sequence[Onset], digests: dict[str, str], out: Path) -> list[_Piece]:
    """Pieces by run and bank, so that a process prepares each as rarely as can be."""
    addresses = dict(inputs.runs)
    return [
        _piece_of(inputs, addresses[run_id], bank, rows[at : at + _PIECE], digests[run_id], out)
        for run_id in sorted({onset.run_id for onset in onsets})
        for bank in inputs.banks
        for rows in [[onset for onset in onsets if onset.run_id == run_id]]
        for at in range(0, len(rows), _PIECE)
    ]


def _piece_of(inputs: Inputs, address: str, bank: Bank, onsets: Sequence[Onset], run_digest: str, out: Path) -> _Piece:
    """Some injections of one run and bank, in a file that is named after all that decides them."""
    made_of = (inputs.digest, run_digest, bank.name, [(one.number, one.cell, one.t_ns, one.lot) for one in onsets])
    name = hashlib.sha256(repr(made_of).encode()).hexdigest()
    return _Piece(inputs, address, bank, tuple(onsets), out / _PIECES / f"{name}.parquet")


def _replay_piece(piece: _Piece) -> Part:
    """Replay the injections of a piece, or read what an earlier call made of them."""
    content = storage.content_of(piece.file)
    if content is not None:
        return _read_part(content)
    base = _cached_baseline(piece.inputs, piece.address, piece.bank)
    rows: list[Row] = []
    lost: list[tuple[str, str, str]] = []
    for onset in piece.onsets:
        try:
            found = inject_fault(base, onset)
        except InputError as error:
            lost.append((piece.bank.name, onset.cell.name, str(error)))
            continue
        rows.append({"bank": piece.bank.name, **outcome_row(base, onset, found)})
    frame = conform(pl.DataFrame(rows, schema=dtypes(ExperimentInjections)), ExperimentInjections)
    storage.write_bytes(piece.file, parquet_bytes(frame, {_LOST_KEY: json.dumps(lost)}))
    return Part(frame, tuple(lost))


def _read_part(content: bytes) -> Part:
    """What became of the injections of a piece, from its file."""
    table = pq.read_table(io.BytesIO(content))
    lost = json.loads((table.schema.metadata or {})[_LOST_KEY.encode()])
    frame = pl.read_parquet(io.BytesIO(content))
    return Part(conform(frame, ExperimentInjections), tuple((bank, cell, why) for bank, cell, why in lost))


def _result_tables(
    parts: Sequence[Part],
    surveyed: Sequence[_Surveyed],
    cells: Sequence[Cell],
    plan: RecordedPlan,
    banks: Sequence[str],
) -> dict[str, pl.DataFrame]:
    """All tables of the experiment."""
    frames = [part.frame for part in parts]
    injections = pl.concat(frames) if frames else ExperimentInjections.create_empty()
    order = pl.col("bank").replace_strict({name: number for number, name in enumerate(banks)}, return_dtype=pl.Int64)
    injections = injections.sort(order, "injection_id")
    lost = pl.DataFrame([row for part in parts for row in part.lost], schema=_LOST, orient="row")
    of_cells = cells_table(injections, banks, cells, plan, lost)
    into = dict(injections.filter(bank=banks[0]).group_by("run_id").len().iter_rows())
    runs = [{**one.row, "injections": into.get(one.run_id, 0)} for one in surveyed]
    return {
        "injections": conform(injections, ExperimentInjections),
        "cells": of_cells,
        "pmd": pmd_table(injections, banks, cells, plan),
        "places": places_table(injections, cells, plan),
        "banks": banks_table(injections, [_sum_over_runs(name, surveyed) for name in banks], of_cells, plan),
        "runs": conform(pl.DataFrame(runs, schema=dtypes(ExperimentRuns)), ExperimentRuns),
    }


def _sum_over_runs(bank: str, surveyed: Sequence[_Surveyed]) -> FaultFree:
    """What a bank did on all runs without a fault."""
    parts = [part for one in surveyed for part in one.fault_free if part.bank == bank]
    sums = {name: sum(getattr(part, name) for part in parts) for name in ("hours", "alarms", "tvb_s", "recorded_s")}
    return FaultFree(bank=bank, runs=len(parts), **sums)


def _write_results(out: Path, tables: dict[str, pl.DataFrame], plan: RecordedPlan) -> list[Path]:
    """Write tables, pictures and page; returns the files."""
    drawn = draw_pictures(tables)
    contents = {PAGE: recorded_page(tables, drawn, plan).encode(), "plan.toml": to_toml(plan).encode()}
    for name, frame in tables.items():
        notes = {"table": f"experiment_{name}", "software": SOFTWARE}
        contents[f"{name}.parquet"] = noted_bytes(frame, notes, EXPERIMENT_TABLES[notes["table"]])
    contents |= {f"{name}.svg": drawing.encode() for name, (_, drawing) in drawn.items()}
    for name, content in contents.items():
        storage.write_bytes(out / name, content)
    return [out / name for name in contents]


def _remove_other_pieces(pieces: Sequence[_Piece], out: Path) -> None:
    """Pieces of other plans, or of other inputs, go."""
    kept = {piece.file.name for piece in pieces}
    for file in (out / _PIECES).glob("*.parquet"):
        if file.name not in kept:
            file.unlink(missing_ok=True)


@cache
def _program_digest() -> str:
    """Digest of the program and of what puts the faults in."""
    digest = hashlib.sha256(software_digest().encode())
    for source in sorted(Path(__file__).parents[2].rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def tables_for_screen(made: ExperimentResult) -> dict[str, pl.DataFrame]:
    """What the screen shows: cells that were replayed, and banks."""
    cells = made.tables["cells"].filter(pl.col("injections") > 0)
    return {"Cells": cells.select(_SHOWN), "Banks": made.tables["banks"].select(_SHOWN_OF_BANKS)}
