"""Sums and verdicts of a replay against a count of the tests' own (DOMAIN 5.2 to 5.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from schemas.config import Configuration

if TYPE_CHECKING:
    from tests.stages.judge.findings import Bools, Rung

BUDGET_S = Configuration().budget_s
LIMIT_M = 20.0
RECOVERY_S = 30.0
CLEAR_M = 1.0  # beyond the limit by this much is beyond it for any evidence of this package
ROUNDING_S = 1e-6


def account_findings(rung: Rung) -> list[str]:
    return [*_acceptances(rung), *_failures(rung), *_verdict(rung), *_states(rung)]


def _acceptances(rung: Rung) -> list[str]:
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy()
    counts = {
        "unsafe_accepted": int((accepted & (rung.passages.judgement == "wrong")).sum()),
        "unproven_accepted": int((accepted & (rung.passages.judgement == "unknown")).sum()),
    }
    return [
        f"runs.{name} is {rung.row[name]}, the passages hold {count}"
        for name, count in counts.items()
        if rung.row[name] != count
    ]


def longest_s(rung: Rung, mask: Bools) -> float:
    """Longest time of it, stretches less than the recovery time apart taken together."""
    time, spent = rung.epochs.time_s, rung.counted_s(mask)
    best = run = 0.0
    last = -np.inf
    for at in np.flatnonzero(mask):
        run = float(spent[at]) + (run if time[at] - last < RECOVERY_S else 0.0)
        best, last = max(best, run), time[at]
    return best


def _failures(rung: Rung) -> list[str]:
    """Failures and hazardous time lie between what was surely in use and what may have been."""
    wrong = rung.epochs.judgement == "wrong"
    surely, at_most = rung.in_use
    # Before a return nothing was in use: that time may count or not.
    before = np.concatenate([[False], at_most[:-1]])
    least, most = longest_s(rung, wrong & surely & before), float(rung.counted_s(wrong & at_most).sum())
    stated_s, failures = rung.row["hazardous_max_s"], rung.number("failures")
    hazardous = 0.0 if stated_s is None else rung.number("hazardous_max_s")
    total = rung.row["hazardous_s"]
    found = []
    if hazardous < least - ROUNDING_S or hazardous > most + ROUNDING_S:
        found.append(f"hazardous_max_s is {stated_s}, judged wrong in use is {least:.3f} to {most:.3f} s")
    if isinstance(total, float) and not hazardous - ROUNDING_S <= total <= most + ROUNDING_S:
        found.append(f"hazardous_s is {total}, judged wrong in use is {hazardous:.3f} to {most:.3f} s")
    if (failures > 0) != (least > 0) and (failures > 0) != (most > 0):
        found.append(f"failures is {failures:.0f}, judged wrong in use is {least:.3f} to {most:.3f} s")
    return found + _share_unknown(rung, surely, at_most) + _share_p1(rung)


def _share_p1(rung: Rung) -> list[str]:
    """Of the time that shares count, P1 is the hazardous time."""
    share, total = rung.row["share_p1"], rung.row["hazardous_s"]
    if share is None or total is None:
        return []
    p1_s = rung.number("share_p1") * rung.number("held_s")
    return [] if abs(p1_s - rung.number("hazardous_s")) < 1e-3 else [f"share_p1 is {p1_s:.3f} s, hazardous_s {total}"]


def _share_unknown(rung: Rung, surely: Bools, at_most: Bools) -> list[str]:
    moving = rung.tables.epochs["moving"].fill_null(True).to_numpy()
    unknown = (rung.epochs.judgement == "unknown") & moving
    right = (rung.epochs.judgement == "right") & moving
    found_s = [float(rung.counted_s(unknown & use).sum()) for use in (surely, at_most)]
    # What was right on both sides of a gap was not in use in it.
    near_s = np.minimum(np.diff(rung.epochs.time_s, prepend=-1.0), 1.0)
    right_s = [float(np.minimum(rung.counted_s(right & use), near_s).sum()) for use in (surely, at_most)]
    wrong = moving & ~right & ~unknown
    total = [
        own_s + more_s + float(rung.counted_s(wrong & use).sum())
        for own_s, more_s, use in zip(found_s, right_s, (surely, at_most), strict=True)
    ]
    if min(total) == 0:
        return []
    shares = [own_s / all_s for own_s, all_s in zip(found_s, total, strict=True)]
    low, high, share = min(shares), max(shares), rung.row["share_unknown"]
    # To which of its two epochs a span belongs is not fixed for a share: one epoch at each end and at each gap.
    period = float(np.median(np.diff(rung.epochs.time_s)))
    gaps = 2 + int((np.diff(rung.epochs.time_s) > 1.5 * period).sum())
    close = 0.005 + 1.5 * gaps * max(period, 1.0) / min(total)
    if isinstance(share, float) and low - close <= share <= high + close:
        return []
    return [f"share_unknown is {share}, the epochs say {low:.4f} to {high:.4f}"]


def _verdict(rung: Rung) -> list[str]:
    verdict, row = rung.row["verdict"], rung.row
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy()
    offers, epochs = rung.passages, rung.epochs
    surely, at_most = rung.in_use
    beside = offers.beside & (offers.apart_m > 3.0)
    wrong = accepted & ((np.abs(offers.error_m) > LIMIT_M + CLEAR_M) | beside)
    failing = (np.abs(epochs.error_m) > LIMIT_M + CLEAR_M) & surely
    failing_s = longest_s(rung, failing)
    moving = rung.tables.epochs["moving"].fill_null(True).to_numpy()
    unknown_s = longest_s(rung, (epochs.judgement == "unknown") & surely & moving)
    period = float(np.median(np.diff(epochs.time_s)))
    maybe = (np.abs(epochs.error_m) > LIMIT_M - CLEAR_M) | epochs.beside
    maybe_accepted = accepted & ((np.abs(offers.error_m) > LIMIT_M - CLEAR_M) | offers.beside)
    healthy = not (maybe & at_most).any() and not maybe_accepted.any()
    unproven = (row["unsafe_accepted"], row["unproven_accepted"]) != (0, 0) or not accepted.any()
    before = np.concatenate([[False], at_most[:-1]])
    over = longest_s(rung, (epochs.judgement == "wrong") & surely & before) > BUDGET_S + ROUNDING_S
    rules = {
        f"{int(wrong.sum())} VBs were accepted wrong by truth": verdict == "safe" and bool(wrong.any()),
        f"{failing_s:.2f} s of failure in use by truth": verdict == "safe" and failing_s > BUDGET_S + period,
        "nothing was wrong by truth": verdict == "unsafe" and healthy and rung.name != "odometer",
        "an acceptance is wrong or unknown, or there is none": verdict == "safe" and unproven,
        "a VB was accepted wrong": verdict != "unsafe" and row["unsafe_accepted"] != 0,
        "a failure is longer than the budget": verdict != "unsafe" and over,
        f"{unknown_s:.2f} s on end are unknown in use": verdict == "safe" and unknown_s > BUDGET_S + period,
        "there is no diagnosis": verdict == "safe" and rung.journey.world.counter is None,
        "the odometer alone proves nothing": verdict == "safe" and rung.name == "odometer",
        "there is no verdict": verdict is None,
    }
    return [f"verdict is {verdict}, but {text}" for text, breached in rules.items() if breached]


def _states(rung: Rung) -> list[str]:
    """P0 and P1 follow the judgement."""
    state = rung.tables.epochs["lds_state"].cast(pl.String).fill_null("null").to_numpy().astype(str)
    judged = rung.epochs.judgement
    bad = ((state == "P0") & (judged != "right")) | ((state == "P1") & (judged != "wrong"))
    return [rung.epochs.breach(int(at), f"its state is {state[at]}") for at in np.flatnonzero(bad)[:3]]
