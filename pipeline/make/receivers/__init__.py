"""Logs of GNSS receivers as runs (`balise convert`).

In: UBX, SBF, NMEA, NovAtel, JSON of gpsd, RTKLIB `.pos`, bags, CSV with a mapping; packed or not. Out: the streams of
a run, new or added to one.
Touches files. Damaged messages are counted and left out, never guessed.

- Which log is it? `convert` (`unpack`: archives); `adding` puts streams into a run.
- Which messages are whole? `frames`. What do they say of an epoch? `ubx`, `sbf`, `nmea`, `novatel`; `epochs` gathers,
  and `messages` chooses the protocol that says most.
- Are they of one receiver? `rivals`. JSON of gpsd: `gpsd`.
- Tables: `csv` with `csv_times`, `rtklib`. Bags: `bags`, as an MCAP log. `earth_fixed` turns axes.
"""

from pipeline.make.receivers.adding import Purpose
from pipeline.make.receivers.convert import (
    Converted,
    Gatherings,
    as_run,
    convert,
    extend_run,
    gather,
    words_for_dropped,
)

__all__ = ["Converted", "Gatherings", "Purpose", "as_run", "convert", "extend_run", "gather", "words_for_dropped"]
