"""When the train passed each balise by the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.hazards.truth import valid_ns
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints

# A hole in the epochs over which the train's speed at both ends gives the passage between them.
_HOLE_S = 120.0
# Crossings of one balise without this much movement between them are one passage (noise at standstill).
_AGAIN_M = 10.0


@dataclass(frozen=True)
class TruePassings:
    """Instants at which the train passed each balise, in order of time, and the true positions over time.

    `slip_m`: by how much two balise reads around an instant contradict the odometer between them; the place there may
    be wrong by as much.
    """

    by_balise: dict[str, tuple[int, ...]]
    at_ns: Ints
    path_m: Floats
    slip_m: Floats

    def assign(self, passages: pl.DataFrame) -> list[int | None]:
        """The true passage of each row; none for an offer beyond it (each true passage is given once).

        The nearest in time to the offer, or to where the odometer reckons the passage; rows with neither take in
        order what is left.
        """
        balises = passages["balise_id"].to_list()
        places = passages["path_m"].to_list()
        about = _about_when(passages)
        pairs = [
            (abs(t - t_ns), row, t)
            for row, (balise, t_ns) in enumerate(zip(balises, about, strict=True))
            if t_ns is not None
            for t in self.by_balise.get(balise, ())
        ]
        result: list[int | None] = [None] * len(balises)
        taken: set[tuple[str, int]] = set()
        for _, row, t in sorted(pairs):
            free = result[row] is None and (balises[row], t) not in taken
            if free and self._one_passage(about[row], t, places[row]):
                result[row] = t
                taken.add((balises[row], t))
        for row, (balise, t_ns) in enumerate(zip(balises, about, strict=True)):
            left = [t for t in self.by_balise.get(balise, ()) if (balise, t) not in taken]
            if t_ns is None and left:
                result[row] = left[0]
                taken.add((balise, left[0]))
        return result

    def _one_passage(self, a_ns: int | None, b_ns: int, balise_m: float) -> bool:
        """Between an offer and a true crossing the train only went from the one to the other, as far as is known."""
        begin, end = np.searchsorted(self.at_ns, sorted((a_ns or b_ns, b_ns)))
        way = np.abs(self.path_m[begin:end] - balise_m)
        if way.size == 0:
            return True
        unseen_m = max(_AGAIN_M, float(self.slip_m[begin:end].max()))
        return bool(way.max() <= (way[0] if b_ns >= (a_ns or b_ns) else way[-1]) + unseen_m)


def _about_when(passages: pl.DataFrame) -> list[int | None]:
    instants = passages["t_offered"]
    if "t_reckoned" in passages.columns:
        instants = passages.select(pl.coalesce("t_offered", "t_reckoned")).to_series()
    return instants.dt.timestamp("ns").to_list()


def true_passings(
    epochs: pl.DataFrame, truth: pl.DataFrame, balises: pl.DataFrame, between: pl.DataFrame | None = None
) -> TruePassings:
    """Crossings of the true position over every balise on the path.

    `between`: places known inside gaps of the epochs (`places_between`).
    """
    at_ns, x, speed, legs, slip = _places(epochs, truth, between)
    found: dict[str, tuple[int, ...]] = {}
    if at_ns.size < 2 or balises.height == 0:
        return TruePassings(found, at_ns, x, slip)
    for part in balises.sort("path_m").partition_by("leg", maintain_order=True):
        names, places = part["balise_id"].to_list(), floats(part, "path_m")
        changes = _changes(x, legs == part["leg"][0], places)
        for index, (balise, beacon_m) in enumerate(zip(names, places.tolist(), strict=True)):
            instants = _instants(at_ns, x, speed, changes.get(index, []), beacon_m)
            found[balise] = tuple(sorted((*found.get(balise, ()), *instants)))
    return TruePassings(found, at_ns, x, slip)


def _places(
    epochs: pl.DataFrame, truth: pl.DataFrame, between: pl.DataFrame | None
) -> tuple[Ints, Floats, Floats, Ints, Floats]:
    """Instants, true positions, speeds, legs and slips in order of time, where the truth is known."""
    place = floats(truth, "truth_path_m")
    rows = np.flatnonzero(np.isfinite(place))
    leg = epochs["leg"]
    if leg.null_count():
        leg = leg.fill_null(strategy="forward").fill_null(strategy="backward")
    at_ns, x, speed, legs = valid_ns(epochs)[rows], place[rows], floats(epochs, "speed_mps")[rows], ints(leg)[rows]
    slip = np.nan_to_num(np.abs(floats(truth, "truth_slip_m")[rows]))
    if between is None:
        return at_ns, x, speed, legs, slip
    at_ns = np.concatenate((at_ns, ints(between["at_ns"])))
    order = np.argsort(at_ns, kind="stable")
    x = np.concatenate((x, floats(between, "path_m")))[order]
    speed = np.concatenate((speed, floats(between, "speed_mps")))[order]
    legs = np.concatenate((legs, ints(between["leg"])))[order]
    return at_ns[order], x, speed, legs, np.concatenate((slip, np.zeros(between.height)))[order]


def legs_of(epochs: pl.DataFrame) -> Ints:
    """Leg of the path at each epoch, held where the position is not known."""
    leg = epochs["leg"].cast(pl.Int64).fill_null(strategy="forward").fill_null(strategy="backward").fill_null(-1)
    return leg.to_numpy()


def _changes(x: Floats, here: Bools, places: Floats) -> dict[int, list[int]]:
    """By number of the balise the epochs whose movement passes it."""
    passed = np.searchsorted(places, x, side="right")
    changes: dict[int, list[int]] = {}
    for epoch in (np.flatnonzero((passed[1:] != passed[:-1]) & here[1:]) + 1).tolist():
        a, b = sorted((int(passed[epoch - 1]), int(passed[epoch])))
        for index in range(a, b):
            changes.setdefault(index, []).append(epoch)
    return changes


def _instants(at_ns: Ints, x: Floats, speed: Floats, changes: list[int], beacon_m: float) -> list[int]:
    instants: list[int] = []
    previous = -1
    for index in changes:
        span_s = float(at_ns[index] - at_ns[index - 1]) / NS_PER_S
        if span_s > _HOLE_S:
            continue
        away = previous < 0 or float(np.abs(x[previous:index] - beacon_m).max()) >= _AGAIN_M
        previous = index
        if away:
            share = _share(x[index - 1 : index + 1], speed[index - 1 : index + 1], span_s, beacon_m)
            instants.append(int(at_ns[index - 1]) + round(share * span_s * NS_PER_S))
    return instants


def _share(x: Floats, speed: Floats, span_s: float, beacon_m: float) -> float:
    """Share of the interval at which a cubic through both ends with their speeds meets the balise.

    Exact for constant acceleration; straight line where a speed is not known or the cubic turns back.
    """
    linear = float((beacon_m - x[0]) / (x[1] - x[0]))
    if not np.isfinite(speed).all() or span_s < 1.5:
        return linear
    m0, m1, d = speed[0] * span_s, speed[1] * span_s, x[1] - x[0]
    roots = np.roots([m0 + m1 - 2.0 * d, 3.0 * d - 2.0 * m0 - m1, m0, x[0] - beacon_m])
    real = roots[np.abs(roots.imag) < 1e-9].real
    inside = real[(real >= 0.0) & (real <= 1.0)]
    return float(inside[0]) if inside.size == 1 else linear
