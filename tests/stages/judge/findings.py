"""What the tables of a replay say against the truth of a journey: every breach of DOMAIN 5.1, 5.2 and 5.4 as a text.

A `Rung` is one replay of the journey under one kind of evidence. Epochs and offers become the same small frame of
`Judgements`, so that each rule is written once for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline import replay
from schemas.config import Configuration
from schemas.run import RunTables
from tests.stages.judge.ground import Floats
from tests.stages.judge.sensors import seconds
from tests.stages.judge.world import Journey

Bools = NDArray[np.bool_]

LIMIT_M = 20.0
CI_LIMIT_M = 14.0
GATE = 0.99
MARGIN_M = 0.6  # interpolation between samples and the survey's chords; noise of the evidence ends below 3 sigma
BESIDE_MARGIN_M = 8.0  # a neighbour is not exactly as long as the track beside it
TURNING_MPS = 1.2  # slower than this the direction of travel may be told either way (dead band, odometer averaging)
APART_M = 3.0  # tracks nearer than this to each other (at a switch) are not told apart
AT_JOINT_M = 25.0  # where the train or its interval may be on either side of a switch
RUNGS = ("reference", "balise", "odometer")


@dataclass(frozen=True, repr=False)
class Judgements:
    """Judged positions with their truth: `error_m` as the program placed them, `beside` on a track that is not ours."""

    what: str
    time_s: Floats
    place_m: Floats
    error_m: Floats
    speed_mps: Floats
    beside: Bools
    apart_m: Floats
    sure: Bools
    judgement: NDArray[np.str_]

    def breach(self, at: int, why: str) -> str:
        return (
            f"{self.what} at {self.time_s[at]:.2f} s judged {self.judgement[at]}: {why} "
            f"(true error {self.error_m[at]:.2f} m, {'beside' if self.beside[at] else 'on'} the train's track)"
        )


@dataclass(frozen=True, repr=False)
class Rung:
    """One replay under one kind of evidence."""

    name: str
    journey: Journey
    tables: RunTables

    @property
    def row(self) -> dict[str, object]:
        return self.tables.runs.row(0, named=True)

    def number(self, column: str) -> float:
        value = self.row[column]
        assert isinstance(value, int | float), f"runs.{column} is {value!r}, a number was expected"
        return float(value)

    @cached_property
    def offers(self) -> pl.DataFrame:
        """Virtual balises that the position offered, in order."""
        offered = (pl.col("kind").cast(pl.String) == "virtual") & pl.col("t_offered").is_not_null()
        return self.tables.passages.filter(offered).sort("t_offered")

    @cached_property
    def epochs(self) -> Judgements:
        frame = self.tables.epochs
        sure = frame.select(
            (pl.max_horizontal("gate_probability", "path_probability").fill_null(0) >= GATE)
            & pl.col("on_track").fill_null(False)
        ).to_series()
        return self._judged("epoch", frame, frame["t"], sure.to_numpy())

    @cached_property
    def passages(self) -> Judgements:
        sure = self.offers["status"].cast(pl.String) != "rejected_ambiguous"
        return self._judged("offer", self.offers, self.offers["t_offered"], sure.to_numpy())

    def _judged(self, what: str, frame: pl.DataFrame, times: pl.Series, sure: Bools) -> Judgements:
        journey, time = self.journey, seconds(times)
        names = frame["netelement_id"].to_list()
        place = journey.chainage_of(names, frame["measure_m"].fill_null(np.nan).to_numpy())
        true = journey.true_chainage_m(time)
        return Judgements(
            what,
            time,
            place,
            (place - true) * journey.sense(time),
            journey.ride.speed_mps(journey.judged_at_s(time)),
            ~journey.on_route(names) & ~np.isnan(place),
            np.minimum(journey.apart_m(true), journey.apart_m(np.nan_to_num(place))),
            sure,
            frame["judgement"].cast(pl.String).fill_null("null").to_numpy().astype(str),
        )

    @cached_property
    def in_use(self) -> tuple[Bools, Bools]:
        """In use for certain, and in use at most (the epochs until negation are a matter of one period)."""
        frame = self.tables.epochs
        fit = (
            (pl.col("confidence_m").fill_null(np.inf) <= CI_LIMIT_M)
            & pl.col("on_track").fill_null(False)
            & (pl.col("gate_probability").fill_null(0) >= GATE)
            & pl.col("withheld_for").is_null()
        )
        usable = frame.select(fit).to_series().to_numpy()
        safe = (frame["lds_mode"].cast(pl.String) == "fail_safe").to_numpy()
        alarm = frame["alarm"].to_numpy()
        before = np.concatenate([[False, False], safe[:-2]]) if len(safe) > 2 else safe
        return usable & ~safe & ~alarm, usable & ~(safe & before)

    def counted_s(self, mask: Bools) -> Floats:
        """Time from the epoch before, up to max(1.5 periods, 1 s) (DOMAIN 5.3)."""
        time = self.epochs.time_s
        period = float(np.median(np.diff(time)))
        step = np.diff(time, prepend=time[0] - period)
        return np.where(mask, np.minimum(step, max(1.5 * period, 1.0)), 0.0)


def rungs_of(journey: Journey, config: Configuration | None = None) -> dict[str, Rung]:
    """The journey judged with its reference, with its reads alone, with its odometer alone."""
    gone: dict[str, tuple[str, ...]] = {
        "reference": (),
        "balise": ("reference",),
        "odometer": ("reference", "balise_reads"),
    }
    return {name: rung_of(journey, name, gone[name], config) for name in RUNGS if _has(journey, name)}


def complete(config: Configuration | None) -> Configuration:
    """The survey of these worlds holds every track that the train may use, and says so."""
    config = config or Configuration()
    return config.model_copy(update={"evidence": config.evidence.model_copy(update={"survey_complete": True})})


def rung_of(journey: Journey, name: str, gone: tuple[str, ...] = (), config: Configuration | None = None) -> Rung:
    return Rung(name, journey, replay(journey.weaker(*gone), journey.site, journey.vehicle, complete(config)))


def _has(journey: Journey, name: str) -> bool:
    reads = journey.run.balise_reads
    return {
        "reference": journey.run.reference is not None,
        "balise": reads is not None and reads.height > 0,
        "odometer": True,
    }[name]


def findings(journey: Journey, rungs: dict[str, Rung], crooked: bool = False) -> list[str]:
    """Every breach, with rung, instant and true error.

    `crooked`: the evidence itself errs, so that it need not decide; where its reference does, taking it away may help.
    """
    found = [f"{name}: {text}" for name, rung in rungs.items() for text in _of_rung(rung, crooked)]
    if journey.world.better is not None and journey.world.better.aside is not None:
        return [f"{journey.name}: {text}" for text in found]
    names = [name for name in RUNGS if name in rungs]
    best = [name for name in names if rungs[name].row["verdict"] == "safe"]
    for name in names[: names.index(best[-1])] if best else []:
        if rungs[name].row["verdict"] != "safe":
            found.append(f"{best[-1]}: its verdict is better than that of {name}, {rungs[name].row['verdict']}")
    for stronger, weaker in ((a, b) for k, a in enumerate(names) for b in names[k + 1 :]):
        found += [f"{weaker} against {stronger}: {text}" for text in _ladder(rungs[stronger], rungs[weaker])]
    return [f"{journey.name}: {text}" for text in found]


def _of_rung(rung: Rung, crooked: bool) -> list[str]:
    from tests.stages.judge.accounts import account_findings

    judged = [text for kind in (rung.epochs, rung.passages) for text in (*_right(rung, kind), *_wrong(rung, kind))]
    decided = [] if crooked else _decided(rung)
    return [*judged, *_intervals(rung), *decided, *account_findings(rung)]


def _first(mask: Bools) -> list[int]:
    """The first few of them: one cause makes hundreds."""
    return [int(at) for at in np.flatnonzero(mask)[:3]]


def _margin_m(kind: Judgements) -> Floats:
    return np.where(kind.beside, BESIDE_MARGIN_M, MARGIN_M)


def _right(rung: Rung, kind: Judgements) -> list[str]:
    """Never right where the truth is beyond the limit or on another track; never right by the odometer alone."""
    right = kind.judgement == "right"
    if rung.name == "odometer":
        return [kind.breach(at, "the odometer alone never says right") for at in _first(right)]
    beyond = right & (np.abs(kind.error_m) > LIMIT_M + _margin_m(kind))
    beside = right & kind.beside & (kind.apart_m > APART_M)
    lost = right & np.isnan(kind.error_m)
    return [
        *(kind.breach(at, "it is beyond the limit") for at in _first(beyond)),
        *(kind.breach(at, "it is on another track") for at in _first(beside)),
        *(kind.breach(at, "it has no place") for at in _first(lost)),
    ]


def _wrong(rung: Rung, kind: Judgements) -> list[str]:
    """Never wrong where the truth is within the limit on the train's own track, nor where the match is ambiguous."""
    within = (kind.judgement == "wrong") & (np.abs(kind.error_m) < LIMIT_M - _margin_m(kind))
    if rung.name == "odometer":
        return [kind.breach(at, "its anchor was right too") for at in _first(within & ~_shown(rung, kind))]
    excused = kind.beside & kind.sure
    return [
        *(kind.breach(at, "it is within the limit") for at in _first(within & ~kind.beside)),
        *(kind.breach(at, "the match is ambiguous") for at in _first(within & kind.beside & ~excused)),
    ]


