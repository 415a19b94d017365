"""How a campaign is asked to stop, by the user or the system."""

from __future__ import annotations

import signal
import threading
from asyncio import CancelledError
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from pipeline.results.outcome import CampaignSummary

Handler = Callable[[int, FrameType | None], None] | signal.Handlers

# Windows has no SIGHUP.
_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class StopRun(BaseException):
    """Whatever is under way is to end: nothing on the way may take it for a failure of a run."""


# What passes through the boundary that turns all else that a run raises into a failed run.
ENDING = (StopRun, KeyboardInterrupt, SystemExit, GeneratorExit, CancelledError)


class Interrupted(StopRun):
    """The user or the system asked to stop; `summary` tells what is complete."""

    def __init__(self, signum: int, summary: CampaignSummary | None = None) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum
        self.summary = summary


@contextmanager
def handle_signals(signals: Iterable[int], handler: Handler) -> Iterator[bool]:
    """Let the handler answer these signals meanwhile; only the main thread can, which is what is given."""
    in_main = threading.current_thread() is threading.main_thread()
    before = {signum: signal.signal(signum, handler) for signum in signals if in_main}
    try:
        yield in_main
    finally:
        for signum, earlier in before.items():
            signal.signal(signum, earlier)


@contextmanager
def listen_for_signals(heard: Callable[[int], None], at_once: bool) -> Iterator[None]:
    """Pass SIGINT, SIGTERM and SIGHUP on to `heard`; `at_once` also raises `Interrupted` where they arrive.

    What the caller ignores (`nohup`) is ignored.
    """

    def answer(signum: int, frame: FrameType | None) -> None:
        """Pass a signal on."""
        heard(signum)
        if at_once:
            raise Interrupted(signum)

    with handle_signals([signum for signum in _STOPPING if signal.getsignal(signum) is not signal.SIG_IGN], answer):
        yield
