"""Figures over many runs, with their bounds: the tables of `OUT/campaign/`.

In: judged tables of many runs. Out: `OUT/campaign/`, and what terminal and pages say of hazards.
Touches no file.

- `campaign_tables.py`: per run, balise and service level, and unnoticed errors; `campaign_figures.py`: per solution.
- `head.py`: the verdict over several runs, and counts that nobody could make. `hazard_words.py`: hazards in phrases.
- `map_errors.py`: places where run after run raises the same alarm across the track.
"""
