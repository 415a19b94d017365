"""Configuration: frozen models nested by stage, TOML on disk, every default in one place.

The text under a key says what it decides, and in its second paragraph the reason and source of the default;
`docs/configuration.md` is made of these texts (`make configuration`).
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args

import tomli_w
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from schemas.config_base import NonNegative, Number, Positive, Probability, Settings
from schemas.config_ingest import (
    FixSigma,
    IngestConfig,
    PlausibilityConfig,
    StreamCorrection,
    StreamMapping,
    StreamMappings,
    WrapsConfig,
)
from schemas.config_judge import EvidenceConfig, HazardConfig, LdsConfig, UndetectedConfig
from schemas.config_monitors import MonitorConfig, threshold_factor
from schemas.config_odometer import AlignConfig
from schemas.config_safety import AdviceConfig, CalibrationConfig, SafetyConfig, ServiceLevel
from schemas.config_track import MatchingConfig, SiteConfig, SurveyConfig
from schemas.enums import Origin
from schemas.errors import BaliseError, ConfigError, listed
from schemas.limits import noise_limit_m, scatter_limit_m
from schemas.near import did_you_mean

# By pydantic's types of errors; what they say of themselves is for programmers.
_WORDS = {
    "missing": "is missing",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be text",
    "string_pattern_mismatch": "must have the form {pattern}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "model_type": "must be a table of keys",
    "model_attributes_type": "must be a table of keys",
    "dict_type": "must be a table of keys",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "timezone_aware": "needs a time zone, for example 2025-03-03T06:00:00Z",
}


def breach_messages(error: ValidationError, kind: type[BaseModel]) -> list[str]:
    """Every breach with its path: an unknown key with the nearest known one, else what was found and expected.

    Args:
        error: what pydantic found.
        kind: the model that was validated.

    Returns:
        One sentence per breach.
    """
    return [
        _unknown(breach, kind) if breach["type"] == "extra_forbidden" else _wrong(breach) for breach in error.errors()
    ]


def _wrong(breach: ErrorDetails) -> str:
    """One breach, for people."""
    key = ".".join(map(str, breach["loc"])) or "(file)"
    text = _WORDS.get(breach["type"], breach["msg"].removeprefix("Value error, "))
    found = breach["input"]
    single = isinstance(found, str | int | float) and breach["type"] != "missing"
    return f"{key}: {_fill_text(text, breach.get('ctx') or {})}" + (f", found {_shown(found)}" if single else "")


def _shown(value: object) -> str:
    """The value as TOML was read; an integer of more digits than Python writes has no text."""
    long = isinstance(value, int) and value.bit_length() > 1024
    return "a very large integer" if long else repr(value)[:100]


def _fill_text(text: str, context: Mapping[str, Any]) -> str:
    """A text with its placeholders filled in; as it stands where that cannot be."""
    try:
        return text.format_map(context)
    except (KeyError, ValueError, IndexError):
        return text


def _unknown(breach: ErrorDetails, kind: type[BaseModel]) -> str:
    """An unknown key; the one that was meant is looked for in the same section first."""
    *path, name = map(str, breach["loc"])
    elsewhere = {key.rsplit(".", 1)[-1]: key for key in _keys(kind)}
    if name in elsewhere:
        near = f" (did you mean `{elsewhere[name]}`?)"
    else:
        near = did_you_mean(name, _model_at(kind, path).model_fields) or did_you_mean(name, elsewhere)
    return f"unknown key `{'.'.join([*path, name])}`{near}"


def _model_at(kind: type[BaseModel], path: list[str]) -> type[BaseModel]:
    """The section that a path leads to; numbers and names of a list or a table of sections are passed over."""
    for part in path:
        field = kind.model_fields.get(part)
        inner = None if field is None else next(_models_in(field.annotation), None)
        kind = inner or kind
    return kind


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Sections that a type may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def _keys(kind: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every key with its path, but for lists and tables of sections."""
    for name, field in kind.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _keys(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name


__all__ = [
    "AdviceConfig",
    "AlignConfig",
    "CalibrationConfig",
    "Configuration",
    "EvidenceConfig",
    "FixSigma",
    "HazardConfig",
    "IngestConfig",
    "LdsConfig",
    "MatchingConfig",
    "MonitorConfig",
    "NonNegative",
    "Number",
    "PlausibilityConfig",
    "Positive",
    "Probability",
    "SafetyConfig",
    "ServiceLevel",
    "Settings",
    "SiteConfig",
    "StreamCorrection",
    "StreamMapping",
    "StreamMappings",
    "SurveyConfig",
    "UndetectedConfig",
    "Vehicle",
    "WrapsConfig",
    "digest_of",
    "load_settings",
    "read_toml",
    "settings_from",
    "threshold_factor",
    "to_toml",
    "toml_of",
]


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
        """The service level of the hazards is one of those of the model."""
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
    """The train: antenna, odometer scale and latencies (CONTRACT section 1); `balise calibrate` writes it.

    A scale or latency that is not set is learned in the run, from earlier epochs only. This costs sensitivity: their
    uncertainty widens the thresholds. Impossible values (a latency over 10 s, an antenna more than 3 km ahead or 20 m
    up) are errors: they are milliseconds or millimetres.
    """

    gnss_antenna_ahead_m: Annotated[Number, Field(ge=-3000, le=3000)] = 0.0
    """GNSS antenna ahead of the balise antenna, towards the leading end (to which the odometer counts up) [m]."""
    antenna_height_m: Annotated[Number, Field(ge=-20, le=20)] = 0.0
    """GNSS antenna over the rail [m]."""
    odometer_scale: Positive | None = None
    """True distance over odometer distance."""
    odometer_scale_sigma: Annotated[Number, Field(ge=0, lt=1)] | None = None
    """Standard deviation of `odometer_scale`."""
    gnss_latency_s: Annotated[Number, Field(ge=-10, le=10)] | None = None
    """Age of a position at its time stamp [s]."""
    gnss_latency_sigma_s: Annotated[Number, Field(ge=0, le=10)] | None = None
    """Standard deviation of `gnss_latency_s` [s]."""
    odometer_origin: Origin | None = None
    """Where the figures of the odometer that the LDS uses come from, if its stream does not say it: `wheel`, `radar`,
    `inertial`, `gnss`, `fused`.
    """
    reference_latency_s: Annotated[Number, Field(ge=-60, le=60)] = 0.0
    """Stamps of the reference are so much later than its positions [s]."""
    reads_latency_s: Annotated[Number, Field(ge=-60, le=60)] = 0.0
    """Stamps of balise reads are so much later than the reads [s]."""


S = TypeVar("S", bound=Settings)


def settings_from(
    data: Mapping[str, object], kind: type[S], place: str, remedy: str = "`balise dictionary` lists every key."
) -> S:
    """Validate a mapping as settings.

    Args:
        data: keys and values, as read from TOML.
        kind: the model that they are settings of.
        place: the file, for the error.
        remedy: what to do about a breach, for the error.

    Returns:
        The validated settings.

    Raises:
        ConfigError: keys are unknown or values wrong; all of them are listed with their paths.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ConfigError(listed(breach_messages(error, kind)), place=place, remedy=remedy) from None


_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){50}""")


