"""Routes of a site and of single runs: which net elements a train ran over, as somebody knows it."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import polars as pl

from pipeline.read.site.checks import route_breaches
from pipeline.read.site.tables import load_table, typed_table
from pipeline.stages.track.network import surveyed_track
from pipeline.storage.address import Address, name_of, shown
from pipeline.storage.files import read_bytes
from schemas.config import SiteConfig
from schemas.errors import InputError
from schemas.inputs import Route
from schemas.run import Site

_DIRECTIONS = {
    "ab": "AB", "growing": "AB", "forward": "AB", "+": "AB",
    "ba": "BA", "falling": "BA", "reverse": "BA", "backward": "BA", "-": "BA",
}  # fmt: skip


def route_table(file: str, data: bytes, breaches: list[str]) -> pl.DataFrame | None:
    """A route file's elements in order, directions as AB (from the element's start to its end) or BA, and its legs.

    Other columns are left alone: `balise replay --write-route` writes some that say what is in doubt.
    """
    raw = load_table(file, data, breaches)
    route = None if raw is None else typed_table(raw, "route", breaches)
    if route is None:
        return None
    words = route["direction"].str.strip_chars().str.to_lowercase()
    direction = words.replace_strict(_DIRECTIONS, default=None, return_dtype=pl.String)
    if direction.null_count():
        strange = words.filter(direction.is_null())[0]
        breaches.append(f"route: column direction: {strange!r}; expected AB or BA (growing or falling)")
    return route.with_columns(direction.alias("direction"))


def with_route(site: Site, address: Address, config: SiteConfig) -> Site:
    """The site for one run whose route is known. Raises `InputError` where the route does not fit the site.

    A run of several legs (it turned back over a switch) gets a site of nothing but the elements of its route.
    """
    data = read_bytes(address)
    breaches: list[str] = []
    route = route_table(name_of(address), data, breaches)
    if route is not None and not breaches:
        breaches = route_breaches(surveyed_track(site), route, config)
    if route is None or breaches:
        remedy = "Correct the route; `balise replay --write-route` writes the route that was found."
        raise InputError("; ".join(breaches), place=shown(address), remedy=remedy)
    digest = hashlib.sha256(f"{site.digest} {hashlib.sha256(data).hexdigest()}".encode()).hexdigest()
    if route["leg"].n_unique() > 1:
        return replace(_restrict_to_elements(site, route["netelement_id"]), digest=digest)
    return replace(site, route=Route.validate(route.drop("leg"), cast=True), digest=digest)


def _restrict_to_elements(site: Site, names: pl.Series) -> Site:
    """The site's tables of nothing but some elements."""
    kept = names.unique().to_list()
    inside = pl.col("netelement_a").is_in(kept) & pl.col("netelement_b").is_in(kept)
    own = pl.col("netelement_id").is_in(kept)
    balises = None if site.balises is None else site.balises.filter(own)
    return replace(site, track=site.track.filter(own), links=site.links.filter(inside), balises=balises, route=None)
