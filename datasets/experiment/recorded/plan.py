"""What faults are put into recorded runs: the plan file, and the cells that it comes to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from datasets.faults import FaultKind, FaultSpec
from schemas.config import (
    Configuration,
    NonNegative,
    Number,
    Positive,
    Settings,
    load_settings,
    read_toml,
    settings_from,
)
from schemas.errors import ConfigError
from schemas.frozen import frozen

_AMOUNTS = {
    FaultKind.RAMP: ("rates_mps", "rate_mps", "m/s"),
    FaultKind.STEP: ("sizes_m", "size_m", "m"),
    FaultKind.BIAS: ("sizes_m", "size_m", "m"),
    FaultKind.OUTAGE: ("durations_s", "duration_s", "s"),
    FaultKind.LATENCY: ("latencies_s", "latency_s", "s"),
    FaultKind.SLIP: ("rates_mps", "rate_mps", "m/s"),
    FaultKind.SLIDE: ("rates_mps", "rate_mps", "m/s"),
    FaultKind.SCALE: ("scales", "scale", "1"),
}
"""Per kind its list in the plan, the quantity of the fault, and its unit."""
_LISTS = ("rates_mps", "sizes_m", "durations_s", "latencies_s", "scales")
_SIGNED = (FaultKind.RAMP, FaultKind.STEP, FaultKind.BIAS)
_DIRECTIONS = {
    "along": ("ahead", "behind"),
    "cross": ("left", "right"),
    "up": ("up", "down"),
    "east": ("east", "west"),
    "north": ("north", "south"),
}
"""What a positive and a negative fault is called by target; of ranges longer and shorter."""
SATELLITE = "satellite"
"""Target of the range of one satellite, drawn for each injection among those used there."""
Amounts = tuple[Positive, ...]


class PlannedFault(Settings):
    """One kind of fault, in several amounts; each amount and direction is a cell of the experiment.

    `target` as in a fault file, or `satellite`. `both_ways`: ramps, steps and biases in both directions. `duration_s`:
    how long it lasts, else to the end of the watch. `watch_s`: how long it is watched, else as `Cell` says.
    `per_cell`: injections in each of its cells.
    """

    kind: FaultKind
    target: str = ""
    rates_mps: Amounts = ()
    sizes_m: Amounts = ()
    durations_s: Amounts = ()
    latencies_s: Amounts = ()
    scales: Amounts = ()
    both_ways: bool = True
    duration_s: Positive | None = None
    watch_s: Positive | None = None
    per_cell: Annotated[int, Field(strict=True, ge=1)] | None = None
    solution: str | None = None

    @model_validator(mode="after")
    def _require_amounts(self) -> Self:
        """A fault names the amounts of its kind, and no others."""
        if self.kind not in _AMOUNTS:
            raise ValueError(f"a plan takes faults of kind {', '.join(_AMOUNTS)}; found {self.kind.value}")
        wanted = _AMOUNTS[self.kind][0]
        given = [name for name in _LISTS if getattr(self, name)]
        if given != [wanted]:
            raise ValueError(f"a fault of kind {self.kind.value} needs {wanted}; found {', '.join(given) or 'none'}")
        self.spec(self.amounts[0], 1.0, "G01")
        return self

    @property
    def amounts(self) -> Amounts:
        """All that the plan asks of it, in `unit`."""
        amounts: Amounts = getattr(self, _AMOUNTS[self.kind][0])
        return amounts

    @property
    def unit(self) -> str:
        """Unit of the amounts."""
        return _AMOUNTS[self.kind][2]

    def spec(self, amount: float, start_s: float, satellite: str | None) -> FaultSpec:
        """The fault of this signed amount as a fault file would hold it."""
        values: dict[str, object] = {"kind": self.kind, "start_s": start_s, _AMOUNTS[self.kind][1]: amount}
        target = satellite if self.target == SATELLITE else self.target
        optional = {"target": target or None, "duration_s": self.duration_s, "solution": self.solution}
        return FaultSpec.model_validate({**{k: v for k, v in optional.items() if v is not None}, **values})


class PlannedBank(Settings):
    """A bank of the comparison: a configuration file, relative to the plan; `vehicle` in place of the command's."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
    config: str
    vehicle: str | None = None


