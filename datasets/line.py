"""A railway line made of straights, curves and grades: where it lies, how it is surveyed, where its balises are.

A place on the line is its chainage `s_m`, the 3-D distance along the rail from the start of the line.
"""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import polars as pl
from scipy.ndimage import uniform_filter1d

from datasets.scenario import LineSpec, ParallelSpec, SurveySpec
from pipeline.stages.track.geodesy import curvature_radii_m, moved_deg
from schemas.arrays import Floats
from schemas.conform import conform
from schemas.errors import ConfigError
from schemas.frozen import frozen
from schemas.inputs import Balises, Links, Track

_STEP_M = 1.0


@frozen
class RailPlaces:
    """Places on the rail: heading clockwise from north, in the sense of growing chainage; slope is rise over run."""

    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    heading_deg: Floats
    slope: Floats


@frozen
class LineAxis:
    """The axis of the line, sampled every metre, so that reading between samples errs by less than a millimetre."""

    spec: LineSpec
    chainage_m: Floats
    samples: RailPlaces

    @property
    def length_m(self) -> float:
        """Length of the line [m]."""
        return float(self.chainage_m[-1])

    def places_at(self, s_m: Floats) -> RailPlaces:
        """Places at chainages; a chainage beyond the line is an error in the scenario."""
        if s_m.size and (s_m.min() < 0.0 or s_m.max() > self.length_m):
            raise ConfigError(
                "a run or fault leaves the line",
                place="scenario",
                found=f"chainage {s_m.min():.1f} to {s_m.max():.1f} m",
                expected=f"0 to {self.length_m:.1f} m",
                remedy="Lengthen the line or shorten the run.",
            )
        read = {
            name: np.interp(s_m, self.chainage_m, getattr(self.samples, name))
            for name in ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "slope")
        }
        return RailPlaces(**read)


def build_line(spec: LineSpec) -> LineAxis:
    """Integrate curvature and grade into positions on the ellipsoid.

    The sections repeat until all net elements are laid. Curvature and grade change linearly over
    `transition_m` (clothoids, and parabolas in the vertical plane).
    """
    total_m = sum(element.length_m for element in spec.elements)
    chainage = np.linspace(0.0, total_m, int(np.ceil(total_m / _STEP_M)) + 1)
    step = chainage[1]
    curvature, grade = _curvature_and_grade(spec, chainage, step)
    heading = np.radians(spec.heading_deg) - _running_integral(curvature, step)
    slope_angle = np.arctan(grade)
    samples = _integrate_positions(spec, heading, slope_angle, step)
    return LineAxis(spec, chainage, samples)


def offset_places(places: RailPlaces, left_m: Floats | float) -> RailPlaces:
    """The same places moved to the left of growing chainage."""
    heading = np.radians(places.heading_deg)
    return shift_places(places, -np.cos(heading) * left_m, np.sin(heading) * left_m, np.zeros_like(heading))


def shift_places(places: RailPlaces, east_m: Floats, north_m: Floats, up_m: Floats) -> RailPlaces:
    """Places moved by a vector of the local horizon, small against the radius of the Earth."""
    latitude_deg, longitude_deg = moved_deg(places.latitude_deg, places.longitude_deg, places.height_m, east_m, north_m)
    return RailPlaces(latitude_deg, longitude_deg, places.height_m + up_m, places.heading_deg, places.slope)


def track_table(line: LineAxis, rng: np.random.Generator) -> pl.DataFrame:
    """The survey of all net elements, with the errors that the scenario gives it (constant in place)."""
    parts = []
    for element, begin_m in zip(line.spec.elements, _element_starts(line.spec), strict=True):
        parts.append(_surveyed_element(line, element.id, begin_m, element.length_m, 0.0, element.reversed))
    for parallel in line.spec.parallels:
        parts.append(
            _surveyed_element(line, parallel.id, parallel.from_m, _parallel_length_m(parallel), parallel.left_m, False)
        )
    survey = line.spec.survey
    table = pl.concat(parts)
    noise = _survey_noise(table, survey, rng)
    moved = shift_places(
        RailPlaces(**{name: table[name].to_numpy() for name in _PLACE}, heading_deg=np.zeros(0), slope=np.zeros(0)),
        survey.bias_east_m + noise[0],
        survey.bias_north_m + noise[1],
        survey.bias_up_m + noise[2],
    )
    height = pl.lit(None, pl.Float64) if survey.flat else pl.Series(moved.height_m)
    surveyed = table.with_columns(
        latitude_deg=pl.Series(moved.latitude_deg),
        longitude_deg=pl.Series(moved.longitude_deg),
        height_m=height,
        sigma_m=pl.lit(survey.sigma_m, pl.Float64),
    )
    return conform(surveyed, Track)


def links_table(spec: LineSpec) -> pl.DataFrame:
    """Net relations between the elements in order of the line; parallel tracks have none."""
    rows = []
    for before, after in zip(spec.elements, spec.elements[1:], strict=False):
        rows.append((before.id, 0 if before.reversed else 1, after.id, 1 if after.reversed else 0, "both"))
    return conform(pl.DataFrame(rows, schema=Links.column_names(), orient="row"), Links)


