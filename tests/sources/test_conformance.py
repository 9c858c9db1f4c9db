"""One suite over all sources: the same spaces, the same meaning of actions, masks and ages, whatever gives the ticks.

Simulator, fake cars, a recorded drive, and that drive as a bag. `tests/cars` has fake cars as processes, over Zenoh.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

import coopenv
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import decode
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.cars import LAB, LAB_CARS, cars, fakes, write_fleet

Env = coopenv.CooperativeLocalisationEnv
Make = Callable[..., Env]

GROUPS = ["estimate", "quality", "bearings", "odometry", "messages", "goal", "self"]
OVERRIDES: dict[str, Any] = {"observation.include": GROUPS}
AHEAD = np.array([0.2, 0.0], dtype=np.float32)
TOPICS_OF_A_LAB = f'{LAB}\n[overrides]\n"observation.include" = INCLUDE\n{LAB_CARS}'


def simulated(**options: Any) -> Env:
    return coopenv.parallel_env("svea_overtaking", overrides=OVERRIDES, **options)


def in_process(path: Path, hub: Any, **options: Any) -> Env:
    return coopenv.parallel_env("cars", backend=cars(path, hub, overrides=OVERRIDES), **options)


def recorded(path: Path, **options: Any) -> Env:
    return coopenv.parallel_env(path, **options)


def imported(path: Path, topics: Path, **options: Any) -> Env:
    return coopenv.parallel_env(path, backend="replay", topics=topics, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("conformance")


@pytest.fixture(scope="module")
def drive(folder: Path) -> Path:
    """Record a drive of three seconds, of which a busy computer takes part of the frames."""
    with fakes(path := write_fleet(folder)) as (hub, _):
        env = coopenv.parallel_env("cars", backend=cars(path, hub, overrides=OVERRIDES, record=folder / "drive.mcap"))
        env.reset(seed=5, options={"arm": True})
        for _ in range(60):
            env.step(dict.fromkeys(env.agents, AHEAD))
        env.close()
    return folder / "drive.mcap"


@pytest.fixture(scope="module", params=["simulated", "drive", "bag", "in process"])
def make(request: pytest.FixtureRequest, folder: Path) -> Iterator[Make]:
    """Yield what makes the environment; fake cars in this process drive for no longer than they are asked for."""
    if request.param == "simulated":
        yield simulated
    elif request.param == "in process":
        with fakes(path := write_fleet(folder)) as (hub, _):
            yield partial(in_process, path, hub)
    elif request.param == "drive":
        yield partial(recorded, request.getfixturevalue("drive"))
    else:
        topics = folder / "topics.toml"
        topics.write_text(TOPICS_OF_A_LAB.replace("INCLUDE", str(GROUPS).replace("'", '"')))
        yield partial(imported, request.getfixturevalue("drive"), topics)


def assert_spaces_of_the_simulator(env: Env, observation: Any) -> None:
    expected = simulated(observation=observation)
    assert env.possible_agents == expected.possible_agents
    for agent in env.possible_agents:
        assert env.observation_space(agent) == expected.observation_space(agent)
        assert env.action_space(agent) == expected.action_space(agent)
    assert env.state_space == expected.state_space
    assert env.observation_layout == expected.observation_layout


def test_sources_pass_the_official_test(make: Make) -> None:
    env = make()
    assert_spaces_of_the_simulator(env, "flat")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env, num_cycles=10)
    env.close()


def masks_and_ages(env: Env, agent: str, seen: dict[str, np.ndarray], info: dict[str, Any]) -> None:
    """Check what masks and ages say against the info of the same step."""
    targets = env.scenario.target_names
    visible = [name in info["visible"] for name in targets]
    neighbours = {name for name, there in zip(targets, seen["bearing_mask"], strict=False) if there}
    assert set(np.unique(seen["bearing_mask"])) <= {0.0, 1.0} and set(np.unique(seen["message_mask"])) <= {0.0, 1.0}
    for name in ("bearing_age", "odometry_age", "message_age"):
        assert ((seen[name] >= 0.0) & (seen[name] <= 1.0)).all(), name
    # Frames older than a part of a second are reported missing, as by a busy computer.
    assert (seen["odometry_age"] < 0.5).all() or info["missing_ticks"] > 0, agent
    if any(visible):
        assert neighbours


def test_masks_and_ages_mean_the_same(make: Make) -> None:
    env = make(observation="dict")
    try:
        assert_spaces_of_the_simulator(env, "dict")
        env.reset(seed=5)
        ever_seen, ever_heard, steps = False, False, 0
        known, errors = env.engine.backend.capabilities.truth, dict[str, float]()

        def settled() -> bool:
            """True if all expected ticks have come, which takes longer if a busy computer delays frames."""
            return steps > 15 and ever_heard and ever_seen and all(error < 0.2 for error in errors.values())

        while env.agents and not settled() and steps < 55:
            observations, rewards, _, _, infos = env.step(dict.fromkeys(env.agents, AHEAD))
            steps += 1
            for agent, seen in observations.items():
                assert env.observation_space(agent).contains(seen) and np.isfinite(rewards[agent])
                assert all(part.dtype == np.float32 and np.isfinite(part).all() for part in seen.values())
                masks_and_ages(env, agent, seen, infos[agent])
                ever_seen |= bool(infos[agent]["visible"])
                # A computer that was busy leaves gaps in the poses of a bag: the truth is then NaN for some ticks.
                if np.isfinite(error := infos[agent]["position_error"]):
                    errors[agent] = error
            ever_heard |= bool(observations.get("vehicle_2", {"message_mask": np.zeros(1)})["message_mask"].any())
        assert sorted(errors) == (env.possible_agents if known else [])
        assert settled(), errors
    finally:
        env.close()


def begins_at(commands: dict[int, np.ndarray], wanted: np.ndarray) -> list[int]:
    """Return which number the first of the wanted speeds and angles (steps, 2) may have, by what was heard."""
    possible = range(max(commands) - len(wanted) + 1, min(commands) + 1)
    return [k for k in possible if all(np.abs(wanted[n - k] - c).max() < 1e-6 for n, c in commands.items())]


def driving(commands: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return the commands from the first speed on: a car stands until its estimate has settled."""
    first = min((n for n, command in commands.items() if command[0]), default=len(commands) + 1)
    return {n: command for n, command in commands.items() if n >= first}


