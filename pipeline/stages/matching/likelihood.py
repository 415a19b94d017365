"""How well a net element explains a position, as a function of the run's bias across the track.

Newson & Krumm (2009, eq. 1) take the positions' errors as independent. A receiver's are not: the offset from the true
track is a bias b that lasts the whole run plus a first-order Gauss-Markov process of variance V. Each step is judged
by what it adds, N(x_k - φ x_(k-1); 0, V (1 - φ²)) with x = level - b, exact for such errors at any spacing of steps.
That is a quadratic in b, and so is all that a run shows: `Terms` add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.stages.matching.fixes import Fixes
from pipeline.stages.matching.steps import Steps
from pipeline.stages.paths.candidates import Candidates
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Coefficients c, l, p of a log-likelihood c + l b - p b²/2 of the bias b [m]: `[coefficient, ..., scale]`.
Terms = Floats

# Log-likelihood that leaves next to nothing.
_RULED_OUT = -50.0


@dataclass(frozen=True)
class Likelihood:
    """Per candidate (row) and scale (column), the scales being how many times the stated sigma the true one is.

    `log_prior`, `bias_m2`: of each scale, and variance of the bias under it. `variance_m2`: of the offset about the
    bias; `fresh_m2`: of what is new in it since the step before; `keep`: φ. `fixed` is the log-likelihood that does not
    depend on the step before (place past an element's end, reads of balises, heading and height as far as they are new,
    time off the track); `direct` is the whole of heading and height, for a first step. `off`: no error explains how far
    the position lies from the element.
    """

    log_prior: Floats
    bias_m2: Floats
    variance_m2: Floats
    fresh_m2: Floats
    keep: Floats
    fixed: Floats
    direct: Floats
    off: Bools
    outlier_sigmas: float

    def with_pins(self, ruled_out: Bools) -> Likelihood:
        """As before, and candidates ruled out by a balise read next to impossible."""
        return replace(self, fixed=self.fixed + np.where(ruled_out, _RULED_OUT, 0.0))

    def prior(self) -> Terms:
        """Of the bias, before any position: N(0, `bias_m2`) under each scale."""
        constant = self.log_prior - 0.5 * np.log(self.bias_m2)
        return np.stack([constant, np.zeros_like(constant), 1.0 / self.bias_m2])


def likelihood_of(
    fixes: Fixes, steps: Steps, candidates: Candidates, survey_sigma_m: Floats, config: MatchingConfig
) -> Likelihood:
    """The part of the likelihood that needs no neighbouring step."""
    row = steps.epoch[candidates.step]
    gnss_m2 = _cross_m2(fixes, row, candidates.heading_rad)
    survey_m2 = survey_sigma_m**2
    scales = _scales(fixes, steps, config)
    elapsed_s = np.nan_to_num(steps.elapsed_s[candidates.step])
    keep = np.exp(-elapsed_s / config.noise_tau_s)
    fast_m2 = ((1.0 - config.slow_share) * gnss_m2)[:, None] * scales**2
    floor_m2 = np.where(fixes.from_receiver[row], config.offset_floor_m, config.table_floor_m) ** 2
    drift_m = config.estimated_drift * np.nan_to_num(steps.chord_m[candidates.step])
    floor_m2 = floor_m2 + np.where(fixes.estimated[row], drift_m**2, 0.0)
    whole_m2 = gnss_m2 + survey_m2 + config.on_track_bias_m**2
    unexplained = candidates.distance_m > config.on_track_sigmas * np.sqrt(whole_m2)
    off = unexplained & (candidates.distance_m > config.outlier_scale_m)
    direct = _heading(steps, candidates, config) + _height(fixes, row, candidates, survey_m2, config)
    share_new = np.clip(gnss_m2 * (1.0 - keep**2), np.minimum(floor_m2, whole_m2), whole_m2) / whole_m2
    return Likelihood(
        # The larger the likelier: that the stated sigma is too large is left out altogether.
        log_prior=np.log(scales / scales.sum()),
        bias_m2=_bias_m2(fixes, steps, candidates, survey_m2, scales, config),
        variance_m2=fast_m2 + floor_m2[:, None],
        fresh_m2=fast_m2 * (1.0 - keep**2)[:, None] + floor_m2[:, None],
        keep=keep,
        # Two surveys never end at the same place.
        fixed=_ends(candidates, gnss_m2 + survey_m2 + config.survey_sigma_default_m**2, config)
        + direct * share_new
        - _time_off(steps, candidates, off, config),
        direct=direct,
        off=off,
        outlier_sigmas=config.outlier_sigmas,
    )


def initial_terms(offset_m: Floats, candidate: Ints, like: Likelihood) -> Terms:
    """Of states without a step before them."""
    variance_m2 = _held(offset_m[:, None], like.variance_m2[candidate] + like.bias_m2, like) - like.bias_m2
    terms = _quadratic(offset_m[:, None], np.ones((len(offset_m), 1)), variance_m2)
    terms[0] += (like.fixed + like.direct)[candidate][:, None]
    return terms


def step_terms(movement_m: Floats, level_m: Floats, candidate: Ints, like: Likelihood) -> Terms:
    """Of states at their offset `level_m` after a movement across the track since the step before.

    With x = level - b: x_k - φ x_(k-1) = φ movement + (1 - φ)(level - b).
    """
    keep = like.keep[candidate][:, None]
    moved_m = keep * movement_m[:, None]
    # Alike on all tracks that share the movement: else the variance itself would tell between them.
    variance_m2 = _held(moved_m, like.fresh_m2[candidate], like)
    # An error far outside all that is expected follows no law by which it returns, whatever the bias.
    most_m = like.outlier_sigmas * np.sqrt(like.variance_m2[candidate] + like.bias_m2)
    held_m = np.clip(level_m[:, None], -most_m, most_m)
    slope = np.where(held_m == level_m[:, None], 1.0 - keep, 0.0)
    terms = _quadratic(moved_m + (1.0 - keep) * held_m, slope, variance_m2)
    terms[0] += like.fixed[candidate][:, None]
    return terms


def _quadratic(value_m: Floats, slope: Floats, variance_m2: Floats) -> Terms:
    """Log density of `value_m - slope b`, Gaussian."""
    constant = -0.5 * (value_m**2 / variance_m2 + np.log(2.0 * np.pi * variance_m2))
    return np.stack([constant, slope * value_m / variance_m2, slope**2 / variance_m2])


def _held(value_m: Floats, variance_m2: Floats, like: Likelihood) -> Floats:
    """The variance, larger where a value is beyond so many sigmas: reflections follow no error model."""
    return np.asarray(np.maximum(variance_m2, (value_m / like.outlier_sigmas) ** 2))


def _scales(fixes: Fixes, steps: Steps, config: MatchingConfig) -> Floats:
    """How many times the stated sigma the true one may be, each at most twice the one before.

    That it may be less is left out: errors that hardly change, as of dead reckoning, would look small and prove too
    much.
    """
    stated = float(np.mean(fixes.from_receiver[steps.epoch])) > 0.5
    doubt = config.sigma_doubt if stated else config.table_sigma_doubt
    return np.geomspace(1.0, doubt, 1 + int(np.ceil(np.log2(doubt))))


def _bias_m2(
    fixes: Fixes, steps: Steps, candidates: Candidates, survey_m2: Floats, scales: Floats, config: MatchingConfig
) -> Floats:
    """Variance of what lasts the whole run, the same on every track (DOMAIN section 2), under each scale.

    Antenna and datum, what of the position's error outlasts minutes (DIAG Table 1), and twice the survey's variance:
    of a step the larger one, over the run the mean, for a mean of errors varies by no more than that.
    """
    gnss_m2 = float(np.median(0.5 * (fixes.cov_ee_m2 + fixes.cov_nn_m2)[steps.epoch]))
    worst_m2 = float(np.mean(np.maximum.reduceat(survey_m2, candidates.first[:-1])))
    return np.asarray(config.cross_bias_sigma_m**2 + 2.0 * worst_m2 + config.slow_share * gnss_m2 * scales**2)


def _time_off(steps: Steps, candidates: Candidates, off: Bools, config: MatchingConfig) -> Floats:
    """Cost of a position that lies off the element by what no error explains, by how long it does."""
    elapsed_s = np.minimum(np.nan_to_num(steps.elapsed_s[candidates.step]), config.step_time_s)
    return np.where(off, elapsed_s / config.off_track_s, 0.0)


def _cross_m2(fixes: Fixes, row: Ints, heading_rad: Floats) -> Floats:
    """Variance of the position across an element's axis."""
    sin = np.sin(heading_rad)
    cos = np.cos(heading_rad)
    ee = fixes.cov_ee_m2[row]
    en = fixes.cov_en_m2[row]
    nn = fixes.cov_nn_m2[row]
    return np.maximum(cos * cos * ee - 2.0 * sin * cos * en + sin * sin * nn, 1e-6)


