"""The `runs` row of a solution: figures of the run with their bounds, verdict, remedies, notes.

In: judged tables of a solution. Out: one `runs` row; the notes of a run.
Touches no file. What is unknown stays unknown here: it counts neither as right nor as wrong.
"""
