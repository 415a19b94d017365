"""Why a run's availability is low, in one sentence."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.epochs.clock import Clock, confident, may_move, met, unambiguous
from schemas.arrays import Bools
from schemas.config import Configuration
from schemas.enums import LdsMode

# When and how much a note says, no figure: a healthy run loses some at its start, below this share the reader asks why;
# so many reasons are named, and none for less than this share.
_LOW = 0.9
_SHOWN = 3
_LEAST_SHARE = 0.02
_REST = "of the moving time, the rest lost to: "


def availability_notes(epochs: pl.DataFrame, clock: Clock, config: Configuration) -> tuple[str, ...]:
    """What the moving time without a valid TVB was lost to, the largest parts first; none where little was lost.

    `epochs`: monitored and judged, in order of time. Each epoch counts for the first reason that applies.
    """
    moving = met(epochs, may_move())
    whole_s = float(clock.held_s[moving].sum())
    if whole_s <= 0.0 or not met(epochs, pl.col("moving")).any():
        return ()
    lost = moving & ~met(epochs, pl.col("tvb") & pl.col("moving").is_not_null())
    lost_s = float(clock.held_s[lost].sum())
    if lost_s <= (1.0 - _LOW) * whole_s:
        return ()
    parts: dict[str, float] = {}
    for reason, applies in _reasons(epochs, config).items():
        parts[reason] = float(clock.held_s[lost & applies].sum()) / whole_s
        lost &= ~applies
    shown = sorted(((share, reason) for reason, share in parts.items() if share > _LEAST_SHARE), reverse=True)[:_SHOWN]
    told = ", ".join(f"{share:.0%} {reason}" for share, reason in shown) or "many short losses"
    return (f"available for {1.0 - lost_s / whole_s:.0%} {_REST}{told}",)


def lost_to() -> pl.Expr:
    """The same reasons out of `notes` of a result; null where little was lost."""
    return pl.col("notes").str.extract(f"{_REST}([^;]*)").alias("lost_to")


def _reasons(epochs: pl.DataFrame, config: Configuration) -> dict[str, Bools]:
    """Conditions by their words, in the order in which they apply."""
    aside_m = epochs.filter(~pl.col("on_track"))["cross_track_m"].abs().median()
    by = f", usually {aside_m:.0f} m beside it" if isinstance(aside_m, float) else ""
    return {
        "no fix": ~met(epochs, pl.col("fix_valid")),
        f"positions off the track{by}": ~met(epochs, pl.col("on_track")),
        f"a confidence interval over {config.lds.ci_limit_m:g} m": met(epochs, ~confident(config)),
        "positions that fit more than one track": met(epochs, ~unambiguous(config)),
        f"an alarm, or the wait for re-linking after it{_loudest(epochs)}": met(
            epochs, pl.col("lds_mode").cast(pl.String) == LdsMode.FAIL_SAFE.value
        ),
        "no odometer": met(epochs, pl.col("odometer_reason").is_not_null()),
        "initialisation": met(epochs, pl.col("lds_mode").cast(pl.String) == LdsMode.INITIALISING.value),
        "positions not validated": np.ones(epochs.height, dtype=np.bool_),
    }


def _loudest(epochs: pl.DataFrame) -> str:
    """The monitor that failed in most epochs."""
    states = [name for name in epochs.columns if name.endswith("_state") and name != "lds_state"]
    counts = {name: int((epochs[name].cast(pl.String) == "fail").sum() or 0) for name in states}
    worst = max(counts, key=lambda name: counts[name], default="")
    return f" (mostly {worst.removesuffix('_state')})" if worst and counts[worst] else ""
