"""What a run's availability was lost to, in one sentence. Loads no stage: `balise inspect` reads it out of results."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.epochs.clock import Clock, confident, may_move, met, unambiguous
from schemas.arrays import Bools
from schemas.config import Configuration
from schemas.enums import LdsMode

# How much the sentence says, no figure. A healthy run loses some time at its start: below this availability the reader
# asks why, and no reason is named for less than this share.
_LOW = 0.9
_SHOWN = 3
_LEAST_SHARE = 0.02
_REST = "of the moving time, the rest lost to: "


def availability_words(epochs: pl.DataFrame, clock: Clock, config: Configuration) -> str:
    """How much is left and the largest parts that were lost; nothing where that was little.

    Each epoch counts for the first reason that applies.
    """
    moving = met(epochs, may_move())
    whole_s = float(clock.held_s[moving].sum())
    if whole_s <= 0.0 or not met(epochs, pl.col("moving")).any():
        return ""
    lost = moving & ~met(epochs, pl.col("tvb") & pl.col("moving").is_not_null())
    lost_s = float(clock.held_s[lost].sum())
    if lost_s <= (1.0 - _LOW) * whole_s:
        return ""
    parts: dict[str, float] = {}
    for reason, applies in _reasons(epochs, config).items():
        parts[reason] = float(clock.held_s[lost & applies].sum()) / whole_s
        lost &= ~applies
    shown = sorted(((share, reason) for reason, share in parts.items() if share > _LEAST_SHARE), reverse=True)[:_SHOWN]
    told = ", ".join(f"{share:.0%} {reason}" for share, reason in shown) or "many short losses"
    return f"{1.0 - lost_s / whole_s:.0%} {_REST}{told}"


def lost_to() -> pl.Expr:
    """The same reasons out of `notes` of a result; null where little was lost."""
    return pl.col("notes").str.extract(f"{_REST}([^;]*)").alias("lost_to")


def _reasons(epochs: pl.DataFrame, config: Configuration) -> dict[str, Bools]:
    """Conditions by their words, in the order in which they apply."""
    aside_m = epochs.filter(~pl.col("on_track"))["cross_track_m"].abs().median()
    by = f", usually {aside_m:.0f} m beside it" if isinstance(aside_m, float) else ""
    mode = pl.col("lds_mode").cast(pl.String)
    reasons = {
        "no fix": ~pl.col("fix_valid"),
        f"positions off the track{by}": ~pl.col("on_track"),
        f"a confidence interval over {config.lds.ci_limit_m:g} m": ~confident(config),
        "positions that fit more than one track": ~unambiguous(config),
        f"an alarm, or the wait for re-linking after it{_loudest(epochs)}": mode == LdsMode.FAIL_SAFE.value,
        "no odometer": pl.col("odometer_reason").is_not_null(),
        "initialisation": mode == LdsMode.INITIALISING.value,
    }
    applies = {reason: met(epochs, condition) for reason, condition in reasons.items()}
    return applies | {"positions not validated": np.ones(epochs.height, dtype=np.bool_)}


def _loudest(epochs: pl.DataFrame) -> str:
    """The monitor that failed in most epochs."""
    states = [name for name in epochs.columns if name.endswith("_state") and name != "lds_state"]
    counts = {name: int((epochs[name].cast(pl.String) == "fail").sum() or 0) for name in states}
    worst = max(counts, key=lambda name: counts[name], default="")
    return f" (mostly {worst.removesuffix('_state')})" if worst and counts[worst] else ""
