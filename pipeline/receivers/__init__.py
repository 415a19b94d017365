"""Logs of GNSS receivers as runs (`balise convert`).

In: UBX, SBF, NMEA, CSV with a mapping. Out: the streams of a run.
Touches files. Damaged messages are counted and left out, never guessed.
"""

from pipeline.receivers.convert import Converted, convert

__all__ = ["Converted", "convert"]
