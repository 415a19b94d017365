"""The `runs` row with its verdict, and the tables over many runs: figures with their bounds.

In: judged tables of a solution, or those of many runs. Out: one `runs` row; `OUT/campaign/`; notes.
Touches no file. What is unknown stays unknown here: it counts neither as right nor as wrong.
"""
