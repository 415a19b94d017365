"""Configuration: frozen models nested by stage, TOML on disk, every default in this one place."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import tomli_w
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from schemas.breaches import told
from schemas.enums import Fix, Origin
from schemas.errors import BaliseError, ConfigError, listed
from schemas.limits import Limits, limits_of, noise_limit_m, scatter_limit_m
from schemas.tables import MONITORS

# Strict: neither text nor true or false is a number.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Probability = Annotated[Number, Field(gt=0, lt=1)]


class Settings(BaseModel):
    """Base of every model read from TOML: unknown keys are refused, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StreamMapping(Settings):
    """How one recorded topic becomes one stream (CONTRACT section 1).

    `fields` maps stream column to recorded field path, `factors` multiplies (unit conversion),
    `constants` fills columns that the log does not hold. `time` is `auto` (the payload's own stamp, else
    the log time), `log`, `publish` or `field:PATH`; numbers there are nanoseconds (integers) or seconds
    (floats) unless `factors.t` gives the seconds per unit, counted from `time_epoch` (of `excel`: days). CSV files may
    name two columns, `field:DATE + TIME`, or with epoch `gps` the week and its seconds; `date_order` says what
    01.02.2025 means where the whole file leaves it open, `time_zone` (IANA) of which place times without a zone are.
    `wrap`: recorded distances begin anew after so much, before `factors`; `frame`: in which the components of recorded
    velocities are, where the message does not say it or says another. A path may be `norm(PATH)`: length of a vector.
    """

    topic: str
    fields: dict[str, str] = {}
    factors: dict[str, float] = {}
    constants: dict[str, str | float | bool] = {}
    fix_codes: dict[str, Fix] = {}
    origin: Origin | None = None
    wrap: Positive | None = None
    frame: str | None = None
    time: str = Field(default="auto", pattern=r"^(auto|log|publish|field:.+)$")
    time_scale: Literal["utc", "gps"] = "utc"
    time_epoch: Literal["unix", "gps", "excel"] = "unix"
    time_zone: str | None = None
    date_order: Literal["auto", "day_first", "month_first"] = "auto"
    solution: str = "primary"


class WrapsConfig(Settings):
    """When a fall of a counter is the end of its bits or digits, and no reset."""

    # Steps over the end that are longer than this share of the counter could as well be a reset.
    sure_share: Probability = 0.01
    # Of 1,000 random resets 4 look like the end of a counter of 1,000 or 10,000 counts, hardly one like a larger one's.
    sure_size: Positive = 16_384.0
    # A counter that falls by less than this share of its counts was set.
    named_share: Probability = 0.9
    # Trains brake and accelerate within ten rows by less than this.
    times_longer: Annotated[Number, Field(ge=1)] = 2.0
    # A recorder that paused for so many usual steps may have set its counter meanwhile.
    pause_steps: Annotated[Number, Field(gt=1)] = 2.5


Shift = Annotated[Number, Field(ge=-1e6, le=1e6)]  # [m]


class StreamCorrection(Settings):
    """Corrections of a recorded stream, made right after reading, for any kind of file.

    First two columns are exchanged, a distance that begins anew after `wrap` is counted on, then `factors` multiply,
    `shift_s` is added to the times and `shift_*_m` to the positions. `solution`: of GNSS and satellites only this one.
    """

    stream: Literal["gnss", "odometer", "satellites", "reference", "balise_reads"]
    solution: str | None = None
    exchange: tuple[str, str] | None = None
    wrap: Positive | None = None
    factors: dict[str, Number] = {}
    shift_s: Annotated[Number, Field(ge=-9e9, le=9e9)] = 0.0  # what 64 bits of nanoseconds hold
    shift_east_m: Shift = 0.0
    shift_north_m: Shift = 0.0
    shift_up_m: Shift = 0.0

    @property
    def moves(self) -> bool:
        """It moves positions: a constant error of the receiver could be meant as well as another datum."""
        return bool(self.shift_east_m or self.shift_north_m or self.shift_up_m)

    @property
    def changes(self) -> str:
        """What it changes, in the words of the configuration."""
        changed = self.model_dump(exclude_defaults=True, exclude={"stream"})
        return ", ".join(f"{name} {value}" for name, value in changed.items())


