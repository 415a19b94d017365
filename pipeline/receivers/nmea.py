"""NMEA 0183: GGA, GNS or RMC, with RMC or ZDA for the date, GST for accuracy, gathered by time of day."""

from __future__ import annotations

from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import numpy as np

from pipeline.ingest.guesses import UNITS
from pipeline.receivers.epochs import Epoch, Gathered
from schemas.enums import Fix

_FIXES = {
    0: Fix.NONE,
    1: Fix.AUTONOMOUS,
    2: Fix.DIFFERENTIAL,
    3: Fix.AUTONOMOUS,
    4: Fix.RTK_FIXED,
    5: Fix.RTK_FLOAT,
    6: Fix.ESTIMATED,
    9: Fix.SBAS,  # of NovAtel's receivers; 7 and 8 are typed in or simulated
}
# Mode letters of RMC and GNS, the best first: a solution is as good as its best satellite system.
_MODES = {
    "R": Fix.RTK_FIXED,
    "F": Fix.RTK_FLOAT,
    "D": Fix.DIFFERENTIAL,
    "P": Fix.AUTONOMOUS,
    "A": Fix.AUTONOMOUS,
    "E": Fix.ESTIMATED,
}
# Differential corrections whose station is an SBAS satellite: 120-158 as PRN, 33-64 as NMEA satellite number.
_SBAS_PRNS, _SBAS_NUMBERS, _NUMBER_TO_PRN = range(120, 159), range(33, 65), 87
_HALF_DAY_S = 43_200


def parse(raw: bytes) -> Any:
    """The sentence, none if it is of no interest."""
    from pynmeagps import NMEAReader

    return NMEAReader.parse(raw) if raw[3:6] in _WANTED and raw[6:7] == b"," else None


class NmeaDecoder:
    """Keeps the day while sentences go by: most of them only tell the time of day."""

    def __init__(self) -> None:
        self._day: date | None = None
        self._latest: time | None = None

    def decode(self, gathered: Gathered, message: Any, raw: bytes) -> None:
        """Add what this sentence says to its epoch."""
        if not isinstance(message.time, time):
            gathered.drop("time not valid")
            return
        self._follow(message)
        position = message.identity if message.msgID in _POSITIONS else ""
        epoch = gathered.at((self._day, message.time), position, raw)
        if self._day is not None:
            epoch.t_ns = _time_ns(self._day, message.time)
        _DECODERS[message.msgID](epoch, message)

    def _follow(self, message: Any) -> None:
        """The day of this sentence: as it says itself, or the last one, past midnight the next."""
        if message.msgID == "RMC" and isinstance(message.date, date) and (message.status == "A" or message.lat != ""):
            self._day = message.date  # before its first position a receiver tells a date of its own making
        elif message.msgID == "ZDA" and (day := _date_of(message)):
            self._day = day
        elif self._day is not None and self._latest is not None:
            back_s = _seconds(self._latest) - _seconds(message.time)
            self._day += timedelta(days=1) if back_s > _HALF_DAY_S else timedelta(0)
        self._latest = message.time


def settle_first_day(gathered: Gathered, told: date | None = None) -> None:
    """Give the positions before the first date their day, counted back from it; without any, on from the day `told`.

    Sentences of the same epoch as the first dated ones join them. A time with neither date nor position may be that of
    a receiver just switched on, whose clock is not set yet: it is dropped.
    """
    undated = [epoch for epoch in gathered.epochs if _key_of(epoch)[0] is None]
    gathered.epochs = [epoch for epoch in gathered.epochs if _key_of(epoch)[0] is not None]
    if not gathered.epochs:
        if told is None:
            gathered.drop("time without a date", len(undated))
        else:
            gathered.epochs = undated
            _count_on(undated, told)
        return
    first = gathered.epochs[0]
    day, following = _key_of(first)
    kept: list[Epoch] = []
    for early in reversed(undated):
        _, moment = _key_of(early)
        if moment == following and not early.positions.keys() & first.positions.keys():
            _join(first, early)
        elif early.gnss.get("fix", Fix.NONE.value) == Fix.NONE.value:
            gathered.drop("time without a date")
        else:
            day -= timedelta(days=1) if _seconds(moment) - _seconds(following) > _HALF_DAY_S else timedelta(0)
            early.t_ns, following = _time_ns(day, moment), moment
            kept.append(early)
    gathered.epochs = kept[::-1] + gathered.epochs


def _count_on(undated: list[Epoch], day: date) -> None:
    """The first epoch is of this day, and past midnight comes the next."""
    before_s = 0
    for epoch in undated:
        _, moment = _key_of(epoch)
        day += timedelta(days=1) if before_s - _seconds(moment) > _HALF_DAY_S else timedelta(0)
        epoch.t_ns, before_s = _time_ns(day, moment), _seconds(moment)


