"""An analyst's session: what did a campaign show, which run deserves a look, and how far was its position off?

python examples/analysts_session.py OUT [PICTURE.png]

`OUT` is the result of `balise replay` over many runs. The picture needs the extra `plots`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import polars as pl

from pipeline import read_table


def main(out: Path, picture: Path | None = None) -> dict[str, pl.DataFrame]:
    """Print one table per question, and return them by name."""
    answers = {
        "verdicts": verdicts(out),
        "lost": lost_time(out),
        "detections": detections(out),
        "balises": worst_balises(out),
    }
    with pl.Config(tbl_rows=12, tbl_cols=-1, tbl_width_chars=120):
        for question, answer in answers.items():
            print(question, answer, sep="\n")
    if picture is not None:
        run_id, solution = answers["verdicts"].select("run_id", "solution").row(0)
        draw_error(out, run_id, solution, picture)
    return answers


def verdicts(out: Path) -> pl.DataFrame:
    """Runs, the worst first: failed ones have no verdict, and count in no figure."""
    worst_first = pl.col("verdict").cast(pl.String).replace_strict({"unsafe": 0, "unproven": 1, "safe": 2}, default=3)
    return (
        read_table(out, "runs")
        .sort(worst_first, "hazardous_s", descending=[False, True], nulls_last=True)
        .select(
            "run_id", "solution", "status", "verdict", "reasons", "balises_accepted", "balises_on_path", "availability"
        )
        .collect()
    )


def lost_time(out: Path) -> pl.DataFrame:
    """What the moving time without a valid TVB was lost to, over all runs [s]."""
    return (
        read_table(out, "epochs")
        .filter(pl.col("lost_s") > 0)
        .group_by(pl.col("lost_to").cast(pl.String))
        .agg(pl.col("lost_s").sum().round(1), runs=pl.col("run_id").n_unique())
        .sort("lost_s", descending=True)
        .collect()
    )


def detections(out: Path) -> pl.DataFrame:
    """Hazards by class: how many no monitor detected, and the longest time from failure to detection [s]."""
    return (
        read_table(out, "hazards")
        .group_by(pl.col("hazard").cast(pl.String))
        .agg(
            hazards=pl.len(),
            undetected=(~pl.col("detected")).sum(),
            largest_m=pl.col("size_m").abs().max().round(1),
            latest_s=pl.col("time_since_failure_may_s").max(),
        )
        .sort("hazard")
        .collect()
    )


def worst_balises(out: Path) -> pl.DataFrame:
    """Virtual balises by the share of passages that did not end in an acceptance."""
    accepted = pl.col("status") == "accepted"
    return (
        read_table(out, "passages")
        .filter(pl.col("kind") == "virtual")
        .group_by("balise_id")
        .agg(
            passages=pl.len(),
            accepted=accepted.sum(),
            wrong=(accepted & (pl.col("judgement") == "wrong")).sum(),
            largest_error_m=pl.col("location_error_m").abs().max().round(1),
        )
        .sort(pl.col("accepted") / pl.col("passages"), "balise_id")
        .collect()
    )


def draw_error(out: Path, run_id: str, solution: str, picture: Path) -> None:
    """The error along the track over time: an interval, for evidence does not know it to the metre."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    of_run = (pl.col("run_id") == run_id) & (pl.col("solution") == solution) & pl.col("error_low_m").is_not_null()
    epochs = read_table(out, "epochs").filter(of_run).collect()
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    axes.fill_between(
        epochs["t"], epochs["error_low_m"], epochs["error_high_m"], alpha=0.4, label="error along the track"
    )
    for sign in (-1, 1):
        axes.plot(epochs["t"], sign * epochs["confidence_m"], color="tab:red", linewidth=0.8)
    # Decimetres and a jump of a kilometre in one figure: linear up to 10 m, in powers of ten beyond.
    axes.set_yscale("symlog", linthresh=10)
    axes.set_title(f"{run_id}, {solution}")
    axes.set_ylabel("along the track [m]")
    axes.legend()
    figure.savefig(picture)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
