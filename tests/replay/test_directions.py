"""Virtual balises of one direction over whole replays: what the other direction sees, counts and is judged by."""

from __future__ import annotations

import polars as pl
from polars.testing import assert_frame_equal

from schemas.inputs import Balises
from schemas.run import Site
from tests.replay.journeys import VEHICLE, journey, replay
from tests.replay.test_properties import JUMP, OFFSET, backwards, flipped
from tests.replay.test_shunting import KNOWN, shunting

OTHER = {"AB": "BA", "BA": "AB", "both": "both"}


def valid_in(site: Site, directions: dict[str, str]) -> Site:
    """The virtual balises named, in these directions."""
    said = pl.col("balise_id").replace_strict(directions, default="both", return_dtype=pl.String)
    return Site(site.track, site.links, Balises.validate(site.balises.with_columns(direction=said), cast=True))


def test_balises_of_the_other_direction_might_as_well_not_be_there():
    """A run with a jump and an offset: tables as on a site without them, and as on one surveyed from the other ends."""
    run, site = journey(JUMP, OFFSET)
    virtual = site.balises.filter(pl.col("kind").cast(pl.String) == "virtual")["balise_id"].to_list()
    forward = element_senses(run, site)
    ahead = {name: "AB" if forward[name] else "BA" for name in virtual}
    against = {name: OTHER[way] if number % 2 else way for number, (name, way) in enumerate(ahead.items())}
    gone = [name for name in virtual if against[name] != ahead[name]]
    assert gone
    bare = Site(site.track, site.links, site.balises.filter(~pl.col("balise_id").is_in(gone)))
    expected, found = replay(run, bare, VEHICLE), replay(run, valid_in(site, against), VEHICLE)
    for name in ("hazards", "passages", "alarms", "epochs"):
        assert_frame_equal(getattr(found, name), getattr(expected, name), check_exact=True)
    assert_frame_equal(found.runs.drop("input_digest"), expected.runs.drop("input_digest"))
    turned, _ = flipped(valid_in(site, against))
    swapped = valid_in(turned, {name: OTHER[way] for name, way in against.items()})
    columns = ["balise_id", "status", "direction", "linking_error"]
    assert_frame_equal(replay(run, swapped, VEHICLE).passages.select(columns), found.passages.select(columns))
    # The way back meets exactly the rest.
    back = replay(backwards(run), valid_in(site, against), VEHICLE)
    assert set(back.passages.filter(kind="virtual")["balise_id"]) == set(gone)


def element_senses(run, site):
    """Whether the run passes each balise with the measure of its net element."""
    epochs = replay(run, site, VEHICLE).epochs.filter(pl.col("on_track"))
    grows = epochs.group_by("netelement_id").agg(pl.col("measure_m").last() > pl.col("measure_m").first())
    return dict(site.balises.join(grows, on="netelement_id").select("balise_id", "measure_m_right").iter_rows())


def test_a_zig_zag_meets_each_balise_in_its_own_direction():
    run, site = shunting()
    tables = replay(run, valid_in(site, {"A1": "BA", "A2": "AB", "B1": "BA", "B2": "AB", "C1": "BA"}), KNOWN)
    # `c` is entered at the switch, its start: out with the measure, back against it.
    assert tables.passages.select("balise_id", "direction", "status").rows() == [
        ("A2", "growing", "accepted"),
        ("B2", "growing", "accepted"),
        ("B1", "falling", "accepted"),
        ("C1", "growing", "accepted"),
        ("B2", "growing", "accepted"),
    ]
    assert tables.runs["balises_on_path"].to_list() == [5]
    assert tables.runs["balises_missed"].to_list() == [0]
    assert tables.hazards.height == tables.alarms.height == 0


def test_without_an_odometer_the_reference_says_which_way_the_train_went():
    """A jump of 1,000 m ahead and back: the position comes back over a balise, the train does not turn."""
    run, site = journey(JUMP)
    velocities = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
    gnss = run.gnss.with_columns(pl.lit(None, pl.Float64).alias(name) for name in velocities)
    run = run.with_streams(odometer=None, gnss=gnss)
    forward = element_senses(run, site)
    virtual = site.balises.filter(pl.col("kind").cast(pl.String) == "virtual")["balise_id"].to_list()
    ahead = {name: "AB" if forward[name] else "BA" for name in virtual}
    both, found = replay(run, site, VEHICLE), replay(run, valid_in(site, ahead), VEHICLE)
    assert set(both.passages["direction"]) == {"growing"}
    assert both.passages.filter(kind="virtual")["balise_id"].is_duplicated().any()
    assert_frame_equal(found.passages, both.passages, check_exact=True)
    back = replay(run, valid_in(site, {name: OTHER[way] for name, way in ahead.items()}), VEHICLE)
    assert back.passages.filter(kind="virtual").is_empty()
