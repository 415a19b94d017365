"""One solution's positions as arrays, with their covariance or a table's sigma in its place, and their digits."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.odometry.rows import step_of
from pipeline.stages.track.geodesy import MEAN_RADIUS_M, Points, points_of
from schemas.arrays import Bools, Floats, Ints, floats, times_ns
from schemas.config import FixSigma
from schemas.enums import Fix
from schemas.frozen import frozen


@frozen
class Fixes:
    """Epochs of one solution in order; NaN where not known.

    `valid` has a position and a fix; `from_receiver` says that the (co)variances [m2] are the receiver's; `estimated`
    that the position was carried on without satellites.
    """

    t_ns: Ints
    valid: Bools
    points: Points
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    cov_ee_m2: Floats
    cov_en_m2: Floats
    cov_nn_m2: Floats
    cov_uu_m2: Floats
    from_receiver: Bools
    estimated: Bools
    vel_e_mps: Floats
    vel_n_mps: Floats
    hpl_m: Floats

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def t_s(self) -> Floats:
        """Seconds since the first epoch."""
        return np.asarray((self.t_ns - self.t_ns[:1]) * 1e-9, dtype=np.float64)


def fixes_of(frame: pl.DataFrame, sigma: FixSigma) -> Fixes:
    """Arrays of a `gnss` stream of one solution.

    A receiver's covariance counts where both horizontal variances are positive (zero means not known in
    many logs); else the configuration's sigma by kind of fix stands in (DOMAIN section 3). A correlation that no
    covariance can have is not known: the variances stand alone.
    """
    column = {name: _floats(frame, name) for name in _NUMBERS}
    fix = _kinds(frame["fix"])
    table_m = np.array([*(sigma.horizontal_m(kind) for kind in Fix), None], dtype=np.float64)
    valid = np.isfinite(column["latitude_deg"]) & np.isfinite(column["longitude_deg"])
    valid &= fix != _KINDS.index(Fix.NONE.value)
    with np.errstate(invalid="ignore"):
        receiver = valid & (column["cov_ee_m2"] > 0) & (column["cov_nn_m2"] > 0)
        height_known = receiver & (column["cov_uu_m2"] > 0)
        correlated = receiver & (column["cov_en_m2"] ** 2 < column["cov_ee_m2"] * column["cov_nn_m2"])
    table = np.where(valid, (table_m**2)[fix], np.nan)
    ee = np.where(receiver, column["cov_ee_m2"], table)
    nn = np.where(receiver, column["cov_nn_m2"], table)
    up = np.where(height_known, column["cov_uu_m2"], 0.5 * (ee + nn) * sigma.vertical_factor**2)
    latitude = np.where(valid, column["latitude_deg"], np.nan)
    longitude = np.where(valid, column["longitude_deg"], np.nan)
    return Fixes(
        t_ns=times_ns(frame),
        valid=valid,
        points=points_of(latitude, longitude),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=np.where(valid, column["height_m"], np.nan),
        cov_ee_m2=ee,
        cov_en_m2=np.where(correlated, column["cov_en_m2"], np.where(valid, 0.0, np.nan)),
        cov_nn_m2=nn,
        cov_uu_m2=up,
        from_receiver=receiver,
        estimated=fix == _KINDS.index(Fix.ESTIMATED.value),
        vel_e_mps=column["vel_e_mps"],
        vel_n_mps=column["vel_n_mps"],
        hpl_m=column["hpl_m"],
    )


def contradictory_covariances(frame: pl.DataFrame) -> int:
    """Epochs of a `gnss` stream whose `cov_en_m2` no covariance with these variances can have."""
    ee, en, nn = (pl.col(f"cov_{axes}_m2") for axes in ("ee", "en", "nn"))
    return frame.filter((ee > 0) & (nn > 0) & (en**2 >= ee * nn)).height


_KINDS = [kind.value for kind in Fix]
_NUMBERS = (
    *("latitude_deg", "longitude_deg", "height_m"),
    *("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "cov_uu_m2", "vel_e_mps", "vel_n_mps", "hpl_m"),
)


def _floats(frame: pl.DataFrame, name: str) -> Floats:
    """A column with null as NaN; an optional column that is absent is not known."""
    if name not in frame.columns:
        return np.full(frame.height, np.nan)
    return frame[name].cast(pl.Float64).to_numpy()


def _kinds(fix: pl.Series) -> Ints:
    """Kinds of fix by their number; the number after the last is not known."""
    return fix.cast(pl.Enum(_KINDS)).to_physical().cast(pl.Int64).fill_null(len(_KINDS)).to_numpy()


# Numerics: less than this is rounding.
_ROUNDED_M = 1e-4


def digit_steps(fixes: pl.DataFrame, least_m: float) -> tuple[float, float, float]:
    """Deviation to the north, to the east and of the height by the steps of the recorded coordinates [m].

    Five decimals of a degree, NMEA of four decimals of a minute, or single precision move each position by up to half a
    step, the next one by something else: at 10 Hz metres per second. Only the digits are looked at, so no fault of the
    position can pass for it.

    `fixes`: those of one solution. `least_m`: finer steps count for nothing.
    """
    latitude = floats(fixes, "latitude_deg")
    known = latitude[np.isfinite(latitude)]
    north_per_deg = np.radians(1.0) * MEAN_RADIUS_M
    east_per_deg = north_per_deg * np.cos(np.radians(known.mean())) if known.size else north_per_deg
    north, east, up = (
        step_m(values[np.isfinite(values)], scale, least_m) / np.sqrt(12.0)
        for values, scale in (
            (latitude, north_per_deg),
            (floats(fixes, "longitude_deg"), east_per_deg),
            (floats(fixes, "height_m"), 1.0),
        )
    )
    return north, east, up


def step_m(values: Floats, metres: float, least_m: float) -> float:
    """The step of a recorded coordinate [m], 0 where there is none of `least_m`; `metres`: of one unit of it."""
    changes = np.diff(values)
    # At speed the changes themselves are many steps each, but the change of the change is one at times.
    return metres * step_of(changes, np.diff(changes), least_m / metres, _ROUNDED_M / metres)
