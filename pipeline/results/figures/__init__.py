"""Figures over many runs, with their bounds: the tables of `OUT/campaign/`.

In: judged tables of many runs. Out: `OUT/campaign/`, and what terminal and pages say of hazards.
Touches no file.
"""
