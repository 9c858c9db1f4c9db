"""Observers on the host meet the faults of the world as those in its kernels do; what they receive is checked."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

from coopenv.base.errors import CoopenvError
from coopenv.base.seeds import world_keys
from coopenv.observers import Message, Recording, run
from coopenv.observers.centralised import Centralised
from coopenv.observers.contract import Tick, check_received
from coopenv.observers.pose_filters import MekfCovariance
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.sources.worlds import Replay
from coopenv.world.world import World
from tests.helpers.builders import estimated_position, start
from tests.helpers.builders import run as over_ticks
from tests.helpers.recordings import Tampering, completed

OTHER = "vehicles.vehicle_2.faults"
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "jump": {f"{OTHER}.lie": {"kind": "jump", "start": 0.3, "std": 0.1}},
    "drift": {f"{OTHER}.lie": {"kind": "drift", "start": 0.3, "speed": 1.0}},
    "replay": {f"{OTHER}.lie": {"kind": "replay", "start": 0.3, "age": 0.2}, "v2x.delay": 2, "v2x.period": 3},
    "clock": {"faults.clock_offset": 0.1, "v2x.staleness": 0.1},
    "corruption": {"faults.corruption.probability": 0.3},
    "restart": {OTHER: {"restart": {"chance": 1.0, "time": 0.42}}},
    "map": {f"{OTHER}.map_error": {"chance": 1.0, "landmark": "SL2", "offset": 2.0, "start": 0.3}},
    "map of a restart": {"faults": {"map_error": {"chance": 0.7}, "restart": {"chance": 0.5, "time": 0.42}}},
    "jammer": {f"{OTHER}.jammer": {"chance": 1.0, "range": 22.0, "start": 0.3, "period": 0.2, "duty": 0.5}},
    "lens": {"camera.focal_length_error": 0.05},
}


def scene(name: str, **more: Any) -> Scenario:
    start = {"position_radius": 0.2, "orientation_angle": 0.05}
    overrides = {"horizon": 1.0, "vehicle_defaults.initial_estimate": start, **FAULTS[name], **more}
    return load_scenario("busy_intersection_tracking", overrides)


@cache
def recorded(name: str, seed: int = 3) -> Recording:
    return record(scene(name), seed)


def in_kernels(made: Scenario, seed: int) -> np.ndarray:
    """Return (K, N, 3) the positions that the world's own observers estimate, m."""
    return positions(start(made, [world_keys(seed)[0]]), made.horizon_ticks)


def positions(world: World, ticks: int) -> np.ndarray:
    """Return (K, N, 3) the estimated positions over some ticks, m."""
    states = over_ticks(world, ticks, "estimate_rotation", "estimate_position")
    return np.array([estimated_position(state)[0] for state in states[1:]])


@pytest.mark.parametrize(
    ("observer", "atol"),
    [("riccati", 1e-9), pytest.param("robust", 1e-6, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("name", list(FAULTS))
def test_the_same_observer_meets_the_same_faults_on_the_host(name: str, observer: str, atol: float) -> None:
    """The host's messages, clocks and restarts are code of their own: Python and dictionaries in place of kernels."""
    found = completed(observer, recorded(name))
    assert_allclose(found.position[1:], in_kernels(scene(name, **{"observer.name": observer}), 3), atol=atol)


class Listens(MekfCovariance):
    """Keeps what vehicle 3 hears of vehicle 2, and starts."""

    heard: list[tuple[float, Message, float]]
    started: list[tuple[int, np.ndarray]]

    def __init__(self, setup: Any) -> None:
        super().__init__(setup)
        self.me = setup.vehicle

    def reset(self, initial_pose: Any, initial_covariance: np.ndarray) -> None:
        Listens.started.append((self.me, initial_covariance))
        super().reset(initial_pose, initial_covariance)

    def update(self, tick: Tick) -> Any:
        if self.me == 2 and 4 in tick.messages:
            Listens.heard.append((tick.time, tick.messages[4].message, tick.messages[4].age))
        return super().update(tick)


def listen(made: Recording, tamper: Any = None) -> Any:
    Listens.heard, Listens.started = [], []
    return run(Listens, made, tamper)


def test_a_restart_resets_its_vehicle_alone() -> None:
    listen(recorded("restart"))
    assert [vehicle for vehicle, _ in Listens.started] == [0, 1, 2, 3, 4, 1]
    assert Listens.started[-1][1][3, 3] >= 1e4


class SeesMaps(Centralised):
    """Keeps the maps of all vehicles by tick."""

    maps: list[list[np.ndarray]]

    def update(self, ticks: Any) -> Any:
        SeesMaps.maps.append([tick.landmarks for tick in ticks])
        return super().update(ticks)


def test_a_joint_observer_has_every_vehicle_s_own_map() -> None:
    SeesMaps.maps = []
    completed(SeesMaps, recorded("map"))
    off = np.array(SeesMaps.maps) - recorded("map").landmarks[1:, None]
    wrong = np.linalg.norm(off, axis=-1)
    expected = np.zeros_like(wrong)
    expected[17:, 1, 1] = 2.0  # from tick 18 on, the second landmark of the second vehicle
    assert_allclose(wrong, expected, atol=1e-12)


def with_(**fields: Any) -> Any:
    return lambda message: replace(message, **fields)


LOPSIDED = np.eye(3) + np.triu(np.ones((3, 3)), 1)
HOSTILE = {
    "NaN": with_(position=np.full(3, np.nan)),
    "far": with_(position=np.array([1e30, 0.0, 0.0])),
    "words": with_(position="here"),
    "ragged": with_(covariance=[[1.0], [2.0, 3.0]]),
    "lopsided": with_(covariance=LOPSIDED),
    "of a pose": with_(covariance=np.eye(6)),
    "stretched": with_(rotation=2.0 * np.eye(3)),
    "more": with_(extra={"more": np.array([np.nan])}),
    "too much": with_(extra={"more": np.zeros(10**6)}),
    "no message": lambda message: None,
}


@pytest.mark.parametrize("name", list(HOSTILE))
def test_invalid_messages_are_refused_and_counted(name: str) -> None:
    """It is as if it had been lost: followers go on with the last one that was sound."""
    made = recorded("none")
    found = listen(made, Tampering(HOSTILE[name]))
    assert not found.failure and np.isfinite(found.position).all()
    followers = [i for i, setup in enumerate(made.setups) if 4 in setup.targets]
    assert (found.refused[followers] == made.ticks - 1).all()
    assert found.refused.sum() == (made.ticks - 1) * len(followers)


def test_the_last_valid_message_stays_in_the_inbox() -> None:
    listen(recorded("none"), Tampering(HOSTILE["NaN"], lambda message: message))
    ages = [age for _, _, age in Listens.heard]
    assert {round(60 * age) for age in ages[4:]} == {0, 1}
    assert len(ages) == recorded("none").ticks - 2  # the first one after the start was none


number = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-100, 100),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e8, -1e8, 1e308]),
)


