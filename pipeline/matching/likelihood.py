"""How well a net element explains a position (Newson & Krumm 2009, eq. 1, made fit for correlated errors).

Newson & Krumm take the positions' errors as independent. A receiver's are not. Under each hypothesis of what lasts
(`Hypotheses`) the offset from a track is that bias plus a first-order Gauss-Markov process of variance V, and each
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

# Grid of the bias in its standard deviations. Half of a spacing is how far the bias scatters about each value, which
# leaves no gaps between them.
_GRID_SIGMAS = np.linspace(-3.6, 3.6, 9)
_WITHIN_SIGMAS = 0.5 * float(_GRID_SIGMAS[1] - _GRID_SIGMAS[0])


@dataclass(frozen=True)
class Hypotheses:
    """What stays the same for minutes, and is not known: bias left of growing path [m], true sigma over the stated one.

    A thousand epochs 3 m aside are one observation (DOMAIN section 2), so every track is judged under each of a grid of
    biases, and one that the run has shown on one net element counts on the next. The bias is the run's (antenna,
    datum), the element's (its survey, drawn anew on each) and what of the position's error outlasts minutes (DIAG
    Table 1).

    `within_m`: deviation of the bias about its grid value. `renewal`: probability of each (column) after a change of
    net element, from each (row).
    """

    bias_m: Floats
    scale: Floats
    within_m: Floats
    log_prior: Floats
    renewal: Floats

    def __len__(self) -> int:
        return len(self.bias_m)


def hypotheses_of(cross_m2: float, survey_m2: float, doubt: float, config: MatchingConfig) -> Hypotheses:
    """The grid for positions of variance `cross_m2` and a survey of variance `survey_m2` [m2].

    `doubt`: the truth may be that many times the stated sigma. That it may be less is left out: errors that hardly
    change, as of dead reckoning, would look small and prove too much.
    """
    # Each sigma at most twice the one before: between two of them it would be taken for the smaller one.
    scales = np.geomspace(1.0, doubt, 1 + int(np.ceil(np.log2(doubt))))
    lasting_m2 = config.cross_bias_sigma_m**2 + config.slow_share * cross_m2 * scales**2
    sigma_m = np.sqrt(lasting_m2 + survey_m2)
    count = len(_GRID_SIGMAS)
    prior = np.exp(-0.5 * _GRID_SIGMAS**2)
    kept = np.sqrt(1.0 - _WITHIN_SIGMAS**2)
    renewal = np.zeros((count * len(scales), count * len(scales)))
    for index, share in enumerate((lasting_m2 / sigma_m**2).tolist()):
        rows = slice(index * count, (index + 1) * count)
        renewal[rows, rows] = _renewal(share)
    return Hypotheses(
        bias_m=(kept * sigma_m[:, None] * _GRID_SIGMAS).ravel(),
        scale=np.repeat(scales, count),
        within_m=np.repeat(_WITHIN_SIGMAS * sigma_m, count),
        log_prior=np.log(np.outer(scales / scales.sum(), prior / prior.sum()).ravel()),
        renewal=renewal,
    )


def _renewal(share: float) -> Floats:
    """Bias on the next element given that on this: `share` of the variance goes on, the rest is drawn anew."""
    spread = max(1.0 - share**2, 1e-6)
    away = _GRID_SIGMAS[None, :] - share * _GRID_SIGMAS[:, None]
    exponent = -0.5 * away**2 / spread
    weight = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


# Log-likelihood that leaves next to nothing.
_RULED_OUT = -50.0


@dataclass(frozen=True)
class Likelihood:
    """Per candidate (row) and hypothesis (column): variance of the offset about the bias, what of it is new since the
    step before, and which part of the offset is expected to stay.

    `renewed_m2`: what a change of element adds. `fixed` is the log-likelihood that does not depend on the step before
    (place past an element's end, reads of balises, heading and height as far as they are new, time off the track);
    `direct` is the whole of heading and height, for a first step.
    """

    hypotheses: Hypotheses
    variance_m2: Floats
    fresh_m2: Floats
    keep: Floats
    renewed_m2: Floats
    fixed: Floats
    direct: Floats
    outlier: float
    outlier_scale_m: float
    return_sigmas: float

    def with_pins(self, ruled_out: Bools) -> Likelihood:
        """As before, and candidates ruled out by a balise read next to impossible."""
        return replace(self, fixed=self.fixed + np.where(ruled_out, _RULED_OUT, 0.0))


def likelihood_of(fixes: Fixes, steps: Steps, candidates: Candidates, config: MatchingConfig) -> Likelihood:
    """The part of the likelihood that needs no neighbouring step."""
    row = steps.epoch[candidates.step]
    gnss_m2 = _cross_m2(fixes, row, candidates.heading_rad)
    survey = np.where(np.isfinite(candidates.survey_sigma_m), candidates.survey_sigma_m, config.survey_sigma_default_m)
    survey_m2 = survey**2
    common_m2 = float(np.median(survey_m2))
    hypotheses = hypotheses_of(float(np.median(gnss_m2)), common_m2, _sigma_doubt(fixes, steps, config), config)
    elapsed, way = steps.elapsed_s[candidates.step], steps.chord_m[candidates.step]
    renewed = -np.expm1(-2.0 * np.nan_to_num(elapsed) / config.noise_tau_s)
    wander_m2 = survey_m2 * -np.expm1(-2.0 * np.nan_to_num(way) / config.survey_correlation_m)
    wander_m2 += np.where(fixes.estimated[row], (config.estimated_drift * np.nan_to_num(way)) ** 2, 0.0)
    fast_m2 = ((1.0 - config.slow_share) * gnss_m2)[:, None] * hypotheses.scale**2
    variance = fast_m2 + hypotheses.within_m**2 + np.maximum(survey_m2 - common_m2, 0.0)[:, None]
    floor_m2 = np.where(fixes.from_receiver[row], config.offset_floor_m, config.table_floor_m) ** 2
    fresh = np.maximum(fast_m2 * renewed[:, None] + wander_m2[:, None], floor_m2[:, None])
    whole_m2 = gnss_m2 + survey_m2 + config.on_track_bias_m**2
    unexplained = candidates.distance_m > config.on_track_sigmas * np.sqrt(whole_m2)
    off = unexplained & (candidates.distance_m > config.outlier_scale_m)
    direct = _heading(steps, candidates, config) + _height(fixes, row, candidates, survey_m2, config)
    share_new = np.clip(gnss_m2 * renewed + wander_m2, np.minimum(floor_m2, whole_m2), whole_m2) / whole_m2
    return Likelihood(
        hypotheses=hypotheses,
        variance_m2=variance,
        fresh_m2=fresh + _wander_m2(candidates, unexplained, config)[:, None],
        # A survey's error may as well stay what it is: only the position's own error is sure to return.
        keep=np.sqrt(1.0 - fast_m2 * renewed[:, None] / (variance + survey_m2[:, None])),
        renewed_m2=2.0 * (config.sigma_doubt**2) * survey_m2,
        # Two surveys never end at the same place.
        fixed=_ends(candidates, gnss_m2 + survey_m2 + config.survey_sigma_default_m**2, config)
        + direct * share_new
        - _time_off(steps, candidates, off, config),
        direct=direct,
        outlier=config.outlier_probability,
        outlier_scale_m=config.outlier_scale_m,
        return_sigmas=config.return_sigmas,
    )


def initial_score(offset_m: Floats, candidate: Ints, like: Likelihood) -> Floats:
    """Log-likelihood of states without a step before them, per hypothesis: `[state, hypothesis]`."""
    off_m = offset_m[:, None] - like.hypotheses.bias_m
    density = log_density(off_m, np.zeros(1), like.variance_m2[candidate], like)
    return np.asarray(density + (like.fixed + like.direct)[candidate][:, None])


def step_score(before_m: Floats, offset_m: Floats, candidate: Ints, changes: Bools, like: Likelihood) -> Floats:
    """Log-likelihood of states after those of the step before, per hypothesis: `[state, hypothesis]`.

    An error returns towards the bias; one far outside its sigma follows no such law, so no more than the return from
    `return_sigmas` is expected of it, and what counts is how it moves.
    """
    bias_m = like.hypotheses.bias_m
    before = before_m[:, None] - bias_m
    usual = like.return_sigmas * np.sqrt(like.variance_m2[candidate])
    mean = before - (1.0 - like.keep[candidate]) * np.clip(before, -usual, usual)
    fresh = like.fresh_m2[candidate] + np.where(changes, like.renewed_m2[candidate], 0.0)[:, None]
    density = log_density(offset_m[:, None] - bias_m, mean, fresh, like)
    return np.asarray(density + like.fixed[candidate][:, None])


def log_density(offset_m: Floats, mean_m: Floats, variance_m2: Floats, like: Likelihood) -> Floats:
    """Log density of an offset: Gaussian, or with small probability an outlier (Cauchy)."""
    gauss = -0.5 * ((offset_m - mean_m) ** 2 / variance_m2 + np.log(2.0 * np.pi * variance_m2))
    scale = like.outlier_scale_m
    return np.asarray(np.logaddexp(np.log1p(-like.outlier) + gauss, np.log(like.outlier) + _wide(offset_m, scale)))


def _sigma_doubt(fixes: Fixes, steps: Steps, config: MatchingConfig) -> float:
    """How wrong the stated sigmas of most steps may be."""
    stated = float(np.mean(fixes.from_receiver[steps.epoch])) > 0.5
    return config.sigma_doubt if stated else config.table_sigma_doubt


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
    return np.where(lost, (config.off_track_wander * nearest_m) ** 2, 0.0)


def _time_off(steps: Steps, candidates: Candidates, off: Bools, config: MatchingConfig) -> Floats:
    """Cost of a position that lies off the element by what no error explains, by how long it does."""
    elapsed_s = np.minimum(np.nan_to_num(steps.elapsed_s[candidates.step]), config.step_time_s)
    return np.where(off, elapsed_s / config.off_track_s, 0.0)


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
    value = np.maximum(-0.5 * (folded / config.heading_sigma_deg) ** 2, -config.direct_limit)
    moving = steps.speed_mps[candidates.step] >= config.heading_min_speed_mps
    return np.where(moving & np.isfinite(value), value, 0.0)


def _height(fixes: Fixes, row: Ints, candidates: Candidates, survey_m2: Floats, config: MatchingConfig) -> Floats:
    """Log-likelihood of the height over the track, where tracks lie over each other; nothing without heights.

    Tracks at one level differ by superelevation and errors of the survey, which say nothing of the train.
    """
    begin, track_m = candidates.first[:-1], candidates.height_m
    apart_m = np.maximum.reduceat(track_m, begin) - np.minimum.reduceat(track_m, begin)
    above_m = fixes.height_m[row] - track_m
    variance = config.sigma_doubt**2 * fixes.cov_uu_m2[row] + survey_m2 + config.height_bias_sigma_m**2
    value = np.maximum(-0.5 * above_m**2 / variance, -config.direct_limit)
    return np.where((apart_m[candidates.step] >= config.clearance_m) & np.isfinite(value), value, 0.0)
