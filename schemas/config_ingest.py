"""Configuration of reading logs: mappings, corrections, what is impossible, accuracy by kind of fix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field, model_validator

from schemas.config_base import NonNegative, Number, Positive, Probability, Settings
from schemas.enums import Fix, Origin
from schemas.run import RecordedStream


class StreamMapping(Settings):
    """How one recorded topic becomes one stream (CONTRACT section 1): one table per topic and stream."""

    topic: str
    """Topic of the log, or name of the CSV file; `LOG.mcap:TOPIC` is the topic of one of several bags that are
    converted together.
    """
    fields: dict[str, str] = Field(default={})
    """Stream column = path of the recorded field, or `norm(PATH)`, the length of the vector `x`, `y`, `z` there."""
    factors: dict[str, float] = Field(default={})
    """Stream column = factor of the recorded value."""
    constants: dict[str, str | float | bool] = Field(default={})
    """Stream column = a fixed value that the log does not hold."""
    fix_codes: dict[str, Fix] = Field(default={})
    """Recorded code (number or text) = kind of fix; a code that is not listed is an error."""
    origin: Origin | None = None
    """Of an odometer: where its figures come from (`wheel`, `radar`, `inertial`, `gnss`, `fused`), for rows that do not
    say it. What a receiver computed (`fix_velocity`, a message of positions) is `gnss` whatever stands here.
    """
    wrap: Positive | None = None
    """Of an odometer's distance: the counter begins anew after this much of the recorded unit, before `factors`, for
    example 65536 for 16 bits. Without it a counter of 14 to 32 bits or 5 to 9 digits is counted on where its steps go
    on over the end, with a note; a smaller one is only reported (`ingest.wraps`).
    """
    frame: str | None = None
    """Of a speed that is one component of a velocity (`twist.linear.x`): the frame that it is in, where the message
    says none or a wrong one. In a frame of the world (`map`, `odom`, `enu`) a component is no speed of the train and is
    refused: `norm(twist.linear)` is the length, which is never negative.
    """
    time: str = Field(default="auto", pattern=r"^(auto|log|publish|field:.+)$")
    """`auto`: the message's own stamp, else the log time; `log`; `publish`; `field:PATH`."""
    time_scale: Literal["utc", "gps"] = "utc"
    """`utc` or `gps`: leap seconds are subtracted from GPS time."""
    time_epoch: Literal["unix", "gps", "excel"] = "unix"
    """Numbers in a field count from 1970 (`unix`), from 1980-01-06 (`gps`), or days from 1899-12-30 (`excel`)."""
    time_zone: str | None = None
    """Time zone (IANA, for example `Europe/Berlin`) of CSV times that are written without one. The hour that clocks
    show twice in autumn is resolved by the order of consecutive rows, else refused.
    """
    date_order: Literal["auto", "day_first", "month_first"] = "auto"
    """Of dates such as 01.02.2025 in CSV: `day_first`, `month_first`; `auto` decides over the whole file, and asks
    where both fit.
    """
    solution: str = "primary"
    """Name of the solution."""


Mapped = TypeVar("Mapped", bound=StreamMapping)


class StreamMappings(Settings, Generic[Mapped]):
    """Mappings of what was recorded, by the stream that they make."""

    gnss: tuple[Mapped, ...] = ()
    """Mappings of topics that hold GNSS positions.

    Schema names that are known need none (CONTRACT section 1).
    """
    odometer: tuple[Mapped, ...] = ()
    """Mappings of topics that hold odometer distance or speed.

    As for `ingest.gnss`.
    """
    satellites: tuple[Mapped, ...] = ()
    """Mappings of topics that hold range residuals.

    As for `ingest.gnss`.
    """
    reference: tuple[Mapped, ...] = ()
    """Mappings of topics that hold true positions.

    As for `ingest.gnss`.
    """
    balise_reads: tuple[Mapped, ...] = ()
    """Mappings of topics that hold reads of physical balises.

    As for `ingest.gnss`.
    """


class WrapsConfig(Settings):
    """When a fall of a counter is the end of its bits or digits, and no reset."""

    sure_share: Probability = 0.01
    """The step over the end of a counter is no longer than this share of it, else the counter may have been reset.

    A row of a fast train is a hundredth of a counter of 16 bits at most. Ours.
    """
    sure_size: Positive = 16_384.0
    """A smaller counter is reported, and counted on only where `wrap` says so [counts].

    Of 1,000 random resets 4 look like the end of a counter of 1,000 or 10,000 counts, hardly one like a larger one's.
    Ours.
    """
    named_share: Probability = 0.9
    """A counter that falls by less than this share of its counts was set.

    A train's row is no tenth of a counter. Ours.
    """
    times_longer: Annotated[Number, Field(ge=1)] = 2.0
    """The step over the end is at most so many times the longest of the ten before and behind, and two counts.

    Trains brake and accelerate by less within ten rows. Ours.
    """
    pause_steps: Annotated[Number, Field(gt=1)] = 2.5
    """The step over the end takes no longer than this many usual steps; after a longer pause the counter is not counted
    on.

    A recorder that paused may have set its counter. Ours.
    """


