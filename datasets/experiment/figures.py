"""The three figures of the experiment as pictures (optional dependency matplotlib, extra `plots`)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from datasets.experiment.plan import READINGS, SENSORS
from schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"gps": "#1f5fa8", "gps_galileo": "#c4561a"}
_NAMES = {"gps": "GPS", "gps_galileo": "GPS + Galileo"}
_LINES = {"odometer": "--", "odometer_and_track": "-"}
_SENSOR_NAMES = {"odometer": "odometer only", "odometer_and_track": "odometer and track"}
_PMD_RATES = (0.01, 0.03, 0.1)
_TIME_RATES = (0.03, 0.1, 0.5, 1.0)
_SINCE_RATES = (0.03, 0.1, 1.0)


def require_matplotlib() -> None:
    """Say what to install before hours of simulation, not after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise UsageError(
            "pictures need matplotlib",
            found="not installed",
            remedy="Install `balise[plots]`, or ask for the tables alone.",
        )


def draw_figures(pmd: pl.DataFrame, detection: pl.DataFrame, geometry: pl.DataFrame, out: Path) -> list[Path]:
    """Fig. 5 to 7 and the skyplot, both readings side by side; PNG without anything that changes from run to run."""
    figures = {
        "figure_5_pmd": _pmd_figure(pmd),
        "figure_6_time_to_detect": _time_figure(detection),
        "figure_7_time_since_failure": _since_figure(detection),
        "figure_4_sky": _sky_figure(geometry),
    }
    paths = []
    for name, figure in figures.items():
        path = out / f"{name}.png"
        figure.savefig(path, dpi=120, metadata={"Software": None})
        paths.append(path)
    return paths


def _panels(count: int, title: str) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0 * count, 4.6), layout="constrained")
    figure.suptitle(title)
    return figure, [figure.add_subplot(1, count, index + 1) for index in range(count)]


def _curve(axes: Axes, frame: pl.DataFrame, x: str, y: str, label: str, style: str, colour: str) -> None:
    axes.plot(frame[x].to_list(), frame[y].to_list(), style, color=colour, label=label, markersize=3)
    low, high = frame[f"{y}_low"].to_list(), frame[f"{y}_high"].to_list()
    axes.fill_between(frame[x].to_list(), low, high, color=colour, alpha=0.15, linewidth=0)


def _pmd_figure(pmd: pl.DataFrame) -> Figure:
    figure, panels = _panels(len(READINGS), "Missed detection against time since failure, heading 0, odometer only")
    for axes, reading in zip(panels, READINGS, strict=True):
        for constellation, colour in _COLOURS.items():
            for rate, style in zip(_PMD_RATES, ("-", "--", ":"), strict=True):
                chosen = pmd.filter(
                    (pl.col("reading") == reading)
                    & (pl.col("constellation") == constellation)
                    & (pl.col("sensors") == "odometer")
                    & (pl.col("heading_deg") == 0.0)
                    & (pl.col("rate_mps") == rate)
                )
                label = f"{_NAMES[constellation]}, {rate:g} m/s"
                _curve(axes, chosen, "time_since_failure_s", "pmd", label, style, colour)
        axes.axvline(0.0, color="0.6", linewidth=0.8)
        axes.set(title=_reading_name(reading), xlabel="time since failure [s]", ylabel="Pmd", ylim=(-0.02, 1.02))
        axes.legend(fontsize=7)
    return figure


def _reading_name(reading: str) -> str:
    return f"odometer noise on {reading}"


def _time_figure(detection: pl.DataFrame) -> Figure:
    figure, panels = _panels(len(READINGS), "Expected time to detect against heading")
    for axes, reading in zip(panels, READINGS, strict=True):
        for constellation, colour in _COLOURS.items():
            for sensors in SENSORS:
                for rate, marker in zip(_TIME_RATES, "osv^", strict=True):
                    chosen = _by_heading(detection, reading, constellation, sensors, rate)
                    label = f"{_NAMES[constellation]}, {_SENSOR_NAMES[sensors]}, {rate:g} m/s"
                    style = marker + _LINES[sensors]
                    axes.plot(
                        chosen["heading_deg"].to_list(),
                        chosen["time_to_detect_s"].to_list(),
                        style,
                        color=colour,
                        label=label,
                        markersize=3,
                    )
        axes.set(title=_reading_name(reading), xlabel="heading [deg]", ylabel="expected T_D [s]", yscale="log")
        axes.legend(fontsize=5, ncols=2)
    return figure


def _by_heading(detection: pl.DataFrame, reading: str, constellation: str, sensors: str, rate: float) -> pl.DataFrame:
    return detection.filter(
        (pl.col("reading") == reading)
        & (pl.col("constellation") == constellation)
        & (pl.col("sensors") == sensors)
        & (pl.col("rate_mps") == rate)
    ).sort("heading_deg")


def _since_figure(detection: pl.DataFrame) -> Figure:
    figure, panels = _panels(len(_SINCE_RATES), "Expected time since failure against heading, with track")
    for axes, rate in zip(panels, _SINCE_RATES, strict=True):
        for constellation, colour in _COLOURS.items():
            for reading, style in zip(READINGS, ("o-", "s--"), strict=True):
                chosen = _by_heading(detection, reading, constellation, "odometer_and_track", rate)
                chosen = chosen.drop_nulls("time_since_failure_s")
                label = f"{_NAMES[constellation]}, noise on {reading}"
                renamed = chosen.rename(
                    {"time_since_failure_low_s": "since_low", "time_since_failure_high_s": "since_high"}
                ).with_columns(since=pl.col("time_since_failure_s"))
                _curve(axes, renamed, "heading_deg", "since", label, style, colour)
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set(title=f"{rate:g} m/s", xlabel="heading [deg]", ylabel="expected T_dsf [s]")
        axes.legend(fontsize=7)
    return figure


def _sky_figure(geometry: pl.DataFrame) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for index, constellation in enumerate(_COLOURS):
        axes = figure.add_subplot(1, 2, index + 1, projection="polar")
        sky = geometry.filter(pl.col("constellation") == constellation)
        for row in sky.iter_rows(named=True):
            angle = row["azimuth_deg"] * 3.141592653589793 / 180.0
            colour = "#c00000" if row["faulty"] else "#1f5fa8"
            axes.plot([angle], [90.0 - row["elevation_deg"]], "o", color=colour)
            axes.annotate(row["sv"], (angle, 90.0 - row["elevation_deg"]), fontsize=7)
        # Azimuth runs clockwise from north, elevation from the rim to the zenith.
        axes.set(theta_zero_location="N", theta_direction=-1, ylim=(0.0, 90.0), title=_NAMES[constellation])
        axes.set_yticks([0.0, 30.0, 60.0], ["90°", "60°", "30°"])
    return figure
