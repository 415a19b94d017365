"""Location determination system: virtual balises, ETCS linking, travelling virtual balise.

In: aligned epochs of one solution, a monitor bank, balises of the path, telegrams with the odometer at each.
Out: LDS columns of the epochs, the table of crossings, passages.
Touches no file, knows of no truth, and asks the monitors only through `MonitorBank`.

Where the sources leave a choice, this package reads them so:

- A step that passes a balise is judged by its last epoch: first the monitors (negated or failing: rejected
  by monitor), then the match (of both its epochs), then the confidence; only what is then a detection is
  judged by linking.
- A passage has one row. An offer outside the window, before or after it, is the passage's row unless the
  position went back over the balise; further offers have rows of their own. `linking_error` keeps the
  first error: an early balise that is then not found in its window stays `early`, and still counts for
  two missed in a row.
- A balise that is passed but not accepted is `missed` by linking whatever kept it from being accepted
  (outage, monitor, confidence, ambiguity): `status` says what happened, `linking_error` what the train
  made of it.
- Virtual balises and physical ones are two chains that know nothing of each other, with one exception: a telegram
  says what GNSS minus odometer should be, so it is the re-link anchor from then on (`relink`).
- Before the first alarm the anchor is the later of telegram and TVB; an alarm fixes it, a return does not move it.
  Where the odometer lost its distance since the anchor, only a telegram re-links.
- Linking holds in both directions of travel. Balises in whose window the train turned round may be found
  or not; the 5 % of the odometer then count on the whole way run since the reference.
- Not announced (`linked` false): rejected while linking is in force, taken like any other before that.
- With `entry_from_unfitted_area` the first virtual balise too needs the diagnosis behind it (a TVB, or
  `init_s` of consistent epochs); without it the first one may begin the chain at once.
- The linking distance monitor allows the odometer's 5 m + 5 % and the noise of the two positions at k_T:
  5 m alone would alarm on sound receivers.
- Over an outage for which the bank begins anew (`align.gap_reset_s`) nobody looked on, and the expectation window is
  too wide to see what came of it: of 300 virtual balises that 20 runs passed after an outage of 90 s with the position
  30 m off, the plain rules accept 300 and this one none. So the first usable position after it has to re-link
  (`relink`, the same function): where GNSS minus odometer has moved, the linking distance monitor fails; where it
  cannot be told (no vehicle file, distance lost), it is `not_evaluated` and the position is negated without an alarm
  until a telegram.
- Withheld positions (DOMAIN section 5.2) are refused as negated ones are (`rejected_monitor`: known noise and no failed
  monitor are one condition of a detection), but raise no alarm; `withheld_for` says why.
- After slip that the odometer reports, the position has to re-link (`relink`, the same function). No alarm stands
  there, so the last TVB before the slip is the anchor, unless an alarm or a telegram fixed another. The wheel was
  counted, if wrongly: what it may be off by (`slip_doubt_m`) widens the bound, up to half the failure limit. If it is
  more than that, a fault could hide in the slip, and only a telegram re-links.
- A start of mission (`lds.starts_of_mission`) forgets LRVB, linking and anchor.
- Exposure at an epoch is the time since the TVB or accepted VB before it, so a gap without epochs shows.
"""

from pipeline.stages.lds.run import LdsResult, run_lds

__all__ = ["LdsResult", "run_lds"]
