"""Closed sets of the contract. Values are what stands in the tables."""

from __future__ import annotations

from enum import StrEnum


class Fix(StrEnum):
    NONE = "none"
    AUTONOMOUS = "autonomous"
    DIFFERENTIAL = "differential"
    SBAS = "sbas"
    RTK_FLOAT = "rtk_float"
    RTK_FIXED = "rtk_fixed"
    ESTIMATED = "estimated"


class Origin(StrEnum):
    """Where the figures of an odometer come from (DOMAIN section 5.0). Declared, never guessed."""

    WHEEL = "wheel"
    RADAR = "radar"
    INERTIAL = "inertial"
    GNSS = "gnss"
    FUSED = "fused"
    UNKNOWN = "unknown"

    @property
    def independent(self) -> bool:
        """Free of the GNSS by its declaration; one that follows the positions all the same is found by the replay."""
        return self in (Origin.WHEEL, Origin.RADAR, Origin.INERTIAL)


class Navigability(StrEnum):
    AB = "AB"
    BA = "BA"
    BOTH = "both"
    NONE = "none"


class BaliseKind(StrEnum):
    VIRTUAL = "virtual"
    PHYSICAL = "physical"


class BaliseDirection(StrEnum):
    """In which direction along its net element a virtual balise is valid; AB is growing measure."""

    AB = "AB"
    BA = "BA"
    BOTH = "both"


class TravelAlong(StrEnum):
    """For which travel balises are placed: away from the start of the survey or of a way, back to it, or both."""

    BOTH = "both"
    AHEAD = "ahead"
    BACK = "back"


class AreaType(StrEnum):
    """Types of area of 22E126: traffic on a main line, on a dense line, in a node, and precise positioning."""

    MAINLINE = "mainline"
    DENSE_LINE = "dense_line"
    NODE = "node"
    PRECISE = "precise"


class Reaction(StrEnum):
    NONE = "none"
    SERVICE_BRAKE = "service_brake"
    TRIP = "trip"


class Hazard(StrEnum):
    VB_JUMP_1A = "VB_JUMP_1A"
    VB_JUMP_1B = "VB_JUMP_1B"
    VB_SHIFT = "VB_SHIFT"
    VB_WRONG_TRACK = "VB_WRONG_TRACK"

    @property
    def counted_as(self) -> str:
        """The column of `runs` that counts the rows of this class: `hazards_1a`, `hazards_shift`."""
        return "hazards_" + self.value.removeprefix("VB_").removeprefix("JUMP_").lower()


class FailureMode(StrEnum):
    INSERTION = "insertion"
    DELETION = "deletion"
    NONE = "none"


class Timing(StrEnum):
    EARLY = "early"
    LATE = "late"
    NONE = "none"


class Evidence(StrEnum):
    """What a judgement rests on, the strongest first: where two kinds are needed, the weaker one is named."""

    REFERENCE = "reference"
    BALISE = "balise"
    ODOMETER = "odometer"


class Judgement(StrEnum):
    """What the evidence says of a position (DOMAIN section 5.2). Weaker evidence says `UNKNOWN`, never `RIGHT`."""

    RIGHT = "right"
    WRONG = "wrong"
    UNKNOWN = "unknown"


class RunVerdict(StrEnum):
    """Verdict of a run, worst first (DOMAIN section 5.4)."""

    UNSAFE = "unsafe"
    UNPROVEN = "unproven"
    SAFE = "safe"


