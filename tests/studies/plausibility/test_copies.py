"""A copy of the solution is no reference; an independent one is, however near it is and however few its digits are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import polars as pl
import pytest

from datasets.random_trials import random_trial
from pipeline.one_run import replay as replayed
from pipeline.studies.plausibility.places import copy_check
from pipeline.studies.plausibility.recording import recording_of
from schemas.config import Configuration, PlausibilityConfig, Vehicle
from schemas.errors import InputError
from schemas.inputs import Links
from schemas.run import RunLog, Site

_METRES = 111_319.5
_COLUMNS = ("t", "latitude_deg", "longitude_deg", "height_m")
Changed = Callable[[pl.DataFrame], pl.DataFrame]


def _rounded(decimals: int, per_degree: int = 1) -> Changed:
    return lambda frame: frame.with_columns(
        (pl.col("latitude_deg", "longitude_deg") * per_degree).round(decimals) / per_degree
    )


def _truncated(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns((pl.col("latitude_deg", "longitude_deg") * 1e7).floor() / 1e7)


def _gnss(run: RunLog, sigma_m: float = 1.0) -> pl.DataFrame:
    """Positions with a sigma stated, of which a part has no fix."""
    fixed = pl.col("fix").cast(pl.String) != "none"
    return run.gnss.with_columns(cov_ee_m2=pl.when(fixed).then(sigma_m**2), cov_nn_m2=pl.when(fixed).then(sigma_m**2))


def _copied(gnss: pl.DataFrame) -> pl.DataFrame:
    return gnss.drop_nulls("latitude_deg").select(*_COLUMNS, sigma_m=pl.lit(0.02))


def _moved(frame: pl.DataFrame, sigma_m: float, seed: int = 1) -> pl.DataFrame:
    """The same places with noise of their own."""
    noise = np.random.default_rng(seed).normal(0.0, sigma_m / _METRES, (2, frame.height))
    return frame.with_columns(pl.col("latitude_deg") + noise[0], pl.col("longitude_deg") + noise[1])


def _copies(
    gnss: pl.DataFrame, reference: pl.DataFrame, site: Site | None = None, config: PlausibilityConfig | None = None
) -> list[str]:
    run = RunLog("r", gnss, reference=reference)
    recording = recording_of(run, "primary", config or PlausibilityConfig(), Vehicle(), site)
    assert recording is not None
    check = copy_check(recording)
    return [] if check is None else [check.found]


@pytest.fixture(scope="module")
def run() -> RunLog:
    return random_trial(0).run


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda frame: frame, "places are those"),
        (_rounded(7), "0.01 m"),
        (_rounded(6), "0.1 m"),
        (_rounded(5, per_degree=60), "0.02 m"),
        (_truncated, "0.01 m"),
        (lambda frame: frame.gather_every(3, offset=1), "places are those"),
        (lambda frame: frame.slice(frame.height // 3), "places are those"),
    ],
    ids=["exact", "7 decimals", "6 decimals", "minutes", "truncated", "thinned", "part"],
)
def test_a_copy_is_reported(run: RunLog, change: Changed, said: str) -> None:
    gnss = _gnss(run)
    (found,) = _copies(gnss, change(_copied(gnss)))
    assert said in found


def test_an_independent_reference_is_none(run: RunLog) -> None:
    """Truth without noise and RTK of 2 cm, in many and in few digits, beside positions of 1 m and of 1 cm."""
    assert run.reference is not None
    truth = run.gnss.sort("t").select("t", "fix", "solution")
    at = [
        np.interp(truth["t"].to_physical(), run.reference["t"].to_physical(), run.reference[one])
        for one in _COLUMNS[1:]
    ]
    truth = run.gnss.with_columns(pl.Series(one, values) for one, values in zip(_COLUMNS[1:], at, strict=True))
    for sigma_m in (0.01, 0.02, 1.0):
        gnss = _gnss(run.with_streams(gnss=_moved(truth, sigma_m, 2)), sigma_m)
        for noise_m in (0.0, 0.02):
            for change in (lambda frame: frame, _rounded(7), _rounded(6), _rounded(5)):
                assert _copies(change(gnss), change(_moved(_copied(truth), noise_m))) == []
    # Where nothing is stated the kind of fix says it.
    unstated = _moved(truth, 0.01, 2).with_columns(
        pl.lit(None, pl.Float64).alias(one) for one in ("cov_ee_m2", "cov_nn_m2")
    )
    for change in (_rounded(7), _rounded(6)):
        fixed = unstated.with_columns(fix=pl.lit("rtk_fixed", unstated.schema["fix"]))
        assert _copies(change(fixed), change(_copied(truth))) == []


def test_positions_without_errors_may_equal_the_truth() -> None:
    """Ten minutes along a straight track, as a test of another program draws it; 0.5 m of error make a copy of it."""
    seconds = np.arange(0, 600)
    track = pl.DataFrame({"netelement_id": "A", "measure_m": [0.0, 20_000.0], "sigma_m": 1.0}).with_columns(
        latitude_deg=pl.Series([50.0, 50.0 + 20_000.0 / _METRES]), longitude_deg=4.0, height_m=pl.lit(None, pl.Float64)
    )
    gnss = pl.DataFrame({"latitude_deg": 50.0 + seconds * 20.0 / _METRES}).with_columns(
        t=pl.from_epoch(pl.Series(seconds), time_unit="s").cast(pl.Datetime("ns", "UTC")),
        longitude_deg=4.0,
        height_m=pl.lit(None, pl.Float64),
        fix=pl.lit("sbas"),
        solution=pl.lit("primary"),
        cov_nn_m2=1.0,
        cov_ee_m2=1.0,
    )
    site = Site(track, Links.create_empty(), None, None)
    assert _copies(gnss, _copied(gnss), site) == []
    assert len(_copies(_moved(gnss, 0.5), _copied(_moved(gnss, 0.5)), site)) == 1


def test_a_run_with_a_copy_fails_or_is_unproven() -> None:
    trial = random_trial(0)
    copied = trial.run.with_streams(reference=_copied(trial.run.gnss))
    with pytest.raises(InputError, match=r"copy of the solution.*Leave the reference out"):
        replayed(copied, trial.site, trial.vehicle)
    warn = Configuration.model_validate({"ingest": {"plausibility": "warn"}})
    (row,) = replayed(copied, trial.site, trial.vehicle, warn).runs.to_dicts()
    assert row["verdict"] in ("unproven", "unsafe")
    assert "copy of the solution" in row["notes"]


def test_what_makes_a_copy_is_configuration(run: RunLog) -> None:
    gnss = _gnss(run)
    half = _moved(_copied(gnss), 2.0).with_columns(
        pl.when(pl.int_range(pl.len()) % 10 < 9).then(_copied(gnss)[name]).otherwise(name).alias(name)
        for name in ("latitude_deg", "longitude_deg")
    )
    assert len(_copies(gnss, half)) == 1
    assert _copies(gnss, half, config=PlausibilityConfig(copy_share=0.95)) == []
    assert _copies(gnss, half, config=PlausibilityConfig(copy_chance=1e-30)) == []
