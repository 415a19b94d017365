"""Was each position right, which failures and hazards follow, were alarms due (DOMAIN sections 5.2 to 5.5).

In: a solution as it was replayed, the evidence of its run, the odometer (`JudgeInput`). Out: `Judged`, the contract's
tables. Touches no file. Velocity, and scale and latency learned in the run, decide no judgement, time or verdict.

- One epoch, from position to judgement: `judge.judge`, `epochs.judged_epochs`, `judgement.judge_positions`.
- One crossing, from offer to `unsafe_accepted`: `epochs.judged_offers`, `judge.passages_table`, and in `run_row`
  `run_figures.acceptance_conditions`.
- One failure, from onset to `within_budget`: `failures.error_history`, `failures.find_failures`,
  `failures.keeps_budget`.

| question | module |
|---|---|
| in which order is it judged; what became of each passage | `judge` |
| when did the train itself pass each balise | `train_crossings` |
| what is judged, and by what; was a position right | `judgement` |
| in which arrays does what is judged go on | `judged` |
| per epoch and offer: in which direction did the train move, was the position in use, how far off across | `epochs` |
| where did the position jump; which wrong time in use is one failure | `failures` |
| since and until when was a position wrong, when was it detected; was an alarm due, who is suspected | `episodes` |
| which hazards | `hazards` |
"""
