"""Messages that no honest vehicle sends, but that pass as messages, end no run of `robust`.

Nor do those of one sender lead others astray that see two honest targets besides.
`pytest -s -m slow tests/observers/robust/test_hostile.py` prints the table of docs/robust_evidence.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from coopenv.observers import Message, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.robust_sources import scene


@dataclass
class Alters:
    """Changes an entry of a field in most messages of a vehicle: by a little, by much, or to another one's."""

    rng: np.random.Generator
    sender: int = 1
    start: float = 0.0  # s

    def applies(self, vehicle: int, time: float) -> bool:
        return vehicle == self.sender and time >= self.start and self.rng.random() < 0.8

    def broadcast(self, observer: Any, message: Message) -> Message:
        if message.position is None:
            return message
        fields = {"position": message.position, "covariance": message.covariance, **message.extra}
        name = list(fields)[self.rng.integers(len(fields))]
        old = np.asarray(fields[name])
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
        fields[name] = value.astype(old.dtype)
        return replace(message, position=fields.pop("position"), covariance=fields.pop("covariance"), extra=fields)


@pytest.mark.parametrize("seed", range(3))
def test_messages_with_altered_entries_end_no_run(seed: int) -> None:
    made = load_scenario("busy_intersection_tracking", {"horizon": 6.0})
    found = run("robust", record(made, seed), Alters(np.random.default_rng(seed)))
    assert not found.failure
    assert np.isfinite(found.position).all()
    assert found.position_error[-60:, 0].max() < 0.2  # who hears nobody is not touched


def errors_beside(sender: int, start: float, seed: int, horizon: float, altered: bool) -> np.ndarray:
    """Return (K, N-1) errors of the others in m, from `start` (at least 5 s) on, of honest or altered messages."""
    recording = record(scene(horizon=horizon), seed)
    found = run("robust", recording, Alters(np.random.default_rng(seed), sender, start) if altered else None)
    assert not found.failure
    return found.position_error[recording.t > max(start, 5.0)][:, [n for n in range(5) if n != sender]]


@pytest.mark.parametrize("sender", [1, 3])
def test_altered_messages_of_one_sender_lead_nobody_astray(sender: int) -> None:
    """Whether they count or not; others see two honest targets besides."""
    assert errors_beside(sender, 12.0, 2, 24.0, True).max() < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 15.0])
@pytest.mark.parametrize("sender", range(4))
def test_what_altered_messages_of_one_sender_cost(sender: int, start: float) -> None:
    pairs = [[errors_beside(sender, start, seed, 40.0, of) for of in (False, True)] for seed in range(900, 912)]
    without = np.mean([honest.mean() for honest, _ in pairs])
    cost = np.array([altered.mean() for _, altered in pairs]) / without
    worst = max(float(altered.max()) for _, altered in pairs)
    print(
        f"\n{sender + 1} from {start:.0f} s: {cost.mean():.2f}({cost.std(ddof=1) / 12**0.5:.2f}), worst {worst:.2f} m"
    )
    assert np.median(cost) < 2.0