class IngestConfig(Settings):
    """Which topics feed which stream (empty: recognised by schema name), and limits of plausible values."""

    gnss: tuple[StreamMapping, ...] = ()
    odometer: tuple[StreamMapping, ...] = ()
    satellites: tuple[StreamMapping, ...] = ()
    reference: tuple[StreamMapping, ...] = ()
    balise_reads: tuple[StreamMapping, ...] = ()
    # A damaged length must not fill the memory; recorders write chunks of a few MiB.
    chunk_limit_mib: Positive = 128.0
    # What one archive may unpack to, archives in it included: a day's logs, not a disk.
    unpacked_limit_mib: Positive = 4096.0
    unpacked_files_limit: Annotated[int, Field(strict=True, gt=0)] = 10_000
    # Text logs pack to a tenth, a train that stands all night to a hundredth; what packs better was made to.
    unpacked_ratio_limit: Annotated[Number, Field(ge=1)] = 300.0
    unpacked_limit_s: Positive = 900.0
    # Rows are held in memory: five receivers at 10 Hz for four days. A file can declare any number of them.
    rows_limit: Annotated[int, Field(strict=True, gt=0)] = 20_000_000
    # No train is under way for a week; memory follows the time, so that a wrong date must not make a journey.
    longest_journey_h: Annotated[Number, Field(gt=0, le=8_784)] = 168.0
    # A receiver before its first fix, or a week rollover, affects few rows; more is another recording. Ours.
    wrong_dates_share: Annotated[Number, Field(ge=0, lt=1)] = 0.1
    wraps: WrapsConfig = WrapsConfig()
    correct: tuple[StreamCorrection, ...] = ()
    # Impossible values of a known cause fail a run (`fail`), or are reported and leave it unproven (`warn`).
    plausibility: Literal["fail", "warn"] = "fail"
    # A nearer wrong position may be a fault; a default place or 0/0 is thousands of kilometres away.
    placeholder_far_m: Positive = 10_000.0
    # Nobody runs trains so near to 0/0, in the Gulf of Guinea.
    placeholder_origin_deg: NonNegative = 0.01
    # A receiver looks for its first fix over this share of the run at most, or so long.
    first_fix_share: Probability = 0.2
    first_fix_s: NonNegative = 900.0

    @model_validator(mode="before")
    @classmethod
    def _one_table_or_many(cls, data: object) -> object:
        if not isinstance(data, Mapping):
            return data
        alone = {"wraps"}
        return {
            key: [value] if isinstance(value, Mapping) and key not in alone else value for key, value in data.items()
        }


class PlausibilityConfig(Settings):
    """Whether the streams of a run can be of one journey: what is reported, and what no train can have."""

    # Worn wheels count 4 % too much, bad radars 6 %; the nearest wrong unit (yards) 9 %.
    scale_limit: Probability = 0.08
    scale_told: Probability = 0.03
    # Receivers and buses are late by 2 s at most; the nearest wrong clock (leap seconds) is 18 s off.
    lag_limit_s: Positive = 5.0
    # 0.3 s at 40 m/s is more than half the failure limit of 20 m.
    lag_told_s: Positive = 0.3
    # Positions without corrections are within 5 m of the track, 95 %; a shift above half of `ci_limit_m` is reported.
    shift_told_m: Positive = 8.0
    # A vehicle file may differ from the run by so many of its own sigmas, and by this scale at least.
    file_sigmas: Positive = 4.0
    file_scale: Probability = 0.005
    # Positions farther from every track are of another place; a yard lies within it.
    same_line_m: Positive = 2_000.0
    # Of a copy so many places are equal to the last digit, and at most so often would an independent record's be.
    copy_share: Probability = 0.8
    copy_chance: Probability = 0.01


class FixSigma(Settings):
    """Horizontal sigma by kind of fix where the receiver gives no covariance (DOMAIN section 3)."""

    # Ours: receivers of these kinds, 68 %; TVB section 5 asks for 1.1 m at 95 %.
    autonomous_m: Positive = 2.0
    differential_m: Positive = 1.0
    sbas_m: Positive = 1.0
    rtk_float_m: Positive = 0.5
    rtk_fixed_m: Positive = 0.1
    estimated_m: Positive = 5.0
    # Satellites are above the horizon only.
    vertical_factor: Positive = 1.5
    # Coordinates written down in finer steps add nothing: those drown in the noise of any receiver.
    digits_least_m: NonNegative = 0.02

    def horizontal_m(self, fix: Fix) -> float | None:
        """Sigma per horizontal axis [m], none for an epoch without fix."""
        value: float | None = getattr(self, f"{fix.value}_m", None)
        return value


class MatchingConfig(Settings):
    """Which paths positions do not reject, and which of them is shown (DOMAIN section 2)."""

    # Farther than any sigma that can still tell tracks apart; DOMAIN section 2.
    reach_m: Positive = 50.0
    # A position is on the track within so many standard deviations of position, survey and bias together.
    on_track_sigmas: Positive = 3.0
    # The bias in that. Not `cross_bias_sigma_m`: an exact reference 0.3 m off the axis is on the track.
    on_track_bias_m: NonNegative = 1.5
    # DIAG, error models: track survey 1 m.
    survey_sigma_default_m: Positive = 1.0
    # Of one run, the same on every element: antenna beside the middle of the vehicle, datum (DOMAIN section 2).
    cross_bias_sigma_m: Positive = 1.5
    # Level of the nine tests of a path together, in 600 s. By offset 0.3 of 1,000 runs beside another track claim that
    # one (simulated; 0.5 at 0.05, which makes a third more claims by offset).
    paths_alpha: Probability = 0.02
    # So long the test of a position waits for those after it, which say whether it is an outlier.
    paths_delay_s: NonNegative = 3.0
    # By so much the variance of a movement, measured along the track, may be too small: it is one of few windows.
    paths_measured_factor: Annotated[Number, Field(ge=1)] = 1.5
    # An empty set begins anew within the first minute of a run: the first positions of a receiver settle. As long it
    # claims nothing then: what refuted every path may have errors larger than stated. Not after every outage: of 60
    # runs with a fault across the tracks from an outage on, 12 would claim another track, none does. As long before the
    # end of a stretch that ends off the network, refuted paths are alike.
    paths_anew_s: NonNegative = 60.0
    # A mean over so long is an offset. Later a set begins anew where such a mean has moved back beside the same line
    # to where it was, within so many sigmas.
    paths_level_s: Positive = 8.0
    paths_back_sigmas: Positive = 1.0
    # Two paths to one element with residuals as near each other as this cannot be told apart.
    paths_alike_m: NonNegative = 0.1
    # A place is known within so many sigmas along the track: near a branch nobody knows on which side of it the train
    # is, and past an open end a path goes on for as much, and for this much more. So far before an element may begin.
    paths_along_sigmas: NonNegative = 3.0
    paths_end_m: NonNegative = 10.0
    # Behind a switch that a path came over its branches are one track until they are so far apart: nearer than the
    # gauge of 1.435 m they share rails.
    paths_one_track_m: NonNegative = 1.5
    # Over a longer step the train may have taken any way of at most this share and margin more than the distance. Of
    # several the one is shown that agrees with it best; the margin is ten sigmas of that: 5 m and 2 % of an odometer.
    paths_gap_s: Positive = 3.5
    detour_share: NonNegative = 0.2
    detour_m: Positive = 50.0
    # More hypotheses than began in 600 s of any run (200 beside a double track): beyond them nothing is claimed.
    paths_limit: Annotated[int, Field(strict=True, gt=0)] = 5000
    # Reflections follow no error model: a position counts as one of so many sigmas at most, or one decides the track.
    outlier_sigmas: Positive = 4.0
    # The path shown goes over to a track that no relation leads to, or against navigability, only where positions off
    # it would last longer than this: receivers that are lost show another track for seconds.
    break_s: Positive = 30.0
    # Heights tell tracks apart that lie over each other by so much: a train needs a clearance of 4.5 m and more.
    # The bias is that of datum and antenna: one that the vehicle file does not know stands some 4 m over the rail.
    clearance_m: Positive = 3.0
    height_bias_sigma_m: Positive = 2.0
    # DOMAIN section 2: the noise of a standing train is no turn; the first 20 m of net movement orient the path.
    deadband_mps: Positive = 0.3
    orientation_distance_m: Positive = 20.0


