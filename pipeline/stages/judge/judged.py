"""What the judge says of epochs and of offered balises, in arrays (DOMAIN sections 5.2 and 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import MonitoredEpochs
from pipeline.stages.evidence import TruePlaces
from pipeline.stages.evidence.evidence import KINDS
from schemas.arrays import Bools, Floats, Ints, Rows
from schemas.conform import dtypes
from schemas.enums import Evidence, Judgement
from schemas.frozen import frozen
from schemas.stages import Crossings, arrays_of, gathered, series_of, words_of
from schemas.tables import Epochs

# Columns of the table whose arrays have another name.
_ARRAYS = {"t": "t_ns", "netelement_id": "element", "lrvb_id": "lrvb"}
JUDGEMENTS = tuple(Judgement)
RIGHT, WRONG, UNKNOWN = (JUDGEMENTS.index(word) for word in (Judgement.RIGHT, Judgement.WRONG, Judgement.UNKNOWN))
REFERENCE, ODOMETER = (KINDS.index(kind) for kind in (Evidence.REFERENCE, Evidence.ODOMETER))
_JUDGEMENT_WORDS = words_of(Judgement)
_EVIDENCE_WORDS = words_of(Evidence)


@frozen
class Judgements:
    """Per instant: judgement (number in `JUDGEMENTS`), interval of the error along the track [m], kind of evidence.

    Arrays of shape (instants,). Errors are along growing path until `turned`. `wrong_track`: wrong for its net element,
    wherever along it. `track_assumed`: right if the survey holds the train's track, which nothing shows. `limit_m`: the
    failure limit that the error is held against [m].
    """

    code: Ints
    low_m: Floats
    high_m: Floats
    kind: Ints
    wrong_track: Bools
    track_assumed: Bools
    limit_m: Floats

    def at(self, rows: Rows) -> Judgements:
        """The judgements of some instants, by row."""
        return Judgements(
            code=self.code[rows],
            low_m=self.low_m[rows],
            high_m=self.high_m[rows],
            kind=self.kind[rows],
            wrong_track=self.wrong_track[rows],
            track_assumed=self.track_assumed[rows],
            limit_m=self.limit_m[rows],
        )

    def columns(self) -> list[pl.Series]:
        """The judgements as columns of `epochs` and `passages`."""
        return [
            gathered(_JUDGEMENT_WORDS, self.code).alias("judgement"),
            pl.Series("error_low_m", self.low_m, nan_to_null=True),
            pl.Series("error_high_m", self.high_m, nan_to_null=True),
            gathered(_EVIDENCE_WORDS, self.kind).alias("evidence"),
        ]

    def turned(self, direction: Ints) -> Judgements:
        """The judgements with errors in the direction of travel (+1 along growing path, -1 against it)."""
        forward = direction > 0
        low_m = np.where(forward, self.low_m, -self.high_m)
        return replace(self, low_m=low_m, high_m=np.where(forward, self.high_m, -self.low_m))

    @cached_property
    def is_right(self) -> Bools:
        """Instants judged right."""
        return np.asarray(self.code == RIGHT)

    @cached_property
    def is_wrong(self) -> Bools:
        """Instants judged wrong."""
        return np.asarray(self.code == WRONG)

    @cached_property
    def is_judged(self) -> Bools:
        """Instants that the evidence calls right or wrong (DOMAIN section 5.2)."""
        return self.is_right | self.is_wrong

    @cached_property
    def rests_on_truth(self) -> Bools:
        """Instants with evidence that can call a position right: any but the odometer since an accepted VB."""
        return np.asarray((self.kind >= 0) & (self.kind != ODOMETER))

    @cached_property
    def middle_m(self) -> Floats:
        """Middle of the interval of the error [m]."""
        return 0.5 * (self.low_m + self.high_m)

    @cached_property
    def half_m(self) -> Floats:
        """Half the width of the interval of the error [m]."""
        return 0.5 * (self.high_m - self.low_m)

    @cached_property
    def least_m(self) -> Floats:
        """The smallest size that the error may have [m]."""
        return np.asarray(np.maximum(np.maximum(self.low_m, -self.high_m), 0.0))

    @cached_property
    def largest_m(self) -> Floats:
        """The largest size that the error may have [m]."""
        return np.asarray(np.maximum(-self.low_m, self.high_m))

    def known_error_m(self, known_to_m: float) -> Floats:
        """The error where reference or balise reads give it to +- `known_to_m`, else NaN [m]."""
        return np.where(self.rests_on_truth & (self.half_m <= known_to_m), self.middle_m, np.nan)


@frozen
class JudgedEpochs(MonitoredEpochs):
    """`MonitoredEpochs` with what the judge says of each; `direction`: without an odometer that of the evidence."""

    epoch: Ints
    """Row among all epochs of the solution."""
    at_ns: Ints
    """The instant at which the position is judged [ns]: its stamp less the latency of the vehicle file."""
    judgements: Judgements
    """What the evidence says of the position, with errors in the direction of travel."""
    true_places: TruePlaces
    """Where the train was."""
    error_along_m: Floats
    """Error where reference or reads give it to `known_error_m` [m]."""
    error_cross_m: Floats
    """Error across the track by the reference, positive to the left [m]."""
    error_up_m: Floats
    """Error in height by the reference [m]."""
    train_m: Floats
    """Path position of the train where reference or reads give it to `known_error_m` [m]."""
    reference_m: Floats
    """The same where the reference gives it [m]."""
    moves: Bools
    """The train moves from here to the next epoch, as is known."""
    may_move: Bools
    """It does, or nobody knows (DOMAIN section 5.5)."""
    odometer_standing: Bools
    """The odometer stood while positions left their place by more than the failure limit."""
    odometer_wrong: Bools
    """The distance since the last accepted VB is beyond 5 m + 5 % by the evidence."""
    undiagnosed: Bools
    """State P3: no verdict of `along_raw`, by the LDS, or `odometer_wrong`."""
    in_use: Bools
    """Fix valid, unambiguous, confident, not negated, not withheld."""
    used_s: Floats
    """Time in use that the epoch stands for [s]."""
    wrong_s: Floats
    """The same where it was wrong [s]."""
    natural_s: Floats
    """Of it what no injected fault of GNSS explains [s]."""
    counted_s: Floats
    """Time that the epoch stands for in shares of time [s]."""
    lds_state: Ints
    """State of the reactive LDS by number in `LdsState`; -1 where it needs a truth that is missing."""

    @property
    def valid(self) -> Bools:
        """Epochs with a TVB of which it is known whether the train moves; else a TVB counts for no availability."""
        return self.tvb & (self.moves | ~self.may_move)

    def series(self) -> list[pl.Series]:
        """All columns, for studies that read tables."""
        return [*super().series(), *self._evidence_series()]

    def contract_series(self) -> list[pl.Series]:
        """The columns of the `epochs` table that the judge knows."""
        of_table = {_ARRAYS.get(name, name) for name in dtypes(Epochs)}
        return [
            *(series_of(self, name) for name in arrays_of(type(self)) if name in of_table),
            self.solution_series(),
            *(column for name, one in self.verdicts.items() for column in one.columns(name)),
            *self._evidence_series(),
        ]

    def _evidence_series(self) -> list[pl.Series]:
        """Columns of judgement, true places and movement."""
        moving = np.where(self.may_move & ~self.moves, np.nan, self.moves)
        return [
            *self.judgements.columns(),
            *self.true_places.columns(),
            pl.Series("moving", moving, nan_to_null=True).cast(pl.Boolean),
        ]


@frozen
class JudgedOffers:
    """Crossings of virtual balises and telegrams, judged against where the train was; arrays of shape (offers,)."""

    crossing_id: Ints
    """Place among the `Crossings` of the solution."""
    balise_id: Sequence[str]
    """Balise."""
    t_ns: Ints
    """The crossing, interpolated [ns]."""
    epoch: Ints
    """Row of the first epoch at or after the crossing."""
    path_m: Floats
    """Path position of the balise [m]."""
    virtual: Bools
    """A virtual balise; else a telegram."""
    accepted: Bools
    """A virtual balise that the LDS accepted."""
    offered: Bools
    """A virtual balise offered; false where crossed again before it was re-armed, which only a jump does."""
    beyond_window: Bools
    """Offered after its window closed."""
    judged: Judgements
    """What the evidence says of the offer, with errors in the direction of travel."""
    location_error_m: Floats
    """Error where reference or reads give it to `known_error_m` [m]."""
    proof_margin_m: Floats
    """By how much the evidence may be wrong before what is right is no longer [m]."""

    @property
    def size(self) -> int:
        """Number of offers."""
        return self.t_ns.size

    def where(self, rows: Ints) -> JudgedOffers:
        """Some of the offers, by their numbers."""
        parts = {name: getattr(self, name)[rows] for name in arrays_of(type(self))}
        names = [self.balise_id[row] for row in rows.tolist()]
        return JudgedOffers(**parts, balise_id=names, judged=self.judged.at(rows))

    @classmethod
    def of_crossings(cls, crossings: Crossings, rows: Ints, **judged: Any) -> JudgedOffers:
        """Some of the crossings as offers; `judged`: the fields that the judge adds."""
        return cls(
            crossing_id=rows,
            balise_id=[crossings.balise_id[row] for row in rows.tolist()],
            t_ns=crossings.t_ns[rows],
            epoch=crossings.epoch[rows],
            path_m=crossings.path_m[rows],
            virtual=crossings.virtual[rows],
            accepted=crossings.accepted[rows],
            offered=crossings.virtual[rows] & crossings.offered[rows],
            **judged,
        )
