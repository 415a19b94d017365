"""What a large network adds to the replay of a short run that is on a few of its elements.

Whole commands, processor time, the demonstration's site beside the same site with many other elements, linked.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from benchmarks.speed.start import Cost, cost_of
from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site
from schemas.enums import Navigability
from schemas.run import Site

# Elements beside those of the run, with the seconds that they may add and the memory [MB] that all may take.
_SIZES = {20_000: (0.3, 600.0), 100_000: (2.0, 1000.0)}
_ROW, _POINTS = 200, 12


def measure(out: Path) -> list[Figure]:
    """Seconds added, and peak memory."""
    scenario = demo_scenario()
    log = write_run_log(build_run(scenario, scenario.runs[-1]), out / "runs")
    site = build_site(scenario)
    write_site(site, out / "site")
    alone = _replayed(log, out / "site")
    figures = [Figure("replay on a few elements", alone.processor_s, "s")]
    for elements, (added_s, memory_mb) in _SIZES.items():
        folder = out / f"site-{elements}"
        write_site(widened(site, elements), folder)
        large = _replayed(log, folder)
        name = f"{elements:,} elements more"
        figures.append(Figure(f"{name}: time added", large.processor_s - alone.processor_s, "s", added_s))
        figures.append(Figure(f"{name}: memory", large.peak_mb, "MB", memory_mb))
    return figures


def _replayed(log: Path, site: Path) -> Cost:
    given = ["replay", str(log), "--site", str(site), "--out", str(log.parent.parent / "result"), "--force", "--quiet"]
    return cost_of(given)


def widened(site: Site, elements: int) -> Site:
    """The site with rows of other elements some 50 km north of it, each of them linked with the next of its row."""
    number = np.arange(elements)
    along = (number % _ROW)[:, None] + np.linspace(0.0, 1.0, _POINTS)
    across = (number // _ROW)[:, None]
    # Identities as registers give them: they compress badly.
    names = np.array([hashlib.sha256(str(one).encode()).hexdigest()[:12] for one in number])
    others = pl.DataFrame(
        {
            "netelement_id": np.repeat(names, _POINTS),
            "latitude_deg": (site.track["latitude_deg"][0] + 0.5 + 0.002 * across + 3e-4 * np.sin(0.7 * along)).ravel(),
            "longitude_deg": (site.track["longitude_deg"][0] + 0.005 * along).ravel(),
        }
    )
    inner = number[number % _ROW < _ROW - 1]
    inner = inner[inner + 1 < elements]
    links = pl.DataFrame({"netelement_a": names[inner], "netelement_b": names[inner + 1]}).with_columns(
        position_a=1, position_b=0, navigability=pl.lit(Navigability.BOTH.value)
    )
    return Site(_with(site.track, others), _with(site.links, links), site.balises)


def _with(frame: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """Both tables, with the columns of the first; empty where the second has none."""
    given = {name: pl.col(name) if name in others.columns else pl.lit(None).alias(name) for name in frame.columns}
    return pl.concat([frame, others.select(given[name].cast(kind) for name, kind in frame.schema.items())])