class Reason(StrEnum):
    """Why a run has its verdict (DOMAIN section 5.4). `CLOCK_ASSUMED` stands beside a verdict and changes none."""

    ACCEPTED_WRONG = "accepted_wrong"
    FAILURE_BEYOND_BUDGET = "failure_beyond_budget"
    HAZARDOUS_SUM = "hazardous_sum"
    ACCEPTED_UNKNOWN = "accepted_unknown"
    BUDGET_UNKNOWN = "budget_unknown"
    UNKNOWN_IN_USE = "unknown_in_use"
    NOT_DIAGNOSED = "not_diagnosed"
    NOTHING_ACCEPTED = "nothing_accepted"
    EVIDENCE_DISPUTED = "evidence_disputed"
    EVIDENCE_CONTRADICTED = "evidence_contradicted"
    ODOMETER_ORIGIN_UNKNOWN = "odometer_origin_unknown"
    ODOMETER_FOLLOWS_GNSS = "odometer_follows_gnss"
    TRACK_ASSUMED = "track_assumed"
    SIGMA_DOUBTFUL = "sigma_doubtful"
    INPUT_DOUBTFUL = "input_doubtful"
    CLOCK_ASSUMED = "clock_assumed"


class Remedy(StrEnum):
    """What would mend a verdict or a low availability (DOMAIN section 5.4)."""

    CALIBRATE = "calibrate"
    VEHICLE_FILE = "vehicle_file"
    REFERENCE = "reference"
    READS_AT_ENDS = "reads_at_ends"
    READS_CLOSER = "reads_closer"
    ROUTE = "route"
    CLOCK = "clock"
    ODOMETER = "odometer"
    ODOMETER_ORIGIN = "odometer_origin"
    FASTER_LOG = "faster_log"
    SURVEY_SIGMA = "survey_sigma"
    REFERENCE_SIGMA = "reference_sigma"
    SURVEY_COMPLETE = "survey_complete"


class LostTo(StrEnum):
    """What moving time without a valid TVB was lost to (CONTRACT section 3, `runs.lost_to`)."""

    NO_POSITION = "no_position"
    NO_ODOMETER = "no_odometer"
    TRACK_AMBIGUOUS = "track_ambiguous"
    CONFIDENCE = "confidence"
    ALARM = "alarm"
    NOISE = "noise"
    SLIP = "slip"
    RELINK = "relink"


class MisfitCause(StrEnum):
    """Why streams of a run do not fit each other; the words are in `schemas/words.toml`."""

    UNIT = "unit"
    WHEEL = "wheel"
    PULSES = "pulses"
    SCALE_OF_FILE = "scale_of_file"
    LATENCY_OF_FILE = "latency_of_file"
    IMPOSSIBLE_SCALE = "impossible_scale"
    COUNTS_BACKWARDS = "counts_backwards"
    COUNTER_WITHOUT_SIGN = "counter_without_sign"
    OFFSET_OF_REFERENCE = "offset_of_reference"
    WHOLE_SECONDS = "whole_seconds"
    MAP_SHIFT = "map_shift"
    HEIGHT_ZERO = "height_zero"
    COPY = "copy"
    OTHER_PLACE = "other_place"
    VELOCITY_EXCHANGED = "velocity_exchanged"
    VELOCITY_SIGN = "velocity_sign"
    VELOCITY_FRAME = "velocity_frame"
    VELOCITY_DOWN = "velocity_down"
    GPS_AS_UTC = "gps_as_utc"
    LEAP_SECONDS = "leap_seconds"
    TIME_ZONE = "time_zone"
    GPS_WEEK = "gps_week"
    WRONG_DAY = "wrong_day"
    CONSTANT_LAG = "constant_lag"
    LATENCY = "latency"
    AXES_EXCHANGED = "axes_exchanged"
    LONGITUDE_SIGN = "longitude_sign"
    LATITUDE_SIGN = "latitude_sign"
    BOTH_SIGNS = "both_signs"
    RADIANS = "radians"
    MINUTES = "minutes"
    SIGMA_TOO_SMALL = "sigma_too_small"
    SIGMA_TOO_LARGE = "sigma_too_large"
    SIGMA_UNIT = "sigma_unit"
    SIGMA_FOR_VARIANCE = "sigma_for_variance"
    VARIANCE_FOR_SIGMA = "variance_for_sigma"


class MisfitPlace(StrEnum):
    """Where the cause of a misfit lies, as far as that is known."""

    IN_STREAM = "in_stream"
    RATHER_IN_STREAM = "rather_in_stream"


