"""What a run comes to in errors that nobody would have noticed (DOMAIN section 5.6)."""

from __future__ import annotations

import polars as pl

from pipeline.stages.judge.judged import JudgedEpochs
from schemas.frozen import frozen


@frozen
class Spacing:
    """The shortest distance and time from a physical balise, wherever it is thought to be, to an error beyond the
    limit.

    None where no start reaches the limit before the run ends. `starts`: balises thought of; `reached`: how many of them
    reach it.
    """

    distance_m: float | None = None
    time_s: float | None = None
    starts: int = 0
    reached: int = 0


def undetected_figures(
    epochs: JudgedEpochs, undetected: pl.DataFrame, spacing: Spacing, limit_m: float
) -> dict[str, object]:
    """Figures of the `runs` row, over the epochs whose position was in use; `undetected`: its columns of `epochs`."""
    larger = pl.max_horizontal("undetected_ahead_m", "undetected_behind_m")
    at = {"t_ns": epochs.t_ns, "path_m": epochs.path_m, "in_use": epochs.in_use}
    known = undetected.with_columns(larger=larger, **{name: pl.Series(values) for name, values in at.items()})
    known = known.filter(pl.col("in_use") & larger.is_not_null())
    figures: dict[str, object] = {
        "physical_spacing_m": spacing.distance_m,
        "physical_spacing_s": spacing.time_s,
        "physical_spacing_starts": spacing.starts,
        "physical_spacing_reached": spacing.reached,
    }
    if known.is_empty():
        return figures
    beyond = known.filter(pl.col("larger") > limit_m)
    return figures | {
        "undetected_median_m": known["larger"].median(),
        "undetected_p95_m": known["larger"].quantile(0.95, interpolation="higher"),
        "undetected_max_m": known["larger"].max(),
        "undetected_share_beyond": beyond.height / known.height,
        "t_undetected_beyond": None if beyond.is_empty() else beyond["t_ns"][0],
        "undetected_beyond_path_m": None if beyond.is_empty() else beyond["path_m"][0],
    }
