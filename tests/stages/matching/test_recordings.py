"""Measurement trains near Brussels airport, against paths reviewed by the network's own people."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from pipeline.read.site.read import read_site
from pipeline.stages.epochs.clock import least_belief
from pipeline.stages.matching import Match, match
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.run import Site

DATA = Path(__file__).parents[4] / "shared" / "data" / "infrabel"
FIX = {"NARROW_INT3": "rtk_fixed", "PROPAGATED": "estimated", "SINGLE": "autonomous"}
pytestmark = pytest.mark.skipif(not DATA.exists(), reason="the shared recordings are not beside the repository")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Site:
    folder = tmp_path_factory.mktemp("site")
    (folder / "track.geojson").write_bytes((DATA / "network_airport.geojson").read_bytes())
    return read_site(folder)


def recording(number: int) -> pl.DataFrame:
    log = pl.read_csv(next(DATA.glob(f"log_{number}_*.csv")))
    return (
        log.select(
            pl.col("timestamp").str.to_datetime(time_unit="ns").dt.replace_time_zone("UTC").alias("t"),
            pl.lit("primary").alias("solution"),
            pl.col("latitude").alias("latitude_deg"),
            pl.col("longitude").alias("longitude_deg"),
            pl.lit(None, dtype=pl.Float64).alias("height_m"),
            pl.col("position_type").replace_strict(FIX).alias("fix"),
        )
        .unique("t", keep="first")
        .sort("t")
    )


def matched(number: int, network: Site) -> Match:
    return match(recording(number), None, network, Vehicle(), MatchingConfig(), FixSigma())


def reviewed(number: int) -> list[str]:
    """Elements in the file; where epochs are given, in order of travel. Those without any stand at the end."""
    document = json.loads(next(DATA.glob(f"log_{number}_*path*.geojson")).read_text())
    return [feature["properties"]["netelement_id"] for feature in document["features"]]


@pytest.mark.parametrize("number", [28876, 29304])
def test_the_path_is_the_reviewed_one(number: int, network: Site) -> None:
    assert matched(number, network).path.element_names() == reviewed(number)


def test_where_positions_lie_nearer_the_track_beside_that_is_shown_and_nothing_claimed(network: Site) -> None:
    """In a tunnel, 2 m from one track and 6 m from the reviewed one for a minute; before and behind both agree."""
    found, known = matched(31241, network), reviewed(31241)
    shown = found.path.element_names()
    assert (shown[:8], shown[-3:]) == (known[:8], known[-3:])
    beside = found.epochs.table.filter(~pl.col("netelement_id").is_in(known))
    assert beside.select(pl.max_horizontal("gate_probability", "path_probability").max()).item() < 0.99
    tunnel = beside.filter(pl.col("netelement_id") == "88_L_13697")
    assert tunnel["cross_track_m"].abs().median() < 3.0


@pytest.mark.parametrize("number", [28573, 28876, 29304, 31241])
def test_nothing_is_claimed_off_the_reviewed_path_and_nothing_near_it_is_lost(number: int, network: Site) -> None:
    known = reviewed(number)
    epochs = matched(number, network).epochs.table
    sure = epochs.filter((pl.col("path_probability") >= 0.99) | (pl.col("gate_probability") >= 0.99))
    assert sure.height > 0.6 * epochs["on_track"].sum()
    assert set(sure["netelement_id"]) <= set(known)
    # Three elements of the first recording lie more than 50 m from every position.
    without_fixes = {"88_L_3955", "88_L_5977", "88_L_7820"} if number == 28573 else set()
    without_fixes = set(known[8:13]) if number == 31241 else without_fixes
    assert set(known) - without_fixes <= set(epochs["netelement_id"])


def test_positions_off_every_track_are_said_to_be_and_the_way_meanwhile_is_in_doubt(network: Site) -> None:
    """Fixes flagged as fixed ambiguities, and yet more than 50 m from any track; the train went on meanwhile."""
    found = matched(28573, network)
    flagged = found.epochs.table.with_columns(recording(28573)["fix"]).filter(pl.col("fix") == "rtk_fixed")
    assert flagged.filter(~pl.col("on_track")).height >= 200
    assert found.epochs.table.filter(pl.col("on_track") & (pl.col("cross_track_m").abs() > 20.0)).is_empty()
    assert found.ambiguous.select(least_belief().min()).item() < 0.5


def test_where_the_exact_path_is_unknown_the_doubt_is_listed(network: Site) -> None:
    found = matched(31241, network)
    assert found.ambiguous.height >= 3
    assert found.ambiguous.select(least_belief().min()).item() < 0.5


def test_the_constant_offset_of_map_or_antenna_is_told(network: Site) -> None:
    """Element by element -1.0 to -3.0 m, -1.9 m over the run: no fault of the GNSS."""
    found = matched(28876, network)
    epochs = found.epochs.table["cross_track_m"]
    assert epochs.median() == pytest.approx(-1.9, abs=0.3)
    used = (
        found.epochs.table.filter("fix_valid", "on_track")
        .group_by("netelement_id")
        .agg(pl.col("cross_track_m").median())
    )
    assert used["cross_track_m"].min() > -3.2
    assert used["cross_track_m"].max() < -0.8
    assert found.epochs.table["sigma_source"].cast(str).unique().to_list() == ["table"]