class AlignConfig(Settings):
    """Odometer against GNSS (DOMAIN section 3), and the causal filter of scale and latency."""

    # DOMAIN section 3: slow errors have changed meanwhile.
    gap_reset_s: Positive = 60.0
    # A pause of the recording inside which the way is not known: longer than this, and than so many periods. Loggers
    # drop single rows at any rate.
    odometer_gap_s: Positive = 1.0
    odometer_gap_periods: Positive = 2.5
    # No train is faster: the speed record is 160 m/s.
    fastest_mps: Positive = 200.0
    # Neighbouring steps of a counter differ by no more than braking and acceleration allow, the rows' own scatter, two
    # counts and this: the odometer's fixed error (SUBSET-041 5.3.1.1). Rows stamped in bunches gain some metres in no
    # time.
    leap_m: NonNegative = 5.0
    bunched_stamps_m: NonNegative = 20.0
    # With fewer steps between two such places the counter was reset or wrong there: recorders that restart may set it
    # back at several rows one after the other.
    leap_steps: Annotated[int, Field(strict=True, gt=1)] = 4
    # Smaller leaps than `leap_m` stay counted, but are in doubt from here on: a tenth of the fixed error.
    near_leap_m: NonNegative = 0.5
    # Over a reset between two rows the speed about it counts where braking x dt^2 / 4 is no more than this, as at 1 Hz:
    # a tenth of the odometer's fixed error.
    reset_doubt_m: NonNegative = 0.5
    # Speeds give the distance over such a jump if, so far, they differed from it by a smaller share: another unit or
    # sign differs by more than a half, slip and scale by some percent. Once they agree, more contradicts it.
    speed_agreement: Probability = 0.2
    # Between rows no farther apart a straight line is within 0.5 m of a train that brakes as hard as this, which
    # is an emergency brake.
    straight_s: Positive = 1.5
    braking_mps2: Positive = 1.8
    # An odometer with a larger sigma says itself that it slips: three of these are the 2 km/h to which SUBSET-041
    # 5.3.1.2 holds it at low speed.
    slip_sigma_mps: Positive = 0.185
    # By what share of the way a wheel that slips or slides may miscount: anti-slip control keeps it below, ours.
    slip_way_share: Probability = 0.1
    # The same of another odometer that does not slip: 0.8 % of scale was seen in recorded runs (DOMAIN section 3).
    other_way_share: Probability = 0.01
    # Smaller steps of a counter do not count: they scatter less than the white noise of one second.
    counter_step_m: Positive = 0.05
    # Scatter of rows is quantisation noise where it is beyond so many times what white noise explains: the median of
    # 400 pieces is within 10 % of its mean.
    quantisation_factor: Positive = 2.0
    # Over so long, or over eight rows where that is longer, the way of a train is a curve of third degree.
    quantisation_span_s: Positive = 2.0
    # 0.8 % of scale and 83 ms of latency were seen in recorded runs (DOMAIN section 3).
    scale_prior_sigma: Positive = 0.01
    latency_prior_sigma_s: Positive = 0.2
    # Errors of a position hardly change in less (DIAG Table 1).
    filter_period_s: Positive = 1.0
    # Stamps that scatter make no gap by themselves: the first position after one that they made is always late.
    scattered_gap_sigmas: NonNegative = 3.0
    # Prior probability that a position is offset after a long gap: a wrong scale with a small sigma is worse than slow
    # learning. A receiver bridges seconds, and restarts after half a minute or so. With the same probability for single
    # missing epochs, almost nothing would be learned from noisy positions.
    break_moved_probability: Probability = 0.8
    break_moving_s: Positive = 30.0
    # Time constant with which such an offset settles: fits positions that settle over 10 to 60 s. With more, a drift
    # that begins meanwhile would be learned as scale.
    settling_tau_s: Positive = 25.0
    # More standard deviations than this are not noise of odometer or reference: two-sided Gaussian 1e-7, as k_T of the
    # monitors by default. It does not follow k_T: the odometer does not depend on the alarm rate.
    sure_sigmas: Positive = 5.3267
    # A speed is a mean over this time: single rows are mostly noise (DOMAIN section 2).
    speed_window_s: Positive = 1.0
    # Latency is learned from changes of speed. Over less time before and after an epoch, noise looks like such changes:
    # at constant speed the filter would become sure of any latency.
    latency_span_s: Positive = 2.0
    # Receivers show a little noise without memory beside the modelled one: this share of the variance.
    white_share: Probability = 0.01
    # A step of the stamps over more periods is not used for the receiver's clock: it may have restarted.
    clock_periods: Positive = 3.0


