"""Configuration of the LDS, the evidence, the hazard classes and the largest unnoticed error."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field

from schemas.config_base import NonNegative, Number, Positive, Probability, Settings
from schemas.limits import Limits, limits_of


class LdsConfig(Settings):
    """Virtual and travelling virtual balises (DOMAIN section 4)."""

    odometer_sensor: str = "primary"
    """Of several odometers (`odometer.sensor`) the one that the LDS uses; all of them are evidence.

    The train's own choice; streams without the column have one sensor, `primary` (DOMAIN section 5.1).
    """
    ci_limit_m: Positive = 14.0
    """A position with a wider confidence interval detects no balise [m].

    3InSat's requirement for the most demanding operation (LOC section I).
    """
    ci_factor: Positive = 6.18
    """Half-width of the interval over sigma along the track.

    K of HPL for NPA: 6.18 (RTCA DO-229).
    """
    ci_source: Literal["sigma", "hpl"] = "sigma"
    """`sigma`: factor times sigma; `hpl`: the receiver's protection level.

    Few receivers give a protection level.
    """
    recovery_s: Positive = 30.0
    """A negated position returns after this long without a failing monitor, if it also re-links [s].

    DOMAIN section 4; ours.
    """
    init_s: Positive = 10.0
    """Consistent time before the first TVB if no balise was accepted before [s].

    DOMAIN section 4; ours.
    """
    rearm_m: Positive = 10.0
    """A balise can be detected again once the train was this far away [m].

    Noise at a stand must not detect it twice. DOMAIN section 4; ours.
    """
    rearm_sigmas: NonNegative = 3.0
    """... or this many standard deviations, if that is more.

    DOMAIN section 4.
    """
    odometer_fixed_m: NonNegative = 5.0
    """Fixed part of the odometer's confidence [m].

    SUBSET-041 5.3.1.1.
    """
    odometer_share: Annotated[Number, Field(ge=0, lt=1)] = 0.05
    """Share of the distance in the odometer's confidence.

    SUBSET-041 5.3.1.1.
    """
    crossing_gap_s: Positive = 1.0
    """A balise crossed in a longer gap is `not_available`, and two solutions are not compared over it [s]; 1.5 periods
    of a slower log, by the 100 steps before.

    A crossing inside it is only interpolated. DOMAIN section 4; ours.
    """
    entry_from_unfitted_area: bool = False
    """`true`: the first virtual balise is accepted only after a TVB, or after `lds.init_s`.

    Insertion is the more dangerous failure there (TVB section 5; DOMAIN section 4).
    """
    starts_of_mission: tuple[AwareDatetime, ...] = ()
    """Times with time zone at which the LDS restarts, without LRVB, linking and anchor.

    Initialisation in staff responsible mode (DOMAIN section 4).
    """
    relink: bool = True
    """`false`: a negated position never returns.

    Switches every return (DOMAIN section 4).
    """


class HazardConfig(Settings):
    """Hazard classes and budgets (DOMAIN section 5)."""

    failure_limit_m: Positive = 20.0
    """An error along the track beyond this is a position failure [m]; also the sigma of an offset after an outage,
    where scale and latency are learned.

    DIAG: 20 m.
    """
    shift_limit_m: Positive = 20.0
    """A balise offered this much early or late is `VB_SHIFT` [m].

    DIAG: 20 m.
    """
    jump_limit_m: Positive = 20.0
    """A step beyond this is a jump [m].

    As the failure limit. Ours.
    """
    jump_window_s: Positive = 1.0
    """Steps of the error are added up over this time to a jump [s].

    So that the class does not depend on the logger's rate. DOMAIN section 5.3; ours.
    """
    jump_share: Probability = 0.3
    """A jump over several epochs reaches from its first to its last step of at least this share of the largest.

    Two halves belong to one jump, noise does not. Ours.
    """
    failure_hold_s: NonNegative = 1.0
    """A drifting error must stay beyond the limit this long to be a failure [s].

    Noise at the limit is not a failure. DOMAIN section 5.3; ours.
    """
    episode_end_s: NonNegative = 10.0
    """An episode ends after this long within half the failure limit [s].

    DOMAIN section 5.3; ours.
    """
    alarm_lead_s: NonNegative = 30.0
    """An alarm up to this long before a drift was visible is its onset [s].

    Monitors see a drift before its error can be told from noise. DOMAIN section 5.3; ours.
    """
    reaction_s: NonNegative | None = None
    """From detection to negation [s]; not set: one epoch.

    The position of the failing epoch has been used already. DOMAIN section 5.3.
    """
    false_alarm_margin_m: NonNegative = 5.0
    """An alarm is false if the error stayed within the larger of this and 3 sigma (3 sigma at most the failure limit)
    [m].

    Errors of a healthy position. DOMAIN section 5.3; ours.
    """
    false_alarm_lookback_s: NonNegative = 300.0
    """The error has to be that small from this long before the alarm [s].

    A slow average may alarm minutes after its cause. DOMAIN section 5.3; ours.
    """
    evidence_factor: Positive = 3.0
    """Half-width of evidence in its own standard deviations.

    3 sigma. DOMAIN section 5.1.
    """
    reference_sigma_m: Positive = 1.0
    """Standard deviation of a reference that states none [m].

    DOMAIN section 5.1; ours.
    """
    reference_alpha: Probability = 0.01
    """Level of the tests of a path against the reference, in 600 s.

    A true track that is lost makes a false `wrong`: of 450 runs (survey 0.3 to 1 m, reference 0.05 to 2 m) in none for
    5 s or more, in 3 for less, at 0.001, 0.01 and 0.05 alike. One element is left for 69, 78 and 84 % of the time at 1
    m, 93, 95 and 96 % at 0.5 m; on a siding that the survey lacks the wrong track was the only one for more than 5 s in
    29, 15 and 8 of 75 runs. By offset alone 0.1 of 1,000 runs lose the true track at 0.01, 0.5 at 0.05. Ours.
    """
    survey_sigma_m: Positive = 1.0
    """Standard deviation of a survey that states none, where tracks of the reference are told apart [m].

    DOMAIN section 5.1.
    """
    evidence_clock_s: Positive = 0.1
    """A lag between reference or reads and the odometer that is known less closely (at `evidence_factor`) counts as not
    measured, and the clocks as apart by this at most [s].

    2 m for a tram, 8 m at 80 m/s. DOMAIN section 5.1; ours.
    """
    reference_gap_s: Positive = 2.0
    """Reference samples farther apart are not joined by a straight line [s]; the odometer is used from both.

    A train that brakes with 1 m/s2 leaves the line by 0.5 m in 2 s. DOMAIN section 5.1.
    """
    open_end_m: NonNegative = 1000.0
    """For this far behind an open end that the reference may have passed, its track is unknown where another one is
    near [m].

    The rest of a siding may not be surveyed: as long as the longest trains (740 m on the TEN-T network, Regulation (EU)
    2024/1679) and their switches. Ours.
    """
    reference_leaves_m: NonNegative = 120.0
    """Where the reference comes to lie on no track, or comes back from there, its track is unknown for at most this
    distance, up to the first sample within `matching.paths_back_sigmas` roots of a track [m].

    It left over a switch that the survey lacks: the longest (1:18.5 after a curve of 1200 m) lead 4 m aside in it.
    Ours.
    """
    slip_m: NonNegative = 200.0
    """The route between two known places may differ from the odometer's distance by this [m].

    A limit of the search, where no way is within the odometer's confidence; beyond it position and track are unknown.
    Ours.
    """
    slip_share: Annotated[Number, Field(ge=0, lt=1)] = 0.5
    """... plus this share of the distance.

    As for `slip_m`.
    """
    routes_limit: Annotated[int, Field(strict=True, gt=0)] = 64
    """With more chains of net elements between two known places, position and track are unknown there.

    A large yard has too many to compute. Ours.
    """
    turn_s: Positive = 2.0
    """Without an odometer the direction of travel is that of the evidence over this time [s].

    At walking speed the train then moves by more than the interval. Ours.
    """
    suspect_lookback_s: NonNegative = 60.0
    """`suspect` uses the data from this long before alarm or hazard [s].

    Monitors and evidence see a drift late. DOMAIN section 5.5; ours.
    """
    balise_read_sigma_m: Positive = 1.0
    """Standard deviation of a physical balise read [m].

    Of the read itself; Q_LOCACC of the site belongs to the linking information. DOMAIN section 5.1; ours.
    """
    known_error_m: Positive = 5.0
    """An error is given as a number where it is known to plus or minus this [m].

    A wider interval has no useful middle. DOMAIN section 5.2; ours.
    """
    undiagnosed_share: Probability = 0.01
    """A run is `unproven` if more of its moving time in use was without diagnosis (P3).

    1 %: the bank needs an epoch after each restart. DOMAIN section 5.4; ours.
    """
    map_reach_m: Positive = 100.0
    """Alarms across the track of several runs that begin within this distance belong to one place [m].

    Ours.
    """
    service_level: str = "lpv200"
    """The level whose allowed detection time is the budget; a name of `safety.service_levels`.

    LPV-200 is the guaranteed service (LOC uses no other).
    """

    @property
    def limits(self) -> Limits:
        """What is compared with these limits, by the name of the question."""
        return limits_of(self)


class EvidenceConfig(Settings):
    """What the evidence may take for granted (DOMAIN section 5.0)."""

    survey_complete: bool = False
    """The survey holds every track that the train may have used.

    No position can tell; somebody has to say so. DOMAIN section 5.0.
    """
    track_spacing_m: Positive = 3.4
    """The least distance between the axes of neighbouring tracks [m].

    3.5 m and more on old lines, less a survey's rounding; many trams run closer. DOMAIN section 5.0.
    """
    follows_limit: Annotated[Number, Field(gt=0, lt=1)] = 0.25
    """An odometer is made of the positions if they predict its steps to this part of what it or they leave unexplained
    alone (V).

    Independent odometers stay above it (above 0.58 but for RTK), copies at SBAS noise are near 0.05:
    `benchmarks/follows.py`. DOMAIN section 5.0.
    """
    sigma_refuted_share: Probability = 0.01
    """A stated sigma (or HPL) is refuted by errors beyond `lds.ci_factor` sigmas at more than this part of the epochs.

    An error counts only as far as the evidence proves it. DOMAIN section 3.
    """
    sigma_evidence_part: Annotated[Number, Field(ge=0, le=1)] = 0.2
    """In that test an error is reduced by this part of what the evidence leaves open: 1 m and 1 % of the distance
    between reads.

    SUBSET-041 allows 5 m and 5 %; healthy odometers err by less than a fifth. Ours.
    """
    sigma_epochs_least: Annotated[int, Field(ge=1)] = 300
    """With fewer judged epochs a stated sigma is not tested.

    DOMAIN section 3.
    """
    sigma_too_large: Annotated[Number, Field(gt=1)] = 5.0
    """A stated sigma is too large where all errors are below this part of it.

    DOMAIN section 3.
    """
    follows_steps_least: Annotated[int, Field(ge=200)] = 300
    """With fewer steps V is not evaluated.

    A prediction has 73 numbers to fit. DOMAIN section 5.0.
    """
    follows_steps_most: Annotated[int, Field(ge=200)] = 2000
    """V uses at most this many steps, spread over the run.

    V is a quantile, and costs 20 ms so. DOMAIN section 5.0.
    """
    follows_stand_s: Positive = 20.0
    """With at least this much standstill, the steps of both at standstill are compared [s].

    Fewer seconds show no correlation. DOMAIN section 5.0.
    """
    follows_stand_mps: Positive = 0.1
    """A speed by the positions below this is a standstill [m/s].

    A train that creeps moves its wheel and its antenna.
    """
    follows_correlation: Annotated[Number, Field(gt=0, lt=1)] = 0.3
    """From this correlation of steps at standstill on, an odometer is made of the positions.

    DOMAIN section 5.0.
    """
    follows_sigmas: Positive = 5.0
    """... and from this many of its own sigmas on.

    Two independent recorders come as far in 6e-7 of all cases. DOMAIN section 5.0.
    """
    survey_window_m: Positive = 200.0
    """The reference is compared with its track by the median over this distance [m].

    Some hundred samples at 10 Hz, shorter than most sidings. DOMAIN section 5.0.
    """


class UndetectedConfig(Settings):
    """The largest error that no monitor would have noticed (DOMAIN section 5.6)."""

    compute: bool = False
    """Compute the largest unnoticed error (`balise replay --undetected` does).

    A second or two for an hour of run. Ours.
    """
    max_rate_mps: Positive = 5.0
    """The fastest fault [m/s]; it decides only where no monitor looks on.

    The fastest ramp of DIAG's simulation.
    """
    fixes: tuple[Literal["read", "reference"], ...] = ("read",)
    """What shows that the position was right: `read` (physical balises), `reference`; `[]`: starts of mission alone.

    A reference that is always there leaves no time for a fault. No monitor compares the position with a balise read:
    `[]` where nobody does. Ours.
    """
    solutions_at_fault: Literal["all", "one"] = "all"
    """`all`: comparing solutions shows nothing; `one`: the channel monitor counts.

    A fault that all receivers share is the worse one. Ours.
    """
    spacing_step_s: Positive = 60.0
    """Interval of the epochs at which a physical balise is tried [s]; more are tried between them until the spacing is
    known to `spacing_close_share`.

    Time against closeness: `physical_before_m` is too short by the distance of one step at most. Ours.
    """
    spacing_close_share: Annotated[Number, Field(gt=0, lt=1)] = 0.1
    """Accuracy of the largest spacing of physical balises: never too large, at most too small by this share.

    Time against closeness. Ours.
    """
    spacing_resolution_s: NonNegative = 10.0
    """Least interval of the epochs that are tried [s]: a spacing may be too small by this, and is 0 where the limit is
    reached within it.

    Without it an hour at 10 Hz whose limit is reached within a second takes minutes; 10 s of travel are less than any
    spacing of balises in use at line speed. Ours.
    """
    look_back_s: Positive = 60.0
    """A test of the position itself (channel, ranges, telegram) is followed back over this time [s].

    A longer time gave no smaller bound: averages have learned as much by then. Ours.
    """
    holding_share: Probability = 0.01
    """A monitor is listed in `undetected_monitors` if it determines at least this share of the bound.

    Less does not determine it. Ours.
    """
    hidden_share: Probability = 0.5
    """Largest share of a fault that a curve is taken to hide.

    Of positions farther beside a curve nothing along it could be said any more. Ours.
    """
