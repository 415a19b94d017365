"""A run replayed from Python: which balises were accepted, and how far the position was off. Needs the extra `plots`.

python docs/example.py RUN SITE error.png
"""

from __future__ import annotations

import sys

import matplotlib
import polars as pl

from pipeline import read_run, read_site, replay

matplotlib.use("Agg")
import matplotlib.pyplot as plt

run, site, picture = sys.argv[1:]
tables = replay(read_run(run), read_site(site))

verdict = tables.runs.select("solution", "verdict", "reasons", "balises_accepted", "balises_on_path")
print(verdict)

passages = tables.passages.group_by("status").len().sort("status")
print(passages)

# A position is wrong, right or unknown; where the error is not known to 5 m, only its bounds are.
epochs = tables.epochs.filter(pl.col("error_low_m").is_not_null(), pl.col("solution") == pl.col("solution").first())
figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
middle_m = (epochs["error_low_m"] + epochs["error_high_m"]) / 2
axes.fill_between(epochs["t"], epochs["error_low_m"], epochs["error_high_m"], alpha=0.4)
axes.plot(epochs["t"], middle_m, ".", markersize=3, label="error along the track, with its bounds")
axes.plot(epochs["t"], epochs["confidence_m"], color="tab:red", linewidth=0.8, label="confidence")
axes.plot(epochs["t"], -epochs["confidence_m"], color="tab:red", linewidth=0.8)
# Decimetres and a jump of a kilometre in one figure: straight up to 10 m, in powers of ten beyond.
axes.set_yscale("symlog", linthresh=10)
axes.set_ylabel("m")
axes.legend()
figure.savefig(picture)