def threshold_factor(false_alarm_probability: float) -> float:
    """k_T: two-sided Gaussian quantile of the false-alarm probability (DIAG eq. 17); 5.3267 for 1e-7."""
    from scipy.special import ndtri  # most commands that read a configuration test nothing

    return float(-ndtri(false_alarm_probability / 2.0))


class MonitorConfig(Settings):
    """Monitor bank (DIAG eq. 1-17; DOMAIN section 3)."""

    # DIAG eq. 8; the paper's own set is missing in the text (eq. 9, 16).
    ewma_alphas: tuple[Probability, Probability, Probability] = (0.1, 0.01, 0.001)
    # Per sample and monitor, two-sided Gaussian: k_T 5.3267 (DIAG; DOMAIN section 3).
    false_alarm_probability: Probability = 1e-7
    # Shares of the variance at 45 degrees, and correlation times: DIAG Table 1.
    ionosphere_share: NonNegative = 0.083
    ionosphere_tau_s: Positive = 360.0
    troposphere_share: NonNegative = 0.014
    troposphere_tau_s: Positive = 1800.0
    orbit_clock_share: NonNegative = 0.150
    orbit_clock_tau_s: Positive = 3600.0
    user_share: NonNegative = 0.752
    user_tau_s: Positive = 100.0
    # DIAG, error models: 0.05 m/s at 1 Hz.
    odometer_sigma_mps: Positive = 0.05
    # Of plain receivers; `balise calibrate` measures it.
    doppler_sigma_mps: Positive = 0.1
    # Velocities farther apart are not integrated to a distance: one missing epoch of a log at 1 Hz is bridged.
    doppler_gap_s: Positive = 2.5
    # Stamps of positions and of satellites that belong together may differ by rounding.
    satellite_stamp_s: NonNegative = 0.001
    # A drawn line is not a survey: 2-D surveys without a sigma wander across the track.
    survey_wander_m: NonNegative = 0.3
    survey_wander_length_m: Positive = 100.0
    # The error of a survey that states its sigma: constant in place (DOMAIN section 3), but for the steps between net
    # elements. With a length it also changes along the track, by all of the sigma over some of these lengths.
    survey_length_m: Positive | None = None
    # A sigma that changes by a larger factor between two epochs is another kind of fix, not a drift of the accuracy.
    sigma_step_factor: Positive = 1.5
    # DIAG regresses thresholds on sigma; `balise calibrate` fits both.
    sigma_intercept_m: NonNegative = 0.0
    sigma_slope: Positive = 1.0
    # The fast noise of an axis [m], for raw and each average, as measured on other runs: it holds from the first epoch
    # on, and replaces what the run itself shows (DOMAIN section 3). Not set: measured in the run.
    noise_along_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    noise_cross_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    noise_up_m: tuple[NonNegative, NonNegative, NonNegative, NonNegative] | None = None
    # DOMAIN section 3: not known before so long under way; renewed so often; from the last minutes, or lags.
    noise_first_s: Positive = 30.0
    noise_renewal_s: Positive = 10.0
    noise_window_s: Positive = 300.0
    noise_window_lags: Positive = 20.0
    # Samples of the short lags are no closer: 300 in the window are enough for the last quantile.
    noise_spacing_s: Positive = 1.0
    # A lag counts after so many of itself. Longer ones than this take longer than a run lets them: they are expected
    # by how the noise grows over the shorter ones.
    noise_ready_lags: Annotated[Number, Field(gt=2)] = 7.0
    noise_longest_lag_s: Positive = 100.0
    # The onset of a drift shows in samples of two lags; they wait so many times that before they count.
    noise_wait_spans: NonNegative = 1.0
    # So many standard errors are added: of 120 random receivers 116 stayed without an alarm for 4 h, without it 113.
    noise_doubt: NonNegative = 1.0
    # Of the second differences: the largest of these over their Gaussian values; the last needs more samples than the
    # longest lag has.
    noise_quantiles: tuple[Probability, ...] = (0.5, 0.95, 0.99)
    # More, and a failure would be no more than noise; not set: `failure_limit_m` / (2 k_T), 1.88 m.
    noise_limit_m: Positive | None = None
    # Of what second differences show beyond the stated sigma and so many standard errors of their model, this part is
    # added to the variance of the confidence interval (DOMAIN section 3). Own simulation, 16 h at 1 Hz, sigma 1 m: a
    # healthy receiver's interval grows 1.00 times (median over time; 95 %: 1.00), with a correlation of 20 s 1.24
    # (1.44), with a fourth of the variance white 1.20 (1.27), all white 1.70 (1.84); of receivers 2, 3 and 4 times
    # worse than stated 1.71, 2.75 and 3.79 times. With 1/2: 1.35 (1.62) at 20 s. RTK of 2 cm: 1.00 (1.00), beside a map
    # whose length wiggles by 3e-4 1.00 (3.39); without the standard errors 8.2, of the scatter of the odometer alone.
    stated_excess_share: NonNegative = 0.33
    stated_excess_errors: NonNegative = 2.0
    # The second receiver of composite fail-safety (LOC Fig. 3).
    channel_reference: str | None = None
    disabled: tuple[str, ...] = ()

    @property
    def threshold_factor(self) -> float:
        """k_T of every monitor."""
        return threshold_factor(self.false_alarm_probability)

    @field_validator("ewma_alphas")
    @classmethod
    def _fastest_first(cls, alphas: tuple[float, float, float]) -> tuple[float, float, float]:
        if not alphas[0] > alphas[1] > alphas[2]:
            raise ValueError(f"found {list(alphas)}; expected three falling weights, the fastest average first")
        return alphas

    @field_validator("disabled")
    @classmethod
    def _monitors_exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if unknown := [name for name in names if name not in MONITORS]:
            raise ValueError(f"no monitor is called {', '.join(unknown)}; expected some of {', '.join(MONITORS)}")
        return names


