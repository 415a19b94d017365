"""Location determination system: virtual balises, ETCS linking, travelling virtual balise.

In: aligned epochs of one solution, a monitor bank, balises of the path, telegrams with the odometer at each.
Out: LDS columns of the epochs, the table of crossings, passages.
Touches no file, knows of no truth, and asks the monitors only through `MonitorBank`.

`run` is the stage, `journey` the columns of the epochs, `machine` the walk along them with one state of the position
(`Use`). `crossings`: where a balise is passed or read; `detection` offers them to the two chains of `linking`
(`windows`); `link_monitors`: order and distance; `relink`: anchor and comparison. Where the sources leave a choice:

- A step that passes a balise is judged by its last epoch: first the monitors (negated, withheld or failing: rejected by
  monitor), then the match (of both its epochs), then the confidence; only what is then a detection is judged by
  linking.
- A passage has one row. An offer outside the window is the passage's row unless the position went back over the balise;
  further offers have rows of their own. `linking_error` keeps the first error: an early balise that is not found in its
  window stays `early`, and still counts for two missed in a row.
- A balise that is passed but not accepted is `missed` by linking whatever kept it from being accepted: `status` says
  what happened, `linking_error` what the train made of it.
- Virtual and physical balises are two chains that know nothing of each other, but that a telegram is the re-link
  anchor.
- Linking holds in both directions of travel. Balises in whose window the train turned round may be found or not; the 5
  % of the odometer then count on the whole way run since the reference.
- Not announced (`linked` false): rejected while linking is in force, taken like any other before that.
- With `entry_from_unfitted_area` the first virtual balise too needs the diagnosis behind it (a TVB, or `init_s` of
  consistent epochs).
- The linking distance monitor allows the odometer's 5 m + 5 % and the noise of both positions at k_T: 5 m alone would
  alarm on sound receivers.
- After an outage that the bank does not bridge (`align.gap_reset_s`, or shorter where the odometer lost its
  distance), or noise that hid the position for as long, the first usable position has to re-link, for the window is
  too wide to see what came of it: where it has moved, the linking distance monitor fails; where that cannot be said,
  the position is negated without an alarm until a telegram.
- After slip that the odometer reports no alarm stands, so the last TVB before it, or a later telegram, is the anchor.
  While a position is held to an anchor after a return, it is that one.
- A start of mission (`lds.starts_of_mission`) forgets LRVB, linking and anchor.
- Exposure at an epoch is the time since the TVB or accepted VB before it, so a gap without epochs shows.
"""

from pipeline.stages.lds.run import LdsResult, run_lds

__all__ = ["LdsResult", "run_lds"]
