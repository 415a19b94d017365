"""Logs of GNSS receivers as runs."""

from pipeline.receivers.convert import Converted, convert

__all__ = ["Converted", "convert"]
