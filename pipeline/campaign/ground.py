"""The site of a campaign in each of its processes: read and checked by whoever plans, and handed to the workers."""

from __future__ import annotations

from pipeline import storage
from pipeline.read.site.read import read_site
from pipeline.storage.address import redacted
from schemas.config import SiteConfig
from schemas.errors import SiteError
from schemas.run import Site

# At most one, by digest of its files and configuration: the same content is the same site, wherever it lies.
_held: dict[tuple[str, SiteConfig], Site] = {}


def hold(site: Site, config: SiteConfig) -> None:
    """Keep the site of this process, so that no run reads it again."""
    _held.clear()
    _held[site.digest, config] = site


def held() -> list[tuple[Site, SiteConfig]]:
    """What a new worker is to hold."""
    return [(site, config) for (_, config), site in _held.items()]


def site_of(address: str, digest: str, config: SiteConfig) -> Site:
    """The site of this digest, read where this process does not hold it. Raises `SiteError` where it has changed."""
    if (digest, config) not in _held:
        storage.reach(address)  # or a worker that the store does not answer would end the campaign, not fail its run
        site = read_site(address, config)
        if site.digest != digest:
            remedy = "Start the campaign again."
            raise SiteError("has changed since the campaign began", place=redacted(address), remedy=remedy)
        hold(site, config)
    return _held[digest, config]