def _shown(rung: Rung, kind: Judgements) -> Bools:
    """Position and one of the last anchors part by more than the limit, or the odometer is not within 5 m + 5 %."""
    journey = rung.journey
    broken = [slip.begin_s for slip in journey.slips if slip.kind in ("slip", "freeze") and not slip.flagged]
    shown = kind.time_s >= min(broken, default=np.inf)
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy()
    times, errors = rung.passages.time_s[accepted], _growing(rung, rung.passages)[accepted]
    own = _growing(rung, kind)
    for at in np.flatnonzero(kind.judgement == "wrong"):
        last = np.searchsorted(times, kind.time_s[at] + 1e-3)
        anchors = errors[max(last - 2, 0) : last]
        shown[at] |= bool(np.any(np.abs(own[at] - anchors) > LIMIT_M - MARGIN_M))
    return shown


def _growing(rung: Rung, kind: Judgements) -> Floats:
    """Errors along the growing route."""
    return kind.error_m * rung.journey.sense(kind.time_s)


def _intervals(rung: Rung) -> list[str]:
    """The interval holds the true error, and the judgement follows from the interval (DOMAIN 5.2)."""
    kind, frame = rung.epochs, rung.tables.epochs
    low, high = (frame[name].fill_null(np.nan).to_numpy() for name in ("error_low_m", "error_high_m"))
    middle = frame["error_along_m"].fill_null(np.nan).to_numpy()
    texts = _consistent(rung, low, high, middle)
    if rung.name == "odometer":
        return texts
    fast = (np.abs(kind.speed_mps) > TURNING_MPS) & ~kind.beside
    outside = fast & ((kind.error_m < low - MARGIN_M) | (kind.error_m > high + MARGIN_M))
    texts += [kind.breach(at, f"the interval is {low[at]:.2f} to {high[at]:.2f} m") for at in _first(outside)]
    off = fast & (np.abs(middle - kind.error_m) > 5.0 + MARGIN_M)
    return texts + [kind.breach(at, f"error_along_m is {middle[at]:.2f} m") for at in _first(off)]


