"""The rank of a trained policy: arrivals come before errors, and what is missing is named."""

from __future__ import annotations

import pytest

from coopenv.evaluation import ranking_key
from coopenv.training.ranking import Ranking


def driver(arrived: float, collided: float, e95: float) -> dict[str, float]:
    return {"arrival_rate": arrived, "collision_rate": collided, "e95_m": e95, "e50_m": e95}


SAFE, EXACT = driver(0.99, 0.0, 0.21), driver(0.77, 0.2, 0.09)


def test_a_driver_that_crashes_ranks_behind_one_that_arrives() -> None:
    assert ranking_key(SAFE) < ranking_key(EXACT)
    assert ranking_key(driver(0.9, 0.0, 0.2)) < ranking_key(driver(0.9, 0.1, 0.1))
    assert ranking_key(driver(0.99, 0.0, 0.1)) < ranking_key(driver(0.995, 0.0, 0.2)), "both arrive"
    assert ranking_key(SAFE) < ranking_key(driver(0.0, 1.0, float("nan")))


@pytest.mark.parametrize(
    ("own", "missing"),
    [
        (EXACT, ["worse than peek: 77 against 99 % arrive"]),
        (driver(0.99, 0.05, 0.1), ["worse than peek: 5 against 0 % collide"]),
        (driver(1.0, 0.0, 0.25), ["worse than peek: 25 against 21 cm e95"]),
        (driver(1.0, 0.0, 0.08), []),
    ],
)
def test_the_last_line_names_what_is_missing(own: dict[str, float], missing: list[str]) -> None:
    ranking = Ranking("mine", {"peek": SAFE, "mine": own})
    assert ranking.missing == missing
    assert ranking.order == (["peek", "mine"] if missing else ["mine", "peek"])
    assert ranking.line.startswith(f"Rank {2 if missing else 1} of 2 in held-out worlds: {ranking.order[0]} (")
    assert ("more steps" in ranking.line) == bool(missing)


def test_the_first_of_drivers_that_crash_lacks_arrivals() -> None:
    assert Ranking("mine", {"peek": EXACT, "mine": driver(0.9, 0.0, 0.1)}).missing == ["90 % arrive, 98 % should"]


def test_the_error_of_a_lost_driver_is_a_plain_number() -> None:
    assert "mine (0 % arrive, e95 100 cm)" in Ranking("mine", {"peek": SAFE, "mine": driver(0.0, 1.0, 1.0)}).line