def entry(at: int, value: float) -> Any:
    """Return a function that changes one entry of a field."""

    def change(own: np.ndarray | None) -> np.ndarray | None:
        if own is None:
            return None
        made = np.array(own, dtype=float)
        made.flat[at % made.size] = value
        return made

    return change


def changes(*shape: int) -> st.SearchStrategy[Any]:
    """Draw functions that keep a field, leave it out, change an entry or all of them."""
    replaced = arrays(float, shape, elements=number).map(lambda values: lambda own: values)
    one = st.builds(entry, st.integers(0, 100), number)
    return st.one_of(st.just(lambda own: own), st.just(lambda own: None), one, replaced)


definite = arrays(float, 3, elements=st.floats(-16, 12)).map(lambda scales: lambda own: np.diag(10.0**scales))
messages = st.fixed_dictionaries(
    {"position": changes(3), "rotation": changes(3, 3), "covariance": changes(3, 3) | definite}
)


def altered(drawn: dict[str, Any]) -> Any:
    return lambda message: replace(message, **{name: made(getattr(message, name)) for name, made in drawn.items()})


@pytest.mark.parametrize(
    "observer",
    [
        "mekf",
        "mekf_covariance",
        "left_invariant",
        "right_invariant",
        "ukf",
        "covariance_intersection",
        "riccati",
        "p3p",
    ],
)
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(drawn=st.lists(messages, min_size=20, max_size=20))
def test_no_message_ends_a_run(observer: str, drawn: list[dict[str, Any]]) -> None:
    found = completed(observer, recorded("none"), Tampering(*map(altered, drawn)))
    assert np.isfinite(found.position).all()


@given(drawn=messages)
@settings(max_examples=300, deadline=None)
def test_messages_that_pass_the_check_are_usable(drawn: dict[str, Any]) -> None:
    """By other means than the check's own: determinants, eigenvalues, and orthogonality."""
    with np.errstate(all="ignore"):
        made = altered(drawn)(Message(np.ones(3), np.eye(3), np.eye(3)))
        try:
            check_received(made)
        except CoopenvError:
            return
    if made.position is not None:
        assert np.isfinite(made.position).all()
    if made.rotation is not None:
        assert np.linalg.det(made.rotation) == pytest.approx(1.0, abs=1e-5)
    if made.covariance is not None:
        rounding = 1e-15 * np.trace(made.covariance)  # of eigenvalues that are far apart
        assert np.linalg.eigvalsh(made.covariance)[0] > -rounding
        assert np.isfinite(np.linalg.inv(made.covariance)).all()


def test_a_covariance_without_variance_of_the_height_is_refused() -> None:
    with pytest.raises(CoopenvError, match="not positive definite"):
        check_received(Message(np.ones(3), np.eye(3), np.diag([1.0, 1.0, 0.0])))


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_replay_has_the_faults_of_its_world(name: str) -> None:
    """They are drawn again from what the recording says of its seed."""
    world = Replay(recorded(name), "log").world(1, "float64", "cpu", 1)
    world.reset(None)
    assert_allclose(positions(world, recorded(name).ticks - 1), in_kernels(scene(name), 3), atol=1e-9)