def read_toml(path: Path, kind: type[BaliseError] = ConfigError) -> dict[str, object]:
    """Read a TOML file as a mapping.

    Args:
        path: the file.
        kind: class of the error to raise.

    Returns:
        Keys and values.

    Raises:
        BaliseError: of the class `kind`: the file cannot be read or is not TOML.
    """
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may be read for ever
            raise kind("is no regular file", place=str(path), expected="a TOML file")
        return toml_of(path.read_bytes(), str(path), kind)
    except OSError as error:
        raise kind(f"cannot be read: {error.strerror}", place=str(path)) from None


def toml_of(content: bytes, place: str, kind: type[BaliseError] = ConfigError) -> dict[str, object]:
    """Parse TOML as a mapping.

    Args:
        content: the bytes of a file.
        place: its name, for the error.
        kind: class of the error to raise.

    Returns:
        Keys and values.

    Raises:
        BaliseError: of the class `kind`: the content is not TOML.
    """
    try:
        text = content.decode()
        if _DEEP_KEY.search(text):  # for which the parser takes time and memory that grow with the square of the depth
            raise ValueError("a key has fifty parts or more")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also: not UTF-8, an integer of thousands of digits
        raise kind(f"is not TOML: {error}", place=place) from None


def load_settings(path: Path | None, kind: type[S]) -> S:
    """A settings file, or the defaults where none is given.

    Args:
        path: the file, or None.
        kind: the model of its settings.

    Returns:
        The validated settings.

    Raises:
        ConfigError: the file cannot be read, or breaches the model.
    """
    return kind() if path is None else settings_from(read_toml(path), kind, str(path))


def to_toml(settings: Settings) -> str:
    """The resolved settings as TOML; keys that are not set are left out.

    Args:
        settings: validated settings.

    Returns:
        The text of a TOML file.
    """
    return tomli_w.dumps(settings.model_dump(mode="json", exclude_none=True))


def digest_of(*parts: Settings) -> str:
    """SHA-256 over the canonical JSON of settings, independent of how they were written.

    Args:
        parts: settings, in an order that counts.

    Returns:
        64 hexadecimal digits.
    """
    text = json.dumps([part.model_dump(mode="json") for part in parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