def _consistent(rung: Rung, low: Floats, high: Floats, middle: Floats) -> list[str]:
    kind = rung.epochs
    beyond = (low > LIMIT_M) | (high < -LIMIT_M)
    bounded = (low >= -LIMIT_M) & (high <= LIMIT_M)
    rules = {
        "low is above high": low > high + 1e-9,
        "the whole interval is beyond the limit": beyond & (kind.judgement != "wrong"),
        "its interval is not within the limit": (kind.judgement == "right") & ~bounded,
        "no interval beyond the limit, and no other track": (kind.judgement == "wrong") & ~beyond & ~kind.beside,
        "it has no judgement": ~np.isin(kind.judgement, ("right", "wrong", "unknown")),
        "error_along_m is not known to 5 m": ~np.isnan(middle) & ~(high - low <= 10.0 + 1e-6),
        "the odometer alone gives no error_along_m": ~np.isnan(middle) & (rung.name == "odometer"),
    }
    return [kind.breach(at, text) for text, mask in rules.items() for at in _first(mask)]


def _decided(rung: Rung) -> list[str]:
    """With a reference on both sides of an epoch what is clear has to be said: unknown is no way out."""
    better = rung.journey.world.better
    if rung.name != "reference" or better is None:
        return []
    kind, reference = rung.epochs, rung.journey.run.reference
    assert reference is not None
    # With 0.08 s of its clock at 30 m/s.
    band = 6 * (better.sigma_m if better.stated else 1.0) + 2.4
    heard, at = seconds(reference["t"]), rung.journey.judged_at_s(kind.time_s)
    after = np.clip(np.searchsorted(heard, at), 1, len(heard) - 1)
    covered = (heard[after] - heard[after - 1] < 2.0) & (at >= heard[0]) & (at <= heard[-1]) & kind.sure & ~kind.beside
    # A neighbour is out at 4.3 sigmas of reference and survey (`hazards.reference_alpha`), not at three.
    alone = ~_at_switch(rung, kind) & (band < 1.3 * kind.apart_m)
    beyond = covered & (np.abs(kind.error_m) > LIMIT_M + band) & (kind.judgement != "wrong")
    within = covered & alone & (np.abs(kind.error_m) < LIMIT_M - band) & (kind.judgement != "right")
    return [
        *(kind.breach(at, "the reference shows it beyond the limit") for at in _first(beyond)),
        *(kind.breach(at, "the reference shows it within the limit") for at in _first(within)),
    ]


