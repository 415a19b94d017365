"""What passes between the stages of one run: each frame's columns with unit and meaning (docs/architecture.md)."""

from __future__ import annotations

import dataframely as dy

from schemas.columns import flag, instant, one_of, real, text
from schemas.enums import BaliseKind, Evidence, Judgement, PassageStatus


class Crossings(dy.Schema):
    """One row per crossing of a balise by the raw matched position, or per telegram read, in order of time.

    The LDS finds each crossing once and says what became of it; who needs it later joins by `crossing_id`.
    """

    crossing_id = dy.Int64(min=0, description="0, 1, ... in order of time within the solution")
    balise_id = text("balise")
    kind = one_of(BaliseKind, "virtual: crossed by the position; physical: read")
    netelement_id = text("net element of the balise")
    measure_m = real("m", "measure of the balise", nullable=False)
    leg = dy.Int32(description="leg of the path")
    path_m = real("m", "path position of the balise", nullable=False)
    before = dy.Int64(min=0, description="row of the last epoch before the crossing with a position; of a telegram any")
    epoch = dy.Int64(min=0, description="row of the first epoch at or after the crossing")
    t = instant("the crossing, interpolated; of a telegram its own time; after a gap that of `epoch`")
    sense = dy.Int8(description="+1 passed along growing path, -1 against it")
    direction = dy.Int8(description="direction of travel at the crossing, +1 or -1 along growing path")
    odometer_m = real("m", "odometer distance at the crossing")
    offered = flag("offered to the train; false: inside a gap, or crossed again before the balise was re-armed")
    status = one_of(
        PassageStatus, "what became of it; null where crossed again before the balise was re-armed", nullable=True
    )


class EvidenceAt(dy.Schema):
    """Where the train was at each of some instants, by evidence alone (DOMAIN section 5.1).

    `low_m` and `high_m` are positions on the path of the solution that asks; nothing but this last change of
    coordinates knows of that solution.
    """

    t = instant("the instant asked for")
    evidence = one_of(Evidence, "what it rests on; null where nothing is known", nullable=True)
    low_m = real("m", "least path position that the evidence leaves")
    high_m = real("m", "largest path position that the evidence leaves")
    tracks = dy.Int64(nullable=True, min=0, description="how many tracks the train may have been on")
    same_track = flag("the net element of the position is one of these; null where not known", nullable=True)


class Judged(dy.Schema):
    """What the evidence says of each epoch or offer (DOMAIN section 5.2)."""

    error_low_m = real("m", "least error along the track, in the direction of travel")
    error_high_m = real("m", "largest error along the track")
    error_along_m = real("m", "the middle of both where reference or balise tell it to `known_error_m`")
    judgement = one_of(Judgement, "right, wrong or unknown")
    wrong_track = flag("the position, unambiguous, is on a net element that the evidence excludes")


class Failures(dy.Schema):
    """One row per failure: a stretch judged wrong in use, whether it crosses a VB or not (DOMAIN section 5.3)."""

    t_onset = instant("begin of the fault")
    t_failure = instant("begin of the position failure", nullable=True)
    t_end = instant("end of the episode")
    hazardous_s = real("s", "time judged wrong in use, over the whole episode", nullable=False, min=0)
    hazardous_may_s = real("s", "the same with the time that is unknown", nullable=False, min=0)
    within_budget = flag("hazardous time within the budget; null where it cannot be said", nullable=True)
    wrong_track = flag("the position was on a net element that the evidence excludes")
    hazard_id = dy.Int64(nullable=True, min=0, description="first hazard row of the episode; null where it hit no VB")
