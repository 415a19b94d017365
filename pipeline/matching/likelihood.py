"""How well a net element explains a position (Newson & Krumm 2009, eq. 1, made fit for correlated errors).

Newson & Krumm take the positions' errors as independent. A receiver's are not: they last for a minute, so
independent epochs would make the search certain of the wrong track within seconds. Here the offset from a
track is a first-order Gauss-Markov process whose variance V is the position's and the survey's, and each
step is judged by what it adds: N(r; φ r', V (1 - φ²)), exact for such errors at any spacing of the steps.
A small share of outliers with a wide distribution keeps single jumps from deciding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from pipeline.matching.candidates import Candidates
from pipeline.matching.fixes import Fixes
from pipeline.matching.steps import Steps
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Floor of what the offset changes from step to step [m]: rounding of surveys and fixes; more where the sigma is a
# table's, which knows nothing of this receiver's noise.
_FLOOR_M = 0.02
_TABLE_FLOOR_M = 0.1
# An offset outside this many sigmas, and the scale of outliers, lasts for this long [s]: being off costs by the time.
# Where a position is off every element, its offsets change by this share of the least from step to step.
_OFF_SIGMAS = 5.0
_OFF_S = 8.0
_OFF_WANDER = 0.01
_HEADING_LIMIT = 8.0
_ENDS_SIGMA_M = 1.0
_RULED_OUT = -50.0


@dataclass(frozen=True)
class Likelihood:
    """Per candidate: variance of the offset, what of it is new since the step before, and the rest.

    `fixed` is the log-likelihood that does not depend on the step before (place past an element's end,
    reads of balises, heading as far as it is new, time off the track); `heading` is the whole of it, for a first step.
    """

    variance_m2: Floats
    fresh_m2: Floats
    keep: Floats
    fixed: Floats
    heading: Floats
    outlier: float
    outlier_scale_m: float

    def with_pins(self, ruled_out: Bools) -> Likelihood:
        """As before, and candidates ruled out by a balise read next to impossible."""
        return replace(self, fixed=self.fixed + np.where(ruled_out, _RULED_OUT, 0.0))


def likelihood_of(fixes: Fixes, steps: Steps, candidates: Candidates, config: MatchingConfig) -> Likelihood:
    """The part of the likelihood that needs no neighbouring step."""
    row = steps.epoch[candidates.step]
    gnss_m2 = _cross_m2(fixes, row, candidates.heading_rad)
    survey = np.where(np.isfinite(candidates.survey_sigma_m), candidates.survey_sigma_m, config.survey_sigma_default_m)
    # A table's sigma knows nothing of antenna and datum: their offset comes on top, and it does not change.
    bias_m2 = np.where(fixes.from_receiver[row], 0.0, config.bias_sigma_m**2)
    variance = gnss_m2 + survey**2 + bias_m2
    elapsed, way = steps.elapsed_s[candidates.step], steps.chord_m[candidates.step]
    renewed = -np.expm1(-2.0 * np.nan_to_num(elapsed) / config.noise_tau_s)
    new_track = -np.expm1(-2.0 * np.nan_to_num(way) / config.survey_correlation_m)
    floor_m = np.where(fixes.from_receiver[row], _FLOOR_M, _TABLE_FLOOR_M)
    fresh = np.clip(gnss_m2 * renewed + survey**2 * new_track, np.minimum(floor_m**2, variance), variance)
    off = candidates.distance_m > np.maximum(_OFF_SIGMAS * np.sqrt(variance), config.outlier_scale_m)
    heading = _heading(steps, candidates, config)
    return Likelihood(
        variance_m2=variance,
        fresh_m2=fresh + _wander_m2(candidates, off, config),
        # A survey's error may as well stay what it is: only the position's own error is sure to return.
        keep=np.sqrt(1.0 - gnss_m2 * renewed / variance),
        fixed=_ends(candidates, variance + _ENDS_SIGMA_M**2, config)
        + heading * fresh / variance
        - _time_off(steps, candidates, off, config),
        heading=heading,
        outlier=config.outlier_probability,
        outlier_scale_m=config.outlier_scale_m,
    )


def expected_m(before_m: Floats, candidate: Ints, like: Likelihood) -> Floats:
    """Offset expected at candidates after an offset of the step before [m].

    An error returns towards zero; one far outside its sigma follows no such law, so no more than the return
    from three sigma is expected of it, and what counts is how it moves.
    """
    usual = 3.0 * np.sqrt(like.variance_m2[candidate])
    return before_m - (1.0 - like.keep[candidate]) * np.clip(before_m, -usual, usual)


def log_density(offset_m: Floats, mean_m: Floats, variance_m2: Floats, like: Likelihood) -> Floats:
    """Log density of an offset: Gaussian, or with small probability an outlier (Cauchy)."""
    gauss = -0.5 * ((offset_m - mean_m) ** 2 / variance_m2 + np.log(2.0 * np.pi * variance_m2))
    scale = like.outlier_scale_m
    return np.asarray(np.logaddexp(np.log1p(-like.outlier) + gauss, np.log(like.outlier) + _wide(offset_m, scale)))


def _wide(off_m: Floats, scale_m: float) -> Floats:
    """Log density of an outlier (Cauchy)."""
    return np.asarray(-np.log(np.pi * scale_m * (1.0 + (off_m / scale_m) ** 2)))


def _wander_m2(candidates: Candidates, off: Bools, config: MatchingConfig) -> Floats:
    """What the offset changes besides where a position is off every element: that much of the distance to the nearest.

    A lost position drifts by metres in seconds, whatever it says of itself; how it moves is weak evidence. It is the
    same for all elements, so none is preferred for explaining noise.
    """
    begin = candidates.first[:-1]
    nearest_m = np.minimum.reduceat(candidates.distance_m, begin)[candidates.step]
    lost = np.logical_and.reduceat(off, begin)[candidates.step]
    return np.where(lost, (_OFF_WANDER * nearest_m) ** 2, 0.0)


def _time_off(steps: Steps, candidates: Candidates, off: Bools, config: MatchingConfig) -> Floats:
    """Cost of a position that lies off the element by what no error explains, by how long it does.

    Otherwise a constant offset is paid for once, and a run whose positions are elsewhere for a minute, which is paid
    for twice, would be put on a track far beside for all of it.
    """
    elapsed_s = np.minimum(np.nan_to_num(steps.elapsed_s[candidates.step]), config.step_time_s)
    return np.where(off, elapsed_s / _OFF_S, 0.0)


def _cross_m2(fixes: Fixes, row: Ints, heading_rad: Floats) -> Floats:
    """Variance of the position across an element's axis."""
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    ee, en, nn = fixes.cov_ee_m2[row], fixes.cov_en_m2[row], fixes.cov_nn_m2[row]
    return np.maximum(cos * cos * ee - 2.0 * sin * cos * en + sin * sin * nn, 1e-6)


