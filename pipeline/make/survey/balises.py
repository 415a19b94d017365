"""Balises on the net elements: every so many metres, or where a list says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pipeline.make.survey.network import SurveyNetwork
from pipeline.make.survey.pieces import Survey, content_of_survey, measures_at
from pipeline.make.survey.tables import placed_table
from pipeline.read.ingest.guesses import BALISE_KINDS, BALISE_LIST, first_fitting, word_of
from pipeline.read.site.tables import RawTable, typed_table
from pipeline.stages.paths.candidates import candidates_of, segments_of
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import network_of
from pipeline.stages.track.survey import SurveyedTrack, track_of
from schemas.config import Configuration, SurveyConfig
from schemas.enums import BaliseDirection, TravelAlong
from schemas.errors import SiteError
from schemas.inputs import Balises


def balises_every(network: SurveyNetwork, spacing_m: float, travel: TravelAlong) -> pl.DataFrame:
    """Virtual balises at whole multiples of the spacing, counted along the shortest route from the survey's start.

    So the spacing holds over joints and switches; where two routes meet again it begins anew. `travel`: for trains away
    from the survey's start, back to it, or both.
    """
    track = track_of(network.track)
    from_start = _distances_from_start_m(network.ends, track.length_m)
    rows: list[dict[str, Any]] = []
    for element, name in enumerate(track.ids):
        at_start, at_end = from_start[network.ends[element]]
        length = float(track.length_m[element])
        begins = min(at_start, at_end)
        chainage_m = (
            np.arange(np.floor(begins / spacing_m) + 1, np.floor((begins + length) / spacing_m) + 1) * spacing_m
        )
        away = bool(at_start <= at_end)
        measures = chainage_m - begins if away else length - (chainage_m - begins)
        side = {"netelement_id": name, "direction": _valid_direction(away, travel).value}
        rows += [{**side, "measure_m": float(measure)} for measure in np.clip(measures, 0.0, length)]
    ids = [f"VB{number:0{len(str(len(rows)))}}" for number in range(1, len(rows) + 1)]
    table = pl.DataFrame(rows, schema={"netelement_id": pl.String, "direction": pl.String, "measure_m": pl.Float64})
    return _cast_balises(
        "balises", table.with_columns(pl.Series("balise_id", ids, dtype=pl.String), kind=pl.lit("virtual"))
    )


def _valid_direction(away: bool, travel: TravelAlong) -> BaliseDirection:
    """The direction in which a balise is valid, on a net element that grows `away` from the survey's start or not."""
    if travel is TravelAlong.BOTH:
        return BaliseDirection.BOTH
    return BaliseDirection.AB if away == (travel is TravelAlong.AHEAD) else BaliseDirection.BA


def _cast_balises(place: str, table: pl.DataFrame) -> pl.DataFrame:
    """A list of balises in the types of a site."""
    breaches: list[str] = []
    typed = typed_table(RawTable(place, table), "balises", breaches)
    if typed is None:
        raise SiteError(breaches[0])
    if (repeated := typed.filter(typed["balise_id"].is_duplicated())["balise_id"]).len():
        raise SiteError("occurs more than once", place=f"{place}: column balise_id", found=repeated[0])
    return Balises.validate(typed, cast=True)


def _distances_from_start_m(ends: np.ndarray, length_m: np.ndarray) -> np.ndarray:
    """Distance of each node from the start of the first element of its part of the network."""
    count = int(ends.max()) + 1
    pairs = np.sort(ends, axis=1)
    order = np.lexsort((length_m, pairs[:, 1], pairs[:, 0]))
    _, first = np.unique(pairs[order], axis=0, return_index=True)
    kept = order[first]
    graph = coo_array((length_m[kept], (pairs[kept, 0], pairs[kept, 1])), shape=(count, count)).tocsr()
    distance_m = np.full(count, np.inf)
    for node in ends[:, 0].tolist():
        if not np.isfinite(distance_m[node]):
            distance_m = np.minimum(distance_m, dijkstra(graph, directed=False, indices=node))
    return distance_m


def balises_of_list(
    path: Path, network: SurveyNetwork, epsg: int | None, survey: Survey, config: Configuration
) -> pl.DataFrame:
    """The balises of a table, each at its net element and measure, its coordinates, or its line kilometre.

    Raises `SiteError` for a balise that no track, or more than one, can be meant for.
    """
    place = str(path)
    table = placed_table(place, content_of_survey(path, config.survey), epsg, config.site)
    track = track_of(network.track)
    table = _with_names_and_kinds(table, survey)
    placer = _BalisePlacer(place, network, track, survey, config.survey)
    places = [placer.place_row(row) for row in table.iter_rows(named=True)]
    columns = {"netelement_id": pl.String, "measure_m": pl.Float64}
    placed = pl.DataFrame(places, schema=columns, orient="row")
    return _cast_balises(place, table.with_columns(placed))


