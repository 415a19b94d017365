"""Two ways to one place stay two ways, however long ago they came together (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np

from tests.stages.matching.builders import Link, line, matched, odometer, run, site

# A loop 4 m beside the line, on a survey of 2 m that cannot tell the two apart, then 15 km of single line.
RAMP = np.linspace(0.0, 1.0, 31)
LOOP = np.concatenate([
    np.column_stack([1000.0 + 90.0 * RAMP, 4.0 * (3 * RAMP**2 - 2 * RAMP**3)]),
    line((1090, 4.0), (1600, 4.0))[1:],
    np.column_stack([1600.0 + 90.0 * RAMP, 4.0 * (1 - 3 * RAMP**2 + 2 * RAMP**3)])[1:],
])  # fmt: skip
LINE = {"w": line((0, 0), (1000, 0)), "m": line((1000, 0), (1690, 0)), "l": LOOP}
LINE |= {f"e{k}": line((1690 + 900.0 * k, 0), (2590 + 900.0 * k, 0)) for k in range(17)}
PAIRS = [("w", "m"), ("w", "l"), ("m", "e0"), ("l", "e0"), *((f"e{k}", f"e{k + 1}") for k in range(16))]
LINKS: list[Link] = [(a, 1, b, 0, "both") for a, b in PAIRS]


def test_a_track_that_nothing_told_apart_is_not_claimed_in_hindsight_after_ten_minutes_either() -> None:
    at = np.arange(50.0, 16900.0, 20.0)
    for x in (at[at < 9000.0], at):
        fixes = run(x, np.where((x > 1090.0) & (x < 1600.0), 2.0, 0.0))
        found = matched(fixes, site(LINE, LINKS, sigma_m=2.0), odometer(x))
        beside = found.epochs.table.filter(
            (found.epochs.table["path_m"] > 1100.0) & (found.epochs.table["path_m"] < 1590.0)
        )
        assert beside.height > 20
        assert beside["path_probability"].max() < 0.99
        assert {"m", "l"} <= {found.path.track.ids[element] for element in found.possible.element.tolist()}