class LdsConfig(Settings):
    """Virtual and travelling virtual balises (DOMAIN section 4)."""

    # Of several odometers the one that the LDS uses; all of them are evidence (DOMAIN section 5.1).
    odometer_sensor: str = "primary"
    # 3InSat's requirement for the most demanding operation (LOC section I).
    ci_limit_m: Positive = 14.0
    # HPL of NPA: K_H 6.18 (RTCA DO-229); few receivers give a protection level themselves.
    ci_factor: Positive = 6.18
    ci_source: Literal["sigma", "hpl"] = "sigma"
    # Times of return and initialisation, and re-arming at a stand: DOMAIN section 4, ours.
    recovery_s: Positive = 30.0
    init_s: Positive = 10.0
    rearm_m: Positive = 10.0
    rearm_sigmas: NonNegative = 3.0
    # SUBSET-041 5.3.1.1: 5 m + 5 % of the distance.
    odometer_fixed_m: NonNegative = 5.0
    odometer_share: Annotated[Number, Field(ge=0, lt=1)] = 0.05
    # A crossing inside a longer gap is only interpolated (DOMAIN section 4).
    crossing_gap_s: Positive = 1.0
    # Insertion is the more dangerous failure there (TVB section 5).
    entry_from_unfitted_area: bool = False
    # Times at which the LDS restarts, without LRVB and linking (DOMAIN section 4, initialisation).
    starts_of_mission: tuple[AwareDatetime, ...] = ()
    # Off: a negated position never returns (DOMAIN section 4).
    relink: bool = True


class HazardConfig(Settings):
    """Hazard classes and budgets (DOMAIN section 5)."""

    # DIAG: 20 m for position failure and shift; a jump the same.
    failure_limit_m: Positive = 20.0
    shift_limit_m: Positive = 20.0
    jump_limit_m: Positive = 20.0
    # So that the class does not depend on the rate of the log (DOMAIN section 5.3).
    jump_window_s: Positive = 1.0
    # A jump over several epochs reaches from its first to its last step of at least this share of the largest one: two
    # halves belong together, noise does not.
    jump_share: Probability = 0.3
    # Noise at the limit is neither a failure nor its end (DOMAIN section 5.3).
    failure_hold_s: NonNegative = 1.0
    episode_end_s: NonNegative = 10.0
    # Monitors see a drift before its error can be told from noise (DOMAIN section 5.3).
    alarm_lead_s: NonNegative = 30.0
    # From detection to negation; not set: one epoch, for the failing one has been used already.
    reaction_s: NonNegative | None = None
    # Errors of a healthy position; a slow average may alarm minutes after its cause (DOMAIN section 5.3).
    false_alarm_margin_m: NonNegative = 5.0
    false_alarm_lookback_s: NonNegative = 300.0
    # Half-width of evidence in its sigmas, and the sigma of a reference that states none (DOMAIN section 5.1).
    evidence_factor: Positive = 3.0
    reference_sigma_m: Positive = 1.0
    # Level of the tests of a path against the reference, in 600 s: a true track that is lost makes a false `wrong`. It
    # was lost in 0 of 450 runs for 5 s or more at 0.001 as at 0.05; what 0.001 keeps are sidings that no survey has.
    reference_alpha: Probability = 0.01
    # Of a survey that states no sigma (DOMAIN section 5.1).
    survey_sigma_m: Positive = 1.0
    # A lag between recorders that is known less closely counts as not measured (DOMAIN section 5.1): 2 m for a tram.
    evidence_clock_s: Positive = 0.1
    # A train that brakes by 1 m/s2 leaves a straight line by 0.5 m in 2 s.
    reference_gap_s: Positive = 2.0
    # Behind an open end a track may go on unsurveyed: sidings are as long as the longest trains (740 m on the TEN-T
    # network, Regulation (EU) 2024/1679) and their switches.
    open_end_m: NonNegative = 1000.0
    # A reference on no track left its track over a switch that the survey lacks: within so much way the longest ones
    # (1:18.5 and a curve of 1200 m) have led it 4 m aside.
    reference_leaves_m: NonNegative = 120.0
    # If no way between two known places is within the odometer's confidence, ways that differ from its distance by no
    # more than this are taken: slip may be that large. A limit of the search: beyond it position and track are unknown.
    slip_m: NonNegative = 200.0
    slip_share: Annotated[Number, Field(ge=0, lt=1)] = 0.5
    # With more chains of net elements between two known places, position and track are unknown there.
    routes_limit: Annotated[int, Field(strict=True, gt=0)] = 64
    # Without an odometer the direction of travel is that of the evidence over this time.
    turn_s: Positive = 2.0
    # `suspect` uses the data from this long before alarm or hazard.
    suspect_lookback_s: NonNegative = 60.0
    # Of the read itself; Q_LOCACC of the site belongs to the linking information (DOMAIN section 5.1).
    balise_read_sigma_m: Positive = 1.0
    # An error known less closely is not given as a number (DOMAIN section 5.2).
    known_error_m: Positive = 5.0
    # Without diagnosis (P3) for more of the moving time in use a run is `unproven` (DOMAIN section 5.4).
    undiagnosed_share: Probability = 0.01
    # Ours: alarms across the track of several runs that begin so near each other are of one place of the map.
    map_reach_m: Positive = 100.0
    # LPV-200 is the guaranteed service (LOC uses no other).
    service_level: str = "lpv200"

    @property
    def limits(self) -> Limits:
        """What is compared with these limits, by the name of the question."""
        return limits_of(self)


