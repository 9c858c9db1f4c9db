"""The trained adversary: its search, its attacks, and their replay on a recording."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import adversary
from coopenv.bench.observers.faults import variant_of
from coopenv.observers import run
from coopenv.runs import record
from coopenv.scenario import load_scenario

HORIZON = 8.0


def test_the_cross_entropy_method_finds_a_maximum() -> None:
    best = np.array([1.0, -2.0, 0.5])
    found = adversary.cross_entropy(
        lambda candidates, generation: -np.square(candidates - best).sum(axis=1), np.zeros(3), np.ones(3), 30, 24
    )
    assert_allclose(found, best, atol=0.05)


def test_a_steering_begins_in_time_and_keeps_the_limit() -> None:
    parameters = adversary.constant(np.array([2.0, 2.0]), np.array([0.1, 0.9]), np.array([0.0, np.pi / 2]))
    steering, features = adversary.linear(parameters, 0.3), np.ones((2, 10))
    assert not steering(1.0, features).any()
    assert_allclose(steering(2.0, features), [[0.1, 0.0], [0.0, 0.3]], atol=1e-12)


@pytest.mark.parametrize("odometry", adversary.ODOMETRY)
def test_an_attack_of_the_worlds_is_replayed_on_a_recording(odometry: str) -> None:
    """Steps of the velocity in the kernels are sums of drifts on the host."""
    seeds, drawn = [3, 4], np.random.default_rng(5).normal(scale=0.3, size=(3, 2, 2))
    worlds = adversary.Worlds(2, "riccati", odometry, {"horizon": HORIZON})
    rollouts = worlds.play(seeds, lambda time, features: drawn[int(time)])
    assert_allclose(rollouts.velocity, drawn.swapaxes(0, 1))
    assert np.isnan(rollouts.error[:, adversary.LIAR]).all()
    for world, seed in enumerate(seeds):
        recording = record(load_scenario(adversary.SCENE, {"horizon": HORIZON}), seed)
        fault = adversary.fault_of(rollouts.velocity[world], odometry)
        changed = variant_of(fault).applied(recording, 0)
        assert changed.interference is not None
        assert_allclose(changed.interference.shift[-1, adversary.LIAR, :2], drawn[:, world].sum(axis=0), atol=1e-3)
        found = run("riccati", changed)
        decisions = found.position_error[306::6]  # 10 Hz at 60 ticks per second, after `START`
        assert_allclose(np.delete(decisions.mean(axis=0), 1), np.delete(rollouts.error[world], 1), rtol=1e-3)


def test_the_table_and_the_worst_case(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(adversary, "OBSERVERS", ("riccati",))
    sizes = ["--generations", "1", "--population", "2", "--seeds", "1", "--held-out", "2"]
    assert adversary.main(["--horizon", "7", *sizes]) == 0
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 1 + 2 * 4 and rows[2].startswith("| none |")
    fault = printed.rpartition("--fault ")[2].split()[0]
    assert all(part.vehicles == ("vehicle_2",) for part in variant_of(fault).faults)