Shift = Annotated[Number, Field(ge=-1e6, le=1e6)]  # [m]


class StreamCorrection(Settings):
    """Corrections of a recorded stream, made right after reading, for any kind of file.

    First two columns are exchanged, a distance that begins anew after `wrap` is counted on, then `factors` multiply,
    `shift_s` is added to the times and `shift_*_m` to the positions. `solution`: of GNSS and satellites only this one.
    """

    stream: RecordedStream
    """The stream: any of CONTRACT section 1 but `faults`."""
    solution: str | None = None
    """Of GNSS and satellites only this solution."""
    exchange: tuple[str, str] | None = None
    """Two columns that are exchanged, before the other corrections."""
    wrap: Positive | None = None
    """Of the odometer: `distance_m` begins anew after so much, as recorded, and is counted on, before `factors`."""
    factors: dict[str, Number] = Field(default={})
    """Column = factor of its values."""
    shift_s: Annotated[Number, Field(ge=-9e9, le=9e9)] = 0.0  # what 64 bits of nanoseconds hold
    """Added to the times [s]; at most 9e9."""
    shift_east_m: Shift = 0.0
    """Positions are moved east [m]."""
    shift_north_m: Shift = 0.0
    """Positions are moved north [m]."""
    shift_up_m: Shift = 0.0
    """Positions are moved up [m]."""

    @property
    def moves(self) -> bool:
        """It moves positions: a constant error of the receiver could be meant as well as another datum."""
        return bool(self.shift_east_m or self.shift_north_m or self.shift_up_m)

    @property
    def changes(self) -> str:
        """What it changes, in the words of the configuration."""
        changed = self.model_dump(exclude_defaults=True, exclude={"stream"})
        return ", ".join(f"{name} {value}" for name, value in changed.items())


class IngestConfig(StreamMappings[StreamMapping]):
    """Which topics feed which stream (empty: recognised by schema name), and limits of plausible values."""

    chunk_limit_mib: Positive = 128.0
    """Largest record that is read from an MCAP log [MiB]; a larger one counts as damage.

    A damaged length must not fill the memory; recorders write chunks of a few MiB. Ours.
    """
    unpacked_limit_mib: Positive = 4096.0
    """Largest size that one archive may unpack to, with the archives in it [MiB].

    A few kilobytes can be made to fill any disk; a day of a train's logs is smaller. Raise it for larger archives.
    Ours.
    """
    unpacked_files_limit: Annotated[int, Field(strict=True, gt=0)] = 10_000
    """Largest number of files that one archive may unpack to.

    Each takes time and room, an empty one too. Ours.
    """
    unpacked_ratio_limit: Annotated[Number, Field(ge=1)] = 300.0
    """An archive, or the chunks of an MCAP log, may unpack to so many times its size, and to 64 MiB always.

    Text logs pack to a tenth, those of a train that stands all night to a hundredth; what packs better was made to.
    Ours.
    """
    unpacked_limit_s: Positive = 900.0
    """Longest time that unpacking one archive may take [s].

    4 GiB take a minute; slow disks ten. Ours.
    """
    rows_limit: Annotated[int, Field(strict=True, gt=0)] = 20_000_000
    """Largest number of rows of one stream of a run.

    Rows are held in memory, and a file of some kilobytes can declare billions; five receivers at 10 Hz record this in
    four days. Ours.
    """
    longest_journey_h: Annotated[Number, Field(gt=0, le=8_784)] = 168.0
    """A stream of a run whose times span more is refused, before anything is computed from it; at most 8784 [h].

    No train is under way for a week; memory and time follow the span, so that a wrong date must not make a journey.
    Ours.
    """
    wrong_dates_share: Annotated[Number, Field(ge=0, lt=1)] = 0.1
    """Largest share of a stream's rows with an impossible date, or a date more than a day from the others; they are
    left out and counted, more is an error.

    A receiver before its first fix, or a week rollover, affects few rows; more is another recording. Ours.
    """
    wraps: WrapsConfig = WrapsConfig()
    correct: tuple[StreamCorrection, ...] = ()
    """Corrections of recorded streams, in order: one `[[ingest.correct]]` table each.

    `balise inspect` prints them for what does not fit.
    """
    plausibility: Literal["fail", "warn"] = "fail"
    """`fail`: a run with impossible units, clocks or axes of a known cause fails; `warn`: it is replayed with a note,
    and its verdict is at best `unproven`.

    A wrong unit or clock looks like a healthy run or like a fault. Ours.
    """
    placeholder_far_m: Positive = 10_000.0
    """A default place is at least this far from the rest of the run [m].

    A nearer one may be a fault, which must not be hidden. Ours.
    """
    placeholder_origin_deg: NonNegative = 0.01
    """A position is a placeholder if it lies so near to latitude and longitude 0 [deg].

    Nobody runs trains there, in the Gulf of Guinea. Ours.
    """
    first_fix_share: Probability = 0.2
    """Places far away at the start of a run are those of a receiver without a first fix, if they last for this share of
    it at most.

    More is another run. Ours.
    """
    first_fix_s: NonNegative = 900.0
    """Such places may also last this long, if that is less than half of the run [s].

    A cold start takes up to a quarter of an hour. Ours.
    """

    @model_validator(mode="before")
    @classmethod
    def _as_lists(cls, data: object) -> object:
        """One table of a kind as a list of one."""
        if not isinstance(data, Mapping):
            return data
        alone = {"wraps"}
        return {
            key: [value] if isinstance(value, Mapping) and key not in alone else value for key, value in data.items()
        }


