"""The story from surveys to a site."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.make.survey.balises import balises_every, balises_of_list
from pipeline.make.survey.doubts import find_doubts
from pipeline.make.survey.network import SurveyNetwork, make_network
from pipeline.make.survey.pieces import Survey
from pipeline.make.survey.sources import read_surveys
from pipeline.make.survey.trace import clean_traces
from pipeline.read.site.alike import ambiguities
from pipeline.read.site.checks import check_site
from pipeline.read.site.describe import no_balises_finding
from pipeline.stages.track.survey import track_of
from pipeline.storage.described import table_bytes
from pipeline.storage.writing import replace_files
from schemas.config import Configuration, Vehicle
from schemas.enums import TravelAlong
from schemas.errors import SiteError, UsageError
from schemas.frozen import frozen
from schemas.inputs import SITE_SCHEMAS
from schemas.run import Finding, Site

_FILES = ("track", "links", "balises", "route")


@frozen
class SiteRequest:
    """What a site is made of: balises every so many metres or of a list; ends this near [m] meet.

    `travel`: for which direction of travel those every so many metres are valid. `id_field`: attribute of maps that
    names the lines. `sigma_m`: standard deviation across the track of points that state none.
    """

    surveys: list[Path]
    spacing_m: float | None = None
    travel: TravelAlong = TravelAlong.BOTH
    balise_list: Path | None = None
    epsg: int | None = None
    join_m: float | None = None
    flat: bool = False
    id_field: str | None = None
    sigma_m: float | None = None


def site_request(
    surveys: list[Path],
    balises: str | None,
    epsg: int | None,
    join_m: float | None,
    flat: bool,
    travel: TravelAlong = TravelAlong.BOTH,
    id_field: str | None = None,
    sigma_m: float | None = None,
) -> SiteRequest:
    """The words of the command; `--balises every 1000` leaves its number among the surveys. Raises `UsageError`."""
    words = [str(path) for path in surveys]
    spacing: float | None = None
    if balises is not None and balises.startswith("every"):
        text = balises.removeprefix("every").strip(" =:")
        if not text:
            text = next((word for word in words if _number_or_none(word) is not None and not Path(word).exists()), "")
            surveys = [path for path in surveys if str(path) != text]
        spacing = _number_or_none(text.removesuffix("m"))
        if spacing is None or not 1.0 <= spacing <= 1e6:
            raise UsageError("is no spacing", place=f"--balises {balises}", expected="every 1000 (metres)")
    if not surveys:
        raise UsageError("no survey is named", expected="a map, a table of points, or a run")
    if spacing is None and travel is not TravelAlong.BOTH:
        remedy = "In a list of balises the column `direction` says it, one by one."
        raise UsageError("needs --balises every N", place=f"--direction {travel.value}", remedy=remedy)
    if sigma_m is not None and not 0.0 < sigma_m < math.inf:
        raise UsageError("is no standard deviation", place=f"--sigma {sigma_m:g}", expected="metres, more than 0")
    balise_list = None if spacing or balises is None else Path(balises)
    return SiteRequest(surveys, spacing, travel, balise_list, epsg, join_m, flat, id_field, sigma_m)


def make_site(request: SiteRequest, vehicle: Vehicle, config: Configuration) -> Site:
    """The site of surveys, with findings of the survey and of the site itself. `track` has `line_km` besides.

    Raises `SiteError`, `UsageError`.
    """
    if request.join_m is not None and not 0.0 <= request.join_m <= config.site.joined_m:
        expected = f"0 to {config.site.joined_m:g} m"
        raise UsageError("is no reach", place=f"--join {request.join_m:g}", expected=expected)
    survey = clean_traces(read_surveys(request.surveys, request.epsg, vehicle, config, request.id_field), config.survey)
    if request.flat:
        survey.pieces = [replace(piece, height_m=np.full(len(piece), np.nan)) for piece in survey.pieces]
    if request.sigma_m is not None:
        survey.pieces = [piece.with_sigma(request.sigma_m) for piece in survey.pieces]
    network = make_network(survey, request.join_m, config.survey)
    if not network.elements:
        raise SiteError("nothing is left of the survey", place=", ".join(map(str, request.surveys)))
    balises = _requested_balises(request, network, survey, config)
    track = network.track
    remarked = check_site(track_of(track), network.links, balises, None, survey.declared_m, config.site)
    if remarked.breaches:
        raise SiteError(remarked.breaches[0], place=", ".join(map(str, request.surveys)))
    # Relations as given: what no train can run over is said, and left out, each time that the site is read.
    site = Site(track, network.links, balises, None)
    findings = (
        *ambiguities(site, config),
        *survey.findings,
        *find_doubts(network, config.survey, config.site),
        *remarked.findings,
        *no_balises_finding(balises),
    )
    return replace(site, findings=findings)


def _requested_balises(
    request: SiteRequest, network: SurveyNetwork, survey: Survey, config: Configuration
) -> pl.DataFrame | None:
    """Balises at a spacing or from a list, whichever is requested; None where neither is."""
    if request.spacing_m is not None:
        table = balises_every(network, request.spacing_m, request.travel)
        return table if table.height else None
    if request.balise_list is None:
        return None
    return balises_of_list(request.balise_list, network, request.epsg, survey, config)


def write_site(site: Site, page: str, out: Path, force: bool) -> None:
    """The site as Parquet and its page; a site that is there stays, unless `force`. Raises `UsageError`."""
    there = [name for name in _FILES for suffix in ("parquet", "csv", "geojson") if (out / f"{name}.{suffix}").exists()]
    if there and not force:
        raise UsageError("holds a site", place=str(out), remedy="Name another folder, or replace it with --force.")
    contents = {f"{name}.{suffix}": None for name in _FILES for suffix in ("csv", "geojson", "parquet")}
    tables = {"track": site.track, "links": site.links, "balises": site.balises}
    written = {
        f"{name}.parquet": table_bytes(table, name, SITE_SCHEMAS[name], {})
        for name, table in tables.items()
        if table is not None
    }
    findings = pl.DataFrame([asdict(one) for one in site.findings], schema=list(Finding.__dataclass_fields__))
    companions = {"findings.csv": findings.write_csv().encode(), "site.html": page.encode()}
    replace_files(out, {**contents, **written, **companions}, marker="track.parquet")


def _number_or_none(text: str) -> float | None:
    """The number that a text is; None where it is none."""
    try:
        return float(text)
    except ValueError:
        return None
