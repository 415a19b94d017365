"""A synthetic line with known bad places, fifty runs: does `balise line` find them with their causes, and no others?"""

from __future__ import annotations

from pathlib import Path

import polars as pl

from benchmarks.results import Figure
from datasets.scenario import Scenario
from datasets.trial import write_trial
from pipeline.campaign import make_plan, run_campaign
from pipeline.read.site.read import read_site
from pipeline.results.store import read_table
from pipeline.studies.line.classes import piece_classes
from pipeline.studies.line.passes import PieceIndex
from pipeline.studies.line.pieces import middles_in_plane_m, pieces_of
from pipeline.studies.line.study import passes_of_runs, study_line
from schemas.config import Configuration, settings_from
from schemas.line import LineCriteria

RUNS = 50
# Chainage from, to, the causes that may be named there, and the fault that makes the place bad.
PLACES: dict[str, tuple[float, float, tuple[str, ...], dict[str, object]]] = {
    "tunnel mouth": (2000.0, 2300.0, ("outage",), {"kind": "outage"}),
    "cutting": (
        3200.0,
        3500.0,
        ("few_satellites",),
        {"kind": "outage", "target": "satellites", "below_deg": 45.0},
    ),
    "station roof": (4000.0, 4150.0, ("alarm", "wrong"), {"kind": "noise", "sigma_m": 15.0}),
    "facade": (
        6000.0,
        6100.0,
        ("wrong", "claimed_wrongly", "unsafe_acceptance", "alarm"),
        {"kind": "step", "size_m": 35.0},
    ),
    "neighbour track": (
        8000.0,
        8400.0,
        ("ambiguous_track", "wrong_track"),
        {"kind": "bias", "target": "cross", "size_m": 2.3},
    ),
}
_END_M = 11000.0
# D is surveyed against the line.
_ELEMENTS = (("A", 0.0, 5000.0), ("B", 5000.0, 8000.0), ("C", 8000.0, 8400.0), ("D", 11500.0, 8400.0))
# A position that is wrong by this much says that it is elsewhere, and a span reaches from one epoch to the next.
_REACH_M = 100.0