class NotShown(StrEnum):
    """Why the data neither meet nor break a requirement; the words are in `schemas/words.toml`."""

    BEFORE_LOG = "before_log"
    AT_SWITCH_ON = "at_switch_on"
    SINCE_SWITCH_ON = "since_switch_on"
    WITHOUT_POWER = "without_power"
    WITHIN_WINDOW = "within_window"
    NOT_RECORDED = "not_recorded"
    NO_LONG_WAY = "no_long_way"
    NO_EVENT_ON_WAYS = "no_event_on_ways"
    NOTHING_RECORDED = "nothing_recorded"
    EVIDENCE_SILENT = "evidence_silent"
    NO_PROBABILITY = "no_probability"
    PARTLY_SILENT = "partly_silent"
    TOO_FEW = "too_few"


class Note(StrEnum):
    """What the notes of a run say; their words are in `schemas/words.toml`."""

    CORRECTED = "corrected"
    CHUNKS_WITHOUT_CRC = "chunks_without_crc"
    FILES_WITHOUT_CRC = "files_without_crc"
    TOPICS_NOT_USED = "topics_not_used"
    MISFIT = "misfit"
    MISFIT_MENDED = "misfit_mended"
    FAULTS_INJECTED = "faults_injected"
    BALISES_OFF = "balises_off"
    FAR_OFF = "far_off"
    PLACEHOLDERS = "placeholders"
    HELD = "held"
    CONTRADICTING = "contradicting"
    SPANS_DIFFER = "spans_differ"
    ODOMETER_LEAPS = "odometer_leaps"
    ODOMETER_SLOW = "odometer_slow"
    ODOMETER_REVERSED = "odometer_reversed"
    COVARIANCE = "covariance"
    AMBIGUOUS = "ambiguous"
    OFF_NETWORK = "off_network"
    UNLINKED = "unlinked"
    UNKNOWN_TELEGRAMS = "unknown_telegrams"
    READS_DISPUTED = "reads_disputed"
    READS_UNREACHABLE = "reads_unreachable"
    NO_EVIDENCE = "no_evidence"
    EVIDENCE = "evidence"
    UNKNOWN_SHARE = "unknown_share"
    ODOMETER_CONTRADICTED = "odometer_contradicted"
    LEARNED = "learned"
    UNDIAGNOSED = "undiagnosed"
    IN_USE_UNBOUNDED = "in_use_unbounded"
    MOVING_UNKNOWN = "moving_unknown"
    AVAILABLE = "available"
    REMEDY = "remedy"


class VehicleFigures(StrEnum):
    """Where scale and latency come from: the vehicle file, the run itself, or nowhere (no odometer)."""

    FILE = "file"
    LEARNED = "learned"
    NONE = "none"


TRUTH = tuple(kind.value for kind in Evidence if kind is not Evidence.ODOMETER)
"""Evidence that can call a position right; the odometer alone sees errors beyond its confidence only."""


class Suspect(StrEnum):
    GNSS = "gnss"
    ODOMETER = "odometer"
    MAP = "map"
    TRACK = "track"
    UNKNOWN = "unknown"


class PassageStatus(StrEnum):
    ACCEPTED = "accepted"
    REJECTED_WINDOW = "rejected_window"
    REJECTED_UNLINKED = "rejected_unlinked"
    REJECTED_MONITOR = "rejected_monitor"
    REJECTED_CONFIDENCE = "rejected_confidence"
    REJECTED_AMBIGUOUS = "rejected_ambiguous"
    MISSED = "missed"
    NOT_AVAILABLE = "not_available"


class LinkingError(StrEnum):
    NONE = "none"
    EARLY = "early"
    MISSED = "missed"
    ORDER = "order"


class Cause(StrEnum):
    NONE = "none"
    POSITION = "position"
    NO_POSITION = "no_position"


class Verdict(StrEnum):
    TRUE = "true"
    FALSE = "false"
    UNKNOWN = "unknown"


class ThrVerdict(StrEnum):
    """Whether the position failures of a run were negated within the allowed T_D (TVB eq. 7)."""

    KEPT = "kept"
    EXCEEDED = "exceeded"
    NO_FAILURE = "no_failure"
    UNKNOWN = "unknown"


