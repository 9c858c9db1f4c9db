"""Messages that no honest vehicle sends, but that pass as messages, end no run of `robust` and `robust_joint`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from coopenv.observers import Message, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario


@dataclass
class Alters:
    """Changes an entry of a field in most messages of the second vehicle: by a little, by much, or to another one's."""

    rng: np.random.Generator

    def applies(self, vehicle: int, time: float) -> bool:
        return vehicle == 1 and self.rng.random() < 0.8

    def told(self, observer: Any, message: Message) -> Message:
        if message.position is None:
            return message
        names = ["position", "covariance", *message.extra]
        name = names[self.rng.integers(len(names))]
        old = np.asarray(getattr(message, name) if name in ("position", "covariance") else message.extra[name])
        value = np.array(old, dtype=float)
        if not value.size:
            return message
        k = self.rng.integers(value.size)
        how = self.rng.integers(4)
        if how == 0:
            value.flat[k] *= 1.0 + 0.1 * self.rng.normal()
        elif how == 1:
            value.flat[k] += self.rng.normal() * 10.0 ** self.rng.integers(-3, 6)
        elif how == 2:
            value = value * 10.0 ** self.rng.uniform(-2, 2)
        else:
            value.flat[k] = value.flat[self.rng.integers(value.size)]
        if name == "covariance":
            value = (value + value.T) / 2.0
        info = np.iinfo(old.dtype) if old.dtype.kind in "iu" else None
        value = value if info is None else np.clip(np.rint(value), 0, min(info.max, 2**53))
        field = value.astype(old.dtype)
        if name in ("position", "covariance"):
            return replace(message, **{name: field})
        return replace(message, extra={**message.extra, name: field})


@pytest.mark.parametrize("observer", ["robust", "robust_joint"])
@pytest.mark.parametrize("seed", range(3))
def test_messages_with_altered_entries_end_no_run(observer: str, seed: int) -> None:
    made = load_scenario("busy_intersection_tracking", {"horizon": 6.0})
    found = run(observer, record(made, seed), Alters(np.random.default_rng(seed)))
    assert not found.failure
    assert np.isfinite(found.position).all()
    assert found.position_error[-60:, 0].max() < 0.2  # who hears nobody is not touched
