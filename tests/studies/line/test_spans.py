"""Where the train was between two epochs: the place of the evidence, not that of the position."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.results.places import stretches_of, train_path_m
from pipeline.studies.line.spans import SpanState, spans_of, states_of
from tests.studies.line.tables import CONFIG, SPLIT_M, alarms_of, epochs_of, nowhere


def spans(epochs: pl.DataFrame) -> pl.DataFrame:
    states = states_of(epochs, alarms_of(epochs)["t_start"], CONFIG)
    return spans_of(epochs, states, stretches_of(epochs), CONFIG)


@pytest.mark.parametrize("falling", [False, True])
def test_the_place_is_that_of_the_evidence_whatever_the_error_says(falling: bool) -> None:
    epochs = epochs_of(0, (), falling=falling)
    train_m = epochs["path_m"] + (1.0 if falling else -1.0)
    silent = epochs.with_columns(pl.lit(None, pl.Float64).alias(name) for name in ("error_low_m", "error_high_m"))
    low_m, high_m = train_path_m(silent, stretches_of(epochs))
    known = epochs["true_measure_low_m"].is_not_null().to_numpy()
    assert low_m[known] == pytest.approx((train_m - 2.0).to_numpy()[known])
    assert high_m[known] == pytest.approx((train_m + 2.0).to_numpy()[known])


def test_over_a_joint_the_way_is_known_and_a_track_beside_it_is_not() -> None:
    epochs = epochs_of(0, (), falling=False)
    joint = (pl.col("path_m") - SPLIT_M).abs() < 30.0
    both = {name: pl.when(joint).then(lost).otherwise(name) for name, lost in nowhere().items()}

    def way(names: list[str]) -> pl.DataFrame:
        set_to = pl.when(joint).then(pl.lit(names)).otherwise("true_netelement_ids")
        found = spans(epochs.with_columns(**both).with_columns(true_netelement_ids=set_to))
        return found.filter(pl.col("to_m") - pl.col("from_m") > 30.0)

    assert way(["A", "B"])["state"].to_list() == [int(SpanState.RIGHT)]
    assert way(["A", "B"])["elements"].to_list() == [["A", "B"]]
    assert way(["A", "P"])["state"].to_list() == [int(SpanState.UNKNOWN)]
