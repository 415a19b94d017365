"""Location determination system: virtual balises, ETCS linking, travelling virtual balise.

In: aligned epochs of one solution, a monitor bank, balises of the path, telegrams with the odometer at each. Out: LDS
columns of the epochs, crossings, passages. Touches no file, and knows of no truth.

`run` is the stage, `machine` the walk along the epochs with one state of the position (`Use`), which offers crossings
to the two chains of `linking`. `crossings`: the columns of the journey, and where a balise is passed or read, within
its window. `link_monitors`: order and distance; the re-link, its anchor and comparison.

Where the sources leave a choice:

- A step that passes a balise is judged by its last epoch: the monitors first, then the match (of both its epochs), the
  confidence, and what is then a detection by linking.
- A passage has one row; the first offer outside the window is it, unless the position went back over the balise. It
  keeps its first linking error. What is passed but not accepted is `missed` by linking, whatever its `status`.
- Virtual and physical balises are two chains that share nothing but the re-link anchor.
- Linking holds in both directions of travel. Balises in whose window the train turned round may be found or not; the
  5 % of the odometer then count on the whole distance run since the reference.
- Not announced (`linked` false): rejected while linking is in force, taken like any other before that.
- With `entry_from_unfitted_area` the first virtual balise too needs the diagnosis behind it (`init_s`).
- The linking distance monitor allows 5 m + 5 % and the noise of both positions at k_T: 5 m alone would alarm on sound
  receivers.
- What nothing watched for a while (an outage, noise, lost or guessed distance) re-links: the window is too wide to see
  what came of it. Where it has moved, the linking distance monitor fails; where nothing can be said, the position stays
  withheld until a telegram, without an alarm.
- A start of mission (`lds.starts_of_mission`) forgets LRVB, linking and anchor.
- Exposure at an epoch is the time since the TVB or accepted VB before it, so a gap without epochs shows.
"""

from pipeline.stages.lds.run import LdsResult, run_lds

__all__ = ["LdsResult", "run_lds"]
