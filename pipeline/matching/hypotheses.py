"""What stays the same for minutes, and is not known: the bias across the track, and how far to trust stated sigmas.

A thousand epochs 3 m aside are one observation (DOMAIN section 2). So every track is judged under each of a grid of
biases, and a bias that the run has shown on one net element counts on the next. The bias is the run's (antenna, datum),
the element's (its survey, drawn anew on each element) and what of the position's error outlasts minutes (ionosphere,
troposphere, orbit and clock, DIAG Table 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.arrays import Floats
from schemas.config import MatchingConfig

# Grid of the bias in its standard deviations. Half of a spacing is how far the bias scatters about each value, which
# leaves no gaps between them.
_GRID_SIGMAS = np.linspace(-3.6, 3.6, 9)
_WITHIN_SIGMAS = 0.5 * float(_GRID_SIGMAS[1] - _GRID_SIGMAS[0])


@dataclass(frozen=True)
class Hypotheses:
    """Each a bias left of growing path [m] and the true sigma over the stated one.

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
