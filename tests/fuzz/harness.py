"""Treatment of hostile input, and its effect on an environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv import CoopenvError
from coopenv.base.sections import TOO_DEEP


def taken(read: Callable[[], Any], use: Callable[[Any], None], most: int = 600) -> str:
    """Return how input is taken: refused in one line of at most so many characters, or else used."""
    try:
        made = read()
    except CoopenvError as error:
        message = str(error)
        assert message.isprintable() and len(message) <= 600, message
        assert len(message) <= most or "known:" in message or TOO_DEEP in message, message
        return "refused"
    try:
        use(made)
    except CoopenvError as error:
        return "failed: " + str(error)[:60]
    return "accepted"


def go_through(env: Any, steps: int = 10**6, seed: int | None = None) -> None:
    """Step an environment after its reset, with actions of zero or drawn by a seed; nothing may be NaN."""
    draw = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed or 0)
    for _ in range(steps):
        assert all(np.isfinite(row).all() for row in observations.values()) and np.isfinite(env.state()).all()
        if not env.agents:
            return
        largest = 0.0 if seed is None else 1.0
        actions = {agent: draw.uniform(-largest, largest, 2).astype(np.float32) for agent in env.agents}
        observations, rewards, *_ = env.step(actions)
        assert np.isfinite(list(rewards.values())).all(), rewards
