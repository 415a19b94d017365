"""The replay: `from pipeline import replay` gives the main job as a function."""

from pipeline.replay import replay

__all__ = ["replay"]
