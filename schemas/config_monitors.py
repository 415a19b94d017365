"""Configuration of the monitor bank."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from schemas.config_base import NonNegative, Number, Positive, Probability, Settings
from schemas.monitors import MONITORS


def threshold_factor(false_alarm_probability: float) -> float:
    """k_T: the Gaussian quantile of the false-alarm probability; 5.3267 for 1e-7.

    Args:
        false_alarm_probability: per sample, two-sided [1].

    Returns:
        k_T in standard deviations [1].

    Source:
        DIAG eq. 17.
    """
    from scipy.special import ndtri  # most commands that read a configuration test nothing

    return float(-ndtri(false_alarm_probability / 2.0))


class MonitorConfig(Settings):
    """Monitor bank (DIAG eq. 1-17; DOMAIN section 3).

    Shares are parts of the receiver's own variance; with their correlation times they make the thresholds (DIAG Table
    1).
    """

    ewma_alphas: tuple[Probability, Probability, Probability] = (0.1, 0.01, 0.001)
    """Weights of the three averages at 1 Hz, falling; columns and monitors keep the names of the defaults.

    DIAG eq. 8; its own set is missing in the text (eq. 9, 16).
    """
    false_alarm_probability: Probability = 1e-7
    """False-alarm probability per sample and monitor; it sets the factor k_T of every threshold.

    1e-7, two-sided Gaussian: k_T 5.3267 (DIAG; DOMAIN section 3).
    """
    ionosphere_share: NonNegative = 0.083
    """Share of the ionosphere in the receiver's variance.

    DIAG Table 1 at 45 degrees.
    """
    ionosphere_tau_s: Positive = 360.0
    """Correlation time of the ionosphere [s].

    DIAG Table 1.
    """
    troposphere_share: NonNegative = 0.014
    """Share of the troposphere in the receiver's variance.

    DIAG Table 1 at 45 degrees.
    """
    troposphere_tau_s: Positive = 1800.0
    """Correlation time of the troposphere [s].

    DIAG Table 1.
    """
    orbit_clock_share: NonNegative = 0.150
    """Share of orbits and clocks in the receiver's variance.

    DIAG Table 1.
    """
    orbit_clock_tau_s: Positive = 3600.0
    """Correlation time of orbits and clocks [s].

    DIAG Table 1.
    """
    user_share: NonNegative = 0.752
    """Share of multipath and receiver noise in the receiver's variance.

    DIAG Table 1.
    """
    user_tau_s: Positive = 100.0
    """Correlation time of multipath and receiver noise [s].

    DIAG Table 1.
    """
    odometer_sigma_mps: Positive = 0.05
    """Odometer noise over one second [m/s]; also used for evidence between reads, and for the re-link.

    DIAG, error models: 0.05 m/s at 1 Hz.
    """
    doppler_sigma_mps: Positive = 0.1
    """Standard deviation of the GNSS velocity along the track [m/s].

    Of plain receivers; `balise calibrate` measures it. Ours.
    """
    doppler_gap_s: Positive = 2.5
    """GNSS velocities farther apart are not integrated to a distance [s].

    One missing epoch of a log at 1 Hz is bridged. Ours.
    """
    satellite_stamp_s: NonNegative = 0.001
    """Largest difference in time between positions and satellites of one epoch [s].

    Stamps differ by rounding. Ours.
    """
    survey_wander_m: NonNegative = 0.3
    """Standard deviation of a 2-D survey without a stated sigma, across the track [m].

    A drawn line is not a survey: healthy runs alarmed without it. Ours.
    """
    survey_wander_length_m: Positive = 100.0
    """Correlation length of `survey_wander_m` [m].

    As for `survey_wander_m`.
    """
    survey_length_m: Positive | None = None
    """Length over which the error of a survey that states its sigma changes [m]; not set: it is constant in place but
    for the steps between net elements.

    DOMAIN section 3: constant in place. A survey drawn from one pass of a receiver changes over some hundred metres:
    with positions of 0.1 m and a survey of 0.3 m that changes over 500 m, 71 % of the epochs alarm without the length,
    1 % with it. Thresholds across and in height grow with it.
    """
    sigma_step_factor: Positive = 1.5
    """A sigma that changes by a larger factor from epoch to epoch is another kind of fix, with another error.

    A gradual change of accuracy is smaller. Ours.
    """
    sigma_intercept_m: NonNegative = 0.0
    """Sigma of a position in the tests = intercept + slope times the stated one [m].

    DIAG regresses thresholds on sigma; `balise calibrate` fits both.
    """
    sigma_slope: Positive = 1.0
    """The slope of `sigma_intercept_m`.

    As for `sigma_intercept_m`.
    """
    noise_along_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    """Fast noise along the track for raw and each of the three averages [m], as measured on other runs: known from the
    first epoch on, it replaces what the run itself shows. Not set: measured in the run.

    DOMAIN section 3; `balise calibrate` prints it. `sigma_intercept_m` and `sigma_slope` scale the smooth errors and
    stand beside it.
    """
    noise_cross_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    """Fast noise across the track [m], as `noise_along_m`.

    As for `noise_along_m`.
    """
    noise_up_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    """Fast noise of the height [m], as `noise_along_m`.

    As for `noise_along_m`.
    """
    noise_first_s: Positive = 30.0
    """Fast noise is not known for this long under way [s]; until then nothing is evaluated and nothing freezes.

    DOMAIN section 3.
    """
    noise_renewal_s: Positive = 10.0
    """Fast noise is measured anew this often [s].

    DOMAIN section 3.
    """
    noise_window_s: Positive = 300.0
    """Fast noise is measured from this last time under way [s], or from `noise_window_lags`.

    DOMAIN section 3.
    """
    noise_window_lags: Positive = 20.0
    """... or from this many lags, if that is longer.

    As for `noise_window_s`.
    """
    noise_spacing_s: Positive = 1.0
    """Second differences are sampled every max(this, L/10) [s].

    300 in a window are enough for the last quantile; every 0.3 s cost twice as much. Ours.
    """
    noise_ready_lags: Annotated[Number, Field(gt=2)] = 7.0
    """A lag counts after this many times its length; before, its noise is expected from the shorter ones.

    DOMAIN section 3.
    """
    noise_longest_lag_s: Positive = 100.0
    """Longer lags are not measured but expected from the shorter ones [s].

    1000 s take two hours to measure. Ours.
    """
    noise_wait_spans: NonNegative = 1.0
    """Samples count after a wait of this many times two lags.

    The onset of a drift shows in samples of two lags: without the wait, one of eight drifts of 0.1 m/s passed 20 m
    unseen. Ours.
    """
    noise_doubt: NonNegative = 1.0
    """This many standard errors of the measured variance are added to it.

    Without it 113, with it 116 of 120 random receivers stayed without an alarm for 4 h
    (`benchmarks.truth.noise`). Ours.
    """
    noise_quantiles: tuple[Probability, ...] = (0.5, 0.95, 0.99)
    """Of second differences, each over its Gaussian value: the largest counts; the last not at the longest lag.

    DOMAIN section 3.
    """
    noise_limit_m: Positive | None = None
    """With more fast noise an axis is not evaluated [m]; not set: `hazards.failure_limit_m` / (2 k_T), 1.88 m.

    A failure would be no more than noise (DOMAIN section 3).
    """
    stated_excess_share: NonNegative = 0.33
    """Part of what second differences show beyond the stated sigma that the variance of the interval grows by.

    Own simulation, 16 h at 1 Hz, sigma 1 m, growth of the interval as median (95 %): healthy receivers 1.00 (1.00),
    with a correlation of 20 s 1.24 (1.44), with a fourth of the variance white 1.20 (1.27), with all of it white 1.70
    (1.84); 2, 3 and 4 times worse than stated 1.71, 2.75 and 3.79. A part of 1/2 gives 1.35 (1.62) at 20 s. DOMAIN
    section 3.
    """
    stated_excess_errors: NonNegative = 2.0
    """This many standard errors of the model are no excess.

    Without them the odometer's scatter widens RTK eightfold. Ours.
    """
    channel_reference: str | None = None
    """The solution that all others are compared with (monitor `channel`).

    Composite fail-safety (LOC Fig. 3) needs two receivers.
    """
    disabled: tuple[str, ...] = ()
    """Names of monitors that are switched off; they are `not_evaluated`.

    To measure the effect of each.
    """

    @property
    def threshold_factor(self) -> float:
        """k_T of every monitor."""
        return threshold_factor(self.false_alarm_probability)

    @field_validator("ewma_alphas")
    @classmethod
    def _fastest_first(cls, alphas: tuple[float, float, float]) -> tuple[float, float, float]:
        """Weights of the averages fall."""
        if not alphas[0] > alphas[1] > alphas[2]:
            raise ValueError(f"found {list(alphas)}; expected three falling weights, the fastest average first")
        return alphas

    @field_validator("disabled")
    @classmethod
    def _monitors_exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        """Names are those of monitors."""
        if unknown := [name for name in names if name not in MONITORS]:
            raise ValueError(f"no monitor is called {', '.join(unknown)}; expected some of {', '.join(MONITORS)}")
        return names
