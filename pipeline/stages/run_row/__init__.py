"""The `runs` row of one solution: figures, verdict, what time was lost to, remedies, notes.

In: judged tables of one run. Out: its `runs` row (`summarise`).
Touches no file. What is unknown stays unknown here: it counts neither as right nor as wrong.

- `summary`: the row, and the notes for its reader.
- `run_figures`: availability, accuracy, balises, hazards, alarms, states; reasons and verdict, by service level too.
- `bounds`: how certain figures are, and what counts as one event.
- `lost_time`: what moving time was lost to, and what would mend the run.
"""
