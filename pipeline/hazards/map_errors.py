"""Map errors show over a campaign: the same place raises the cross or up monitors run after run (DOMAIN section 5)."""

from __future__ import annotations

import polars as pl

from schemas.enums import Suspect, Verdict

_ACROSS = r"^(cross|up)_"


def alarm_places(alarms: pl.DataFrame, epochs: pl.DataFrame) -> pl.DataFrame:
    """Alarms of one run with the net element and measure of the epoch in which each began."""
    places = epochs.select("solution", pl.col("t").alias("t_start"), "netelement_id", "measure_m")
    return alarms.join(places, on=["solution", "t_start"], how="left", maintain_order="left")


def map_suspects(alarms: pl.DataFrame, reach_m: float = 100.0) -> pl.DataFrame:
    """Alarms of a campaign (`run_id` and `alarm_places` of each) with `suspect` set to the map where it is due.

    Due are alarms of cross and up monitors only, not held against the position, that began within `reach_m` of
    such an alarm of another run on the same net element.
    """
    across = (pl.col("monitors").list.len() > 0) & pl.col("monitors").list.eval(
        pl.element().str.contains(_ACROSS)
    ).list.all()
    open_case = across & (pl.col("verdict") != Verdict.TRUE.value) & pl.col("measure_m").is_not_null()
    numbered = alarms.with_row_index("_row")
    cases = numbered.filter(open_case).select("_row", "run_id", "netelement_id", "measure_m")
    pairs = cases.join(cases, on="netelement_id", suffix="_other").filter(
        (pl.col("run_id") != pl.col("run_id_other"))
        & ((pl.col("measure_m") - pl.col("measure_m_other")).abs() <= reach_m)
    )
    due = pl.col("_row").is_in(pairs["_row"].unique().implode())
    kind = alarms.schema["suspect"]
    return numbered.with_columns(
        pl.when(due).then(pl.lit(Suspect.MAP.value, kind)).otherwise(pl.col("suspect")).alias("suspect")
    ).drop("_row")