class EvidenceConfig(Settings):
    """What the evidence may take for granted (DOMAIN section 5.0)."""

    # The survey holds every track that the train may have used: no position can tell, somebody has to say so.
    survey_complete: bool = False
    # Axes of neighbouring tracks lie 3.5 m apart and more on old lines (4.0 m on new ones), less a survey's rounding;
    # many trams run closer: smaller there.
    track_spacing_m: Positive = 3.4
    # An odometer of which the positions predict the steps to this part of what it or they leave unexplained alone is
    # made of them (V of DOMAIN section 5.0); independent ones stay above by own simulation (`benchmarks/follows.py`).
    follows_limit: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    # A stated sigma is refuted where the evidence shows errors beyond `lds.ci_factor` of it in more than this part of
    # so many epochs at least; it is too large where none of them reaches this part of it (DOMAIN section 3). Shown is
    # what is left of an error without this part of what the evidence leaves possible, which is 5 m and 5 % between
    # reads: healthy odometers and reads err by less than 1 m and 1 %, RTK must not be blamed for them.
    sigma_refuted_share: Probability = 0.01
    sigma_evidence_part: Annotated[Number, Field(ge=0, le=1)] = 0.2
    sigma_epochs_least: Annotated[int, Field(ge=1)] = 300
    sigma_too_large: Annotated[Number, Field(gt=1)] = 5.0
    # Fewer steps show nothing: a prediction fits 73 numbers to them.
    follows_steps_least: Annotated[int, Field(ge=200)] = 300
    # More, spread over the run, cost more time than they add: the figure is a quantile.
    follows_steps_most: Annotated[int, Field(ge=200)] = 2000
    # At stands of so much together steps of 1 s are correlated; slower than this, by the positions, is a stand.
    follows_stand_s: Positive = 20.0
    follows_stand_mps: Positive = 0.1
    # A correlation is found beyond this, and beyond so many of its sigmas: 3e-7 for two independent recorders.
    follows_correlation: Annotated[Number, Field(gt=0, lt=1)] = 0.3
    follows_sigmas: Positive = 5.0
    # Over so much of the way a reference is held against its track by the median: some hundred samples at 10 Hz.
    survey_window_m: Positive = 200.0


class UndetectedConfig(Settings):
    """The largest error that no monitor would have noticed (DOMAIN section 5.6)."""

    # A second or so for an hour of run: asked for, as `replay --undetected`.
    compute: bool = False
    # The fastest fault of DIAG's simulation; only where nothing looks on does it decide.
    max_rate_mps: Positive = 5.0
    # What says, independently of GNSS, that the position was right; a fault began after the last of them.
    fixes: tuple[Literal["read", "reference"], ...] = ("read",)
    # `all`: the fault is in every solution, and comparing two of them shows nothing. `one`: in this one alone.
    solutions_at_fault: Literal["all", "one"] = "all"
    # Physical balises are thought of at epochs so far apart, to find their largest spacing.
    spacing_step_s: Positive = 60.0
    # ... and at more of them until it is known to this share: never too large, by so much too small at most.
    spacing_close_share: Annotated[Number, Field(gt=0, lt=1)] = 0.1
    # ... but at none nearer than this: no line has physical balises so close, and each epoch takes milliseconds.
    spacing_resolution_s: NonNegative = 10.0
    # A test of the position itself is looked back at over so long: until then the bank has learned as much.
    look_back_s: Positive = 60.0
    # A monitor holds a bound if it pays for this share of it at least.
    holding_share: Probability = 0.01
    # A curve hides this share of a fault at most: of positions farther beside it nothing could be said any more.
    hidden_share: Probability = 0.5