def _ends(candidates: Candidates, variance_m2: Floats, config: MatchingConfig) -> Floats:
    """Log-probability of a place past an element's end: Gaussian, and as an outlier a Cauchy's tail."""
    beyond_m = candidates.beyond_m
    scaled = 1.0 + (beyond_m / config.outlier_scale_m) ** 2
    jumped = -0.5 * config.outlier_sigmas**2 - np.log(scaled)
    return np.where(candidates.past != 0, np.maximum(-0.5 * beyond_m**2 / variance_m2, jumped), 0.0)


def _heading(steps: Steps, candidates: Candidates, config: MatchingConfig) -> Floats:
    """Log-likelihood of the direction of travel, either way along the element; nothing at standstill."""
    difference = steps.heading_rad[candidates.step] - candidates.heading_rad
    folded = (np.degrees(difference) + 90.0) % 180.0 - 90.0
    value = np.maximum(-0.5 * (folded / config.heading_sigma_deg) ** 2, -config.direct_limit)
    moving = steps.speed_mps[candidates.step] >= config.heading_min_speed_mps
    return np.where(moving & np.isfinite(value), value, 0.0)


def _height(fixes: Fixes, row: Ints, candidates: Candidates, survey_m2: Floats, config: MatchingConfig) -> Floats:
    """Log-likelihood of the height over the track, where tracks lie over each other; nothing without heights.

    Tracks at one level differ by superelevation and errors of the survey, which say nothing of the train.
    """
    begin = candidates.first[:-1]
    track_m = candidates.height_m
    apart_m = np.maximum.reduceat(track_m, begin) - np.minimum.reduceat(track_m, begin)
    above_m = fixes.height_m[row] - track_m
    variance = config.sigma_doubt**2 * fixes.cov_uu_m2[row] + survey_m2 + config.height_bias_sigma_m**2
    value = np.maximum(-0.5 * above_m**2 / variance, -config.direct_limit)
    return np.where((apart_m[candidates.step] >= config.clearance_m) & np.isfinite(value), value, 0.0)
