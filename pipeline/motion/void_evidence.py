"""Where the odometer is no evidence, because it stood while the train moved or may have moved."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.motion.moving import Motion
from schemas.arrays import Bools, ints, times_ns, truths
from schemas.enums import Evidence, PassageStatus


def void_evidence(motion: Motion, epochs: pl.DataFrame, truth: pl.DataFrame, passages: pl.DataFrame) -> Bools:
    """Epochs whose truth hangs on an odometer that lost way, or may have lost it.

    From where positions contradict it until the next accepted VB or balise, from which it counts anew, or until its
    distance begins anew. `epochs`: aligned; `truth`: row by row; `passages`: of the LDS.
    """
    t_ns, stretch = times_ns(epochs), ints(epochs["odometer_segment"])
    accepted = passages.filter(passages["status"] == PassageStatus.ACCEPTED.value).drop_nulls("t_offered")
    offered_ns = np.sort(times_ns(accepted, "t_offered"))
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for one in motion.contradicted:
        following = offered_ns[offered_ns > t_ns[one.last + 1]]
        end = int(np.searchsorted(t_ns, following[0])) if following.size else t_ns.size
        void[one.first : end] |= stretch[one.first : end] == stretch[one.first]
    return void & truths(truth["evidence"] == Evidence.ODOMETER.value)
