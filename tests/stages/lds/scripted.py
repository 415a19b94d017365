"""Journeys of a few rows, and a bank that fails where the script says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import Verdicts
from pipeline.stages.lds import run_lds
from pipeline.stages.lds.link_monitors import Held
from schemas.config import Configuration, LdsConfig, MonitorConfig
from schemas.enums import PassageStatus
from schemas.stages import AlignedEpochs, Crossings
from tests.arrays_of_table import arrays_of_table

SCALE_SIGMA = 1e-4
K_T = 5.3267238
INSTANT = pl.Datetime("ns", "UTC")


class LdsTables(NamedTuple):
    """What the LDS made of a journey, in tables; `epochs` with the verdicts of the linking monitors."""

    epochs: pl.DataFrame
    crossings: pl.DataFrame
    passages: pl.DataFrame
    linking: Mapping[str, Verdicts]
    unknown_reads: pl.DataFrame
    held: tuple[Held, ...]


class ScriptedBank:
    """Fails at `fails`; of these `fast` also fails fast. `rings`: fails only until a restart.

    `blind`: no verdict along the track; `unknown`: the noise is not known; `begins`: begins anew by itself.
    """

    def __init__(
        self,
        fails: Iterable[int] = (),
        fast: Iterable[int] | None = None,
        rings: Iterable[int] = (),
        blind: Iterable[int] = (),
        unknown: Iterable[int] = (),
        begins: Iterable[int] = (),
    ) -> None:
        self.fails, self.rings, self.blind = set(fails), set(rings), set(blind)
        self.fast = self.fails if fast is None else set(fast)
        self.window_begins = set(begins)
        self.started = 0
        self.frozen: list[int] = []
        self.unknown = set(unknown)
        self.restarted: list[int] = []
        self.watched = np.zeros(0, dtype=np.int64)

    def watch(self, epochs: pl.DataFrame) -> ScriptedBank:
        """As a real bank: rows where position and odometer are known."""
        self.watched = np.flatnonzero(
            epochs.select(pl.all_horizontal(pl.col("path_m", "odometer_m").is_not_null())).to_series()
        )
        return self

    def failed(self, epoch: int) -> bool:
        return epoch in self.fails or (epoch in self.rings and not self.restarted)

    def fast_failed(self, epoch: int) -> bool:
        return epoch in self.fast

    def along_evaluated(self, epoch: int) -> bool:
        return epoch > self.started and epoch not in self.blind

    def hidden_until(self, epoch: int, end: int) -> int:
        return next((k for k in range(epoch, end) if k not in self.unknown or self.failed(k)), end)

    def first_alarm_from(self, epoch: int, end: int) -> int:
        return next((k for k in range(epoch, end) if not self._quiet(k)), end)

    def _quiet(self, epoch: int) -> bool:
        return not (self.failed(epoch) or self.begins_at(epoch)) and self.noise_known_at(epoch)

    def noise_known_at(self, epoch: int) -> bool:
        return epoch not in self.unknown

    def along_evaluated_between(self, epoch: int, end: int) -> np.ndarray:
        return np.array([self.along_evaluated(k) for k in range(epoch, end)], dtype=bool)

    def freeze(self, epoch: int) -> None:
        self.frozen.append(epoch)

    def begins_at(self, epoch: int) -> bool:
        return epoch in {0, *self.window_begins, *self.restarted}

    def restart(self, epoch: int) -> None:
        self.restarted.append(epoch)
        self.started = epoch


def epochs_of(
    path_m: Sequence[float | None],
    odometer_m: Sequence[float | None] | None = None,
    t_s: Sequence[float] | None = None,
    doubt_m: Sequence[float] | None = None,
    **columns: Any,
) -> pl.DataFrame:
    """One epoch a second unless `t_s`; the odometer reads the path unless given, in doubt by the sum `doubt_m`."""
    size = len(path_m)
    times = range(size) if t_s is None else t_s
    path = pl.Series("path_m", path_m, dtype=pl.Float64)
    odometer = path if odometer_m is None else pl.Series(odometer_m, dtype=pl.Float64)
    frame = pl.DataFrame(
        {"t": pl.Series([round(t * 1e9) for t in times], dtype=pl.Int64).cast(INSTANT), "path_m": path}
    ).with_columns(
        leg=pl.lit(0, pl.Int32),
        on_track=pl.lit(True),
        fix_valid=path.is_not_null(),
        gate_probability=pl.lit(1.0),
        position_sigma_m=pl.lit(1.0),
        confidence_m=pl.lit(6.18),
        odometer_m=odometer,
        direction=pl.lit(1, pl.Int8),
        odometer_slips=pl.lit(value=False),
        odometer_rows_m=pl.lit(0.0),
    )
    series = [
        value.alias(name) if isinstance(value, pl.Series) else pl.Series(name, value) for name, value in columns.items()
    ]
    # As matching says it: without a fix no path position, off the track no probability of the path.
    placed, sure = pl.when("fix_valid").then("path_m"), pl.when("on_track").then("gate_probability")
    travelled_m = pl.col("odometer_m").forward_fill().diff().fill_null(0.0).abs().cum_sum()
    said = frame.with_columns(series)
    said = said.with_columns(pl.Series("odometer_doubt_m", doubt_m or [0.0] * path.len(), dtype=pl.Float64))
    return said.with_columns(path_m=placed, gate_probability=sure, travelled_m=travelled_m)


def balises_at(places: dict[str, float], **columns: Any) -> pl.DataFrame:
    """Virtual, linked, 12 m, service brake, unless `columns` say otherwise (a value or a list)."""
    size = len(places)
    values: dict[str, Any] = {
        "leg": 0,
        "kind": "virtual",
        "netelement_id": "E",
        "location_accuracy_m": 12.0,
        "linked": True,
        "link_reaction": "service_brake",
        "valid_direction": 0,
    } | columns
    spread = {name: value if isinstance(value, list) else [value] * size for name, value in values.items()}
    frame = pl.DataFrame({"balise_id": list(places), "path_m": list(places.values())} | spread)
    return frame.with_columns(measure_m="path_m", leg=pl.col("leg").cast(pl.Int32))


def reads_at(reads: Sequence[tuple[float, str]]) -> pl.DataFrame:
    """Telegrams: seconds and identity."""
    return pl.DataFrame(
        {"t": [round(t * 1e9) for t, _ in reads], "balise_id": [name for _, name in reads]},
        schema={"t": pl.Int64, "balise_id": pl.String},
    ).with_columns(pl.col("t").cast(INSTANT))


def run(
    epochs: pl.DataFrame,
    balises: pl.DataFrame,
    bank: ScriptedBank | None = None,
    reads: pl.DataFrame | None = None,
    scale_sigma: float | None = SCALE_SIGMA,
    disabled: Sequence[str] = (),
    **lds: Any,
) -> LdsTables:
    on_odometer = None if reads is None else with_odometer(reads, epochs)
    bank = (bank or ScriptedBank()).watch(epochs)
    config = settings(disabled, **lds)
    result = run_lds(arrays_of_table(AlignedEpochs, epochs), bank, balises, on_odometer, scale_sigma, config)
    columns = [column for name, verdicts in result.linking.items() for column in verdicts.columns(name)]
    return LdsTables(
        epochs=pl.DataFrame([epochs["t"], *result.epochs.table, *columns]),
        crossings=_crossings(result.crossings),
        passages=result.passages,
        linking=result.linking,
        unknown_reads=result.unknown_reads,
        held=result.held,
    )


def _crossings(crossings: Crossings) -> pl.DataFrame:
    """One row each; `crossing_id` is its place."""
    words = [status.value for status in PassageStatus] + [None]
    return pl.DataFrame(
        {
            "crossing_id": np.arange(crossings.size),
            "t": pl.Series(crossings.t_ns, dtype=pl.Int64).cast(INSTANT),
            "kind": np.where(crossings.virtual, "virtual", "physical"),
            "status": pl.Series([words[number] for number in crossings.status], dtype=pl.String),
            **{name: getattr(crossings, name) for name in ("balise_id", "netelement_id", "measure_m", "leg", "path_m")},
            **{
                name: getattr(crossings, name)
                for name in ("before", "epoch", "sense", "direction", "odometer_m", "offered")
            },
        }
    )


def settings(disabled: Sequence[str] = (), **lds: Any) -> Configuration:
    return Configuration(lds=LdsConfig(**lds), monitors=MonitorConfig(disabled=tuple(disabled)))


def with_odometer(reads: pl.DataFrame, epochs: pl.DataFrame) -> pl.DataFrame:
    """Telegrams with the odometer at each, by a straight line between the epochs about it; null where it is unknown."""
    t_ns, at_ns = (frame["t"].to_physical().to_numpy() for frame in (epochs, reads))
    odometer_m = epochs["odometer_m"].cast(pl.Float64).to_numpy()
    here_m = np.interp(at_ns, t_ns, odometer_m, left=np.nan, right=np.nan)
    return reads.with_columns(odometer_m=pl.Series(here_m, nan_to_null=True))


def negations(result: LdsTables) -> list[tuple[int, int | None]]:
    """First epoch of each negation, and that of the return (none to the end)."""
    negated = np.concatenate([[False], result.epochs["negated"].to_numpy(), [False]])
    begins, ends = np.flatnonzero(np.diff(negated.astype(np.int8))).reshape(-1, 2).T.tolist()
    return [(begin, end if end < result.epochs.height else None) for begin, end in zip(begins, ends, strict=True)]


def passage_rows(result: LdsTables, *columns: str) -> list[tuple[Any, ...]]:
    """Passages as tuples of the named columns, times in seconds, enums as text."""
    frame = result.passages.select(columns)
    times = [i for i, kind in enumerate(frame.dtypes) if kind == INSTANT]
    rows = frame.with_columns(pl.col(pl.Datetime).dt.epoch("ns")).rows()
    return [
        tuple(value / 1e9 if i in times and value is not None else value for i, value in enumerate(row)) for row in rows
    ]


def steps(start_m: float, step_m: float, count: int) -> list[float]:
    return [start_m + step_m * k for k in range(count)]
