"""What each run adds to the page of its campaign, kept beside the result (`OUT/.catalogue`) until the run changes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from pipeline.results import catalogue
from pipeline.safety.tally import COUNTS

_PIECES, _TALLIES = "pieces", "tallies"


@dataclass(frozen=True)
class Share:
    """Of one run: the digest of its tables, its pieces as from `availability_pieces`, and with several solutions the
    tallies of `side_by_side`.
    """

    run: str
    content: str
    pieces: pl.DataFrame
    tallies: pl.DataFrame | None


def known_shares(out: Path, states: Mapping[str, str], settings: str) -> dict[str, Share]:
    """Those of the runs whose tables are in the state in which they were read, under the same program and settings."""
    found = [catalogue.kept_frame(out, name) for name in (_PIECES, _TALLIES)]
    told = [metadata.get("shares") for _, metadata in found]
    if told[0] is None or told[0] != told[1]:
        return {}
    record = json.loads(told[0])
    if record["settings"] != settings:
        return {}
    pieces, tallies = (frame.partition_by("run_id", as_dict=True, include_key=False) for frame, _ in found)
    none = found[0][0].drop("run_id").clear()
    return {
        run: Share(run, content, pieces.get((run,), none), tallies.get((run,)))
        for run, (state, content) in record["runs"].items()
        if states.get(run) == state
    }


def remember(out: Path, states: Mapping[str, str], settings: str, shares: Mapping[str, Share]) -> None:
    """Keep the shares of these runs."""
    runs = {run: (state, shares[run].content) for run, state in states.items()}
    metadata = {"shares": json.dumps({"settings": settings, "runs": runs})}
    kept = [shares[run] for run in states]
    tallies = [_named(share.run, share.tallies) for share in kept if share.tallies is not None]
    catalogue.keep_frame(out, _PIECES, pl.concat([_named(share.run, share.pieces) for share in kept]), metadata)
    empty = pl.DataFrame(schema={"run_id": pl.String(), **COUNTS})
    catalogue.keep_frame(out, _TALLIES, pl.concat([empty, *tallies]), metadata)


def _named(run: str, rows: pl.DataFrame) -> pl.DataFrame:
    return rows.select(pl.lit(run).alias("run_id"), pl.all())
