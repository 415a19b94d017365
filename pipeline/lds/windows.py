"""Expectation windows of ETCS linking, and which balises they cannot tell apart."""

from __future__ import annotations

from typing import NamedTuple

import polars as pl

from schemas.config import LdsConfig

DEFAULTS = LdsConfig()


class Window(NamedTuple):
    """Expectation window in odometer distance from the LRVB [m]."""

    open_m: float
    close_m: float

    def holds(self, distance_m: float) -> bool:
        return self.open_m <= distance_m <= self.close_m


def window_m(distance_m: float, accuracy_m: float, reference_accuracy_m: float, config: LdsConfig = DEFAULTS) -> Window:
    """Window of a balise announced `distance_m` beyond the reference (SUBSET-026 3.4.4.4.3, 3.6.4.1).

    The odometer's reading d is true to 5 m + 5 % of d (SUBSET-041 5.3.1.1), so the window is
    d + (5 + 0.05 d) >= D - Q - Q_r and d - (5 + 0.05 d) <= D + Q + Q_r: not symmetric about D.
    """
    margin_m = accuracy_m + reference_accuracy_m + config.odometer_fixed_m
    return Window(
        (distance_m - margin_m) / (1.0 + config.odometer_share),
        (distance_m + margin_m) / (1.0 - config.odometer_share),
    )


def window_after_turn_m(distance_m: float, travelled_m: float, margin_m: float, config: LdsConfig = DEFAULTS) -> Window:
    """Window of a balise where the train turned round since the reference.

    The odometer's 5 % then counts on the whole way run (`travelled_m`), not on the net distance;
    `margin_m` is Q + Q_r + 5 m. The clauses know no such case: linking holds for one direction.
    """
    half_m = (margin_m + config.odometer_share * travelled_m) / (1.0 - config.odometer_share)
    return Window(distance_m - half_m, distance_m + half_m)


def minimal_next_spacing_m(distance_m: float, accuracy_m: float, config: LdsConfig = DEFAULTS) -> float:
    """Smallest distance from a balise at `distance_m` to the next whose window does not overlap its own.

    All three balises (reference, expected, next) have the same location accuracy (LOC section III).
    """
    margin_m = 2.0 * accuracy_m + config.odometer_fixed_m
    close_m = window_m(distance_m, accuracy_m, accuracy_m, config).close_m
    return close_m * (1.0 + config.odometer_share) + margin_m - distance_m


def overlapping_windows(balises: pl.DataFrame, config: LdsConfig = DEFAULTS) -> pl.DataFrame:
    """Announced balises that linking cannot tell apart, in either direction of travel.

    `balises` is a site's list or that of a travelled path (then by `leg` and `path_m`). One row per
    pair whose windows, both measured from the announced balise before them, overlap:
    `kind, place, direction, reference_id, balise_id, next_balise_id, spacing_m,
    minimal_spacing_m, close_m, next_open_m`.
    """
    on_path = "path_m" in balises.columns
    place, position = ("leg", "path_m") if on_path else ("netelement_id", "measure_m")
    announced = balises.filter("linked").sort("kind", place, position, "balise_id")
    rows = []
    for (kind, where), group in announced.group_by("kind", place, maintain_order=True):
        points = list(zip(group["balise_id"], group[position], group["location_accuracy_m"], strict=True))
        for direction, ordered in (("growing", points), ("falling", points[::-1])):
            for three in zip(ordered, ordered[1:], ordered[2:], strict=False):
                rows.append((str(kind), str(where), direction, *_overlap(*three, config)))
    return pl.DataFrame(rows, schema=_OVERLAP_SCHEMA, orient="row").filter(pl.col("next_open_m") <= pl.col("close_m"))


_Point = tuple[str, float, float]
_OVERLAP_SCHEMA = {
    "kind": pl.String,
    "place": pl.String,
    "direction": pl.String,
    "reference_id": pl.String,
    "balise_id": pl.String,
    "next_balise_id": pl.String,
    "spacing_m": pl.Float64,
    "minimal_spacing_m": pl.Float64,
    "close_m": pl.Float64,
    "next_open_m": pl.Float64,
}


def _overlap(
    reference: _Point, expected: _Point, later: _Point, config: LdsConfig
) -> tuple[str, str, str, float, float, float, float]:
    distance_m = abs(expected[1] - reference[1])
    later_distance_m = abs(later[1] - reference[1])
    close_m = window_m(distance_m, expected[2], reference[2], config).close_m
    later_open_m = window_m(later_distance_m, later[2], reference[2], config).open_m
    spacing_m = later_distance_m - distance_m
    lacking_m = (close_m - later_open_m) * (1.0 + config.odometer_share)
    return reference[0], expected[0], later[0], spacing_m, spacing_m + lacking_m, close_m, later_open_m