def _at_switch(rung: Rung, kind: Judgements) -> Bools:
    """Two tracks are too near to each other there, or become one within the reach of a reference."""
    ends = [element.base_m[[0, -1]] for element in rung.journey.world.ground.elements if element.name == "neighbour"]
    starts = rung.journey.world.ground.route.starts_m
    joints = starts[np.isin(starts, [starts[np.argmin(np.abs(starts - end))] for pair in ends for end in pair])]
    way = rung.journey.true_chainage_m(kind.time_s)
    near = np.any([np.abs(way - joint) < AT_JOINT_M for joint in joints] or [np.zeros(len(way), bool)], axis=0)
    return np.asarray(near | (kind.apart_m <= APART_M))


def _ladder(stronger: Rung, weaker: Rung) -> list[str]:
    """A weaker judgement is the same or unknown, wherever both replays placed the position alike."""
    pairs = ((stronger.epochs, weaker.epochs), (stronger.passages, weaker.passages))
    return [text for strong, weak in pairs for text in _pair(stronger, strong, weaker, weak)]


def _pair(stronger: Rung, strong: Judgements, weaker: Rung, weak: Judgements) -> list[str]:
    found: list[str] = []
    shown = _shown(weaker, weak) if weaker.name == "odometer" else np.zeros(len(weak.time_s), bool)
    better = stronger.journey.world.better
    band = 6 * max(1.0, better.sigma_m if better is not None else 1.0)
    switch = _at_switch(weaker, weak)
    for at in np.flatnonzero(weak.judgement != "unknown"):
        alike = np.abs(strong.time_s - weak.time_s[at]) < 1e-3
        alike &= (np.abs(strong.place_m - weak.place_m[at]) < 1.0) & (strong.beside == weak.beside[at])
        for other in np.flatnonzero(alike)[:1]:
            said, again = strong.judgement[other], weak.judgement[at]
            near = said == "unknown" and (switch[at] or abs(abs(weak.error_m[at]) - LIMIT_M) < band)
            if said != again and not near and not shown[at]:
                found.append(weak.breach(int(at), f"with {stronger.name} it is {said}"))
    return found[:3]
