"""Episodes of single vehicles whose ends and errors are given."""

from __future__ import annotations

import numpy as np

from coopenv.estimation import Outcome
from coopenv.evaluation import Episodes


def trips(
    errors: list[float], arrived: np.ndarray, ended: np.ndarray, horizon: int = 80, speed: float = 1.0
) -> Episodes:
    """Return single-vehicle worlds of 0.5 s decisions on 20 m of road, each with one error all along.

    Args:
        errors: m, one per world.
        arrived: (W,) bool; the others crash when they end, or are under way at the horizon.
        ended: (W,) decisions after which a vehicle ends.
        horizon: decisions.
        speed: m/s.
    """
    W, K = len(errors), int(ended.max())
    under_way = (np.arange(K)[:, None] < ended)[..., None]
    place = np.minimum(np.arange(K + 1)[:, None], ended) * 0.5 * speed
    route = np.broadcast_to(np.array([[0.0, 0.0], [20.0, 0.0]]), (W, 1, 2, 2))
    outcome = np.where(arrived, Outcome.ARRIVED, np.where(ended < horizon, Outcome.COLLIDED, Outcome.UNDER_WAY))
    nothing = np.zeros((K, W, 1))
    return Episodes(
        vehicles=("car",),
        period=0.5,
        under_way=under_way,
        position_error=np.broadcast_to(np.array(errors)[:, None], (K, W, 1)).copy(),
        orientation_error=nothing,
        targets_in_view=nothing,
        reward=nothing,
        position=np.stack([place, np.zeros_like(place)], axis=-1)[:, :, None],
        heading=nothing,
        pan=nothing,
        route=route,
        arrivals=(arrived & (np.arange(1, K + 1)[:, None] >= ended))[..., None].astype(int),
        outcome=outcome[:, None],
        sees=np.zeros((K, W, 1, 1), dtype=bool),
        goal=np.ones((W, 1), dtype=bool),
        horizon=horizon,
    )