def scenario(runs: int = RUNS) -> Scenario:
    """A line of 11.5 km with a track beside it at 8 km; every other run goes the other way."""
    ahead = {"start_m": 200.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": _END_M}]}
    home = {"start_m": _END_M, "direction": "falling", "phases": [{"speed_mps": 30.0}, {"stop_at_m": 200.0}]}
    data = {
        "name": "line",
        "seed": 26,
        "vehicle": {
            "odometer_scale": 1.0,
            "odometer_scale_sigma": 1e-4,
            "gnss_latency_s": 0.0,
            "gnss_latency_sigma_s": 0.002,
        },
        "line": {
            "sections": [{"length_m": 2000.0}, {"length_m": 600.0, "radius_m": 1500.0}],
            "elements": [
                *({"id": name, "length_m": end - begin} for name, begin, end in _ELEMENTS[:-1]),
                {"id": "D", "length_m": 3100.0, "reversed": True},
            ],
            "parallels": [{"id": "P", "from_m": 8000.0, "to_m": 8400.0, "left_m": 4.5}],
            "balises": [{"id": f"VB{at}", "at_m": float(at)} for at in range(600, 11000, 800)],
        },
        "gnss": {"rate_hz": 2.0, "sky": {"solutions": {"primary": ["gps", "galileo"]}, "record_ranges": False}},
        "odometer": {"rate_hz": 10.0},
        "reference": {"rate_hz": 5.0},
        "runs": [
            {
                "id": f"r{number:02d}",
                "motion": home if number % 2 else ahead,
                "faults": _faults(-1 if number % 2 else 1),
            }
            for number in range(runs)
        ],
    }
    return settings_from(data, Scenario, "benchmark")


def _faults(sense: int) -> list[dict[str, object]]:
    """What goes wrong on the way along growing (1) or falling chainage; what lies aside is towards the track there."""
    found: list[dict[str, object]] = []
    for begin, end, _, fault in PLACES.values():
        at_m, until_m = (begin, end) if sense > 0 else (end, begin)
        aside: dict[str, object] = {}
        if fault.get("target") == "cross":
            aside["size_m"] = sense * float(str(fault["size_m"]))
        found.append({**fault, **aside, "at_m": at_m, "until_m": until_m})
    return found


def _write(out: Path, runs: int) -> None:
    """The trial, with the track beside joined to the line at both ends: a scenario has no turnouts."""
    write_trial(scenario(runs), out)
    links = pl.read_parquet(out / "site" / "links.parquet")
    ends = [("B", 1, "P", 0), ("P", 1, "D", 1)]
    turnouts = pl.DataFrame([(*end, "both") for end in ends], schema=links.schema, orient="row")
    pl.concat([links, turnouts]).write_parquet(out / "site" / "links.parquet")


def measure(out: Path, runs: int = RUNS) -> list[Figure]:
    """Replay the trial once and hold the classes against the places."""
    if not (out / "trial" / "site").exists():
        _write(out / "trial", runs)
    vehicle = scenario(runs).vehicle
    plan = make_plan(
        [str(out / "trial" / "runs")], str(out / "trial" / "site"), str(out / "tables"), Configuration(), vehicle
    )
    run_campaign(plan, jobs=2)
    found = study_line(out / "tables", read_site(out / "trial" / "site"), LineCriteria(loss_limit=0.15))
    table = found.pieces.filter(pl.col("passes") > 0).with_columns(chainage=_chainage())
    return [*_found(table), _invented(table), _predicted(out)]


def _chainage() -> pl.Expr:
    middle = 0.5 * (pl.col("from_m") + pl.col("to_m"))
    return pl.coalesce(
        pl.when(pl.col("netelement_id") == name).then(begin + middle if end > begin else begin - middle)
        for name, begin, end in _ELEMENTS
    )


def _found(table: pl.DataFrame) -> list[Figure]:
    figures = []
    for name, (begin, end, causes, _) in PLACES.items():
        inside = table.filter(pl.col("chainage").is_between(begin, end))
        named = inside.filter((pl.col("piece_class") == "unsuitable") & pl.col("cause").cast(pl.String).is_in(causes))
        suitable = inside.filter(pl.col("piece_class") == "suitable").height
        figures.append(
            Figure(
                f"{name}: pieces unsuitable for its cause, of {inside.height}",
                named.height,
                "pieces",
                better="above",
                target=1,
            )
        )
        figures.append(Figure(f"{name}: pieces called suitable", suitable, "pieces", better="below", target=0))
    return figures


def _invented(table: pl.DataFrame) -> Figure:
    clear = pl.lit(value=True)
    for begin, end, _, _ in PLACES.values():
        clear &= ~pl.col("chainage").is_between(begin - _REACH_M, end + _REACH_M)
    invented = table.filter(clear & (pl.col("piece_class") == "unsuitable"))
    return Figure("pieces unsuitable where nothing is wrong", invented.height, "pieces", better="below", target=0)


def _predicted(out: Path) -> Figure:
    """Pieces whose share of losses over one half of the runs lies outside the exact bounds of the other half."""
    site, criteria = read_site(out / "trial" / "site"), LineCriteria()
    ground_pieces = pieces_of(site, criteria.piece_m)
    ground = PieceIndex.of_pieces(site, ground_pieces, middles_in_plane_m(site, ground_pieces))
    runs = read_table(out / "tables", "runs").collect().sort("run_id")
    passes, undetected = passes_of_runs(out / "tables", runs, ground, criteria)
    number = pl.col("run_id").str.slice(1).cast(pl.Int64)
    halves = [
        piece_classes(passes.filter((number // 2) % 2 == half), undetected, ground_pieces, criteria) for half in (0, 1)
    ]
    both = (
        halves[0]
        .join(halves[1], on=["piece", "direction"], suffix="_other")
        .filter((pl.col("passes") > 0) & (pl.col("passes_other") > 0))
    )
    # Both halves are samples: their bounds meet unless they are of different shares.
    apart = (pl.col("loss_low") > pl.col("loss_high_other")) | (pl.col("loss_low_other") > pl.col("loss_high"))
    return Figure("pieces whose halves contradict each other", both.filter(apart).height, "pieces", target=0)