def _ends(candidates: Candidates, variance_m2: Floats, config: MatchingConfig) -> Floats:
    """Log-probability that a position belongs to the element rather than to those linked to its ends.

    About a link it is shared between the elements on both sides and adds up to one, so that a track in many
    pieces is as probable as one in a single piece. Past an end without a link it falls off as a Gaussian.
    As across the track, a single jump past an end does not decide: it may be an outlier.
    """
    sigma = np.sqrt(variance_m2)
    value = np.where(candidates.past != 0, -0.5 * (candidates.beyond_m / sigma) ** 2, 0.0)
    for inside_m, linked, past in (
        (candidates.along_m, candidates.linked_start, candidates.past < 0),
        (candidates.left_m, candidates.linked_end, candidates.past > 0),
    ):
        shared = log_ndtr(np.where(past, -candidates.beyond_m, inside_m) / sigma)
        value = np.where(linked & past, shared, value + np.where(linked & ~past, shared, 0.0))
    jumped = np.log(config.outlier_probability) + _wide(candidates.beyond_m, config.outlier_scale_m)
    return np.where(candidates.past != 0, np.logaddexp(np.log1p(-config.outlier_probability) + value, jumped), value)


def _heading(steps: Steps, candidates: Candidates, config: MatchingConfig) -> Floats:
    """Log-likelihood of the direction of travel, either way along the element; nothing at standstill."""
    difference = steps.heading_rad[candidates.step] - candidates.heading_rad
    folded = (np.degrees(difference) + 90.0) % 180.0 - 90.0
    value = np.maximum(-0.5 * (folded / config.heading_sigma_deg) ** 2, -_HEADING_LIMIT)
    moving = steps.speed_mps[candidates.step] >= config.heading_min_speed_mps
    return np.where(moving & np.isfinite(value), value, 0.0)
