"""Where a result lies: on the path of its solution, on the rails in WGS 84, and in a plane for drawings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import moved_deg, points_of
from pipeline.stages.track.survey import SurveyedTrack, track_of
from schemas.arrays import Floats
from schemas.frozen import frozen
from schemas.run import Site

_POINTS = 3000


@frozen
class GroundPositions:
    """Positions in degrees and metres, NaN where not known; `heading_deg` of growing measure, clockwise from north."""

    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    heading_deg: Floats


def ground_of(track: pl.DataFrame, netelement_id: pl.Series, measure_m: Floats) -> GroundPositions:
    """Places on the rails. Between survey points position is linear; beyond the ends the last chord goes on."""
    survey = track_of(track)
    columns = [np.full(len(measure_m), np.nan) for _ in range(4)]
    names = netelement_id.to_frame("name").with_row_index("row")
    for name, rows in names.drop_nulls().group_by("name", maintain_order=True):
        number = survey.index.get(str(name[0]))
        if number is None:
            continue
        index = rows["row"].to_numpy()
        for column, values in zip(columns, _on_element(survey, number, measure_m[index]), strict=True):
            column[index] = values
    return GroundPositions(*columns)


def offset_positions(ground: GroundPositions, sign: Floats, left_m: Floats, above_m: Floats) -> GroundPositions:
    """Places `left_m` to the left of growing path and `above_m` over the rails.

    `sign` is +1 where path and measure grow together, -1 where against each other. For metres, not kilometres.
    """
    heading = np.radians(ground.heading_deg)
    east = -left_m * sign * np.cos(heading)
    north = left_m * sign * np.sin(heading)
    level = np.nan_to_num(ground.height_m)
    latitude, longitude = moved_deg(ground.latitude_deg, ground.longitude_deg, level, east, north)
    height = ground.height_m + np.nan_to_num(above_m)
    return GroundPositions(latitude, longitude, height, ground.heading_deg)


def stretches_of(epochs: pl.DataFrame) -> pl.DataFrame:
    """The stretches of net elements that a solution's epochs were matched to, each once, in order of time.

    `netelement_id, sign, offset_m, first_m, last_m`: `path_m = offset_m + sign * measure_m` there, from `first_m` to
    `last_m` of the path. Path and measure differ by a constant on an element (up to sign), so every pair of epochs
    there shows both.
    """
    known = epochs.select("netelement_id", "measure_m", "path_m").drop_nulls()
    return (
        known.with_columns(run=pl.col("netelement_id").rle_id())
        .group_by("run", "netelement_id", maintain_order=True)
        .agg(
            turn=(pl.col("measure_m").diff() * pl.col("path_m").diff()).sum(),
            measure=pl.col("measure_m").last(),
            path=pl.col("path_m").last(),
            first_m=pl.col("path_m").min(),
            last_m=pl.col("path_m").max(),
        )
        .filter(pl.col("turn") != 0.0)
        .with_columns(sign=pl.col("turn").sign().cast(pl.Int64))
        .with_columns(offset_m=pl.col("path") - pl.col("sign") * pl.col("measure"))
        .group_by("netelement_id", "sign", pl.col("offset_m").round(0).alias("about"), maintain_order=True)
        .agg(pl.col("offset_m").median(), pl.col("first_m").min(), pl.col("last_m").max())
        .drop("about")
    )


def train_path_m(epochs: pl.DataFrame, stretches: pl.DataFrame) -> tuple[Floats, Floats]:
    """Least and largest path position of the train per epoch [m], by the evidence; NaN where it is not known.

    It is known where the evidence leaves one net element and the path leads over it (`stretches_of`). Of several
    visits to the element the one nearest to the position counts, without a position to the last one before.
    """
    names = pl.col("true_netelement_ids")
    position = pl.col("path_m").fill_nan(None)
    ends = [
        pl.col("offset_m") + pl.col("sign") * pl.col(name) for name in ("true_measure_low_m", "true_measure_high_m")
    ]
    visits = (
        epochs.with_row_index("row")
        .select(
            *("row", "true_measure_low_m", "true_measure_high_m"),
            netelement_id=pl.when(names.list.len() == 1).then(names.list.first()),
            near=position.forward_fill().backward_fill(),
        )
        .drop_nulls(["netelement_id", "true_measure_low_m", "true_measure_high_m"])
        .join(stretches.select("netelement_id", "sign", "offset_m"), on="netelement_id")
        .select("row", "near", low=pl.min_horizontal(*ends), high=pl.max_horizontal(*ends))
        .sort("row", (0.5 * (pl.col("low") + pl.col("high")) - pl.col("near")).abs())
        .unique("row", keep="first", maintain_order=True)
    )
    low, high = np.full((2, epochs.height), np.nan)
    low[visits["row"]] = visits["low"]
    high[visits["row"]] = visits["high"]
    return low, high


def ground_at(track: pl.DataFrame, stretches: pl.DataFrame, path_m: Floats, margin_m: float = 50.0) -> GroundPositions:
    """Places of path positions on the stretches; NaN further than `margin_m` beyond what was travelled."""
    best = np.full(len(path_m), np.inf)
    measure_m = np.full(len(path_m), np.nan)
    names = np.full(len(path_m), None, dtype=object)
    survey = track_of(track)
    for name, sign, offset_m, first_m, last_m in stretches.iter_rows():
        # Path positions of the whole element, not just of the epochs on it.
        ends = [first_m, last_m]
        if name in survey.index:
            measures = survey.measure_m[survey.vertex_range(survey.index[name])][[0, -1]]
            ends += list(offset_m + sign * measures)
        away = np.maximum(np.maximum(min(ends) - path_m, path_m - max(ends)), 0.0)
        nearer = (away < best) & (away <= margin_m)
        best[nearer] = away[nearer]
        names[nearer] = name
        measure_m[nearer] = sign * (path_m[nearer] - offset_m)
    return ground_of(track, pl.Series(names, dtype=pl.String), measure_m)


def sign_of(epochs: pl.DataFrame, stretches: pl.DataFrame) -> Floats:
    """+1 at epochs whose path grows with the measure, -1 against it, NaN where that is not known."""
    rows = epochs.select("netelement_id", "measure_m", "path_m").with_row_index("row")
    fitting = (
        rows.join(stretches, on="netelement_id", how="left", maintain_order="left")
        .with_columns(misfit=(pl.col("path_m") - pl.col("sign") * pl.col("measure_m") - pl.col("offset_m")).abs())
        .sort("row", "misfit", nulls_last=True, maintain_order=True)
        .group_by("row", maintain_order=True)
        .first()
    )
    return fitting["sign"].cast(pl.Float64).fill_null(float("nan")).to_numpy()


def plane_m(ground: GroundPositions, origin: tuple[float, float]) -> tuple[Floats, Floats]:
    """East and north of an origin (latitude, longitude) in its tangent plane [m], for drawing."""
    plane = points_of(np.array([origin[0]]), np.array([origin[1]]))
    offset = points_of(ground.latitude_deg, ground.longitude_deg).surface - plane.surface[0]
    return offset @ plane.east[0], offset @ plane.north[0]


def origin_of(site: Site) -> tuple[float, float]:
    """Latitude and longitude of the track's first point, the origin of drawings."""
    first = site.track.row(0, named=True)
    return float(first["latitude_deg"]), float(first["longitude_deg"])


