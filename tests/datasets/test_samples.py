"""Public recordings: what is known of them shows in the runs made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.comma2k19 import comma2k19_run
from datasets.faults import FaultSpec
from datasets.infrabel import infrabel_run, infrabel_site
from datasets.inject import inject
from pipeline.one_run import replay
from pipeline.stages.matching import match
from pipeline.stages.track.geodesy import earth_centred_m, point_distances_m
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.errors import InputError
from schemas.run import RunLog, Site
from tests.stages.alignment.straight import NO_NOISE

DATA = Path(__file__).parents[2].parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.exists(), reason="the public recordings are not beside the project")
INFRABEL = DATA / "infrabel"


@pytest.fixture(scope="module")
def car() -> tuple[RunLog, Site]:
    return comma2k19_run(DATA / "comma2k19" / "segment", [150.0, 300.0, 500.0, 700.0])


def seconds(frame: pl.DataFrame, origin: pl.DataFrame) -> np.ndarray:
    return (frame["t"].to_physical().to_numpy() - origin["t"].to_physical()[0]) * 1e-9


def test_comma2k19_latency_and_scale_by_least_squares(car: tuple[RunLog, Site]) -> None:
    run, _ = car
    assert run.odometer is not None
    assert run.reference is not None
    pose = [run.reference[c].to_numpy() for c in ("latitude_deg", "longitude_deg", "height_m")]
    way = np.concatenate(([0.0], np.cumsum(point_distances_m(*pose))))
    pose_s, wheel_s, gnss_s = (seconds(f, run.gnss) for f in (run.reference, run.odometer, run.gnss))
    speed = run.odometer["speed_mps"].to_numpy()
    rolled = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(wheel_s))))
    inside = (pose_s > 1.0) & (pose_s < 58.0)
    scale, _ = np.polyfit(np.interp(pose_s[inside], wheel_s, rolled), way[inside], 1)
    assert scale == pytest.approx(1.0085, abs=2e-3)
    # Along the pose's heading the fixes lag by latency times speed.
    there = np.column_stack([np.interp(gnss_s, pose_s, axis) for axis in earth_centred_m(*pose).T])
    fixes = earth_centred_m(*(run.gnss[c].to_numpy() for c in ("latitude_deg", "longitude_deg", "height_m")))
    ahead = np.column_stack([np.interp(gnss_s + 0.5, pose_s, axis) for axis in earth_centred_m(*pose).T]) - there
    inside = (gnss_s > 0.5) & (gnss_s < 58.0)
    unit = ahead[inside] / np.linalg.norm(ahead[inside], axis=1)[:, None]
    behind = -np.einsum("ij,ij->i", fixes[inside] - there[inside], unit)
    latency, _ = np.polyfit(np.linalg.norm(ahead[inside], axis=1) / 0.5, behind, 1)
    mean = behind.mean() / (np.linalg.norm(ahead[inside], axis=1).mean() / 0.5)
    assert mean == pytest.approx(0.085, abs=0.01) or latency == pytest.approx(0.085, abs=0.01)


# A minute is hardly enough to measure the noise of the positions, so it is given.
GIVEN = Configuration.model_validate({"monitors": NO_NOISE})


def test_comma2k19_accepts_nothing_before_its_noise_is_known(car: tuple[RunLog, Site]) -> None:
    tables = replay(*car)
    known = tables.epochs.filter(pl.col("along_raw_state") != "not_evaluated")["t"][0]
    accepted = tables.passages.filter(pl.col("status") == "accepted")["t_offered"]
    assert 0 < accepted.len() < 4
    assert (accepted > known).all()
    assert tables.hazards.is_empty()
    assert tables.alarms.is_empty()


def test_comma2k19_replays_without_hazard(car: tuple[RunLog, Site]) -> None:
    tables = replay(*car, config=GIVEN)
    assert tables.passages["status"].to_list() == ["accepted"] * 4
    assert tables.hazards.is_empty()
    assert tables.alarms.is_empty()
    row = tables.runs.row(0, named=True)
    assert abs(row["odometer_scale"] - 1.0085) < 3.0 * row["odometer_scale_sigma"]
    assert abs(row["latency_s"] - 0.085) < 3.0 * row["latency_sigma_s"]


@pytest.mark.parametrize(
    ("values", "hazard", "within_s"),
    [
        ({"kind": "step", "size_m": 60.0, "start_s": 30.0}, "VB_SHIFT", 0.2),
        ({"kind": "ramp", "rate_mps": 1.5, "start_s": 20.0, "duration_s": 25.0}, "VB_SHIFT", 13.0),
    ],
)
def test_faults_injected_into_real_noise_are_detected(
    car: tuple[RunLog, Site], values: dict[str, object], hazard: str, within_s: float
) -> None:
    run, site = car
    hazards = replay(inject(run, FaultSpec.model_validate(values)), site, config=GIVEN).hazards
    assert hazards["hazard"].to_list() == [hazard]
    assert hazards["detected"].all()
    assert hazards["time_to_detect_s"][0] <= within_s
    assert hazards["accepted_ids"][0].to_list() == []


def test_infrabel_runs_keep_the_receivers_own_word_on_its_fixes() -> None:
    counts = {
        "log_28573_L36-A_to_L36C-A_to_L25N-B": {"estimated": 846, "autonomous": 19, "rtk_fixed": 588},
        "log_31241_L36-B_to_L36C-B_to_L25N-A": {"estimated": 1229, "autonomous": 25, "rtk_fixed": 1055, "none": 1},
    }
    for name, expected in counts.items():
        run = infrabel_run(INFRABEL / f"{name}.csv")
        assert run.run_id == name
        assert dict(run.gnss["fix"].value_counts().iter_rows()) == expected
        assert run.gnss["height_m"].null_count() == run.gnss.height
        assert run.odometer is None


def cross_track_m(run: RunLog, site: Site) -> np.ndarray:
    epochs = match(run.gnss, None, site, Vehicle(), MatchingConfig(), FixSigma()).epochs
    return epochs.cross_track_m


def test_infrabel_site_of_a_path() -> None:
    path = INFRABEL / "log_28876_L36-B-path-calculation.geojson"
    site = infrabel_site(INFRABEL / "network_airport.geojson", path, [("88_L_5900", 300.0)])
    whole = infrabel_site(INFRABEL / "network_airport.geojson")
    assert site.track["netelement_id"].n_unique() == 5
    assert whole.track["netelement_id"].n_unique() == 74
    assert site.links.height == 4
    assert site.balises is not None
    assert site.balises.row(0, named=True)["balise_id"] == "VB1"


def test_an_offset_injected_into_an_infrabel_run_shows_across_the_track() -> None:
    run = infrabel_run(INFRABEL / "log_28876_L36-B.csv")
    path = INFRABEL / "log_28876_L36-B-path-calculation.geojson"
    site = infrabel_site(INFRABEL / "network_airport.geojson", path)
    offset = FaultSpec.model_validate(
        {"kind": "step", "target": "cross", "start_s": 100.0, "size_m": 5.0, "duration_s": 20.0}
    )
    before, after = (cross_track_m(log, site) for log in (run, inject(run, offset)))
    t_s = seconds(run.gnss, run.gnss)
    hit = (t_s >= 100.0) & (t_s < 120.0)
    assert np.nanmean((after - before)[hit]) == pytest.approx(5.0, abs=0.2)
    assert np.nanmax(np.abs(after - before)[~hit]) < 1e-6


def test_a_log_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time,lat\n1,2\n")
    with pytest.raises(InputError, match="lacks columns"):
        infrabel_run(path)
    path.write_text(
        "timestamp,latitude,longitude,solution_status,position_type\n2022-01-01T00:00:00,50,4,SOL_COMPUTED,MAGIC\n"
    )
    with pytest.raises(InputError, match="MAGIC"):
        infrabel_run(path)
    with pytest.raises(InputError, match="cannot be read"):
        comma2k19_run(tmp_path)
