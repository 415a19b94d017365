"""The replay: `from pipeline import replay` gives the main job as a function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.stages import replay

__all__ = ["replay"]


def __getattr__(name: str) -> Any:
    # Not at once: a question to a result would wait half a second for what only a replay needs.
    if name == "replay":
        from pipeline.stages import replay

        return replay
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