class CalibrationConfig(Settings):
    """What `balise calibrate` measures from."""

    # A standard deviation from so many is known to 7 %, if they were independent.
    least_epochs: Annotated[int, Field(strict=True, gt=0)] = 100
    # Standard errors of the sigmas come from leaving out one run, or one piece of a few runs, of so many: epochs are
    # correlated over minutes, so pieces have to be long.
    left_out_pieces: Annotated[int, Field(strict=True, ge=2)] = 8
    # With a sigma that varies by a smaller share, intercept and slope cannot be told apart.
    sigma_spread_share: Probability = 0.05
    # `balise replay --calibrate`: with fewer runs nobody knows how far a further one may lie from them.
    least_runs: Annotated[int, Field(strict=True, ge=2)] = 2
    # A wheel wears by a tenth of this in a campaign of weeks; two vehicles mostly differ by more.
    same_vehicle_scale: Positive = 0.01
    # The runs that the monitors and the vehicle were calibrated by: filled in by `balise replay --calibrate`.
    runs: tuple[str, ...] = ()


class SiteConfig(Settings):
    """What is broken in a site, and what is remarkable."""

    # Ends that a relation joins and that lie farther apart make the path position wrong by a position failure (20 m).
    joined_m: Positive = 20.0
    # Free ends are one place within the first, and one track with a piece missing if they face each other within the
    # second; a curve turns by 20 degrees at most in between.
    near_ends_m: Positive = 5.0
    facing_m: Positive = 300.0
    facing_cosine: Probability = 0.94
    # A corner into an element of less than half a metre is a finding from so much on: no track turns so, points do.
    kink_deg: Positive = 20.0
    # A declared length is that of the geometry within this share: 3-D against 2-D on a grade of 4 %.
    length_share: Probability = 1e-3
    # Straight lines between points leave the curve by this: a quarter of the survey's own sigma.
    chord_m: Positive = 0.25
    # Half a UTM zone: lines that cross a border stay in one system of coordinates.
    beyond_area_deg: Positive = 3.0
    # Balises are announced from so far back: more than twice their longest spacing (DOMAIN section 4).
    announced_m: Positive = 6000.0
    # Where tracks part or cross they are beside each other for less: that is told of no site.
    parallel_least_m: NonNegative = 100.0


class SurveyConfig(Settings):
    """A site from a survey of the line (`balise site`)."""

    # 100 MB hold some two million points: more is no line that a person checks.
    size_limit_mb: Annotated[Number, Field(gt=0, le=100_000)] = 100.0
    # Two places that are nearer are one; maps write seven decimals of a degree, 1 cm.
    same_place_m: Positive = 0.05
    # Tracks lie 3.5 m and more apart, RTK scatters by centimetres: lines that are nearer are one track.
    same_track_m: Positive = 1.5
    # Lines and their lengths keep to this.
    shape_m: Positive = 0.1
    # A stop shrinks to one point: the next counts that is as far away, and farther than the noise reaches.
    stop_m: Positive = 1.0
    stop_sigmas: Positive = 6.0
    # Farther than any train gets in a second or two, and than so many usual steps: nothing was recorded in between.
    gap_m: Positive = 100.0
    gap_steps: Positive = 10.0
    # Behind a switch of 300 m radius the branch is 1.5 m aside after 30 m: there the toe is looked for. What is shorter
    # is the noise of a pass that was left out.
    toe_m: Positive = 30.0
    # At a switch the branches lie within some 12 degrees (1:4.5); maps draw it up to 45.
    switch_deg: Positive = 45.0
    # No track turns by so much at a point; a sideways step of so much on a curve of so small a radius is none either.
    kink_deg: Positive = 20.0
    kink_radius_m: Positive = 60.0
    kink_aside_m: Positive = 0.3
    # The branches of the longest switches (radius 1,200 m) part as far as `same_track_m` within 60 m.
    doubled_m: Positive = 100.0
    # A corner is a kink too if it turns by so much on a curve that no track has; less is how dense surveys scatter.
    corner_deg: Positive = 8.0
    # Kilometres are posts, not lengths: so far they stray from the track between two points, in metres or by share.
    kilometre_m: Positive = 20.0
    kilometre_share: Probability = 0.05
    # Lists of balises give the track's axis or the marker beside it; farther is another line, or system of coordinates.
    balise_beside_m: Positive = 10.0


class ServiceLevel(Settings):
    """Hazard rate of a signal-in-space service: `integrity_risk` per `exposure_s`."""

    integrity_risk: Positive
    exposure_s: Positive

    @property
    def hazard_rate_per_h(self) -> float:
        return self.integrity_risk * 3600.0 / self.exposure_s


class SafetyConfig(Settings):
    """Safety budget (DOMAIN section 6)."""

    # TVB section 3.
    thr_vb_per_h: Positive = 0.67e-9
    # TVB section 5; LOC section V (horizontal signal in space).
    service_levels: dict[str, ServiceLevel] = {
        "npa": ServiceLevel(integrity_risk=1e-7, exposure_s=3600.0),
        "lpv200": ServiceLevel(integrity_risk=2e-7, exposure_s=150.0),
        "egnos_observed": ServiceLevel(integrity_risk=6e-8, exposure_s=150.0),
        "horizontal_sis": ServiceLevel(integrity_risk=1e-9, exposure_s=150.0),
    }
    # The published budget has one; 64 to 400 at 160 km/h (DOMAIN section 6).
    demands_per_hour: Positive = 1.0
    # None is published; SIL 4 (DOMAIN section 6).
    diagnosis_hazard_rate_per_h: Positive = 1e-9

    def allowed_time_to_detect_s(self, level: str) -> float:
        """Allowed T_D [s] = THR_VB / (HR_GNSS per hour) (TVB eq. 7), per demand of the hour."""
        rate = self.service_levels[level].hazard_rate_per_h * self.demands_per_hour
        return self.thr_vb_per_h / rate * 3600.0


