"""The `runs` row of one solution: figures, verdict, what time was lost to, remedies, notes.

In: judged tables of one run. Out: its `runs` row (`summarise`).
Touches no file. What is unknown stays unknown here: it counts neither as right nor as wrong.

- `run_figures.py`: availability, accuracy, balises, hazards, alarms, states; `bounds.py`: how certain they are;
  `independent.py`: what counts as one event.
- `verdict.py`: reasons and verdict, by service level too. `lost_time.py`: what moving time was lost to.
- `remedies.py`: what would mend the run. `notes.py`: what a reader should know.
"""
