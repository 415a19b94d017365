"""Each key of `[survey]` decides what becomes of some survey."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.make.survey.pieces import Survey
from pipeline.make.survey.trace import clean_traces
from schemas.config import SurveyConfig
from schemas.errors import BaliseError
from tests.make.survey.test_site_of_survey import degrees, findings_text, recorded, site_of, track_csv, way, written

# Another value for each key.
OTHERS = {
    "size_limit_mb": 0.0001,
    "same_place_m": 2.0,
    "same_track_m": 0.3,
    "shape_m": 5.0,
    "stop_m": 100.0,
    "stop_sigmas": 5000.0,
    "gap_m": 1000.0,
    "gap_steps": 100.0,
    "toe_m": 400.0,
    "switch_deg": 3.0,
    "kink_deg": 60.0,
    "kink_radius_m": 10.0,
    "kink_aside_m": 2.0,
    "doubled_m": 300.0,
    "corner_deg": 15.0,
    "kilometre_m": 1000.0,
    "kilometre_share": 0.9,
    "balise_beside_m": 2.0,
}


def drawn(folder: Path, **keys: float) -> tuple[str, ...]:
    """What is made of lines and points: one text for each survey."""
    corner = way("corner", (0, 0), (5, 0), (10, 0.9), (200, 35.0))
    stem, branch = way("stem", (-300, 500), (0, 500), (300, 500)), way("branch", (0, 500), (300, 530))
    lines = [
        *(way("bent", (0, 100), (100, 100), (200, 150)), corner, stem, branch),
        *(
            way("one", (0, 200), (200, 200)),
            way("other", (0, 200.6), (200, 200.6)),
            way("near", (201, 200), (300, 200)),
        ),
    ]
    # A jump of 500 m, and posts that are 1,100 m apart by their numbers, 1,000 m by the track.
    even = np.arange(0.0, 2001.0, 10.0)
    posts = track_csv(folder / "km.csv", even, km=even / 1000 + np.where(even > 1000, 0.5, 0.0))
    every = [float(one) * 0.0011 if one % 1000 == 0 else None for one in even]
    sparse = track_csv(folder / "posts.csv", even, km=every)
    wanted = folder / "wanted.csv"
    wanted.write_text("lat,lon\n{},{}\n".format(*(axis[0] for axis in degrees([100.0], [5.0]))))
    made = []
    for survey, balises in (
        *((written(folder, "lines.geojson", *lines), None), (posts, None), (sparse, None)),
        (track_csv(folder / "line.csv", even), str(wanted)),
    ):
        try:
            site = site_of(survey, balises=balises, config=keys)
            made.append(f"{findings_text(site)} {site.track.rows()} {site.links.rows()}")
        except BaliseError as error:
            made.append(str(error))
    return tuple(one.replace(str(folder), "") for one in made)


def traced(**keys: float) -> tuple[str, ...]:
    """What is left of passes with a stop, a pause, a way back 1 m beside, and a branch."""
    rng = np.random.default_rng(3)
    there = np.concatenate([np.arange(0.0, 1000.0, 5.0), np.full(300, 1000.0), np.arange(1000.0, 2000.0, 5.0)])
    there = there[(there < 1400.0) | (there > 1600.0)]
    main = recorded("main", np.concatenate([there, there[::-1]]), np.repeat([0.0, 1.0], len(there)), rng)
    aside = np.arange(0.0, 1300.0, 5.0)
    branch = recorded("branch", aside, np.clip((aside - 800.0).clip(0) ** 2 / 1000.0, 0.0, 60.0), rng)
    survey = clean_traces(Survey([main, branch]), SurveyConfig(**keys))
    return tuple(f"{one.name} {one.latitude_deg.tolist()}" for one in survey.pieces)


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return drawn(tmp_path_factory.mktemp("surveys")), traced()


def test_nothing_changes_without_a_key(before: tuple[tuple[str, ...], tuple[str, ...]], tmp_path: Path) -> None:
    assert (drawn(tmp_path), traced()) == before


def test_every_key_is_tried() -> None:
    assert set(OTHERS) == set(SurveyConfig.model_fields)


@pytest.mark.parametrize("key", OTHERS)
def test_a_key_decides_what_a_survey_becomes(
    key: str, before: tuple[tuple[str, ...], tuple[str, ...]], tmp_path: Path
) -> None:
    changed = {key: OTHERS[key]}
    assert traced(**changed) != before[1] or drawn(tmp_path, **changed) != before[0]