class AdviceConfig(Settings):
    """From which loss on `runs.remedies` names a cure (DOMAIN section 5.4)."""

    # A healthy run loses some time at its start. Ours.
    low_availability: Probability = 0.9
    # Of the moving time; a smaller loss is not worth a cure of its own. Ours.
    lost_share: Probability = 0.02


class Configuration(Settings):
    """The whole of a replay's configuration."""

    ingest: IngestConfig = IngestConfig()
    plausibility: PlausibilityConfig = PlausibilityConfig()
    fix_sigma: FixSigma = FixSigma()
    matching: MatchingConfig = MatchingConfig()
    align: AlignConfig = AlignConfig()
    monitors: MonitorConfig = MonitorConfig()
    lds: LdsConfig = LdsConfig()
    hazards: HazardConfig = HazardConfig()
    safety: SafetyConfig = SafetyConfig()
    evidence: EvidenceConfig = EvidenceConfig()
    undetected: UndetectedConfig = UndetectedConfig()
    site: SiteConfig = SiteConfig()
    survey: SurveyConfig = SurveyConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    advice: AdviceConfig = AdviceConfig()

    @model_validator(mode="after")
    def _level_exists(self) -> Self:
        if self.hazards.service_level not in self.safety.service_levels:
            known = ", ".join(sorted(self.safety.service_levels))
            raise ValueError(f"hazards.service_level {self.hazards.service_level!r} is none of {known}")
        return self

    @property
    def noise_limit_m(self) -> float:
        """The largest fast noise with which a position failure still shows (DOMAIN section 3) [m]."""
        least = noise_limit_m(self.hazards.limits.failure_m, self.monitors.threshold_factor)
        return self.monitors.noise_limit_m or least

    @property
    def scatter_limit_m(self) -> float:
        """The largest deviation of an odometer's row, or of digits, that the thresholds allow for [m]."""
        return scatter_limit_m(self.hazards.limits.failure_m, self.monitors.threshold_factor)

    @property
    def budget_s(self) -> float:
        """Allowed T_D of the level that `within_budget` compares with [s]."""
        return self.safety.allowed_time_to_detect_s(self.hazards.service_level)


class Vehicle(Settings):
    """A vehicle file; a value that is absent is estimated, or taken as zero (CONTRACT section 1).

    `odometer_scale` is true distance over odometer distance. The limits are far beyond any train: they find
    millimetres and milliseconds.
    """

    gnss_antenna_ahead_m: Annotated[Number, Field(ge=-3000, le=3000)] = 0.0
    antenna_height_m: Annotated[Number, Field(ge=-20, le=20)] = 0.0
    odometer_scale: Positive | None = None
    odometer_scale_sigma: Annotated[Number, Field(ge=0, lt=1)] | None = None
    gnss_latency_s: Annotated[Number, Field(ge=-10, le=10)] | None = None
    gnss_latency_sigma_s: Annotated[Number, Field(ge=0, le=10)] | None = None
    # Of odometers whose stream does not say it (DOMAIN section 5.0).
    odometer_origin: Origin | None = None
    # Declared lags of these recorders: their stamps are so much later than what they stamp.
    reference_latency_s: Annotated[Number, Field(ge=-60, le=60)] = 0.0
    reads_latency_s: Annotated[Number, Field(ge=-60, le=60)] = 0.0


S = TypeVar("S", bound=Settings)


def settings_from(
    data: Mapping[str, object], kind: type[S], place: str, remedy: str = "`balise dictionary` lists every key."
) -> S:
    """Validate a mapping; every breach is listed with its path, as one `ConfigError`."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ConfigError(listed(told(error, kind)), place=place, remedy=remedy) from None


_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){50}""")


def read_toml(path: Path, kind: type[BaliseError] = ConfigError) -> dict[str, object]:
    """A TOML file as a mapping, or one error."""
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may be read for ever
            raise kind("is no regular file", place=str(path), expected="a TOML file")
        return toml_of(path.read_bytes(), str(path), kind)
    except OSError as error:
        raise kind(f"cannot be read: {error.strerror}", place=str(path)) from None


def toml_of(content: bytes, place: str, kind: type[BaliseError] = ConfigError) -> dict[str, object]:
    """TOML as a mapping, or one error."""
    try:
        text = content.decode()
        if _DEEP_KEY.search(text):  # for which the parser takes time and memory that grow with the square of the depth
            raise ValueError("a key has fifty parts or more")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also: not UTF-8, an integer of thousands of digits
        raise kind(f"is not TOML: {error}", place=place) from None


def load_settings(path: Path | None, kind: type[S]) -> S:
    """A settings file, or the defaults where none is given."""
    return kind() if path is None else settings_from(read_toml(path), kind, str(path))


def to_toml(settings: Settings) -> str:
    """The resolved settings as TOML; keys that are not set are left out."""
    return tomli_w.dumps(settings.model_dump(mode="json", exclude_none=True))


def digest_of(*parts: Settings) -> str:
    """SHA-256 over the canonical JSON of settings, independent of how they were written."""
    text = json.dumps([part.model_dump(mode="json") for part in parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
