"""The global state vector: truth and estimates of everybody, for centralised critics and for tests."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from coopenv.api.engine import Engine
from coopenv.scenario import Scenario

PER_AGENT = 12
"""position (3), first two columns of R (6), linear velocity (3), all of truth"""
PER_VEHICLE = 9
"""estimated position (3) and first two columns of Rhat (6)"""
LIMIT = 1e6


def state_space(scenario: Scenario) -> spaces.Box:
    """Return the space of `state_vector`: metres and m/s, clipped far beyond any scene."""
    size = PER_AGENT * len(scenario.target_names) + PER_VEHICLE * len(scenario.vehicles) + 1
    return spaces.Box(-LIMIT, LIMIT, shape=(size,), dtype=np.float32)


def state_vector(engine: Engine) -> np.ndarray:
    """Return the state of world 0: every agent's truth (landmarks first), every vehicle's estimate, episode share.

    Truth that a recording does not know reads 0.
    """
    R, position, velocity = (engine.view(name)[0] for name in ("rotation", "position", "velocity"))
    R_hat, p_hat = engine.view("estimate_rotation")[0], engine.view("estimate_position")[0]
    position_hat = np.einsum("nij,nj->ni", R_hat, p_hat)
    truth = np.hstack([position, R[:, :, 0], R[:, :, 1], velocity])
    estimate = np.hstack([position_hat, R_hat[:, :, 0], R_hat[:, :, 1]])
    share = engine.view("tick")[:1] / engine.world.model.horizon_ticks
    whole = np.concatenate([truth.ravel(), estimate.ravel(), share]).astype(np.float32)
    result: np.ndarray = np.nan_to_num(whole.clip(-LIMIT, LIMIT), nan=0.0)
    return result
