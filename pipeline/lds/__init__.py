"""Location determination system: virtual balises, ETCS linking, travelling virtual balise.

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
- Virtual balises and physical ones are two chains that know nothing of each other, with one exception: a
  physical balise read while the position is negated, or after such a return, says what GNSS minus odometer
  should be.
- The last TVB before the alarm's onset: an alarm that follows upon a return may be about the same fault, so its
  re-link also has to hold against what that return was measured from (`footing`), while the odometer can tell.
- The last TVB before the onset of an alarm of which only slow averages know may be any that the odometer still
  reaches. A return wants room for the same drift once more within the failure limit (`drift`).
- Linking holds in both directions of travel. Balises in whose window the train turned round may be found
  or not; the 5 % of the odometer then count on the whole way run since the reference.
- Not announced (`linked` false): rejected while linking is in force, taken like any other before that.
- With `entry_from_unfitted_area` the first virtual balise too needs the diagnosis behind it (a TVB, or
  `init_s` of consistent epochs); without it the first one may begin the chain at once.
- The linking distance monitor allows the odometer's 5 m + 5 % and the noise of the two positions at k_T:
  5 m alone would alarm on sound receivers.
- After a break (no position, no odometer, or an ambiguous match for longer than a crossing is interpolated over; an
  odometer that lost its distance) the position has to be what it was by the last TVB or accepted VB, within the bounds
  of a re-link, else the linking distance monitor fails. Where these exceed the failure limit, or the distance of the
  odometer was lost, nothing can tell: the monitor is `not_evaluated`, the TVB chain begins anew (`init_s`, or a VB
  inside its window), and linking holds on. A locked-out train after every tunnel would be safe and useless.
- Exposure at an epoch is the time since the TVB or accepted VB before it, so a gap without epochs shows.
"""

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.run import LdsResult, run_lds

__all__ = ["Bank", "LdsLimits", "LdsResult", "run_lds"]
