"""The published figures (DIAG Fig. 4 to 7) as SVG; that of Pmd serves the experiment on recorded runs too."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import cos, log10, radians, sin

import polars as pl

from datasets.experiment.bank import READINGS, SENSORS
from datasets.experiment.geometry import CONSTELLATIONS
from pipeline.show.svg_plot import (
    COLOURS,
    HEIGHT,
    WIDTH,
    Axis,
    Curve,
    even_ticks,
    plot,
    svg,
    svg_text,
    symmetric_log_scale,
)

_NAMES = {"gps": "GPS", "gps_galileo": "GPS + Galileo"}
_SENSOR_NAMES = {"odometer": "odometer only", "odometer_and_track": "with track"}
_PMD_RATES_MPS = (0.01, 0.03, 0.1)
_DETECT_RATES_MPS = (0.03, 0.1, 0.5, 1.0)
_SINCE_RATES_MPS = (0.03, 0.1, 1.0)
_DETECT_S = (1.0, 10.0, 100.0, 1_000.0, 10_000.0)
_HEADINGS = Axis("heading [deg]", 0.0, 75.0, (0.0, 15.0, 30.0, 45.0, 60.0, 75.0))
_HORIZON = 0.42 * HEIGHT
_TIMES_S = (-3000.0, -1000.0, -300.0, -100.0, -30.0, -10.0, -3.0, 0.0, 3.0, 10.0, 30.0, 100.0, 300.0)


def drawn_figures(pmd: pl.DataFrame, detection: pl.DataFrame, geometry: pl.DataFrame) -> dict[str, str]:
    """SVG by name of the file, from the tables `pmd`, `detection` and `geometry` of `diagnostics`."""
    by_heading = detection.sort("heading_deg", maintain_order=True)
    drawn = {f"figure_4_sky_{name}": _sky_figure(geometry, name) for name in CONSTELLATIONS}
    drawn |= {f"figure_5_pmd_{reading}": _pmd_figure(pmd, reading) for reading in READINGS}
    for reading, name in product(READINGS, CONSTELLATIONS):
        drawn[f"figure_6_time_to_detect_{reading}_{name}"] = _time_figure(by_heading, reading, name)
    drawn |= {f"figure_7_time_since_failure_{rate:g}": _since_figure(by_heading, rate) for rate in _SINCE_RATES_MPS}
    return {f"{name}.svg": drawing for name, drawing in drawn.items()}


def _known_points(frame: pl.DataFrame, *columns: str) -> list[tuple[float, float]]:
    """Points of a curve that are known."""
    return list(frame.select(columns).drop_nulls().iter_rows())


def pmd_plot(title: str, curves: Sequence[Curve]) -> str:
    """Pmd over the time since failure [s] (DIAG Fig. 5), the axis at least from -1 to 1 s."""
    times_s = [time_s for curve in curves for time_s, _ in curve.points]
    low, high = min([-1.0, *times_s]), max([1.0, *times_s])
    ticks = [tick for tick in _TIMES_S if low <= tick <= high]
    times = Axis(
        "time since failure T_dsf [s], linear about 0, logarithmic beyond", low, high, ticks, symmetric_log_scale
    )
    return plot(title, times, Axis("Pmd", 0.0, 1.0, (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)), curves)


def _pmd_figure(pmd: pl.DataFrame, reading: str) -> str:
    """Pmd over the time since failure, heading 0, by constellation and rate (DIAG Fig. 5)."""
    ahead = pmd.filter(reading=reading, sensors="odometer", heading_deg=0.0)
    curves = []
    for constellation, (number, rate) in product(CONSTELLATIONS, enumerate(_PMD_RATES_MPS)):
        chosen = ahead.filter(constellation=constellation, rate_mps=rate)
        curve = Curve(
            f"{_NAMES[constellation]}, {rate:g} m/s",
            _known_points(chosen, "time_since_failure_s", "pmd"),
            COLOURS[number],
            dashed=constellation != "gps",
            band=_known_points(chosen, "pmd_low", "pmd_high"),
        )
        curves.append(curve)
    return pmd_plot(f"Pmd over the time since failure: heading 0, odometer only, noise on {reading}", curves)


def _time_figure(detection: pl.DataFrame, reading: str, constellation: str) -> str:
    """Expected time to detect over the heading (DIAG Fig. 6)."""
    curves = []
    for (number, rate), sensors in product(enumerate(_DETECT_RATES_MPS), SENSORS):
        chosen = detection.filter(reading=reading, constellation=constellation, sensors=sensors, rate_mps=rate)
        line = _known_points(chosen, "heading_deg", "time_to_detect_s")
        name = f"{rate:g} m/s, {_SENSOR_NAMES[sensors]}"
        curves.append(Curve(name, line, COLOURS[number], dashed=sensors == "odometer"))
    title = f"Expected time to detect over heading: {_NAMES[constellation]}, noise on {reading}"
    return plot(title, _HEADINGS, Axis("expected T_D [s]", _DETECT_S[0], 2.0 * _DETECT_S[-1], _DETECT_S, log10), curves)


def _since_figure(detection: pl.DataFrame, rate_mps: float) -> str:
    """Expected time since failure over the heading (DIAG Fig. 7)."""
    value, low, high = "time_since_failure_s", "time_since_failure_low_s", "time_since_failure_high_s"
    known = detection.filter(sensors="odometer_and_track", rate_mps=rate_mps).drop_nulls(value)
    curves = []
    for (number, constellation), reading in product(enumerate(CONSTELLATIONS), READINGS):
        chosen = known.filter(reading=reading, constellation=constellation)
        name = f"{_NAMES[constellation]}, {reading}"
        band = _known_points(chosen, low, high)
        curves.append(
            Curve(name, _known_points(chosen, "heading_deg", value), COLOURS[number], reading == "position", band)
        )
    ends = (0.0, *known[low].to_list(), *known[high].to_list())
    times = Axis("expected T_dsf [s]", min(ends), max(1.0, *ends), even_ticks(min(ends), max(1.0, *ends)))
    return plot(f"Expected time since failure over heading, with track, {rate_mps:g} m/s", _HEADINGS, times, curves)


def _sky_figure(geometry: pl.DataFrame, constellation: str) -> str:
    """Azimuth clockwise from north, elevation from the rim to the zenith."""
    x0, y0 = WIDTH / 2, HEIGHT / 2
    parts = [svg_text(x0, y0 - _HORIZON - 6, "N", "middle")]
    for elevation_deg in (0.0, 30.0, 60.0):
        radius = _HORIZON * (1.0 - elevation_deg / 90.0)
        parts.append(f'<circle cx="{x0}" cy="{y0}" r="{radius:.1f}" fill="none" stroke="#dddddd"/>')
        parts.append(svg_text(x0 + 3, y0 - radius + 14, f"{elevation_deg:g}°"))
    for row in geometry.filter(constellation=constellation).iter_rows(named=True):
        radius, azimuth = _HORIZON * (1.0 - row["elevation_deg"] / 90.0), radians(row["azimuth_deg"])
        x, y = x0 + radius * sin(azimuth), y0 - radius * cos(azimuth)
        colour = "#c00000" if row["faulty"] else COLOURS[0]
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>', svg_text(x + 6, y - 4, row["sv"])]
    return svg(f"The sky: {_NAMES[constellation]}", HEIGHT, parts)
