"""What a result is made from, and by which program."""

from __future__ import annotations

import hashlib

from schemas.config import Configuration, Vehicle, digest_of
from schemas.frozen import frozen
from schemas.run import RunLog, Site
from schemas.version import SOFTWARE


@frozen
class Provenance:
    """The same provenance always gives the same tables; `calibrated_by`: runs that tell of vehicle and noise."""

    config_digest: str
    input_digest: str
    software: str
    calibrated_by: tuple[str, ...] = ()


def provenance(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration) -> Provenance:
    """Which log, site, settings and program results are made of."""
    return Provenance(
        config_digest=digest_of(config, vehicle),
        input_digest=input_digest(run, site.digest),
        software=SOFTWARE,
        calibrated_by=config.calibration.runs,
    )


def input_digest(run: RunLog, site_digest: str) -> str:
    """What the `runs` table calls the input digest: SHA-256 over those of log and site."""
    return hashlib.sha256(f"{run.input_digest}:{site_digest}".encode()).hexdigest()
