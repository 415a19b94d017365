"""Stated accuracy against the errors that the evidence shows (DOMAIN section 3): sigma, and the receiver's HPL."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from pipeline.stages.judge.epochs import under_injection
from pipeline.studies.plausibility.causes import explain_accuracy
from pipeline.studies.plausibility.check import Cause, Check, FitState
from schemas.arrays import Bools, Floats, floats, times_ns
from schemas.config import Configuration
from schemas.enums import MisfitCause
from schemas.words import say

# Gaussian: 95 % of all errors are within so many sigmas.
_SIGMAS_95 = 1.96


def accuracy_checks(epochs: pl.DataFrame, faults: pl.DataFrame | None, config: Configuration) -> list[Check]:
    """Misfits of the stated sigma and of the receiver's HPL along the track; none where they hold, or nothing shows it.

    `epochs`: judged. Epochs under an injected fault, or negated, are left out: their errors are not the receiver's.
    """
    counted = ~under_injection(times_ns(epochs), faults, config.lds.recovery_s)
    counted &= ~epochs["negated"].fill_null(value=False).to_numpy()
    stated_m = {"sigma": floats(epochs, "sigma_along_m"), "hpl": floats(epochs, "hpl_m") / config.lds.ci_factor}
    return [check for what, sigma_m in stated_m.items() for check in _check(what, sigma_m, epochs, counted, config)]


def refuted(checks: list[Check]) -> bool:
    """A stated accuracy is too small: no verdict may rest on it."""
    return any(cause.code is MisfitCause.SIGMA_TOO_SMALL for check in checks for cause in check.causes)


def _check(what: str, sigma_m: Floats, epochs: pl.DataFrame, counted: Bools, config: Configuration) -> Iterator[Check]:
    low_m, high_m = floats(epochs, "error_low_m"), floats(epochs, "error_high_m")
    # What it leaves possible is the worst; healthy evidence strays by a part of that.
    strays_m = config.evidence.sigma_evidence_part * 0.5 * (high_m - low_m)
    least_m = np.maximum(np.abs(floats(epochs, "error_along_m")) - strays_m, 0.0)
    most_m = np.maximum(np.abs(low_m), np.abs(high_m))
    known = counted & np.isfinite(most_m + least_m + sigma_m) & (sigma_m > 0.0)
    settings = config.evidence
    if known.sum() < settings.sigma_epochs_least:
        return
    sigma_m, least_m, most_m = sigma_m[known], least_m[known], most_m[known]
    beyond = float(np.mean(least_m > config.lds.ci_factor * sigma_m))
    if beyond > settings.sigma_refuted_share:
        factor = float(np.quantile(least_m / sigma_m, 0.95)) / _SIGMAS_95
        words = say("accuracy", "beyond", beyond, config.lds.ci_factor)
        yield _misfit(what, words, MisfitCause.SIGMA_TOO_SMALL, factor, sigma_m)
    elif (most_m < sigma_m / settings.sigma_too_large).all():
        factor = float(np.quantile(most_m / sigma_m, 0.95)) / _SIGMAS_95
        words = say("accuracy", "within", settings.sigma_too_large)
        yield _misfit(what, words, MisfitCause.SIGMA_TOO_LARGE, factor, sigma_m)


def _misfit(what: str, words: str, code: MisfitCause, factor: float, sigma_m: Floats) -> Check:
    """`factor`: true over stated."""
    causes = [Cause(code, (f"{factor if factor > 1.0 else 1.0 / factor:.2g}",))]
    if (unit := explain_accuracy(factor, float(np.median(sigma_m)))) is not None:
        causes.append(unit)
    return Check(say("accuracy", what), FitState.MISFIT, words, tuple(causes), advice=say("accuracy", "advice"))
