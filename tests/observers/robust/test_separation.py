"""What landmarks and odometry alone say: it is consistent, and a belief that is elsewhere goes back to it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coopenv.estimation.poses import Coordinates
from coopenv.observers import run
from coopenv.observers.robust.constants import SEPARATION_GATE
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.builders import reset, simulate
from tests.helpers.robust_observers import OpenRobust
from tests.observers.robust.test_lies import scene


@pytest.mark.parametrize("seed", [515, 522])
def test_beliefs_that_a_lie_has_misled_go_back(seed: int) -> None:
    """The second vehicle lies from its first word: followers that see two landmarks and three of them fit some pose."""
    errors = run("robust", record(scene((1,), 6.0, kind="jump"), seed)).position_error
    assert errors[10:120, 2:].max() > 1.0
    assert errors[-60:, 2:].max() < 0.5


def nees_alone(scenario: Scenario, worlds: int, seconds: int) -> np.ndarray:
    """Return (K, W, N) the NEES of what landmarks alone say in honest worlds.

    NaN where it has not just been carried on.
    """
    world = simulate(scenario, worlds)
    reset(world, range(800, 800 + worlds))
    found = []
    for k in range(seconds):
        world.advance(60)
        alone = world.memory.landmark_only.numpy()
        assert alone["begun"].all()
        estimate = alone["estimate"]
        R, p = (world.view(name)[:, world.model.landmarks :] for name in ("rotation", "position"))
        e = Coordinates.LEFT.error(R, p, estimate["pose"]["R"], estimate["pose"]["p"])
        nees = np.einsum("...i,...i", e, np.linalg.solve(estimate["P"], e[..., None])[..., 0])
        found.append(np.where(alone["tick"] == 60 * (k + 1), nees, np.nan))
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("busy_intersection_tracking", {}),
        ("busy_intersection_tracking", {"camera.extrinsics_position_error": 0.2, "camera.extrinsics_error": 0.02}),
        ("random:12,seed=5", {}),
    ],
)
def test_landmarks_alone_are_consistent(name: str, faults: dict[str, float]) -> None:
    """Also with two of them in view, where a filter that believes its noise gets sure of what it cannot know."""
    scenario = load_scenario(name, {"observer.name": "robust", "horizon": 61.0, **faults})
    nees = nees_alone(scenario, 8, 60)
    assert np.isfinite(nees).mean() > 0.9
    assert np.nanmean(nees, axis=(0, 1)).max() / 6.0 < 2.0
    assert np.nanquantile(nees, 0.999) < SEPARATION_GATE


def test_who_hears_nobody_does_not_go_back() -> None:
    """What landmarks alone say is the same, only vaguer."""
    world = simulate(scene(horizon=6.0), 2)
    reset(world, range(2))
    world.advance(300)
    assert world.memory.landmark_only.numpy()["exposed"].tolist() == [[0, 1, 1, 1, 1]] * 2


def test_who_is_accused_and_out_of_view_is_blamed_alone() -> None:
    """The fifth vehicle sees four others; while bearings contradict the second one that one is hidden."""
    trusted: list[dict[int, bool]] = []

    class Accusing(OpenRobust):
        def update(self, tick: Any) -> Any:
            if self.setup.vehicle != 4 or tick.index != 295:
                return super().update(tick)
            self.memory.belief["suspect"] = 1 + self.member_numbers[1:].index(1)
            self.memory.belief["suspect_error"] = 0.3
            hidden = tick.targets == self.setup.landmarks + 1
            estimate = super().update(replace(tick, valid=tick.valid & ~hidden))
            trusted.append(self.trusted)
            return estimate

    run(Accusing, record(scene(horizon=5.0), 4))
    assert trusted == [{0: True, 1: False, 2: True, 3: True}]


def test_a_belief_that_somebody_has_moved_goes_back_at_once() -> None:
    """The second vehicle sees three landmarks; its belief is moved by 2 m and thinks itself as sure as before."""
    said = []

    class Moved(OpenRobust):
        def update(self, tick: Any) -> Any:
            if self.setup.vehicle == 1 and tick.index == 295:
                self.members["pose"]["p"][0] += np.array([1.2, -1.6, 0.0])
            return super().update(tick)

        def message(self) -> Any:
            message = super().message()
            if self.setup.vehicle == 1:
                said.append(message.position is not None)
            return message

    result = run(Moved, record(scene(horizon=8.0), 4))
    errors = result.position_error[:, 1]
    assert errors[295] > 1.0
    assert errors[310:].max() < 0.3
    assert all(said)
