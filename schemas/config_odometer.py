"""Configuration of the odometer and its alignment with GNSS."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from schemas.config_base import NonNegative, Positive, Probability, Settings


class AlignConfig(Settings):
    """Odometer against GNSS (DOMAIN section 3), and the causal filter of scale and latency."""

    gap_reset_s: Positive = 60.0
    """After a gap of this length the monitors restart, and the first position has to re-link [s].

    Slow errors have changed meanwhile. DOMAIN section 3.
    """
    odometer_gap_s: Positive = 1.0
    """Across a longer pause the odometer is not interpolated [s].

    A train may brake and start inside it. Ours.
    """
    odometer_gap_periods: Positive = 2.5
    """A pause of the odometer is also longer than this many periods of its rows.

    Loggers drop single rows at any rate. Ours.
    """
    fastest_mps: Positive = 200.0
    """A distance that grows faster was reset, overflowed or is wrong [m/s].

    The speed record on rails is 160 m/s.
    """
    leap_m: NonNegative = 5.0
    """Speeds of neighbouring steps of a counter, times the shorter of the two, differ by no more than this, two counts,
    the rows' own scatter and what braking allows: else the counter was set, or rows are wrong [m].

    The fixed error of an odometer. SUBSET-041 5.3.1.1.
    """
    bunched_stamps_m: NonNegative = 20.0
    """Used in place of `leap_m` where a step takes less than half the time of those before [m].

    Rows that are stamped in bunches when they are received. Ours.
    """
    leap_steps: Annotated[int, Field(strict=True, gt=1)] = 4
    """With fewer steps between two places where the counter was set, these steps do not count.

    A recorder that restarts sets its counter back at several rows one after the other. Ours.
    """
    near_leap_m: NonNegative = 0.5
    """Leaps from this on stay counted where they are below `leap_m`, but are in doubt [m].

    A tenth of the odometer's fixed error (SUBSET-041 5.3.1.1). Ours.
    """
    reset_doubt_m: NonNegative = 0.5
    """Over a reset between two rows the speed about it counts where `braking_mps2` dt² / 4 is no more [m]: rows at most
    1.05 s apart. Where a train that accelerates as hard begins to brake just there, the distance is off by up to four
    times as much at 1 Hz: 1.8 m.

    A tenth of the odometer's fixed error (SUBSET-041 5.3.1.1). Ours.
    """
    speed_agreement: Probability = 0.2
    """Speeds give the distance over such a jump if they differed from the distance before by a smaller share; where
    they agreed and then differ by more, over a second, they contradict it.

    Another unit or sign differs by more than a half, slip and scale by some percent. Ours.
    """
    straight_s: Positive = 1.5
    """Between odometer rows farther apart the distance follows curves, not straight lines [s].

    A straight line is within 0.5 m over 1.5 s at `braking_mps2`.
    """
    braking_mps2: Positive = 1.8
    """How hard a train brakes between such rows [m/s2].

    An emergency brake.
    """
    slip_sigma_mps: Positive = 0.185
    """An odometer that gives its speed a larger sigma says itself that it slips [m/s]; nothing is in use until re-link.

    Three of these are the 2 km/h to which SUBSET-041 5.3.1.2 holds an odometer at low speed.
    """
    slip_way_share: Probability = 0.1
    """Largest share of the distance by which a slipping or sliding wheel miscounts; a larger stated sigma replaces it.

    Anti-slip control keeps it below. Ours.
    """
    other_way_share: Probability = 0.01
    """The same share for another odometer of the train that does not slip meanwhile.

    0.8 % of scale was seen in recorded runs. DOMAIN section 3.
    """
    counter_step_m: Positive = 0.05
    """Smaller steps of a counter do not count as noise [m].

    They are less than the white noise of one second (DIAG: 0.05 m).
    """
    quantisation_factor: Positive = 2.0
    """Rows have quantisation noise where they scatter by this many times the white noise; it is estimated separately
    for speeds whose squares differ as much.

    The median of 400 pieces is within 10 % of its mean. Ours.
    """
    quantisation_span_s: Positive = 2.0
    """Rows are compared with a smooth curve over this time, or over eight rows if that is longer [s].

    Over it the distance of a train is a cubic in time. Ours.
    """
    scale_prior_sigma: Positive = 0.01
    """Standard deviation of the odometer scale before anything is learned.

    0.8 % was seen in recorded runs (DOMAIN section 3).
    """
    latency_prior_sigma_s: Positive = 0.2
    """Standard deviation of the GNSS latency before anything is learned [s].

    83 ms was seen in recorded runs (DOMAIN section 3).
    """
    filter_period_s: Positive = 1.0
    """The filter of scale and latency is updated this often [s].

    Errors of a position hardly change in less (DIAG Table 1). Ours.
    """
    scattered_gap_sigmas: NonNegative = 3.0
    """A gap must be longer than this many standard deviations of the stamps.

    The first position after such a gap is always late. Ours.
    """
    break_moved_probability: Probability = 0.8
    """Prior probability that a position is offset after a long gap.

    A wrong scale with a small sigma is worse than slow learning; with the same probability for single missing epochs
    the filter would learn almost nothing from noisy positions. Chosen by the table of tunnels (docs/measurements.md).
    Ours.
    """
    break_moving_s: Positive = 30.0
    """In gaps much shorter than this a position is expected not to move [s].

    A receiver bridges seconds, and restarts after half a minute. Ours.
    """
    settling_tau_s: Positive = 25.0
    """Time constant with which such an offset settles [s].

    Fits positions that settle over 10 to 60 s; with more, a drift that begins meanwhile would be learned. Ours.
    """
    sure_sigmas: Positive = 5.3267
    """More standard deviations than this are not noise of odometer or reference.

    Two-sided Gaussian 1e-7, as k_T by default; it does not follow k_T, since the odometer does not depend on the alarm
    rate. Ours.
    """
    speed_window_s: Positive = 1.0
    """A speed is a mean over this time [s]; so are the movement test and the monitor `along_doppler`.

    Single rows are mostly noise. DOMAIN section 2.
    """
    latency_span_s: Positive = 2.0
    """The filter takes the speed over this time before and after an epoch [s].

    Over less time noise looks like changes of speed, from which the latency is learned. Ours.
    """
    white_share: Probability = 0.01
    """Share of a position's variance that has no memory, in the filter.

    Receivers show a little noise beside the modelled one. Ours.
    """
    clock_periods: Positive = 3.0
    """Steps of the stamps over more periods are not used for the receiver's clock.

    The clock may have restarted. Ours.
    """
