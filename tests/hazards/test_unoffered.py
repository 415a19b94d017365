"""Virtual balises that the train passed and the position never did: rows of their own."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.hazards import establish_truth, with_unoffered
from schemas.config import Configuration, LdsConfig
from tests.hazards.synthetic import UTC, Journey, seconds, stamps, truth_of


def added(
    journey: Journey, offers: list[dict[str, object]], truth: pl.DataFrame | None = None
) -> list[dict[str, object]]:
    """Rows that the LDS did not write, of a journey of which it wrote `offers`."""
    passages = journey.passages(offers).with_columns(t_reckoned=pl.lit(None, UTC))
    site = {"netelement_id": pl.lit("A"), "measure_m": pl.col("path_m"), "location_accuracy_m": pl.lit(12.0)}
    balises = journey.balises().with_columns(**site)
    truth = truth_of(journey) if truth is None else truth
    found = with_unoffered(passages, journey.epochs(), truth, balises, LdsConfig(), "primary")
    assert found.select(pl.coalesce("t_offered", "t_reckoned")).to_series().is_sorted()
    return found.filter(pl.col("t_offered").is_null()).to_dicts()


def all_offers(*ids: int) -> list[dict[str, object]]:
    """Offers at the true passage: 100 m + 200 m a number, at 20 m/s."""
    return [{"balise_id": f"V{i}", "t_offered": 5.0 + 10.0 * i} for i in ids]


SHORT = Journey(duration_s=60.0, balises_m=(100.0, 300.0, 500.0, 700.0, 900.0, 1100.0))


def test_nothing_is_added_to_a_healthy_run():
    assert added(SHORT, all_offers(0, 1, 2, 3, 4, 5)) == []


def test_late_position_at_the_end_of_a_run_misses_what_the_train_passed():
    # 140 m behind from 50 s on: the position ends at 1060 m, the train passes V5 (1100 m) at 55 s.
    (row,) = added(SHORT.but(steps=((50.0, 61.0, -140.0),)), all_offers(0, 1, 2, 3, 4))
    assert (row["balise_id"], row["status"], row["direction"]) == ("V5", "missed", "growing")
    assert (row["failure_mode"], row["cause"]) == ("deletion", "position")
    assert seconds(row["t_reckoned"]) == pytest.approx(55.0)


def test_early_position_at_the_start_of_a_run_misses_what_the_train_passed():
    # 120 m ahead up to 10 s: the position begins at 120 m, beyond V0 (100 m).
    (row,) = added(SHORT.but(steps=((0.0, 10.0, 120.0),)), all_offers(1, 2, 3, 4, 5))
    assert (row["balise_id"], row["status"]) == ("V0", "missed")
    assert seconds(row["t_reckoned"]) == pytest.approx(5.0)


def test_outage_at_the_start_of_a_run_is_not_available():
    rows = added(SHORT.but(outages=((0.0, 20.0),)), all_offers(2, 3, 4, 5))
    assert [(row["balise_id"], row["status"], row["cause"]) for row in rows] == [
        ("V0", "not_available", "no_position"),
        ("V1", "not_available", "no_position"),
    ]


def test_falling_path_is_told():
    journey = SHORT.but(speed_mps=-20.0, start_m=1150.0, steps=((50.0, 61.0, 140.0),))
    offers = [{"balise_id": f"V{i}", "t_offered": (1150.0 - 100.0 - 200.0 * i) / 20.0} for i in (1, 2, 3, 4, 5)]
    (row,) = added(journey, offers)
    assert (row["balise_id"], row["direction"]) == ("V0", "falling")


def test_beside_a_balise_at_the_start_noise_decides():
    # The train begins 5 m before V0, the position 1 m behind it; the run ends 9 m behind V5, the position 1 m before.
    journey = SHORT.but(start_m=95.0, duration_s=50.7, steps=((0.0, 25.0, 6.0), (25.0, 51.0, -10.0)))
    assert added(journey, [{"balise_id": f"V{i}", "t_offered": 10.0 * i} for i in (1, 2, 3, 4)]) == []


def truth_by_reads(journey: Journey, reads: dict[float, float]) -> pl.DataFrame:
    """Truth by balise reads alone: place by second."""
    frame = pl.DataFrame({"t": stamps(reads), "path_m": list(reads.values())})
    return establish_truth(journey.epochs(), None, frame, None, Configuration())


@pytest.mark.parametrize(
    "reads",
    [
        pytest.param({15.0: 300.0, 20.0: 1000.0, 45.0: 900.0}, id="a balise further on is read 600 m before it"),
        pytest.param({5.0: 100.0, 20.0: 800.0, 40.0: 400.0, 50.0: 1000.0}, id="two balises have changed places"),
    ],
)
def test_balise_reads_out_of_order_lose_no_balise_that_was_offered(reads: dict[float, float]):
    # What the reads say of the places between would have passed V2 to V4 again, and elsewhere.
    offers = all_offers(0, 1, 2, 3, 4, 5)
    assert added(SHORT, offers, truth_by_reads(SHORT, reads)) == []


def test_balise_lost_where_reads_contradict_the_odometer_still_has_its_row():
    reads = {5.0: 100.0, 20.0: 440.0, 50.0: 1000.0}
    (row,) = added(SHORT.but(outages=((34.0, 36.0),)), all_offers(0, 1, 2, 4, 5), truth_by_reads(SHORT, reads))
    assert (row["balise_id"], row["status"]) == ("V3", "not_available")