class PlausibilityConfig(Settings):
    """Whether the streams of a run can be of one journey: what is reported, and what no train can have."""

    scale_limit: Probability = 0.08
    """An odometer scale that differs from 1 by more is impossible.

    Worn wheels 4 %, bad radars 6 %; the nearest wrong unit (yards) 9 %. Ours.
    """
    reported_scale: Probability = 0.03
    """A scale that differs from 1 by more is reported.

    Wrong wheel diameters are larger; 0.8 % was seen in recorded runs. Ours.
    """
    lag_limit_s: Positive = 5.0
    """A larger lag is impossible for a recorder on a train [s].

    Receivers and buses are late by 2 s at most; the nearest wrong clock (leap seconds) is 18 s off. Ours.
    """
    reported_lag_s: Positive = 0.3
    """A larger lag is reported [s].

    At 40 m/s it is more than half the failure limit of 20 m. Ours.
    """
    reported_shift_m: Positive = 8.0
    """A larger constant shift of survey or reference is reported [m].

    Positions without corrections are within 5 m of the track, 95 %. Ours.
    """
    file_sigmas: Positive = 4.0
    """A vehicle file is reported where it differs from the run by more of its own sigmas, and by `file_scale`.

    Noise of both. Ours.
    """
    file_scale: Probability = 0.005
    """The least difference of scale that is reported of a vehicle file.

    Noise of both. Ours.
    """
    same_line_m: Positive = 2_000.0
    """Positions farther from every track are of another place [m]; a reference ten times as far.

    A yard lies within it. Ours.
    """
    copy_share: Probability = 0.8
    """Share of places equal to the last digit that makes a reference a copy.

    Independent records have 1 in 10. Ours.
    """
    copy_chance: Probability = 0.01
    """Equal places count only where independent ones would agree with at most this probability.

    Coarse digits are equal by chance. Ours.
    """


class FixSigma(Settings):
    """Horizontal sigma per axis, by kind of fix, for epochs without a covariance of the receiver (DOMAIN section 3)."""

    autonomous_m: Positive = 2.0
    """Sigma per axis of GNSS alone [m].

    DOMAIN section 3; ours, for receivers without a covariance.
    """
    differential_m: Positive = 1.0
    """Sigma with ground-based corrections [m].

    As for `autonomous_m`.
    """
    sbas_m: Positive = 1.0
    """Sigma with SBAS corrections (EGNOS, WAAS, ...) [m].

    As for `autonomous_m`; TVB section 5 asks for 1.1 m at 95 %.
    """
    rtk_float_m: Positive = 0.5
    """Sigma of RTK with float ambiguities [m].

    As for `autonomous_m`.
    """
    rtk_fixed_m: Positive = 0.1
    """Sigma of RTK with fixed ambiguities [m].

    As for `autonomous_m`.
    """
    estimated_m: Positive = 5.0
    """Sigma of dead reckoning [m].

    As for `autonomous_m`.
    """
    vertical_factor: Positive = 1.5
    """Vertical standard deviation over the horizontal one.

    Satellites are above the horizon only. DOMAIN section 3; ours.
    """
    digits_least_m: NonNegative = 0.02
    """Coordinates that are written down in finer steps than this add nothing to the uncertainty of a position [m].

    Finer steps drown in the noise of any receiver. Ours.
    """

    def horizontal_m(self, fix: Fix) -> float | None:
        """Sigma per horizontal axis [m], none for an epoch without fix."""
        value: float | None = getattr(self, f"{fix.value}_m", None)
        return value
