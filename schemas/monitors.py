"""The monitors by name, with all that others must know of each."""

from __future__ import annotations

from typing import NamedTuple

AXES = ("along", "cross", "up")
SCALES = ("raw", "ewma_0p1", "ewma_0p01", "ewma_0p001")


class Monitor(NamedTuple):
    """What the house must know of one monitor; nobody asks its name.

    `unit`: of value and threshold. `drawing`: which shows it, with `label` for its line. `axis`: along which the error
    lies that it sees, None where all are. `solutions`: how many it compares. `scale`: of a monitor of the bank, which
    averages. `against_odometer`: it holds the position against the odometer and nothing else does so for it.
    """

    name: str
    unit: str
    drawing: str
    label: str
    axis: str | None
    solutions: int = 1
    scale: str | None = None
    against_odometer: bool = False

    @property
    def is_fast(self) -> bool:
        """Shows the noise of single epochs: without memory, or with that of the fastest average."""
        return self.scale is None or self.scale in SCALES[:2]


_SCALE_LABELS = ("raw", "EWMA 0.1", "EWMA 0.01", "EWMA 0.001")
_BANK: tuple[Monitor, ...] = tuple(
    Monitor(f"{axis}_{scale}", "m/s", axis, label, axis, scale=scale)
    for axis in AXES
    for scale, label in zip(SCALES, _SCALE_LABELS, strict=True)
)
ALL_MONITORS: tuple[Monitor, ...] = (
    *_BANK,
    Monitor("link_order", "1", "other", "link order", axis="along"),
    Monitor("link_distance", "m", "other", "link distance", axis="along", against_odometer=True),
    Monitor("along_doppler", "m/s", "other", "along doppler", axis="along", against_odometer=True),
    Monitor("pseudorange", "1", "other", "pseudorange", axis=None),
    Monitor("channel", "m", "other", "channel", axis="along", solutions=2),
)
"""Tables, configuration, pages, exports and dictionary read this tuple; what runs is in `pipeline/stages/monitors`."""
BANK_MONITORS: tuple[str, ...] = tuple(monitor.name for monitor in _BANK)
MONITORS: tuple[str, ...] = tuple(monitor.name for monitor in ALL_MONITORS)
OTHER_MONITORS: tuple[str, ...] = MONITORS[len(BANK_MONITORS) :]
