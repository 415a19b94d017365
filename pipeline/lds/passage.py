"""What the train makes of each balise that it passes: the rows of `passages`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.lds.crossings import Balise, Crossing
from pipeline.lds.journey import Journey
from pipeline.lds.windows import Window
from schemas.conform import dtypes
from schemas.enums import Cause, Direction, FailureMode, LinkingError, PassageStatus, Reaction
from schemas.tables import Passages

_SEVERITY = (Reaction.NONE, Reaction.SERVICE_BRAKE, Reaction.TRIP)


@dataclass(slots=True)
class Passage:
    """A row of `passages` in the making.

    `crossing`: the one that offered it; `t_ns`: of the offer, else when it was settled; `direction`: of travel as
    known then; `announced_odometer_m`: where the train passes it by linking.
    """

    balise: Balise
    t_ns: int
    direction: int
    status: PassageStatus = PassageStatus.MISSED
    crossing: Crossing | None = None
    window: Window | None = None
    odometer_distance_m: float | None = None
    linking_error: LinkingError = LinkingError.NONE
    reaction: Reaction = Reaction.NONE
    announced_odometer_m: float | None = None

    def record(self, error: LinkingError, reaction: Reaction) -> None:
        """The first linking error of a passage stays, the most severe reaction counts."""
        if self.linking_error is LinkingError.NONE:
            self.linking_error = error
        self.reaction = max(self.reaction, reaction, key=_SEVERITY.index)


def passage_rows(
    passages: Sequence[Passage], crossings: Sequence[Crossing], journey: Journey, solution: str
) -> pl.DataFrame:
    """Passages in order of time, as in the contract, and `t_reckoned`; `crossings` in order of time."""
    ids = {id(crossing): number for number, crossing in enumerate(crossings)}
    rows = [_row(passage, ids, journey, solution) for passage in passages]
    when = [row["t_offered"] or row["t_reckoned"] or passage.t_ns for row, passage in zip(rows, passages, strict=True)]
    order = sorted(range(len(rows)), key=lambda i: (when[i], passages[i].balise.balise_id))
    schema = dtypes(Passages) | {"t_reckoned": pl.Datetime("ns", "UTC")}
    return pl.DataFrame([rows[i] for i in order], schema=schema)


def _row(passage: Passage, ids: dict[int, int], journey: Journey, solution: str) -> dict[str, object]:
    balise, window, crossing = passage.balise, passage.window, passage.crossing
    direction = journey.direction_at(passage.t_ns, passage.direction)
    return {
        "solution": solution,
        "balise_id": balise.balise_id,
        "kind": balise.kind.value,
        "netelement_id": balise.netelement_id,
        "measure_m": balise.measure_m,
        "path_m": balise.path_m,
        "direction": (Direction.GROWING if direction > 0 else Direction.FALLING).value,
        "status": passage.status.value,
        "t_offered": crossing and crossing.t_ns,
        "window_open_m": window and window.open_m,
        "window_close_m": window and window.close_m,
        "odometer_distance_m": passage.odometer_distance_m,
        "confidence_m": crossing and crossing.confidence_m,
        "linking_error": passage.linking_error.value,
        "reaction": passage.reaction.value,
        "failure_mode": FailureMode.NONE.value,
        "cause": Cause.NONE.value,
        "suspect_after_the_fact": False,
        "location_accuracy_m": balise.accuracy_m,
        "crossing_id": crossing and ids[id(crossing)],
        "t_reckoned": _reckoned_ns(passage, journey),
    }


def _reckoned_ns(passage: Passage, journey: Journey) -> int | None:
    """When the odometer last passed the announced place before the passage was settled."""
    if passage.crossing is not None or passage.announced_odometer_m is None:
        return None
    known = np.flatnonzero(np.isfinite(journey.odometer_m) & (journey.t_ns <= passage.t_ns))
    beyond = (journey.odometer_m[known] - passage.announced_odometer_m) >= 0
    steps = np.flatnonzero(beyond[1:] != beyond[:-1])
    if not steps.size:
        return None
    i, j = known[steps[-1]], known[steps[-1] + 1]
    part_m = passage.announced_odometer_m - journey.odometer_m[i]
    share = float(part_m / (journey.odometer_m[j] - journey.odometer_m[i]))
    return int(journey.t_ns[i]) + round(share * int(journey.t_ns[j] - journey.t_ns[i]))