def element_lines_m(site: Site) -> Iterator[tuple[str, Floats, Floats]]:
    """Lines of the net elements east and north of the origin [m], of no more points than a screen shows."""
    survey = track_of(site.track)
    nothing = np.full(len(survey.latitude_deg), np.nan)
    east, north = plane_m(GroundPositions(survey.latitude_deg, survey.longitude_deg, nothing, nothing), origin_of(site))
    for _, name, rows in survey.elements():
        yield name, _thin(east[rows]), _thin(north[rows])


def _thin(values: Floats) -> Floats:
    """Some thousand of the values, the last one among them."""
    return np.append(values[: -1 : max(1, -(-len(values) // _POINTS))], values[-1:])


def _on_element(track: SurveyedTrack, number: int, measure_m: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Latitude, longitude, height, heading of measures on one element."""
    rows = track.vertex_range(number)
    measures = track.measure_m[rows]
    if len(measures) < 2:
        nothing = np.full(len(measure_m), np.nan)
        return nothing, nothing, nothing, nothing
    segment = np.clip(np.searchsorted(measures, measure_m, side="right") - 1, 0, len(measures) - 2)
    step = np.diff(measures)
    share = (measure_m - measures[segment]) / np.where(step > 0, step, np.nan)[segment]
    latitude, longitude, height = (column[rows] for column in (track.latitude_deg, track.longitude_deg, track.height_m))
    east = np.diff(longitude) * np.cos(np.radians(latitude[:-1]))
    heading = np.degrees(np.arctan2(east, np.diff(latitude))) % 360.0
    along = (column[segment] + share * np.diff(column)[segment] for column in (latitude, longitude, height))
    return (*along, heading[segment])  # type: ignore[return-value]
