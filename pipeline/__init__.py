"""The replay: `from pipeline import read_run, read_site, replay` gives the main job as functions.

tables = replay(read_run("run.mcap"), read_site("site"))
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.one_run import replay
    from pipeline.read.ingest import read_run
    from pipeline.read.site.read import read_site
    from pipeline.results.store import read_table

__all__ = ["read_run", "read_site", "read_table", "replay"]


def __getattr__(name: str) -> Any:
    # Not at once: a question to a result would wait half a second for what only a replay needs.
    if name == "replay":
        from pipeline.one_run import replay

        return replay
    if name == "read_run":
        from pipeline.read.ingest import read_run

        return read_run
    if name == "read_site":
        from pipeline.read.site.read import read_site

        return read_site
    if name == "read_table":
        from pipeline.results.store import read_table

        return read_table
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