class SigmaSource(StrEnum):
    RECEIVER = "receiver"
    TABLE = "table"


class MonitorState(StrEnum):
    """Absence of data is never health: `NOT_EVALUATED` always comes with a reason."""

    PASS = "pass"
    FAIL = "fail"
    NOT_EVALUATED = "not_evaluated"


class NotEvaluated(StrEnum):
    """Why a monitor is not evaluated at an epoch: the values of `M_reason` in `epochs`."""

    DISABLED = "disabled by configuration"
    NO_ODOMETER = "no odometer"
    ODOMETER_OF_GNSS = "odometer not free of the GNSS"
    BEYOND_SPAN = "outside the odometer's time span"
    INTERRUPTED = "odometer interrupted or slipping"
    NOISE_UNKNOWN = "noise not yet known"
    NOISE_TOO_LARGE = "noise too large"
    NO_POSITION = "no position"
    OFF_TRACK = "off track"
    NO_SIGMA = "no standard deviation of the position"
    NO_HEIGHT = "no height in the position or the survey"
    NO_VELOCITY = "no GNSS velocity"
    NO_VALUE = "nothing to compute it from"
    FIRST_EPOCH = "first epoch after a restart"
    NO_EPOCH_BEFORE = "no epoch before"
    AMBIGUOUS_OR_OFF = "match ambiguous or off track"
    AMBIGUOUS = "the track is ambiguous"
    NO_RANGES = "no satellites stream"
    NO_RANGES_AT_EPOCH = "no satellite residuals at this epoch"
    TOO_FEW_RANGES = "too few satellites to test the ranges"
    NO_OTHER_SOLUTION = "no other solution configured to compare with"
    OTHER_NOT_RECORDED = "the run does not hold the solution to compare with"
    NO_OTHER_EPOCH = "the other solution has no position at this epoch"
    NEVER_VALIDATED = "no balise or validated position to measure from"
    DISTANCE_LOST = "odometer distance lost since the last validated position"
    RELINK_OFF = "no re-link: switched off"
    RELINK_NO_ANCHOR = "no re-link: no validated position or telegram before"
    RELINK_DISTANCE_LOST = "no re-link: the odometer lost its distance since the anchor"
    RELINK_SLIPPED = "no re-link: the odometer slipped too far since the anchor"
    RELINK_NO_VEHICLE = "no re-link: without scale and its sigma in a vehicle file only at a telegram"


NO_RELINK = (
    NotEvaluated.RELINK_OFF,
    NotEvaluated.RELINK_NO_ANCHOR,
    NotEvaluated.RELINK_DISTANCE_LOST,
    NotEvaluated.RELINK_SLIPPED,
    NotEvaluated.RELINK_NO_VEHICLE,
)
"""Why a position could not be re-linked after an outage, and was not used."""


class LdsMode(StrEnum):
    INITIALISING = "initialising"
    LINKED = "linked"
    ODOMETRY = "odometry"
    FAIL_SAFE = "fail_safe"


class LdsState(StrEnum):
    """States of the reactive LDS (TVB section 4, Fig. 3b)."""

    P0 = "P0"
    P1 = "P1"
    P2 = "P2"
    P3 = "P3"


class RunStatus(StrEnum):
    OK = "ok"
    PARTIAL = "partial"
    FAILED = "failed"


class Direction(StrEnum):
    """Direction of travel on the matched path, and of a net element in a route."""

    GROWING = "growing"
    FALLING = "falling"


class LeftOut(StrEnum):
    """Why no fault is put in at an epoch of a recorded run, the strongest last."""

    TOO_SOON = "too_soon"
    NOT_RIGHT = "not_right"
    NO_TVB = "no_tvb"
    AMBIGUOUS = "ambiguous"
    ALARM = "alarm"


class OwnError(StrEnum):
    """Whether the error of a recorded position without a fault is known, or taken to be none."""

    MEASURED = "measured"
    ASSUMED = "assumed"