def _join(dated: Epoch, early: Epoch) -> None:
    """What GGA and GNS say goes before what an RMC says."""
    dated.gnss = dated.gnss | early.gnss if "satellites" in early.gnss else early.gnss | dated.gnss
    dated.positions |= early.positions


def _key_of(epoch: Epoch) -> Any:
    """Day (none before the first date) and time of day."""
    return epoch.key


def _time_ns(day: date, moment: time) -> int:
    """UTC [ns since 1970]."""
    whole = datetime.combine(day, moment.replace(microsecond=0), tzinfo=UTC)
    return int(whole.timestamp()) * 1_000_000_000 + moment.microsecond * 1000


def _seconds(moment: time) -> int:
    return moment.hour * 3600 + moment.minute * 60 + moment.second


def _date_of(m: Any) -> date | None:
    try:
        return date(int(m.year), int(m.month), int(m.day))
    except ValueError:
        return None


def _position(epoch: Epoch, m: Any) -> None:
    """GGA: kind of fix and position, of which an RMC of the epoch may have said less."""
    _put(epoch, m, _FIXES.get(int(m.quality or 0), Fix.NONE))


def _position_of_systems(epoch: Epoch, m: Any) -> None:
    """GNS: a letter of `posMode` per satellite system; where a GGA has told its kind of fix, that stands."""
    if epoch.gnss.get("satellites") is None:
        _put(epoch, m, next((fix for mode, fix in _MODES.items() if mode in str(m.posMode)), Fix.NONE))


def _put(epoch: Epoch, m: Any, fix: Fix) -> None:
    """What GGA and GNS share; height over the ellipsoid is height over the geoid plus the separation."""
    station = int(m.diffStation) if str(m.diffStation).isdigit() else None
    prn = station + _NUMBER_TO_PRN if station is not None and station in _SBAS_NUMBERS else station
    if fix is Fix.DIFFERENTIAL and prn in _SBAS_PRNS:
        fix = Fix.SBAS
        epoch.gnss |= {"sbas_prn": prn, "sbas_age_s": m.diffAge if isinstance(m.diffAge, float) else None}
    epoch.gnss |= {"fix": fix.value, "satellites": int(m.numSV) if m.numSV != "" else None}
    if fix is Fix.NONE or m.lat == "" or m.lon == "":
        return
    epoch.gnss |= {"latitude_deg": m.lat, "longitude_deg": m.lon}
    if isinstance(m.alt, float) and isinstance(m.sep, float):
        epoch.gnss["height_m"] = m.alt + m.sep


def _motion(epoch: Epoch, m: Any) -> None:
    """RMC: velocity; its position and mode count only where neither GGA nor GNS is sent."""
    valid = m.status == "A"
    fix = _MODES.get(getattr(m, "posMode", "") or "A", Fix.NONE) if valid else Fix.NONE
    place = {"latitude_deg": m.lat, "longitude_deg": m.lon} if m.lat != "" and m.lon != "" else {}
    epoch.gnss = {"fix": fix.value, **place} | epoch.gnss
    if valid and isinstance(m.spd, float) and isinstance(m.cog, float):
        course, speed = np.radians(m.cog), m.spd * UNITS["knots"]
        epoch.gnss |= {"vel_e_mps": float(speed * np.sin(course)), "vel_n_mps": float(speed * np.cos(course))}


def _accuracy(epoch: Epoch, m: Any) -> None:
    if all(isinstance(value, float) for value in (m.stdLat, m.stdLong, m.stdAlt)):
        epoch.gnss |= {"cov_ee_m2": m.stdLong**2, "cov_nn_m2": m.stdLat**2, "cov_uu_m2": m.stdAlt**2}
        epoch.gnss |= _correlation(m) | {"cov_eu_m2": 0.0, "cov_nu_m2": 0.0}


def _correlation(m: Any) -> dict[str, float]:
    """GST gives the error ellipse: its orientation is that of the major axis, from true north."""
    if not all(isinstance(value, float) for value in (m.stdMajor, m.stdMinor, m.orient)):
        return {"cov_en_m2": 0.0}
    angle = np.radians(m.orient)
    shared = float((m.stdMajor**2 - m.stdMinor**2) * np.sin(angle) * np.cos(angle))
    # Rounding, or an ellipse of something else: the deviations of the axes count.
    return {"cov_en_m2": shared if abs(shared) <= m.stdLat * m.stdLong else 0.0}


def _nothing(_epoch: Epoch, _m: Any) -> None:
    """ZDA gives only the date."""


_POSITIONS = ("GGA", "GNS", "RMC")
_WANTED = (b"GGA", b"GNS", b"RMC", b"GST", b"ZDA")
_DECODERS = {
    "GGA": _position,
    "GNS": _position_of_systems,
    "RMC": _motion,
    "GST": _accuracy,
    "ZDA": _nothing,
}
