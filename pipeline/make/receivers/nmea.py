"""NMEA 0183: GGA, GNS or RMC, with RMC or ZDA for the date, GST for accuracy, gathered by time of day."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.make.receivers.epochs import Epoch, Gathered
from pipeline.make.receivers.rivals import Talkers, ToldPosition
from pipeline.read.ingest.guesses import UNITS
from schemas.arrays import NS_PER_S
from schemas.enums import Fix

# 9 is of NovAtel's receivers; 7 and 8 are typed in or simulated.
_FIXES = {
    0: Fix.NONE, 1: Fix.AUTONOMOUS, 2: Fix.DIFFERENTIAL, 3: Fix.AUTONOMOUS, 4: Fix.RTK_FIXED, 5: Fix.RTK_FLOAT,
    6: Fix.ESTIMATED, 9: Fix.SBAS,
}  # fmt: skip
# Mode letters of RMC and GNS, the best first: a solution is as good as its best satellite system.
_MODES = {
    "R": Fix.RTK_FIXED, "F": Fix.RTK_FLOAT, "D": Fix.DIFFERENTIAL, "P": Fix.AUTONOMOUS, "A": Fix.AUTONOMOUS,
    "E": Fix.ESTIMATED,
}  # fmt: skip
# Differential corrections whose station is an SBAS satellite: 120-158 as PRN, 33-64 as NMEA satellite number.
_SBAS_PRNS = range(120, 159)
_SBAS_NUMBERS = range(33, 65)
_NUMBER_TO_PRN = 87
_DAY_NS = 86_400 * NS_PER_S
_STEP_NS = 60 * NS_PER_S  # of a log that goes on


def parse(raw: bytes) -> Any:
    """The sentence, none if it is of no interest."""
    from pynmeagps import NMEAReader

    if b"_" in raw:  # Python reads 1_0 as 10
        raise ValueError("a sentence holds an underscore")
    return NMEAReader.parse(raw) if raw[3:6] in _WANTED and raw[6:7] == b"," else None


def decode(gathered: Gathered, message: Any, raw: bytes) -> None:
    """Add what this sentence says to its epoch, whose key is the time of day; most tell no more of the time."""
    assert isinstance(gathered, Sentences)
    if message.talker in gathered.left_out:
        gathered.count_dropped("sentence of another talker")
        return
    if message.msgID == "DTM":
        gathered.datums[message.talker] = _datum_code(message)
        return
    if not isinstance(message.time, time):
        gathered.count_dropped("time not valid")
        return
    if message.msgID in _POSITIONS and not _belongs_to_epoch(gathered, message, raw):
        return
    epoch = gathered.epoch_at(message.time, message.identity if message.msgID in _POSITIONS else "", raw)
    # Before its first position a receiver tells a date of its own making.
    if message.msgID == "RMC" and isinstance(message.date, date) and (message.status == "A" or message.lat != ""):
        epoch.t_ns = _time_ns(message.date, message.time)
    elif message.msgID == "ZDA" and (day := _date_of(message)):
        epoch.t_ns = _time_ns(day, message.time)
    if message.msgID in _DECODERS:
        _DECODERS[message.msgID](epoch, message)


@dataclass
class Sentences(Gathered):
    """Epochs of NMEA, and who talks: `left_out` are talkers of receivers that are not meant; `datums` by talker."""

    left_out: frozenset[str] = frozenset()
    talkers: Talkers = field(default_factory=Talkers)
    datums: dict[str, str] = field(default_factory=dict)

    @property
    def rivals(self) -> frozenset[str]:
        """Talkers of which each has positions of its own at the same times."""
        return self.talkers.rivals

    @property
    def rival_distance_m(self) -> float:
        """How far apart two talkers are at most [m]."""
        return self.talkers.widest_m


def _datum_code(m: Any) -> str:
    """Code of the datum by DTM, where positions are not those of WGS 84."""
    code = str(m.datum).strip().upper()
    shifted = any(isinstance(value, float | int) and value for value in (m.latOfset, m.lonOfset))
    return "" if code in ("", "W84") and not shifted else code or "999"


def _belongs_to_epoch(gathered: Sentences, m: Any, raw: bytes) -> bool:
    """Whether a position is of WGS 84 (or named for what it nearly is), and of the receiver of its epoch."""
    datum = gathered.datums.get(m.talker) or ""
    if datum in _NEAR_WGS84 or (datum and "89" in datum):
        gathered.count_dropped(f"position in {datum} (kept: decimetres from WGS 84)")
    elif datum:
        gathered.count_dropped(f"position in another datum than WGS 84 ({datum})")
        return False
    said = ToldPosition(m.talker, None)
    if m.lat != "" and m.lon != "" and _has_fix(m):
        said = ToldPosition(m.talker, (float(m.lat), float(m.lon)), _last_digit_m(raw))
    before = gathered.talkers.latest(m.time)
    if not gathered.talkers.take_position(m.time, said):
        reason = "no fix beside the position of another talker" if said.place is None else "position of another talker"
        gathered.count_dropped(reason)
        return False
    if before is not None and before.talker != m.talker and before.place is None and said.place is not None:
        gathered.epoch_at(m.time).gnss.clear()
    return True


def _has_fix(m: Any) -> bool:
    """Whether a sentence has a position."""
    if m.msgID == "RMC":
        return bool(m.status == "A")
    kind = _FIXES.get(int(m.quality or 0), Fix.NONE) if m.msgID == "GGA" else None
    return kind is not Fix.NONE if m.msgID == "GGA" else any(mode in str(m.posMode) for mode in _MODES)


def _last_digit_m(raw: bytes) -> float:
    """The last digit of the minutes of the latitude, as a length: a minute is 1852 m."""
    field_of = {b"GGA": 2, b"GNS": 2, b"RMC": 3}[raw[3:6]]
    return float(1852.0 * 10.0 ** -len(raw.split(b",")[field_of].partition(b".")[2]))


def settle_days(gathered: Gathered, first_day: date | None = None) -> None:
    """Give the epochs without a date theirs: past midnight the next, before the first date counted back from it.

    Where no sentence has a date, the first epoch is of `first_day`. A time with neither date nor position before
    the first date may be that of a receiver just switched on, whose clock is not set yet: it is dropped.
    """
    epochs = gathered.epochs
    gathered.count_dropped("date that turned late or early at midnight (put right)", _correct_turned_dates(epochs))
    first = next((number for number, epoch in enumerate(epochs) if epoch.t_ns is not None), None)
    if first is None and first_day is not None and epochs:
        first = 0
        epochs[0].t_ns = _time_ns(first_day, epochs[0].key)
    early = epochs[:first]
    if first is not None:
        early = [epoch for epoch in early if epoch.gnss.get("fix", Fix.NONE.value) == Fix.NONE.value]
    gathered.count_dropped("time without a date", len(early))
    dropped = {epoch.number for epoch in early}
    gathered.epochs = [epoch for epoch in epochs if epoch.number not in dropped]
    for sense in (1, -1):
        for known, epoch in pairwise(gathered.epochs[::sense]):
            if epoch.t_ns is None and known.t_ns is not None:
                epoch.t_ns = _neighbour_time_ns(known.t_ns, epoch.key, sense)


def _correct_turned_dates(epochs: list[Epoch]) -> int:
    """Put dates that turn near midnight on the day of their neighbours; how many.

    Seen by time that goes back by a day within one step: so does no clock. The dates are wrong until time goes on by a
    day within one step, or from such a step before on.
    """
    dated = [epoch for epoch in epochs if epoch.t_ns is not None]
    steps = np.diff([epoch.t_ns or 0 for epoch in dated])
    back = np.flatnonzero(np.abs(steps + _DAY_NS) <= _STEP_NS) + 1
    forth = np.flatnonzero(np.abs(steps - _DAY_NS) <= _STEP_NS) + 1
    turned = 0
    for at in back.tolist():
        until = next((end for end in forth.tolist() if end > at), None)
        since = next((begin for begin in forth[::-1].tolist() if begin < at), None)
        early = since is not None and at - since <= (len(dated) if until is None else until) - at
        begin, end = (since or 0, at) if early else (at, len(dated) if until is None else until)
        for epoch in dated[begin:end]:
            epoch.t_ns = (epoch.t_ns or 0) + (-_DAY_NS if early else _DAY_NS)
        turned += end - begin
    return turned


def _neighbour_time_ns(known_ns: int, moment: time, sense: int) -> int:
    """The time of an epoch after (1) or before (-1) one of known time [ns]; of the same day, or past midnight."""
    t_ns = known_ns - known_ns % _DAY_NS + _time_ns(date(1970, 1, 1), moment)
    return t_ns + sense * _DAY_NS if sense * (known_ns - t_ns) > _DAY_NS // 2 else t_ns


def _time_ns(day: date, moment: time) -> int:
    """UTC [ns since 1970]."""
    whole = datetime.combine(day, moment.replace(microsecond=0), tzinfo=UTC)
    return int(whole.timestamp()) * NS_PER_S + moment.microsecond * 1000


def _date_of(m: Any) -> date | None:
    """Date of a sentence, if it is one."""
    try:
        return date(int(m.year), int(m.month), int(m.day))
    except ValueError:
        return None


def _put_gga(epoch: Epoch, m: Any) -> None:
    """GGA: kind of fix and position, of which an RMC of the epoch may have said less."""
    _put_position(epoch, m, _FIXES.get(int(m.quality or 0), Fix.NONE))


def _put_gns(epoch: Epoch, m: Any) -> None:
    """GNS: a letter of `posMode` per satellite system; the kind of fix of a GGA stands."""
    if epoch.gnss.get("satellites") is None:
        _put_position(epoch, m, next((fix for mode, fix in _MODES.items() if mode in str(m.posMode)), Fix.NONE))


def _put_position(epoch: Epoch, m: Any, fix: Fix) -> None:
    """What GGA and GNS share. Height over the ellipsoid is height over the geoid plus the separation."""
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


def _put_rmc(epoch: Epoch, m: Any) -> None:
    """RMC: velocity; its position and mode count only where neither GGA nor GNS is sent."""
    valid = m.status == "A"
    fix = _MODES.get(getattr(m, "posMode", "") or "A", Fix.NONE) if valid else Fix.NONE
    place = {"latitude_deg": m.lat, "longitude_deg": m.lon} if m.lat != "" and m.lon != "" else {}
    epoch.gnss = {"fix": fix.value, **place} | epoch.gnss
    if valid and isinstance(m.spd, float) and isinstance(m.cog, float):
        course = np.radians(m.cog)
        speed = m.spd * UNITS["knots"]
        epoch.gnss |= {"vel_e_mps": float(speed * np.sin(course)), "vel_n_mps": float(speed * np.cos(course))}


def _put_gst(epoch: Epoch, m: Any) -> None:
    """Covariance of a position from its standard deviations."""
    if all(isinstance(value, float) for value in (m.stdLat, m.stdLong, m.stdAlt)):
        epoch.gnss |= {"cov_ee_m2": m.stdLong**2, "cov_nn_m2": m.stdLat**2, "cov_uu_m2": m.stdAlt**2}
        epoch.gnss |= _gst_correlation(m) | {"cov_eu_m2": 0.0, "cov_nu_m2": 0.0}


def _gst_correlation(m: Any) -> dict[str, float]:
    """GST gives the error ellipse: its orientation is that of the major axis, from true north."""
    if not all(isinstance(value, float) for value in (m.stdMajor, m.stdMinor, m.orient)):
        return {"cov_en_m2": 0.0}
    angle = np.radians(m.orient)
    shared = float((m.stdMajor**2 - m.stdMinor**2) * np.sin(angle) * np.cos(angle))
    # Rounding, or an ellipse of something else: the deviations of the axes count.
    return {"cov_en_m2": shared if abs(shared) <= m.stdLat * m.stdLong else 0.0}


_POSITIONS = ("GGA", "GNS", "RMC")
_WANTED = (b"GGA", b"GNS", b"RMC", b"GST", b"ZDA", b"DTM")
_NEAR_WGS84 = ("P90", "ETR")
_DECODERS = {
    "GGA": _put_gga,
    "GNS": _put_gns,
    "RMC": _put_rmc,
    "GST": _put_gst,
}
