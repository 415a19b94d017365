"""The line by its runs: criteria of `balise line`, and the tables that it writes."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import dataframely as dy
from pydantic import Field

from schemas.columns import count, flag, one_of, real, text
from schemas.config import NonNegative, Positive, Probability, Settings
from schemas.enums import BaliseDirection


class LineCriteria(Settings):
    """When virtual balises may be placed on a piece of track. Ours: no published procedure's thresholds are public."""

    name: str = "default"
    version: str = "1"
    source: str = "this project; no standard's thresholds"
    # No longer than the shortest windows of linking: 73.7 m at 400 m (DOMAIN section 4).
    piece_m: Annotated[Positive, Field(ge=5)] = 50.0
    # Share of passes on which a virtual balise may be lost: the exact bound must keep below it.
    loss_limit: Probability = 0.1
    confidence: Probability = 0.95
    # Passes of one day share satellites, weather and vehicle: `day` counts the worst of them as one.
    independent: Literal["pass", "day"] = "pass"
    # Of the 24 hours (UTC) that right passes must have been in; positions repeat with the satellites.
    hours_least: Annotated[int, Field(strict=True, ge=1, le=24)] = 1
    # A pass that the evidence saw on less of a piece says nothing good of it.
    coverage: Probability = 0.8
    # A lost pass had few satellites with at most this share of the median over the right passes of its run: half of the
    # sky hidden leaves about half of them, and in the open their number changes by a quarter.
    satellites_share: Probability = 0.7
    # A position on a wrong track condemns the tracks this near: the tables do not say which one the train was on.
    beside_m: Positive = 25.0
    # Distances of balises to propose: DOMAIN section 4.
    spacings_m: tuple[Positive, ...] = (400.0, 1000.0, 2000.0)
    # Balises in a row lie a spacing apart, give or take this share of it, and never farther apart than the longest.
    spacing_play: Annotated[float, Field(ge=0, lt=1)] = 0.5
    longest_m: Positive = 2500.0
    location_accuracy_m: Annotated[NonNegative, Field(le=63)] = 12.0
    # A suitable piece so near a station or signal is taken before others.
    near_m: Positive = 150.0


class PieceClass(StrEnum):
    SUITABLE = "suitable"
    UNSUITABLE = "unsuitable"
    UNKNOWN = "unknown"


class LineCause(StrEnum):
    """Why a pass was lost or a piece has no better class, worst first."""

    UNSAFE_ACCEPTANCE = "unsafe_acceptance"
    WRONG = "wrong"
    WRONG_TRACK = "wrong_track"
    CLAIMED_WRONGLY = "claimed_wrongly"
    OUTAGE = "outage"
    AMBIGUOUS = "ambiguous_track"
    CONFIDENCE = "confidence"
    ALARM = "alarm"
    FEW_SATELLITES = "few_satellites"
    FEW_PASSES = "few_passes"
    FEW_HOURS = "few_hours"
    NOT_JUDGED = "not_judged"
    AFTER_ALARM = "after_alarm"
    NO_PASS = "no_pass"
    NONE = "none"


LOSSES = (
    *(LineCause.WRONG, LineCause.WRONG_TRACK, LineCause.OUTAGE),
    *(LineCause.AMBIGUOUS, LineCause.CONFIDENCE, LineCause.ALARM),
)
"""Causes of passes that are counted apart in `LinePieces`."""


SHORT_OF_SATELLITES = (LineCause.AMBIGUOUS.value, LineCause.CONFIDENCE.value, LineCause.ALARM.value)
"""Causes that few satellites explain; wrong positions and missing ones are named as such."""


class LineDirection(StrEnum):
    """Direction of travel over a net element."""

    GROWING = "growing"
    FALLING = "falling"