class RecordedPlan(Settings):
    """The whole plan; docs/experiments.md says why each default is what it is."""

    seed: Annotated[int, Field(ge=0)] = 1
    per_cell: Annotated[int, Field(strict=True, ge=1)] = 10
    # How long a fault is watched beyond the failure that it leads to.
    after_s: Positive = 120.0
    # The recorded position's own error may delay the failure by what the fault needs for so much more.
    margin_m: NonNegative = 5.0
    # A range error reaches the position along the track with at least so much of it, for the length of the watch alone.
    satellite_gain: Annotated[Number, Field(gt=0, le=1)] = 0.2
    # No watch is longer.
    longest_s: Positive = 3600.0
    # The run must have been free of faults for so long before the instant.
    quiet_s: NonNegative = 60.0
    # Instants of one cell in one run are at least so far apart.
    apart_s: Positive = 10.0
    # Injections whose watches overlap are one pass; no watch counts as shorter than this (3 x 100 s, the correlation of
    # the receiver's own error, DIAG Table 1).
    pass_s: Positive = 300.0
    # Length of a piece of line in `places`.
    place_m: Positive = 500.0
    faults: Annotated[tuple[PlannedFault, ...], Field(min_length=1)]
    banks: tuple[PlannedBank, ...] = ()

    @model_validator(mode="after")
    def _require_unique_names(self) -> Self:
        """Every fault and every bank has a name of its own."""
        for what, names in (
            ("faults", [cell.name for cell in self.cells(20.0)]),
            ("banks", [b.name for b in self.banks]),
        ):
            repeated = sorted({name for name in names if names.count(name) > 1})
            if repeated:
                raise ValueError(f"{what}: given more than once: {', '.join(repeated)}")
        return self

    def cells(self, limit_m: float) -> tuple[Cell, ...]:
        """Every fault, amount and direction; `limit_m`: the error that is a failure."""
        return tuple(cell for fault in self.faults for cell in _cells_of_fault(self, fault, limit_m))


@frozen
class Cell:
    """One fault of one amount in one direction, `count` times.

    `amount`: signed, + ahead of the train, to its left, or a longer range. `watch_s`: until the fault alone has moved
    the position by the failure limit and a margin, and `after_s` more; a fault that ends is watched for `after_s`
    beyond its end.
    """

    name: str
    fault: PlannedFault
    amount: float
    count: int
    watch_s: float

    @property
    def direction(self) -> str | None:
        """Where it moves the position, or the range; None where the fault has no direction."""
        return _direction_word(self.fault, self.target, self.amount)

    @property
    def labels(self) -> dict[str, object]:
        """What names the cell in every table."""
        named = {"cell": self.name, "kind": self.fault.kind.value, "target": self.target, "direction": self.direction}
        return named | {"amount": self.amount, "unit": self.fault.unit}

    @property
    def hits_satellite(self) -> bool:
        """Whether it hits the range of one satellite, drawn for each injection."""
        return self.fault.target == SATELLITE

    @property
    def hits_odometer(self) -> bool:
        """Whether the fault is one of the odometer."""
        return self.spec(1.0, "G01").hits_odometer

    @property
    def target(self) -> str:
        """What the fault acts on, as in a fault file, or `satellite`."""
        return SATELLITE if self.hits_satellite else self.spec(1.0, None).target

    def spec(self, start_s: float, satellite: str | None) -> FaultSpec:
        """The fault as a fault file would hold it, from `start_s` after the first epoch on."""
        return self.fault.spec(self.amount, start_s, satellite)


