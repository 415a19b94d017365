"""What passes between the stages of a run is what `schemas.stages` says."""

from __future__ import annotations

import ast
import inspect
from itertools import pairwise

import numpy as np
import polars as pl
import pytest

import schemas.stages
from pipeline.stages.alignment.align import align
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from schemas.config import Configuration, Vehicle
from schemas.stages import ONE_TRACK_LEFT, AlignedEpochs, MatchedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.replay.journeys import VEHICLE, journey

CONFIG = Configuration()
KINDS = {"Floats": np.float64, "Bools": np.bool_, "Ints": np.int64}


def stages(vehicle, with_odometer):
    """A run with a stretch off the track and one without a fix."""
    faults = (
        {"kind": "step", "size_m": 850.0, "start_s": 150.0, "duration_s": 6.0},
        {"kind": "outage", "start_s": 60.0, "duration_s": 5.0},
    )
    run, site = journey(*faults)
    # A logger may write epochs without a position too.
    lost = pl.int_range(run.gnss.height).is_between(100, 120)
    unknown = [pl.when(~lost).then(name).alias(name) for name in ("latitude_deg", "longitude_deg")]
    run = run.with_streams(gnss=run.gnss.with_columns(unknown))
    odometry = odometry_of(run.odometer if with_odometer else None, vehicle, CONFIG)
    found = match(run.gnss, odometry, site, vehicle, CONFIG.matching, CONFIG.fix_sigma)
    oriented = None if odometry is None else odometry.growing_along_path(found.odometer_sign)
    return run, found.epochs, align(found.epochs, oriented, vehicle, CONFIG)


@pytest.mark.parametrize("vehicle", [VEHICLE, Vehicle()], ids=["file", "learned"])
@pytest.mark.parametrize("with_odometer", [True, False])
def test_stages_hand_on_arrays_of_the_kind_and_length_that_they_declare(vehicle, with_odometer):
    run, *frames = stages(vehicle, with_odometer)
    for frame, kind in zip(frames, (MatchedEpochs, AlignedEpochs), strict=True):
        assert type(frame) is kind
        for name, declared in annotations_of(kind).items():
            if declared in KINDS:
                values = getattr(frame, name)
                assert values.shape == (run.gnss.height,), name
                assert values.dtype == KINDS[declared], name


@pytest.mark.parametrize("with_odometer", [True, False])
def test_what_is_on_the_track_has_a_place_and_what_has_a_place_has_a_fix(with_odometer):
    for epochs in stages(VEHICLE, with_odometer)[1:]:
        placed = np.isfinite(epochs.path_m)
        assert not (placed & ~epochs.fix_valid).any()
        assert not (epochs.near_track & ~placed).any()
        assert not (epochs.on_track & ~epochs.near_track).any()
        assert not (np.isfinite(epochs.gate_probability) & ~epochs.on_track).any()
        # The rules are not kept by there being nothing.
        assert 0 < epochs.on_track.sum() <= epochs.fix_valid.sum() < epochs.height
        assert (epochs.gate_probability[epochs.on_track] >= ONE_TRACK_LEFT).any()


def test_a_table_comes_back_as_the_arrays_that_it_was_made_of():
    for epochs in stages(VEHICLE, with_odometer=True)[1:]:
        again = arrays_of_table(type(epochs), epochs.table)
        assert again.table.equals(epochs.table)
        assert epochs.table["leg"].null_count() == (~epochs.fix_valid).sum()
        assert not any(epochs.table.select(pl.col(pl.Float64).is_nan().any()).row(0))


def annotations_of(kind):
    return {name: declared for one in kind.__mro__ for name, declared in vars(one).get("__annotations__", {}).items()}


def test_every_column_between_stages_tells_its_meaning_and_unit():
    tree = ast.parse(inspect.getsource(schemas.stages))
    frames = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Epochs")]
    columns = [
        (f"{frame.name}.{node.target.id}", ast.unparse(node.annotation), ast.unparse(after))
        for frame in frames
        for node, after in pairwise(frame.body)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    ]
    assert len(columns) > 40
    for name, kind, text in columns:
        assert text.startswith(('"', "'")), name
        assert kind != "Floats" or "[" in text or "the same" in text.lower(), name
