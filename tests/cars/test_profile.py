"""Profiles of makes of cars: a second make in one file, and what is refused."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.backend import Svea
from coopenv.cars.backend.binding import bind
from coopenv.cars.backend.station import Gates
from coopenv.cars.bags.topic_map import load_map, patterns_of
from coopenv.cars.codec import decode
from coopenv.cars.deployment import DeploymentError, load_deployment
from coopenv.cars.gate.core import PERIOD, Gate, GateClock, read_drive
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.profile import FOLDER, USUAL, CarProfile, MotionCommand, Role, load_profile
from coopenv.cars.transport.base import Arrival
from tests.helpers.fakes import EXACT, MARKERS, OVERTAKING, Stage
from tests.helpers.hub import Hub

ROVER = Path(__file__).parent / "rover.toml"
FLEET = f"""
environment = "svea_overtaking"
profile = "{ROVER.name}"
cars = [{{ name = "svea7", marker = 9 }}, {{ name = "svea8", marker = 6 }}]
"""


@pytest.fixture
def rover() -> CarProfile:
    return load_profile(ROVER.name, ROVER.parent)


def fleet_file(folder: Path, text: str = FLEET) -> Path:
    (folder / ROVER.name).write_text(ROVER.read_text())
    (folder / "fleet.toml").write_text(text)
    return folder / "fleet.toml"


def test_a_second_make_drives_a_fake_and_is_read(rover: CarProfile) -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT, profile=rover)
    backend = Svea(stage.fleet, bind(stage.scenario, OVERTAKING, MARKERS, "test", None, rover), stage.hub.connect())
    try:
        stage.drive("svea7", 0.3, 0.25, 2.0)
        truth, wheel = stage.arrivals("svea7", Role.TRUTH)[-1], stage.arrivals("svea7", Role.WHEEL)[-1]
        assert wheel.twist.twist.linear.x == pytest.approx(0.3, abs=1e-3)
        assert truth.twist.twist.angular.z == pytest.approx(0.3 * 0.2553419 / 0.324, abs=1e-2)  # to the left
        assert {a.topic for a in stage.hub_arrivals} >= {"robots/svea7/wheel_odometry/velocity", "vicon/svea7"}
        assert not [a for a in stage.hub_arrivals if "mavros" in a.topic or "qualisys" in a.topic]
        assert set(backend.intake.topics) <= {a.topic for a in stage.hub_arrivals}
        read = [sample for arrival in stage.hub_arrivals for sample in backend.intake.samples(arrival)]
        assert {sample.role for sample in read} == {Role.WHEEL, Role.IMU, Role.DETECTIONS, Role.TRUTH}
        assert not any(backend.intake.rejected[car] for car in ("svea7", "svea8"))
    finally:
        backend.close()


def test_its_gate_sends_its_own_command_message(rover: CarProfile) -> None:
    hub, sent, now = Hub(), list[Arrival](), [time.time_ns()]
    hub.connect().subscribe("robots/svea7/drive", sent.append)
    clock = GateClock(lambda: now[0], lambda: now[0])
    link = GateConnection(Gate("svea7", USUAL, clock, profile=rover), hub.connect())
    now[0] += PERIOD
    link.tick()
    message = decode(sent[0].payload, "ackermann_msgs/msg/AckermannDriveStamped").drive
    assert (message.steering_angle, message.speed, message.acceleration) == (0.0, 0.0, 1.0)
    gates = Gates(hub.connect(), ("svea7",), USUAL, None, None, rover)
    link.publish_status()
    assert gates.states["svea7"].state == "disarmed"
    values = rover.command.values(MotionCommand(0.1, 0.5))
    assert values["steering_angle"] == pytest.approx(-5.7295780) and values["speed"] == 0.5
    assert read_drive(sent[0].payload, rover.command) == MotionCommand()


def test_a_deployment_and_a_bag_name_it(tmp_path: Path, rover: CarProfile) -> None:
    fleet = load_deployment(fleet_file(tmp_path))
    assert fleet.profile == rover and fleet.car("svea7").marker == 9
    assert fleet.limits.steering == 0.4
    with pytest.raises(DeploymentError, match=r"fleet\.toml: safety.max_steering: 0.5 is over 0.4, the largest of"):
        load_deployment(fleet_file(tmp_path, FLEET + "[safety]\nmax_steering = 0.5"))
    assert patterns_of(ROVER.name, tmp_path)[Role.WHEEL] == ("/robots/{car}/wheel_odometry/velocity",)
    text = 'environment = "svea_overtaking"\nnames = "rover.toml"\ncars = [{ name = "svea7" }, { name = "svea8" }]'
    (tmp_path / "map.toml").write_text(text)
    assert load_map(tmp_path / "map.toml").names == "rover.toml"
    (tmp_path / "map.toml").write_text(text.replace("rover.toml", "sveaa"))
    with pytest.raises(CoopenvError, match=r"map\.toml: names: unknown profile 'sveaa' \(did you mean 'svea'\?\)"):
        load_map(tmp_path / "map.toml")


BAD = {
    "no such file": ("", "", "No such file"),
    "an unknown key": ("markers =", "marker =", "rover.toml: marker: unknown key (did you mean 'markers'?)"),
    "a missing role": ("imu =", "imu2 =", "topics.imu2"),
    "a repeated name": (
        "camera/camera_info",
        "camera/objects_info",
        "two roles have the name robots/NAME/camera/objects_info",
    ),
    "a name without the car": ("robots/{car}/battery", "battery", "topics: a name is without {car}"),
    "another type of the gate": ("msg/Bool", "msg/Int8", "topics.stop.type: the gate has std_msgs/msg/Bool"),
    "no such field": ('field = "speed"', 'field = "sped"', "command.speed.field: 'sped' is no float32"),
    "a scale of zero": ("change = 1.0", "change = 0.0", "command.speed.change: must not be 0"),
    "no TOML": ("[topics]", "[topics", "not valid TOML"),
    "a text for a number": ("steering = 0.4", 'steering = "a"', "hardest.steering: Input should be a valid number"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_one_line(tmp_path: Path, case: str) -> None:
    before, after, said = BAD[case]
    text = ROVER.read_text()
    assert before in text
    if before:
        (tmp_path / "rover.toml").write_text(text.replace(before, after, 1))
    with pytest.raises(CoopenvError) as caught:
        load_profile("rover.toml", tmp_path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_types_that_cannot_be_read_are_refused(rover: CarProfile) -> None:
    topics: dict[Role, Any] = {**rover.topics}
    topics[Role.IMU] = topics[Role.IMU].model_copy(update={"type": "std_msgs/msg/Bool"})
    with pytest.raises(CoopenvError, match=r"test: profile: topics.imu.type: std_msgs/msg/Bool is none of sensor_msgs"):
        Stage("svea_overtaking", OVERTAKING, profile=rover.model_copy(update={"topics": topics}))


def test_every_shipped_profile_is_valid() -> None:
    assert [file.stem for file in FOLDER.glob("*.toml")] == ["svea"]
    assert isinstance(load_profile("svea"), CarProfile)
