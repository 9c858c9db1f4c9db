"""The way of a fake to a stand, rolling and braking, by the cause of its stop."""

from __future__ import annotations

from itertools import count

import pytest
from pydantic import ValidationError

from coopenv.cars.gate.gate import PERIOD, Gate, GateClock
from coopenv.cars.gate.wheel_command import NEUTRAL, Brake, MotionCommand, read_drive
from coopenv.cars.settings.deployment import Safety
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, CarProfile, Role
from tests.cars.gate import messages
from tests.helpers.env_suite import rest_slow
from tests.helpers.fakes import EXACT, OVERTAKING, Stage

BRAKE = Brake(fields={"z": 620.0}, deceleration=3.0)
BRAKED = SVEA.model_copy(update={"command": SVEA.command.model_copy(update={"brake": BRAKE})})
STATION, GATE, AUTOPILOT = Safety().stopping(1.0, SVEA.command)
FAST = Limits(speed=1.53, steering=0.5, acceleration=2.0, steering_rate=2.0)


def way_to_stand(profile: CarProfile, speed: float, cause: str) -> tuple[float, float, list[MotionCommand]]:
    """Return time, s, and way, m, from the last command to a stand, and what the gate sent meanwhile."""
    stage = Stage("svea_overtaking", OVERTAKING[:2], {**EXACT, "dynamics.max_speed": 1.53}, profile=profile)
    gate = Gate("svea7", FAST, GateClock(lambda: stage.wall + stage.now, lambda: stage.now), profile=profile)
    assert gate.arrive(Role.ARM, messages.arm(stage.wall + stage.now, "s", gate.nonce, True)) is None
    outputs: list[MotionCommand] = []

    def step() -> None:
        payload = gate.tick()
        outputs.append(read_drive(payload, profile.command))
        stage.network.publish(profile.topic_of("svea7", Role.MANUAL), payload)
        stage.run(PERIOD * 1e-9)

    def command(k: int) -> None:
        assert gate.arrive(Role.COMMAND, messages.command(stage.wall + stage.now, "s", k, 0.0, speed)) is None

    for k in range(40):
        command(k)
        step()
    world, outputs[:] = stage.cars["svea7"].world, []
    begin, way = stage.now, world.pose(world.agent)[1].copy()
    for k in count():
        if abs(world.twist[0][0]) <= 0.02:
            break
        if cause == AUTOPILOT and k < Safety().odometry_age / 0.05:
            command(40 + k)
        elif cause in ("stop", AUTOPILOT):
            gate.arrive(Role.STOP, messages.stop(True))
        if cause == GATE:
            stage.run(PERIOD * 1e-9)
        else:
            step()
    reached = world.pose(world.agent)[1]
    return (stage.now - begin) * 1e-9, float(((reached - way) ** 2).sum() ** 0.5), outputs


@pytest.mark.parametrize("speed", rest_slow([0.41, 1.0, 1.5], 0, 2))
def test_a_braked_car_stands_sooner_and_inside_the_margin(speed: float) -> None:
    for cause in (STATION, "stop"):
        rolling, braking = way_to_stand(SVEA, speed, cause), way_to_stand(BRAKED, speed, cause)
        for (seconds, way, _), profile in ((rolling, SVEA), (braking, BRAKED)):
            after, most = Safety().stopping(speed, profile.command)[STATION if cause == "stop" else cause]
            assert way < most and seconds < after + 0.35
        assert braking[1] < rolling[1] - speed**2 / 2 * (1.0 - 1.0 / 3.0) * 0.6
        braked = [drive for drive in braking[2] if drive.brake]
        assert abs(len(braked) * 0.05 - speed / 3.0) <= 0.051
        assert braking[2][-1] == NEUTRAL or len(braked) * 0.05 >= speed / 3.0 - 0.051
    assert not any(drive.brake for drive in rolling[2])


@pytest.mark.parametrize("speed", rest_slow([1.5, 0.41, 1.0], 0))
@pytest.mark.parametrize("cause", [GATE, AUTOPILOT])
def test_a_car_stands_inside_the_margin_of_each_cause(cause: str, speed: float) -> None:
    ways = Safety().stopping(speed, BRAKED.command)
    seconds, way, _ = way_to_stand(BRAKED, speed, cause)
    assert way < ways[cause][1] <= max(most for _, most in ways.values()) == ways[GATE][1]
    assert seconds < ways[cause][0] + 0.35


def test_a_brake_needs_fields_of_the_message() -> None:
    given = SVEA.command.model_dump() | {"brake": {"fields": {"w": 1.0}, "deceleration": 3.0}}
    with pytest.raises(ValidationError, match=r"brake.fields: 'w' is no field of neutral"):
        type(SVEA.command)(**given)
    given["brake"]["fields"] = {"x": 0.0, "z": 500.0}
    with pytest.raises(ValidationError, match=r"brake.fields: equal a standing car"):
        type(SVEA.command)(**given)