class LinePieces(dy.Schema):
    """One row per piece of track and direction of travel over its net element."""

    piece = count("number of the piece in the order of the survey")
    netelement_id = text("net element")
    from_m = real("m", "measure of its begin", nullable=False)
    to_m = real("m", "measure of its end", nullable=False)
    direction = one_of(LineDirection, "direction of travel: growing or falling measure")
    piece_class = one_of(PieceClass, "may a virtual balise be placed here by these criteria")
    cause = one_of(LineCause, "what speaks most against it; none where it is suitable")
    monitors = text("monitors that failed first in the alarms counted, most frequent first; empty without any")
    passes = count("independent passes that the evidence could judge: right, lost or wrong in use")
    right = count("of these with every position in use and right")
    lost = count("of these on which a balise would have been lost somewhere on the piece")
    wrong_in_use = count("of these with a position judged wrong in use, or a balise accepted at a wrong place")
    lost_wrong = count("passes lost or wrong with the cause wrong")
    lost_wrong_track = count("passes lost or wrong with the cause wrong_track")
    lost_outage = count("passes lost or wrong with the cause outage")
    lost_ambiguous_track = count("passes lost or wrong with the cause ambiguous_track")
    lost_confidence = count("passes lost or wrong with the cause confidence")
    lost_alarm = count("passes lost or wrong with the cause alarm")
    few_satellites = count("passes lost where the receiver used few satellites, whatever their cause")
    claimed_wrongly = count("passes on which a wrong position in use claimed this piece; the train was elsewhere")
    unknown = count("further passes that the evidence could not judge")
    unjudged = count(
        "of these in runs with a reference, which should have shown it: each upper bound counts them as lost"
    )
    after_alarm = count("further passes without use because of an alarm before the piece")
    loss_share = real("1", "lost or wrong passes of those judged", min=0)
    loss_low = real("1", "exact lower bound (Clopper-Pearson); 0 where nothing was judged", min=0)
    loss_high = real("1", "exact upper bound, what should have been judged counted as lost", min=0)
    unsafe_high = real("1", "exact upper bound of the share of passes wrong in use, the same counted as wrong", min=0)
    passes_needed = dy.Int64(
        nullable=True,
        min=0,
        description="further right passes to be suitable; null where none can",
        metadata={"unit": "1"},
    )
    days = count("days of the judged passes (UTC)")
    hours = count("hours of the day of the right passes (UTC)")
    hours_of_day = text("these hours")
    largest_undetected_m = real(
        "m", "largest undetected error at balises of the piece; null where not in the tables", min=0
    )


class LineProposals(dy.Schema):
    """One row per proposal: a spacing, for one direction of travel or both."""

    proposal = text("name, and folder of its `balises.csv`")
    spacing_m = real("m", "distance of balises that it aims at", nullable=False, min=0)
    directions = text(
        "both, or ahead or back along the ways of the travelled elements: where its virtual balises are suitable"
    )
    virtual = count("virtual balises")
    physical = count("physical balises that bridge the rest")
    longest_distance_m = real("m", "longest distance between balises in a row", min=0)
    odometer_confidence_m = real("m", "confidence of the odometer after it (SUBSET-041 5.3.1.1)", min=0)
    expected_lost = real("1", "virtual balises lost per journey over all of them, as measured", min=0)
    expected_lost_high = real("1", "the same with the upper bound of each piece", min=0)
    journeys = count("runs that passed some of these pieces and were judged there")
    unsafe_high = real("1", "exact upper bound of the share of journeys with a wrong position in use on them", min=0)
    points_served = count("stations and signals with a virtual balise near")
    points = count("stations and signals given")


class LineBalises(dy.Schema):
    """One row per balise of a proposal."""

    proposal = text("name of the proposal")
    balise_id = text("balise")
    netelement_id = text("net element")
    measure_m = real("m", "measure", nullable=False)
    kind = text("virtual, or physical where no piece is suitable")
    direction = one_of(BaliseDirection, "in which direction along its net element it is valid")
    why = text("of a physical one: class and cause of the piece, per direction of travel over its net element")
    near = text("station or signal that it serves; empty where none")
    distance_m = real("m", "distance from the balise before; null for the first", min=0)
    odometer_confidence_m = real("m", "confidence of the odometer there, 5 m + 5 % of this distance", min=0)
    largest_undetected_m = real("m", "largest undetected error over this distance; null where not in the tables", min=0)
    proved = flag("suitable in every direction of travel, not just in those that were run")


LINE_TABLES: dict[str, type[dy.Schema]] = {
    "line_pieces": LinePieces,
    "line_proposals": LineProposals,
    "line_balises": LineBalises,
}
