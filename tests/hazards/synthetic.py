"""Straight-line journeys made of arrays, with faults whose answer is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl

from pipeline.hazards import Case, HazardResult, classify, establish_truth
from schemas.config import Configuration, HazardConfig
from schemas.tables import MONITORS, Passages

START_NS = 1_700_000_000_000_000_000
UTC = pl.Datetime("ns", "UTC")
PASSAGE_TYPES = {name: column.dtype for name, column in Passages.columns().items()}


def stamps(seconds):
    return pl.Series("t", [START_NS + round(s * 1e9) for s in seconds], dtype=pl.Int64).cast(UTC)


def seconds(instant):
    """Seconds since the journey's start of a datetime cell or a list of them."""
    return None if instant is None else (pl.Series([instant], dtype=UTC).dt.timestamp("ns")[0] - START_NS) / 1e9


@dataclass(frozen=True)
class Journey:
    """A train at constant speed, 10 Hz, VBs each 200 m from 100 m on; `error_m(t)` is along growing path."""

    duration_s: float = 120.0
    rate_hz: float = 10.0
    speed_mps: float = 20.0
    start_m: float = 0.0
    balises_m: tuple[float, ...] = tuple(np.arange(100.0, 3000.0, 200.0))
    sigma_m: float = 1.0
    steps: tuple[tuple[float, float, float], ...] = ()  # from s, to s, metres
    ramps: tuple[tuple[float, float, float], ...] = ()  # from s, to s, m/s; back to zero afterwards
    outages: tuple[tuple[float, float], ...] = ()
    slip: tuple[float, float, float] | None = None  # from s, to s, m/s counted too much
    reference: bool = True
    reads: tuple[float, ...] = ()  # places of physical balises
    doppler: bool = False
    fails: dict[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    negated: tuple[tuple[float, float], ...] = ()
    accepted: dict[str, float] = field(default_factory=dict)
    faults: tuple[tuple[float, float, str, str], ...] = ()
    survey: tuple[float, float, float] | None = None  # from s, to s, metres that the surveyed track is off across

    def but(self, **changes):
        return replace(self, **changes)

    def t_s(self):
        return np.arange(round(self.duration_s * self.rate_hz) + 1) / self.rate_hz

    def truth_m(self):
        return self.start_m + self.speed_mps * self.t_s()

    def error_m(self):
        t = self.t_s()
        error = np.zeros(t.size)
        for begin, end, size in self.steps:
            error += np.where((t >= begin - 1e-9) & (t < end - 1e-9), size, 0.0)
        for begin, end, rate in self.ramps:
            error += np.where((t >= begin - 1e-9) & (t < end - 1e-9), rate * (t - begin), 0.0)
        return error

    def odometer_m(self):
        t = self.t_s()
        extra = np.zeros(t.size)
        if self.slip is not None:
            begin, end, rate = self.slip
            extra = rate * np.clip(t - begin, 0.0, end - begin)
        return self.speed_mps * t + extra

    def within(self, spans):
        t = self.t_s()
        mask = np.zeros(t.size, dtype=bool)
        for begin, end in spans:
            mask |= (t >= begin - 1e-9) & (t <= end + 1e-9)
        return mask

    def epochs(self):
        t = self.t_s()
        out = self.within(self.outages)
        path = np.where(out, np.nan, self.truth_m() + self.error_m())
        size = t.size
        columns = {
            "t": stamps(t),
            "leg": pl.Series([0] * size, dtype=pl.Int32),
            "path_m": pl.Series(path, nan_to_null=True),
            "netelement_id": ["A"] * size,
            "measure_m": pl.Series(path, nan_to_null=True),
            "cross_track_m": self.across_m(t),
            "vertical_m": np.zeros(size),
            "on_track": ~out,
            "fix_valid": ~out,
            "gate_probability": np.ones(size),
            "sigma_along_m": np.full(size, self.sigma_m),
            "sigma_cross_m": np.full(size, self.sigma_m),
            "sigma_up_m": np.full(size, self.sigma_m),
            "confidence_m": np.full(size, 6.18 * self.sigma_m),
            "odometer_m": self.odometer_m(),
            "odometer_segment": np.zeros(size, dtype=np.int64),
            "odometer_white_m2_per_s": np.full(size, 0.0025),
            "odometer_rows_m": np.zeros(size),
            "speed_mps": np.full(size, self.speed_mps),
            "direction": pl.Series([1 if self.speed_mps > 0 else -1] * size, dtype=pl.Int8),
            "scale_sigma": np.full(size, 1e-4),
            "latency_s": np.zeros(size),
            "latency_sigma_s": np.full(size, 0.01),
            "velocity_along_mps": pl.Series(
                np.full(size, self.speed_mps if self.doppler else np.nan), nan_to_null=True
            ),
            "alarm": self.within([span for spans in self.fails.values() for span in spans]),
            "negated": self.within(self.negated),
            "diagnosis_faulty": np.zeros(size, dtype=bool),
            "tvb": ~out & ~self.within(self.negated),
        }
        for name in MONITORS:
            fails = self.within(self.fails.get(name, ()))
            columns[f"{name}_state"] = np.where(fails, "fail", "pass")
            columns[f"{name}_value"] = np.where(fails, 3.0, 0.0)
            columns[f"{name}_threshold"] = np.full(size, 2.0)
        frame = pl.DataFrame(columns)
        return frame.with_columns(
            pl.col(f"{name}_state").cast(pl.Enum(["pass", "fail", "not_evaluated"])) for name in MONITORS
        )

    def balises(self):
        size = len(self.balises_m)
        return pl.DataFrame(
            {
                "leg": pl.Series([0] * size, dtype=pl.Int32),
                "balise_id": [f"V{i}" for i in range(size)],
                "kind": ["virtual"] * size,
                "path_m": pl.Series(self.balises_m, dtype=pl.Float64),
            }
        )

    def passages(self, rows=None):
        """One accepted row per VB named in `accepted` (VB: time of the offer), or the given rows."""
        place = dict(zip([f"V{i}" for i in range(len(self.balises_m))], self.balises_m, strict=True))
        defaults = {
            "solution": "primary",
            "kind": "virtual",
            "netelement_id": "A",
            "status": "accepted",
            "linking_error": "none",
            "reaction": "none",
            "failure_mode": "none",
            "cause": "none",
            "suspect_after_the_fact": False,
        }
        given = rows if rows is not None else [{"balise_id": b, "t_offered": s} for b, s in self.accepted.items()]
        records = []
        for row in given:
            record = {**defaults, "path_m": place[row["balise_id"]], "measure_m": place[row["balise_id"]], **row}
            offered = record.get("t_offered")
            record["t_offered"] = None if offered is None else START_NS + round(offered * 1e9)
            records.append(record)
        plain = {name: pl.String if isinstance(kind, pl.Enum) else kind for name, kind in PASSAGE_TYPES.items()}
        return pl.DataFrame(records, schema=plain, orient="row").cast(PASSAGE_TYPES)

    def reference_frame(self):
        t = np.arange(round(self.duration_s * 20.0) + 1) / 20.0
        place = self.start_m + self.speed_mps * t
        zeros = np.zeros(t.size)
        return pl.DataFrame(
            {
                "t": stamps(t),
                "path_m": place,
                "cross_track_m": self.across_m(t),
                "vertical_m": zeros,
                "sigma_m": zeros + 0.01,
            }
        )

    def across_m(self, t):
        """Distance of the true place from the surveyed track."""
        begin, end, size = self.survey or (0.0, 0.0, 0.0)
        return np.where((t >= begin - 1e-9) & (t < end - 1e-9), size, 0.0)

    def reads_frame(self):
        times = [(place - self.start_m) / self.speed_mps for place in self.reads]
        return pl.DataFrame({"t": stamps(times), "path_m": list(self.reads)}, schema_overrides={"path_m": pl.Float64})

    def faults_frame(self):
        if not self.faults:
            return None
        return pl.DataFrame(
            {
                "t_start": stamps([f[0] for f in self.faults]),
                "t_end": stamps([f[1] for f in self.faults]),
                "kind": [f[2] for f in self.faults],
                "target": [f[3] for f in self.faults],
            }
        )


def locate(leg, path_m):
    place = np.asarray(path_m, dtype=float)
    return np.array(["A"] * place.size, dtype=object), place


def truth_of(journey, passages=None, config=None):
    config = config or Configuration()
    return establish_truth(
        journey.epochs(),
        journey.reference_frame() if journey.reference else None,
        journey.reads_frame() if journey.reads else None,
        journey.passages() if passages is None else passages,
        config,
    )


def judge(journey, passages=None, config=None) -> HazardResult:
    config = config or Configuration()
    rows = journey.passages() if passages is None else passages
    truth = truth_of(journey, rows, config)
    return classify(
        Case("primary", journey.epochs(), truth, rows, journey.balises(), journey.faults_frame(), locate, config)
    )


def with_hazards(**settings):
    return Configuration(hazards=HazardConfig(**settings))
