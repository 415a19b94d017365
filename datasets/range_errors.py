"""Range errors of single satellites: the processes of DIAG Table 1 with the elevation models of DO-229."""

from __future__ import annotations

import numpy as np

from datasets.gnss_errors import gauss_markov
from pipeline.stages.monitors.pseudorange import ionosphere_m2, troposphere_m2
from schemas.arrays import Floats
from schemas.config import NonNegative, Positive, Settings


class RangeErrorSpec(Settings):
    """Error of each range (DIAG Table 1): sigma at zenith or variance, and correlation time, by source.

    `stated_factor` is the sigma that weighs and bounds the ranges over the true one.
    """

    ionosphere_zenith_m: NonNegative = 0.3
    ionosphere_tau_s: Positive = 360.0
    troposphere_zenith_m: NonNegative = 0.12
    troposphere_tau_s: Positive = 1800.0
    orbit_clock_m2: NonNegative = 0.3
    orbit_clock_tau_s: Positive = 3600.0
    user_m2: Positive = 1.5
    user_tau_s: Positive = 100.0
    stated_factor: Positive = 1.0


def range_variances_m2(spec: RangeErrorSpec, elevation_deg: Floats) -> Floats:
    """Variance by source (ionosphere, troposphere, orbit and clock, user), shape (4, ...) [m^2]."""
    ionosphere = ionosphere_m2(elevation_deg, spec.ionosphere_zenith_m)
    troposphere = troposphere_m2(elevation_deg, spec.troposphere_zenith_m)
    level = np.ones_like(troposphere)
    return np.stack([ionosphere, troposphere, spec.orbit_clock_m2 * level, spec.user_m2 * level])


def range_sigma_m(spec: RangeErrorSpec, elevation_deg: Floats) -> Floats:
    """The sigma that the receiver believes [m]."""
    sigma: Floats = spec.stated_factor * np.sqrt(range_variances_m2(spec, elevation_deg).sum(axis=0))
    return sigma


def range_errors_m(spec: RangeErrorSpec, elevation_deg: Floats, step_s: float, rng: np.random.Generator) -> Floats:
    """Errors of all satellites, shape (epochs, satellites) [m]; the variance follows the elevation."""
    taus = (spec.ionosphere_tau_s, spec.troposphere_tau_s, spec.orbit_clock_tau_s, spec.user_tau_s)
    total = np.zeros_like(elevation_deg)
    for variance, tau_s in zip(range_variances_m2(spec, elevation_deg), taus, strict=True):
        total += np.sqrt(variance) * gauss_markov(1.0, tau_s, step_s, elevation_deg.shape, rng)
    return total
