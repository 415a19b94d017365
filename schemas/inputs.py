"""Contracts of the input tables (CONTRACT sections 1 and 2)."""

from __future__ import annotations

import dataframely as dy

from schemas.columns import flag, instant, one_of, real, text
from schemas.enums import AreaType, BaliseDirection, BaliseKind, Fix, Navigability, Origin, Reaction
from schemas.run import Stream


class Gnss(dy.Schema):
    """Positions of the receiver, one row per epoch and solution."""

    t = instant("time of validity")
    solution = text("source of the position; `primary` where the log names none")
    latitude_deg = real("deg", "WGS 84 latitude", min=-90, max=90)
    longitude_deg = real("deg", "WGS 84 longitude", min=-180, max=180)
    height_m = real("m", "ellipsoidal height")
    cov_ee_m2 = real("m2", "covariance of position, east-east", min=0)
    cov_en_m2 = real("m2", "covariance of position, east-north")
    cov_eu_m2 = real("m2", "covariance of position, east-up")
    cov_nn_m2 = real("m2", "covariance of position, north-north", min=0)
    cov_nu_m2 = real("m2", "covariance of position, north-up")
    cov_uu_m2 = real("m2", "covariance of position, up-up", min=0)
    vel_e_mps = real("m/s", "velocity east")
    vel_n_mps = real("m/s", "velocity north")
    vel_u_mps = real("m/s", "velocity up")
    hpl_m = real("m", "horizontal protection level", min=0)
    vpl_m = real("m", "vertical protection level", min=0)
    fix = one_of(Fix, "kind of fix")
    satellites = dy.Int64(nullable=True, min=0, description="satellites used", metadata={"unit": "1"})
    sbas_prn = dy.Int64(nullable=True, description="PRN of the SBAS satellite in use", metadata={"unit": "1"})
    sbas_age_s = real("s", "age of the SBAS corrections", min=0)


class Odometer(dy.Schema):
    """Distance or speed from the train's odometry; at least one of the two in each row."""

    t = instant("time of validity")
    sensor = text("which of the train's odometers; `primary` where the log names none")
    distance_m = real("m", "cumulative distance, falling when reversing")
    speed_mps = real("m/s", "signed speed")
    sigma_speed_mps = real("m/s", "standard deviation of the speed", min=0)
    slip = flag("the odometer reports slip or slide", nullable=True)
    origin = one_of(Origin, "where its figures come from, as declared; null: unknown", nullable=True)

    @dy.rule()
    def distance_or_speed(cls):  # type: ignore[no-untyped-def]  # noqa: N805
        """Every row has at least one of the two."""
        return cls.distance_m.col.is_not_null() | cls.speed_mps.col.is_not_null()


class Satellites(dy.Schema):
    """One row per epoch, solution and satellite."""

    t = instant("time of validity")
    solution = text("solution that the satellite belongs to")
    sv = text("satellite, RINEX style: G08, E11, S23")
    azimuth_deg = real("deg", "azimuth, clockwise from north", nullable=False)
    elevation_deg = real("deg", "elevation", nullable=False, min=-90, max=90)
    residual_m = real("m", "pseudorange residual at the published position (measured minus computed)")
    sigma_m = real("m", "standard deviation of the pseudorange", min_exclusive=0)
    used = flag("used in the solution")


class Reference(dy.Schema):
    """Truth: the position of the GNSS antenna by a better instrument."""

    t = instant("time of validity")
    latitude_deg = real("deg", "WGS 84 latitude", nullable=False, min=-90, max=90)
    longitude_deg = real("deg", "WGS 84 longitude", nullable=False, min=-180, max=180)
    height_m = real("m", "ellipsoidal height")
    sigma_m = real("m", "standard deviation per axis", min=0)


class BaliseReads(dy.Schema):
    """Physical balises read by the train."""

    t = instant("time of the read")
    balise_id = text("balise as in the site's balise list")


class Faults(dy.Schema):
    """What was injected, as truth."""

    t_start = instant("begin of the fault")
    t_end = instant("end of the fault", nullable=True)
    kind = text("ramp, step, bias, noise, outage, slip, scale, latency, ...")
    target = text("what it was applied to: along, cross, up, a satellite, odometer, ...")
    size = dy.Float64(nullable=True, description="size in the unit of the kind")
    rate = dy.Float64(nullable=True, description="size per second")


class Track(dy.Schema):
    """Surveyed points of net elements, in order."""

    netelement_id = text("net element")
    measure_m = real("m", "distance along the net element from its start", nullable=False)
    latitude_deg = real("deg", "WGS 84 latitude", nullable=False, min=-90, max=90)
    longitude_deg = real("deg", "WGS 84 longitude", nullable=False, min=-180, max=180)
    height_m = real("m", "ellipsoidal height of the rail; null in a 2-D survey", min=-1_000, max=10_000)
    sigma_m = real("m", "standard deviation of the survey", min=0)


class Links(dy.Schema):
    """Net relations: ends of two net elements that are connected."""

    netelement_a = text("first net element")
    position_a = dy.Int64(min=0, max=1, description="its end: 0 start, 1 end", metadata={"unit": "1"})
    netelement_b = text("second net element")
    position_b = dy.Int64(min=0, max=1, description="its end: 0 start, 1 end", metadata={"unit": "1"})
    navigability = one_of(Navigability, "in which directions a train can run over it")


class Balises(dy.Schema):
    """Virtual balises and physical balise groups."""

    balise_id = text("identity", primary_key=True)
    netelement_id = text("net element it lies on")
    measure_m = real("m", "place on the net element", nullable=False)
    kind = one_of(BaliseKind, "virtual or physical")
    location_accuracy_m = real("m", "location accuracy Q (SUBSET-026 3.6.4.1)", nullable=False, min=0, max=63)
    linked = flag("announced by linking information")
    link_reaction = one_of(Reaction, "reaction on a linking error")
    direction = one_of(BaliseDirection, "in which direction along its net element a virtual balise is valid")


class Route(dy.Schema):
    """Net elements in order of travel."""

    netelement_id = text("net element")
    direction = text("AB (from start to end) or BA")


class Areas(dy.Schema):
    """Types of area along net elements, for `balise claim`; a site need not have it, and a replay does not read it."""

    netelement_id = text("net element")
    from_m = real("m", "measure where the area begins", nullable=False)
    to_m = real("m", "measure where it ends", nullable=False)
    area_type = one_of(AreaType, "what of the requirements applies")
    track_speed_kmh = real("km/h", "track speed; null: not known", min_exclusive=0)


STREAM_SCHEMAS: dict[Stream, type[dy.Schema]] = {
    "gnss": Gnss,
    "odometer": Odometer,
    "satellites": Satellites,
    "reference": Reference,
    "balise_reads": BaliseReads,
    "faults": Faults,
}
SITE_SCHEMAS: dict[str, type[dy.Schema]] = {
    "track": Track,
    "links": Links,
    "balises": Balises,
    "route": Route,
    "areas": Areas,
}