def balises_table(spec: LineSpec) -> pl.DataFrame:
    """Balises at their surveyed measure."""
    rows = []
    for balise in spec.balises:
        element, measure_m = element_at(spec, balise.at_m)
        linking = (balise.location_accuracy_m, balise.linked, balise.link_reaction.value)
        rows.append((balise.id, element, measure_m, balise.kind.value, *linking, balise.direction.value))
    return Balises.validate(pl.DataFrame(rows, schema=Balises.column_names(), orient="row"), cast=True)


def element_at(spec: LineSpec, s_m: float) -> tuple[str, float]:
    """Net element and measure at a chainage."""
    for element, begin_m in zip(spec.elements, _element_starts(spec), strict=True):
        if s_m <= begin_m + element.length_m:
            along = s_m - begin_m
            return element.id, element.length_m - along if element.reversed else along
    raise ConfigError("a balise lies beyond the line", place="scenario: line.balises", found=f"at_m = {s_m}")


_PLACE = ("latitude_deg", "longitude_deg", "height_m")


def _element_starts(spec: LineSpec) -> list[float]:
    """Begin of each net element along the line [m]."""
    return [0.0, *accumulate(element.length_m for element in spec.elements[:-1])]


def _parallel_length_m(parallel: ParallelSpec) -> float:
    """Length of a parallel track [m]."""
    return parallel.to_m - parallel.from_m


def _curvature_and_grade(spec: LineSpec, chainage: Floats, step: float) -> tuple[Floats, Floats]:
    """Curvature [1/m] and grade at chainages, smoothed over the transitions."""
    ends = np.cumsum([section.length_m for section in spec.sections])
    index = np.searchsorted(ends, chainage % ends[-1], side="right").clip(max=len(spec.sections) - 1)
    curvature = np.array([1.0 / s.radius_m if s.radius_m else 0.0 for s in spec.sections])[index]
    grade = np.array([section.grade for section in spec.sections])[index]
    samples = max(round(float(spec.transition_m / step)), 1)
    return uniform_filter1d(curvature, samples, mode="nearest"), uniform_filter1d(grade, samples, mode="nearest")


def _running_integral(values: Floats, step: float) -> Floats:
    """Running trapezoidal integral, 0 at the first sample."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1])) * step))


def _integrate_positions(spec: LineSpec, heading: Floats, slope_angle: Floats, step: float) -> RailPlaces:
    """Positions from heading and slope; the radii depend on latitude, so latitude is iterated (converges at once)."""
    run = np.cos(slope_angle)
    north = _running_integral(run * np.cos(heading), step)
    east = _running_integral(run * np.sin(heading), step)
    height = spec.height_m + _running_integral(np.sin(slope_angle), step)
    latitude = np.full(heading.size, np.radians(spec.latitude_deg))
    for _ in range(4):
        middle = 0.5 * (latitude[1:] + latitude[:-1])
        meridian_m, normal_m = curvature_radii_m(middle)
        rise = np.diff(north) / (meridian_m + height[:-1])
        latitude = np.radians(spec.latitude_deg) + np.concatenate(([0.0], np.cumsum(rise)))
    turn = np.diff(east) / ((normal_m + height[:-1]) * np.cos(middle))
    longitude = np.radians(spec.longitude_deg) + np.concatenate(([0.0], np.cumsum(turn)))
    return RailPlaces(np.degrees(latitude), np.degrees(longitude), height, np.degrees(heading), np.tan(slope_angle))


def _surveyed_element(
    line: LineAxis, element_id: str, begin_m: float, length_m: float, left_m: float, reverse: bool
) -> pl.DataFrame:
    """A net element as it is surveyed."""
    points = int(np.ceil(length_m / line.spec.survey.spacing_m)) + 1
    measure = np.linspace(0.0, length_m, points)
    s_m = begin_m + (length_m - measure if reverse else measure)
    places = line.places_at(s_m)
    if left_m:
        places = offset_places(places, left_m)
    columns = {name: getattr(places, name) for name in _PLACE}
    return pl.DataFrame({"netelement_id": [element_id] * points, "measure_m": measure, "s_m": s_m, **columns})


def _survey_noise(table: pl.DataFrame, survey: SurveySpec, rng: np.random.Generator) -> Floats:
    """Smooth errors in place: a first-order process along chainage, so that joined elements meet."""
    s_m = table["s_m"].to_numpy()
    places, inverse = np.unique(s_m, return_inverse=True)
    drawn = rng.standard_normal((3, places.size))
    if survey.noise_sigma_m == 0.0:
        return np.zeros((3, s_m.size))
    keep = np.exp(-np.diff(places) / survey.noise_length_m)
    for i in range(1, places.size):
        drawn[:, i] = keep[i - 1] * drawn[:, i - 1] + np.sqrt(1.0 - keep[i - 1] ** 2) * drawn[:, i]
    noise: Floats = survey.noise_sigma_m * drawn[:, inverse]
    return noise