def test_actions_mean_the_same_speeds_and_angles(folder: Path) -> None:
    """The commands to the gates equal the commands of the simulated vehicles.

    Commands are not sent again where a network loses one, so that actions go on until enough have been received.
    """
    actions = np.random.default_rng(3).uniform(-1.0, 1.0, (40, 2)).astype(np.float32)  # none repeats
    expected = simulated()
    expected.reset(seed=1)
    simulated_commands = []
    for action in actions:
        expected.step(dict.fromkeys(expected.possible_agents, action))
        simulated_commands.append(expected.engine.view("command")[0, :, :2].copy())
    assert len({tuple(np.round(command[0], 6)) for command in simulated_commands}) > 4
    wanted = dict(zip(("svea7", "svea1"), np.swapaxes(simulated_commands, 0, 1), strict=True))
    arrivals: list[Arrival] = []
    received: dict[str, dict[int, np.ndarray]] = {car: {} for car in wanted}
    with fakes(path := write_fleet(folder)) as (hub, _):
        network, env = hub.connect(), in_process(path, hub)
        for car in wanted:
            network.subscribe(SVEA.topic_of(car, Role.COMMAND), arrivals.append)
        env.reset(seed=1, options={"arm": True})
        for action in actions:
            env.step(dict.fromkeys(env.possible_agents, action))
            for car, commands in received.items():
                for arrival in [a for a in arrivals if car in a.topic]:
                    command = decode(arrival.payload, SVEA.topics[Role.COMMAND].type)
                    number = int(command.header.frame_id.rpartition(":")[2])
                    commands[number] = np.array([command.drive.speed, command.drive.steering_angle])
            if min(len(driving(commands)) for commands in received.values()) >= 6:
                break
        env.close()
        network.close()
    for car, commands in received.items():
        assert len(driving(commands)) >= 6, (car, commands)
        assert len(begins_at(driving(commands), wanted[car])) == 1, (car, commands)
