"""What happens to one run between reading and writing: one folder per stage; they import `schemas` and one another.

In: frames of a run and its site. Out: the rows of its five tables.
Touches no file. `prepare.py` begins every use of a run and says which inputs and settings made a row; `monitored.py` is
what the train makes of one solution.
"""
