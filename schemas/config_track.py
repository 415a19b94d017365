"""Configuration of the track: map matching, checks of a site, making a site from a survey."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from schemas.config_base import NonNegative, Number, Positive, Probability, Settings


class MatchingConfig(Settings):
    """Which paths positions do not reject, and which of them is shown (DOMAIN section 2)."""

    reach_m: Positive = 50.0
    """A position farther than this from every net element is off the track [m].

    Larger than any sigma that can still tell tracks apart. DOMAIN section 2; ours.
    """
    on_track_sigmas: Positive = 3.0
    """A position is on the track within so many standard deviations of position, survey and bias together.

    The usual 3 sigma. DOMAIN section 2.
    """
    on_track_bias_m: NonNegative = 1.5
    """The sigma of the bias in `on_track_sigmas`, for positions and reference [m].

    Antenna and datum; a key of its own beside `cross_bias_sigma_m`: an exact reference whose antenna is 0.3 m off the
    axis is on its track. Ours.
    """
    survey_sigma_default_m: Positive = 1.0
    """Standard deviation of a survey that states none, and of where one ends [m].

    DIAG, error models: track survey 1 m.
    """
    cross_bias_sigma_m: Positive = 1.5
    """Standard deviation of a run's constant offset across the track (antenna, datum) [m].

    A thousand positions 3 m aside are one observation. DOMAIN section 2; ours.
    """
    paths_alpha: Probability = 0.02
    """Level of the nine tests of a path together, in 600 s.

    The true path is rejected, and its neighbour left, by an offset in 0.3 of 1,000 runs (simulated over surveys of 0.3
    to 2 m and positions of 0.3 to 2.5 m; 0.5 at 0.05, 0.1 at 0.01), of claims by offset 0.2 % (0.3 %, 0.1 %), in 12 %
    of runs (16 %, 10 %). Yards surveyed to 0.3 m are claimed for 82.1, 81.7 and 81.3 % of the time at 0.05, 0.02 and
    0.01. DOMAIN section 2; ours.
    """
    paths_delay_s: NonNegative = 3.0
    """The test of a position waits this long for the positions after it [s].

    They say whether it is an outlier. Ours.
    """
    paths_measured_factor: Annotated[Number, Field(ge=1)] = 1.5
    """Factor from the noise that an independent odometer shows along the track to the noise assumed across it.

    A variance of six windows may be too small by as much. Ours.
    """
    paths_anew_s: NonNegative = 60.0
    """Within this time from the start of a run an empty set of paths restarts at once; it then claims nothing for as
    long [s].

    The first positions of a receiver settle; what refuted every path may have errors larger than stated. Not after
    every outage: positions that a fault moved across the tracks during one would claim another track (12 of 60 runs).
    Ours.
    """
    paths_level_s: Positive = 8.0
    """Later an empty set restarts where the mean offset over this time has moved back beside the same line, by more
    than noise and survey explain, and stays there as long again [s].

    A start anew by itself would claim another track after a fault across the tracks, or from a siding that the survey
    lacks. Ours.
    """
    paths_back_sigmas: Positive = 1.0
    """How near that mean has to come back to the line, in standard deviations of position and survey.

    As for `paths_level_s`.
    """
    paths_alike_m: NonNegative = 0.1
    """Two paths to one element count as one where the means of their residuals agree to this over every window [m].

    No test tells them apart. Ours.
    """
    paths_along_sigmas: NonNegative = 3.0
    """Within this many standard deviations along the track of a branch nothing is claimed; past an open end a path goes
    on for as far.

    Nobody knows on which side of the branch the train is. Ours.
    """
    paths_faster: Annotated[Number, Field(ge=1)] = 1.2
    """Between two tests of a path the train goes on at most so many times as fast as before [1].

    A train at 6 m/s or more gains no fifth of its speed in the second between them, at 1.2 m/s2. Ours.
    """
    paths_end_m: NonNegative = 10.0
    """Additional distance that a path may go on past an open end, or enter an element before its beginning [m].

    Noise along the track and offsets at a bend. Ours.
    """
    paths_one_track_m: NonNegative = 1.5
    """Behind a switch that a path passed, its branches count as one track until they are this far apart [m].

    Nearer than the gauge of 1.435 m they share rails. Ours.
    """
    paths_gap_s: Positive = 3.5
    """Over a longer pause of the positions the train may have taken any route [s].

    Single missing positions are none. Ours.
    """
    detour_share: NonNegative = 0.2
    """A route over such a pause may be longer than the distance by this share.

    A longer one would need another speed. Of several routes the one that agrees best with the odometer is shown; its
    standard deviation is a tenth of this margin. Ours.
    """
    detour_m: Positive = 50.0
    """... plus this margin [m].

    Short steps and noise. Ours.
    """
    paths_limit: Annotated[int, Field(strict=True, gt=0)] = 5000
    """With more hypotheses than this in 600 s nothing is claimed.

    More than any run had. Ours.
    """
    outlier_sigmas: Positive = 4.0
    """For the path shown, a position farther off than this many standard deviations costs no more than one at this
    distance.

    Reflections follow no error model; one position must not decide the track. Ours.
    """
    break_s: Positive = 30.0
    """The path shown goes over to a track that no relation leads to, or against navigability, where positions would be
    off it for longer [s].

    Receivers that are lost show another track for seconds. Ours.
    """
    clearance_m: Positive = 3.0
    """Heights are used to tell tracks apart that are at least this far above each other [m].

    A train needs a clearance of 4.5 m and more; tracks at one level differ by superelevation and errors of the survey.
    Ours.
    """
    height_bias_sigma_m: Positive = 2.0
    """Standard deviation of a run's constant offset in height [m].

    Datum, and an antenna that the vehicle file does not know, some 4 m over the rail. Ours.
    """
    deadband_mps: Positive = 0.3
    """Below this speed a train is at a stand [m/s].

    Noise at a stand is not a change of direction. DOMAIN section 2.
    """
    orientation_distance_m: Positive = 20.0
    """`path_m` grows in the direction of this first net movement [m].

    DOMAIN section 2.
    """


class SiteConfig(Settings):
    """What is broken in a site, and what is remarkable."""

    joined_m: Positive = 20.0
    """A site whose joined ends lie farther apart is refused [m]; `--join` reaches no farther.

    The path position would be wrong by a position failure. DOMAIN section 1.
    """
    near_ends_m: Positive = 5.0
    """Free ends nearer than this are a finding [m].

    Two surveys of one place. Ours.
    """
    facing_m: Positive = 300.0
    """Free ends that point at each other within this distance are a finding [m].

    One track with a piece missing. Ours.
    """
    facing_cosine: Probability = 0.94
    """Least cosine of the angle at which free ends point at each other.

    A curve turns by 20 degrees at most in between. Ours.
    """
    kink_deg: Positive = 20.0
    """A larger turn into an element of less than half a metre is a finding [deg].

    As `survey.kink_deg`. Ours.
    """
    length_share: Probability = 1e-3
    """A declared length that differs from the geometry by a larger share is a finding.

    3-D against 2-D on a grade of 4 %. Ours.
    """
    chord_m: Positive = 0.25
    """Straight lines between points that leave the curve by more are a finding [m].

    A quarter of the survey's sigma. Ours.
    """
    beyond_area_deg: Positive = 3.0
    """Places farther than this outside the area of their EPSG code are refused [deg].

    Half a UTM zone: lines that cross a border stay in one system. Ours.
    """
    announced_m: Positive = 6000.0
    """Distance from which balises are announced, for the finding of overlapping expectation windows [m].

    More than twice their longest spacing. DOMAIN section 4; ours.
    """
    parallel_least_m: NonNegative = 100.0
    """A shorter stretch beside another track is no finding of the site check [m].

    Every switch and crossing has one. Ours.
    """


class SurveyConfig(Settings):
    """A site from a survey of the line (`balise site`)."""

    size_limit_mb: Annotated[Number, Field(gt=0, le=100_000)] = 100.0
    """Largest survey, and largest KML in a KMZ [MB].

    100 MB hold two million points, more than a person checks. Ours.
    """
    same_place_m: Positive = 0.05
    """Two places that are nearer are one: ends meet there, unless `balise site --join` says another [m].

    Maps write seven decimals of a degree, 1 cm. Ours.
    """
    same_track_m: Positive = 1.5
    """Lines that are nearer are one track [m].

    Tracks lie 3.5 m and more apart, RTK scatters by centimetres. Ours.
    """
    shape_m: Positive = 0.1
    """Recorded lines are thinned as far as they keep to this; a length that is too long by more is reported [m].

    A tenth of the survey's sigma. Ours.
    """
    stop_m: Positive = 1.0
    """The next point of a recorded line that counts is this far away [m].

    A stop shrinks to one point. Ours.
    """
    stop_sigmas: Positive = 6.0
    """... and this many recorded standard deviations away.

    Farther than the noise reaches. Ours.
    """
    gap_m: Positive = 100.0
    """A longer step between two recorded points is a gap of the recording [m].

    Farther than any train gets in a second or two. Ours.
    """
    gap_steps: Positive = 10.0
    """... and longer than this many usual steps.

    Recordings by distance have long steps. Ours.
    """
    toe_m: Positive = 30.0
    """A switch toe lies this far before the place where the branch is `same_track_m` aside; shorter branches are noise
    [m].

    Behind a switch of 300 m radius the branch is 1.5 m aside after 30 m.
    """
    switch_deg: Positive = 45.0
    """Largest turn from one line to another at a node of three and more [deg].

    Branches lie within some 12 degrees (1:4.5); maps draw it up to 45. Ours.
    """
    kink_deg: Positive = 20.0
    """A larger turn at one point is reported as a kink [deg].

    No track turns so. Ours.
    """
    kink_radius_m: Positive = 60.0
    """A turn on a curve of a smaller radius is reported as a kink [m].

    No train runs there. Ours.
    """
    kink_aside_m: Positive = 0.3
    """... if it steps aside by more than this [m].

    Dense surveys scatter by centimetres. Ours.
    """
    doubled_m: Positive = 100.0
    """Two lines that lie on each other for longer are reported as one track surveyed twice [m].

    Branches of the longest switches part by 1.5 m within 60 m. Ours.
    """
    corner_deg: Positive = 8.0
    """Smaller turns on a curve are not reported as kinks [deg].

    Dense surveys scatter by centimetres. Ours.
    """
    kilometre_m: Positive = 20.0
    """Largest difference between line kilometres and the distance along the track from point to point; more is a jump
    of the kilometres [m].

    Kilometres are posts, not lengths. Ours.
    """
    kilometre_share: Probability = 0.05
    """... or this share of the distance.

    As for `kilometre_m`. Ours.
    """
    balise_beside_m: Positive = 10.0
    """A balise of a list lies no farther than this from its track [m].

    Lists give the axis or the marker beside it; farther is another line or system of coordinates. Ours.
    """
