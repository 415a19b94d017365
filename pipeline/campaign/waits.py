"""How long a campaign waits for whom, and how often it tries: all in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Waits:
    """Times [s] and counts. None of them changes a table."""

    look_s: float = 0.2
    """Between two looks at the runs under way."""
    attempts: int = 2
    """At a run whose worker died over it."""
    starts: int = 10
    """Of workers that die before they begin a run."""
    start_s: float = 60.0
    """For a process of this machine to start, which takes some seconds; until it counts as dead."""
    lonely_said_s: float = 4.0
    """Without any worker, until that is said."""
    lonely_s: float = 300.0
    """Without any worker, or a word of the scheduler, until the campaign gives up: in the night nobody would notice."""
    runs_per_process: int = 200
    """Until a process is replaced, and its memory is free again."""
    settled_s: float = 2.0
    """What changed as lately as this may change again without showing another time."""
    lock_beat_s: float = 2.0
    """Between two beats of a lock in a store."""
    lock_silence_s: float = 8.0
    """Without a beat, until its holder counts as killed."""
    scheduler_s: float = 8.0
    """For the first answer of a cluster's scheduler."""
    scheduler_answer_s: float = 5.0
    """For each later one."""
    count_every_s: float = 2.0
    """Between two counts of a cluster's workers."""
    kill_s: float = 15.0
    """For the end of a cluster's worker that took too long."""
    grace_s: float = 15.0
    """Beyond the time limit of a run, until its worker ends itself."""


WAITS = Waits()