def _with_names_and_kinds(table: pl.DataFrame, survey: Survey) -> pl.DataFrame:
    """Under the names of the contract; what the list does not say is reported: reads of a balise need its name."""
    words = {name: word_of(name) for name in table.columns}
    columns = f"columns {', '.join(table.columns)}"
    for key, patterns in BALISE_LIST.items():
        found = (first_fitting(words, pattern) for pattern in patterns)
        fitting = next((name for name in found if name and table[name].null_count() == 0), None)
        if key not in table.columns and fitting and (key != "balise_id" or table[fitting].is_unique().all()):
            table = table.rename({fitting: key})
    if "balise_id" not in table.columns:
        table = table.with_columns(balise_id=pl.Series([f"B{row}" for row in range(1, table.height + 1)]))
        survey.report("note", "balises", f"none of the {columns} names them: numbered B1 to B{table.height}")
    if "kind" not in table.columns:
        survey.report("note", "balises", f"none of the {columns} is their kind: all are taken as virtual")
        return table.with_columns(kind=pl.lit("virtual"))
    kind = pl.col("kind").cast(pl.String).str.strip_chars().str.to_lowercase().replace(dict(BALISE_KINDS))
    return table.with_columns(kind=kind.fill_null("virtual"))


class _BalisePlacer:
    """Where on the track a row of a list is."""

    def __init__(
        self, place: str, network: SurveyNetwork, track: SurveyedTrack, survey: Survey, config: SurveyConfig
    ) -> None:
        self.place = place
        self.network = network
        self.track = track
        self.survey = survey
        self.config = config
        self.ground = network_of(track, network.links)
        self.everywhere = segments_of(track).search_in()

    def place_row(self, row: dict[str, Any]) -> tuple[str, float]:
        """Net element and measure [m] of a row: as given, by coordinates, or by line kilometre."""
        filled = {key for key, value in row.items() if value is not None}
        if {"netelement_id", "measure_m"} <= filled:
            return str(row["netelement_id"]), float(row["measure_m"])
        if {"latitude_deg", "longitude_deg"} <= filled:
            return self._at_coordinates(row)
        if "line_km" in filled:
            return self._at_kilometre(row)
        expected = "latitude_deg and longitude_deg (or x_m and y_m), line_km, or netelement_id and measure_m"
        raise self._balise_error(row, "has no place", expected=expected)

    def _balise_error(self, row: dict[str, Any], message: str, **details: str) -> SiteError:
        """The error for a balise."""
        return SiteError(message, place=f"{self.place}: balise {row['balise_id']}", **details)

    def _at_coordinates(self, row: dict[str, Any]) -> tuple[str, float]:
        """Net element and measure of a balise given by coordinates."""
        point = points_of(np.array([row["latitude_deg"]]), np.array([row["longitude_deg"]]))
        far_m = self.config.balise_beside_m
        near = candidates_of(point, self.ground, self.everywhere, 2 * far_m)
        ranked = sorted(zip(near.distance_m.tolist(), near.element.tolist(), near.along_m.tolist(), strict=True))
        wanted = row.get("netelement_id")
        if wanted is not None:
            ranked = [candidate for candidate in ranked if self.track.ids[candidate[1]] == wanted]
        if not ranked or ranked[0][0] > far_m:
            nearest = f"{ranked[0][0]:.1f} m" if ranked else f"none within {2 * far_m:g} m"
            raise self._balise_error(row, "lies beside the track", found=nearest, expected=f"at most {far_m:g} m")
        self._report_rival(row, ranked)
        return self.track.ids[ranked[0][1]], ranked[0][2]

    def _report_rival(self, row: dict[str, Any], ranked: list[tuple[float, int, float]]) -> None:
        """Report tracks on which a balise may lie as well."""
        near = [candidate for candidate in ranked[1:] if candidate[0] < ranked[0][0] + self.config.same_track_m]
        nodes = set(self.network.ends[ranked[0][1]].tolist())
        for _, rival, _ in near:
            if not nodes & set(self.network.ends[rival].tolist()):
                text = f"may as well lie on {self.track.ids[rival]} as on {self.track.ids[ranked[0][1]]}"
                self.survey.report("warning", f"balises: {row['balise_id']}", text, "Name netelement_id in the list.")

    def _at_kilometre(self, row: dict[str, Any]) -> tuple[str, float]:
        """Net element and measure of a balise given by its kilometre."""
        wanted = row.get("netelement_id")
        km = float(row["line_km"])
        hits = [
            (element.name, measure)
            for number, element in enumerate(self.network.elements)
            if wanted in (None, element.name)
            for measure in measures_at(
                element.line_km, self.track.measure_m[self.track.vertex_range(number)], km, self.config
            )
        ]
        if not hits:
            expected = "a line kilometre of the survey, not one that it jumps over"
            raise self._balise_error(row, f"no track has line kilometre {km:g}", expected=expected)
        # A joint is the end of one element and the start of the next: one place.
        inner = [hit for hit in hits if hit[1] > 0] or hits
        if len(inner) > 1:
            places = ", ".join(f"{name} at {measure:.1f} m" for name, measure in sorted(inner))
            remedy = "Name netelement_id in the list; where one element has it twice, give measure_m too."
            raise self._balise_error(row, f"line kilometre {km:g} is on {places}", remedy=remedy)
        return inner[0]
