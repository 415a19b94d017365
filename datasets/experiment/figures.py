"""The three figures of the experiment as pictures (optional dependency matplotlib, extra `plots`)."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterator
from math import radians
from typing import TYPE_CHECKING

import polars as pl

from datasets.experiment.bank import READINGS, SENSORS
from schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"gps": "#1f5fa8", "gps_galileo": "#c4561a"}
_NAMES = {"gps": "GPS", "gps_galileo": "GPS + Galileo"}
_LINES = {"odometer": "--", "odometer_and_track": "-"}
_SENSOR_NAMES = {"odometer": "odometer only", "odometer_and_track": "odometer and track"}


def require_matplotlib() -> None:
    """Say what to install before hours of simulation, not after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise UsageError(
            "pictures need matplotlib",
            found="not installed",
            remedy="Install `balise[plots]`.",
        )


def drawn_figures(pmd: pl.DataFrame, detection: pl.DataFrame, geometry: pl.DataFrame) -> dict[str, bytes]:
    """Fig. 5 to 7 and the skyplot, both readings side by side; PNG without anything that changes from run to run."""
    figures = {
        "figure_5_pmd": _pmd_figure(pmd),
        "figure_6_time_to_detect": _time_figure(detection.sort("heading_deg", maintain_order=True)),
        "figure_7_time_since_failure": _since_figure(detection.sort("heading_deg", maintain_order=True)),
        "figure_4_sky": _sky_figure(geometry),
    }
    return {f"{name}.png": _png(figure) for name, figure in figures.items()}


def _png(figure: Figure) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120, metadata={"Software": None})
    return picture.getvalue()


def _panels(count: int, title: str) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0 * count, 4.6), layout="constrained")
    figure.suptitle(title)
    return figure, [figure.add_subplot(1, count, index + 1) for index in range(count)]


def _readings(panels: list[Axes]) -> Iterator[tuple[Axes, str, str, str]]:
    """Each panel with its reading, and the constellations in it with their colours."""
    for axes, reading in zip(panels, READINGS, strict=True):
        for constellation, colour in _COLOURS.items():
            yield axes, reading, constellation, colour


def _curve(axes: Axes, frame: pl.DataFrame, x: str, ys: tuple[str, ...], label: str, style: str, colour: str) -> None:
    """A line, and the band of its bounds where `ys` names them."""
    along, line, *band = (frame[name].to_list() for name in (x, *ys))
    axes.plot(along, line, style, color=colour, label=label, markersize=3)
    if band:
        axes.fill_between(along, band[0], band[1], color=colour, alpha=0.15, linewidth=0)


def _pmd_figure(pmd: pl.DataFrame) -> Figure:
    figure, panels = _panels(len(READINGS), "Missed detection against time since failure, heading 0, odometer only")
    for axes, reading, constellation, colour in _readings(panels):
        for rate, style in {0.01: "-", 0.03: "--", 0.1: ":"}.items():
            chosen = pmd.filter(
                reading=reading, constellation=constellation, sensors="odometer", heading_deg=0.0, rate_mps=rate
            )
            label = f"{_NAMES[constellation]}, {rate:g} m/s"
            _curve(axes, chosen, "time_since_failure_s", ("pmd", "pmd_low", "pmd_high"), label, style, colour)
    for axes, reading in zip(panels, READINGS, strict=True):
        axes.axvline(0.0, color="0.6", linewidth=0.8)
        title = f"odometer noise on {reading}"
        axes.set(title=title, xlabel="time since failure [s]", ylabel="Pmd", ylim=(-0.02, 1.02))
        axes.legend(fontsize=7)
    return figure


def _time_figure(detection: pl.DataFrame) -> Figure:
    figure, panels = _panels(len(READINGS), "Expected time to detect against heading")
    for axes, reading, constellation, colour in _readings(panels):
        for sensors in SENSORS:
            for rate, marker in {0.03: "o", 0.1: "s", 0.5: "v", 1.0: "^"}.items():
                chosen = detection.filter(reading=reading, constellation=constellation, sensors=sensors, rate_mps=rate)
                label = f"{_NAMES[constellation]}, {_SENSOR_NAMES[sensors]}, {rate:g} m/s"
                _curve(axes, chosen, "heading_deg", ("time_to_detect_s",), label, marker + _LINES[sensors], colour)
    for axes, reading in zip(panels, READINGS, strict=True):
        title = f"odometer noise on {reading}"
        axes.set(title=title, xlabel="heading [deg]", ylabel="expected T_D [s]", yscale="log")
        axes.legend(fontsize=5, ncols=2)
    return figure


def _since_figure(detection: pl.DataFrame) -> Figure:
    rates = (0.03, 0.1, 1.0)
    bounded = ("time_since_failure_s", "time_since_failure_low_s", "time_since_failure_high_s")
    figure, panels = _panels(len(rates), "Expected time since failure against heading, with track")
    known = detection.filter(sensors="odometer_and_track").drop_nulls(bounded[0])
    for axes, rate in zip(panels, rates, strict=True):
        for constellation, colour in _COLOURS.items():
            for reading, style in zip(READINGS, ("o-", "s--"), strict=True):
                chosen = known.filter(reading=reading, constellation=constellation, rate_mps=rate)
                label = f"{_NAMES[constellation]}, noise on {reading}"
                _curve(axes, chosen, "heading_deg", bounded, label, style, colour)
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set(title=f"{rate:g} m/s", xlabel="heading [deg]", ylabel="expected T_dsf [s]")
        axes.legend(fontsize=7)
    return figure


def _sky_figure(geometry: pl.DataFrame) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for index, constellation in enumerate(_COLOURS):
        axes = figure.add_subplot(1, 2, index + 1, projection="polar")
        for row in geometry.filter(constellation=constellation).iter_rows(named=True):
            place = (radians(row["azimuth_deg"]), 90.0 - row["elevation_deg"])
            axes.plot(*([one] for one in place), "o", color="#c00000" if row["faulty"] else "#1f5fa8")
            axes.annotate(row["sv"], place, fontsize=7)
        # Azimuth runs clockwise from north, elevation from the rim to the zenith.
        axes.set(theta_zero_location="N", theta_direction=-1, ylim=(0.0, 90.0), title=_NAMES[constellation])
        axes.set_yticks([0.0, 30.0, 60.0], ["90°", "60°", "30°"])
    return figure
