"""Was each position right, which failures and hazards follow, were alarms due (DOMAIN sections 5.2 to 5.5).

In: a solution as it was replayed, the evidence of its run, the odometer (`JudgeInput`). Out: `Judged`, the contract's
tables. Touches no file. Velocity, and scale and latency learned in the run, decide no judgement, time or verdict.

- One epoch, from position to judgement: `judge.judge`, `epochs.judged_epochs`, `judgement.judge_positions`.
- One crossing, from offer to `unsafe_accepted`: `epochs.judged_offers`, `passages.passages_table`, and in `run_row`
  `run_figures.acceptances`.
- One failure, from onset to `within_budget`: `failures.course_of`, `failures.find_failures`, `failures.within_budget`.

| question | module |
|---|---|
| in which order is it judged | `judge.py` |
| what is judged, and by what | `given.py` |
| was a position right | `judgement.py` |
| did the train move, which way, does the odometer count wrong | `travel.py` |
| for how long was a position in use; state of the LDS | `in_use.py` |
| errors across the track | `cross_errors.py` |
| all of these per epoch, and per offered balise | `epochs.py` |
| where did the position jump | `jumps.py` |
| which wrong time in use is one failure | `failures.py` |
| since when and until when was a position wrong, when was it detected | `episodes.py` |
| which hazards | `hazards.py` |
| was an alarm due; which component is suspected (an opinion) | `alarms.py` |
| when did the train itself pass each balise | `true_crossings.py` |
| what became of each passage | `passages.py` |
"""
