"""What the pages of runs and of the campaign share: what became of each balise, and of each architecture."""

from __future__ import annotations

import polars as pl

from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import section
from pipeline.studies.safety.tally import architecture_figures
from schemas.campaign import CampaignBalises
from schemas.enums import BaliseKind, Judgement, PassageStatus

OUTCOMES = ("read", "right", "lost", "unknown", "wrong")
"""From harmless to bad. `read`: a physical balise, which is evidence itself."""

# The first ten are shown, the others behind a switch.
_COLUMNS = (
    *("balise_id", "kind", "passages", "unsafe_accepted", "unproven_accepted", "lost", "lost_share", "accepted"),
    *("location_error_max_m", "netelement_id", "measure_m", "accepted_judged", "unsafe_rate", "deletions"),
    "location_error_mean_m",
)


def outcome_of_passage() -> pl.Expr:
    """Expression on passages: what became of the balise, of `OUTCOMES`."""
    return (
        pl.when(pl.col("status") != PassageStatus.ACCEPTED.value)
        .then(pl.lit("lost"))
        .when(pl.col("kind") == BaliseKind.PHYSICAL.value)
        .then(pl.lit("read"))
        .otherwise(pl.col("judgement").cast(pl.String).fill_null(Judgement.UNKNOWN.value))
    )


def lost_shares(balises: pl.DataFrame) -> pl.DataFrame:
    """`balises` as `campaign_balises`, with the passages at which each was not accepted, and their share."""
    lost = pl.col("passages") - (pl.col("passages") * pl.col("accepted_share")).round()
    shares = {
        f"lost_share{end}": 1.0 - pl.col(f"accepted_share{other}")
        for end, other in (("", ""), ("_low", "_high"), ("_high", "_low"))
    }
    return balises.with_columns(lost=lost.fill_null(0).cast(pl.Int64), **shares)


def balise_table(identity: str, caption: str, balises: pl.DataFrame) -> str:
    """`balises` as `lost_shares`; the worst first.

    A physical balise is evidence itself, so that nothing checks it: not checked counts for virtual ones alone.
    """
    unproven = pl.when(pl.col("kind") == BaliseKind.VIRTUAL.value).then("unproven_accepted")
    worst_first = ("unsafe_accepted", "unproven_accepted", "lost_share", "location_error_max_m")
    order = [True] * len(worst_first)
    checked = balises.with_columns(unproven_accepted=unproven)
    shown = checked.sort(*worst_first, "balise_id", descending=[*order, False], nulls_last=True)
    return frame_table(identity, caption, shown, _COLUMNS, CampaignBalises)


_NOTE = (
    "<p>Reactive: a solution diagnosed by itself (LOC Fig. 4). Composite: two solutions compared, both needed (LOC "
    "Fig. 3); blind to what they share. Reactive 1oo2: one of two such channels is enough (LOC eq. 11). Judged after "
    "the fact on the same faults.</p>"
)
_ARCHITECTURES = (
    *("architecture", "solution", "other", "hazards", "detected", "failures", "missed", "missed_share"),
    *("common_missed", "availability", "time_to_detect_median_s", "time_to_detect_max_s", "alarms", "false_alarms"),
    *("false_alarm_rate_per_h", "wrong_in_use_s", "mtbf_h", "continuity_15s"),
)


def architectures_section(identity: str, counts: pl.DataFrame) -> str:
    """`counts` as of `pipeline.studies.safety.tally`; nothing where there is but one solution."""
    if counts["other"].null_count() == counts.height:
        return ""
    shown_figures = architecture_figures(counts)
    shown = frame_table(
        f"table-{identity}", "Composite and reactive fail-safety side by side", shown_figures, _ARCHITECTURES
    )
    return section(identity, "Architectures", _NOTE, shown)