def _cells_of_fault(plan: RecordedPlan, fault: PlannedFault, limit_m: float) -> Iterator[Cell]:
    """A cell for each amount and direction of a fault."""
    signs = (1.0, -1.0) if fault.both_ways and fault.kind in _SIGNED else (1.0,)
    for amount in fault.amounts:
        for sign in signs:
            target = SATELLITE if fault.target == SATELLITE else fault.spec(amount, 1.0, "G01").target
            words = [fault.kind.value, target, f"{amount:g} {fault.unit}"]
            direction = _direction_word(fault, target, sign)
            words += [] if direction is None else [direction]
            words += [f"for {fault.duration_s:g} s"] if fault.duration_s is not None else []
            words += [f"in {fault.solution}"] if fault.solution is not None else []
            yield Cell(
                name=" ".join(words),
                fault=fault,
                amount=sign * amount,
                count=fault.per_cell or plan.per_cell,
                watch_s=_watch_length_s(plan, fault, amount, limit_m),
            )


def _direction_word(fault: PlannedFault, target: str, amount: float) -> str | None:
    """The direction of a fault in a word; None where it has none."""
    if fault.kind not in _SIGNED:
        return None
    more, less = _DIRECTIONS.get(target, ("longer", "shorter"))
    return more if amount > 0.0 else less


def _watch_length_s(plan: RecordedPlan, fault: PlannedFault, amount: float, limit_m: float) -> float:
    """How long a fault is watched [s]: until it alone has moved the position by the failure limit."""
    if fault.watch_s is not None:
        return min(fault.watch_s, plan.longest_s)
    grows_s = 0.0
    if fault.kind is FaultKind.RAMP:
        gain = plan.satellite_gain if fault.target == SATELLITE else 1.0
        grows_s = (limit_m + plan.margin_m) / (gain * amount)
    lasts_s = amount if fault.kind is FaultKind.OUTAGE else fault.duration_s or 0.0
    return min(max(grows_s, lasts_s) + plan.after_s, plan.longest_s)


_RATES_MPS = (0.01, 0.03, 0.1, 0.5, 1.0, 5.0)
_DEFAULT = RecordedPlan(
    faults=(
        PlannedFault(kind=FaultKind.RAMP, target="along", rates_mps=_RATES_MPS),
        PlannedFault(kind=FaultKind.STEP, target="along", sizes_m=(5.0, 10.0, 25.0, 50.0, 100.0, 500.0)),
        PlannedFault(kind=FaultKind.RAMP, target=SATELLITE, rates_mps=(0.1, 0.5, 1.0, 5.0)),
        PlannedFault(kind=FaultKind.OUTAGE, target="position", durations_s=(5.0, 30.0, 120.0)),
        PlannedFault(kind=FaultKind.SLIP, rates_mps=(0.1, 0.5, 2.0), duration_s=20.0),
        PlannedFault(kind=FaultKind.SLIDE, rates_mps=(0.1, 0.5, 2.0), duration_s=20.0),
    )
)
"""DIAG's rates (0.01 to 5 m/s, section Simulation), and what the paper does not inject."""


@frozen
class Bank:
    """A bank to compare, with the vehicle that its runs are replayed with; None: that of the command."""

    name: str
    config: Configuration
    vehicle: Path | None = None


def load_plan(path: Path | None) -> RecordedPlan:
    """The plan of a file, or the default; breaches are one `ConfigError`."""
    if path is None:
        return _DEFAULT
    return settings_from(read_toml(path), RecordedPlan, str(path), "docs/experiments.md lists every key.")


def banks_of(plan: RecordedPlan, path: Path | None, config: Configuration) -> tuple[Bank, ...]:
    """The banks that the plan names, else that of the command alone."""
    if not plan.banks:
        return (Bank("bank", config),)
    folder = Path() if path is None else path.parent
    banks = tuple(
        Bank(
            bank.name,
            load_settings(folder / bank.config, Configuration),
            None if bank.vehicle is None else folder / bank.vehicle,
        )
        for bank in plan.banks
    )
    limits = {bank.config.hazards.limits.failure_m for bank in banks}
    if len(limits) > 1:
        found = ", ".join(f"{limit:g}" for limit in sorted(limits))
        raise ConfigError("banks have different failure limits", place=str(path), found=found, expected="one for all")
    return banks
