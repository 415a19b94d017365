"""What happens to one run between reading and writing: one folder per stage; they import `schemas` and one another.

In: frames of a run and its site. Out: the rows of its five tables.
Touches no file.
"""
