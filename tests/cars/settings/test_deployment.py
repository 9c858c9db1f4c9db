"""Deployment files and profiles of makes of cars: what they say, and each mistake in one line."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.assembler import Intake
from coopenv.cars.backend.station import Gates
from coopenv.cars.bags.topic_map import load_map, patterns_of
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.gate import PERIOD, Gate, GateClock
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.gate.wheel_command import MotionCommand, read_drive, write_drive
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import decode
from coopenv.cars.messages.readings import check_types
from coopenv.cars.settings.deployment import DeploymentError, Remote, load_deployment
from coopenv.cars.settings.limits import USUAL
from coopenv.cars.settings.profile import FOLDER, SVEA, CarProfile, Role, load_profile
from tests.helpers.fakes import EXACT, OVERTAKING, Stage

GOOD = """
environment = "crossing_path"
[markers]
SL1 = 1
[[cars]]
name = "svea7"
marker = 7
[[cars]]
name = "svea8"
agent = 8
[[cars]]
name = "leader"
landmark = "ML"
marker = 5
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "lab.toml"
    path.write_text(text)
    return path


def test_a_good_file_is_read(tmp_path: Path) -> None:
    fleet = load_deployment(written(tmp_path, GOOD))
    assert [car.name for car in fleet.cars] == ["svea7", "svea8", "leader"]
    assert [car.agent_number for car in fleet.cars] == [7, 8, 5]
    assert fleet.network.connect == ("tcp/127.0.0.1:7447",)
    assert fleet.folder == tmp_path
    assert fleet.car("svea8").marker is None


@pytest.mark.parametrize(
    ("kind", "endpoint", "tells"),
    [
        ("zenoh", "tcp/127.0.0.1:7447", True),
        ("nats", "nats/127.0.0.1:4222", False),
        ("ros1", "tcp/127.0.0.1:11311", False),
    ],
)
def test_each_network_has_its_usual_place_and_the_authors_cars_need_no_conditions(
    tmp_path: Path, kind: str, endpoint: str, tells: bool
) -> None:
    for safety, needed in (("", tells), ("conditions = false", False), ("conditions = true", True)):
        fleet = load_deployment(written(tmp_path, GOOD + f'[network]\nkind = "{kind}"\n[safety]\n{safety}'))
        assert fleet.network.connect == fleet.gate_connect == (endpoint,) and fleet.conditions is needed


def test_a_gate_stays_on_its_car_wherever_the_network_is(tmp_path: Path) -> None:
    away = '[network]\nconnect = ["tcp/192.0.2.1:7447"]\n'
    assert load_deployment(written(tmp_path, GOOD + away)).gate_connect == ("tcp/127.0.0.1:7447",)
    loaded = load_deployment(written(tmp_path, GOOD + away + '[gate]\nconnect = ["tcp/[::1]:1"]'))
    assert loaded.gate_connect == ("tcp/[::1]:1",)


FENCES = ("[[0, 0], [1, 0]]", "[[0, 0], [1, 1], [1, 0], [0, 1]]", "[[0, 0], [1, 0], [2, 0]]", str([[0, 0]] * 4))
CORNERS = "safety.geofence: expected at least 3 corners of a polygon whose edges do not cross"
BAD = {
    "an unknown key": ('[network]\nconect = ["tcp/a:1"]', "network.conect: unknown key (did you mean 'connect'?)"),
    "no protocol": ('[network]\nconnect = ["127.0.0.1:7447"]', "network.connect.0: '127.0.0.1:7447' is no endpoint"),
    "a port too large": ('[network]\nconnect = ["tcp/a:70000"]', "'tcp/a:70000' is no endpoint"),
    "a wire's protocol": ('[network]\nconnect = ["nats/a:1"]', "network.connect: 'nats/a:1': zenoh has tcp, tls"),
    "a gate's endpoint": ('[gate]\nconnect = ["there"]', "gate.connect.0: 'there' is no endpoint"),
    "a gate's wire": ('[gate]\nconnect = ["nats/127.0.0.1:1"]', "gate.connect: 'nats/127.0.0.1:1': zenoh has tcp, tls"),
    "TLS without it": (
        '[network]\nconnect = ["tls/a:1"]',
        "network.tls: is missing, tls/a:1 needs at least its root_ca",
    ),
    "TLS in the clear": (
        '[network.tls]\nroot_ca = "ca.pem"',
        "network.connect: tcp/127.0.0.1:7447 is not encrypted",
    ),
    "half an identity": (
        '[network]\nconnect = ["tls/a:1"]\ntls = {root_ca = "ca.pem", key = "k"}',
        "network.tls: certificate and key: give both or none",
    ),
    "a marker over 7": ('[[cars]]\nname = "c"\nmarker = 9', "marker 9 of c: the camera knows 1 to 7 only"),
    "a marker of two": ('[[cars]]\nname = "c"\nmarker = 1', "markers: the number 1 is used twice"),
    "a name of two": ('[[cars]]\nname = "svea7"', "cars: the name 'svea7' is used twice"),
    "an agent of two": ('[[cars]]\nname = "c"\nagent = 7', "cars: the agent (or marker) 7 is used twice"),
    "a name no topic can have": ('[[cars]]\nname = "a/b"', "cars.3.name: "),
    "no deceleration": ("[safety]\ndeceleration = 1e-9", "safety.deceleration: "),
    "not a number": ("[safety]\nmax_speed = nan", "safety.max_speed: "),
    "two things at once": ('[[cars]]\nname = "c"\nvehicle = "v"\nlandmark = "L"', "cars.3: is a vehicle or a landmark"),
    "too fast": ("[safety]\nmax_speed = 2.0", "safety.max_speed: 2 is over 1.53, the largest of this make"),
    "a channel of two": ("[remote]\nthrottle = 1", "remote: steering, throttle and mode_switch: two of them are on"),
    **{f"a fence of {n}": (f"[safety]\ngeofence = {fence}", CORNERS) for n, fence in enumerate(FENCES)},
    "a make that does not reverse": (
        '[profile]\nbase = "svea"\nhardest.reverse = false\n[safety]\nreverse = true',
        "safety.reverse: true, but this make does not reverse",
    ),
    "no TOML": ("[network", "not valid TOML: "),
    "too deep": (f"overrides = {'[' * 5000}", "not valid TOML|too deep"),
}


def test_identified_takes_the_result_of_identify_alone(tmp_path: Path) -> None:
    (tmp_path / "cal.toml").write_text("[overrides]\n[clocks.leads]\n[constants]\n", encoding="utf-8")
    with pytest.raises(DeploymentError, match=r"lab\.toml: identified: cal\.toml: clocks: unknown key"):
        load_deployment(written(tmp_path, 'identified = "cal.toml"\n' + GOOD))


def test_of_another_kind_of_file_all_keys_are_listed() -> None:
    """The nearest key helps after a typing error alone."""
    with pytest.raises(DeploymentError, match=r"^svea_overtaking\.toml: title: unknown key; allowed: calibration, "):
        load_deployment(Path(__file__).parents[3] / "envs" / "svea_overtaking.toml")


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_in_a_deployment_is_one_line(tmp_path: Path, case: str) -> None:
    added, said = BAD[case]
    with pytest.raises(DeploymentError) as caught:
        load_deployment(written(tmp_path, GOOD + added))
    line = str(caught.value)
    assert "lab.toml: " in line
    assert any(part in line for part in said.split("|")), line
    assert "\n" not in line


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "latin.toml").write_bytes(b'environment = "\xff"')
    for name, why in (("none.toml", "No such file"), (".", "Is a directory"), ("latin.toml", "not a text file")):
        with pytest.raises(DeploymentError, match=why) as caught:
            load_deployment(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_an_unknown_car_is_answered_by_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(
        DeploymentError, match=r"unknown car 'svea9' \(did you mean 'svea[78]'\?\); known: svea7, svea8"
    ):
        load_deployment(written(tmp_path, GOOD)).car("svea9")


REST = (1500, 1500, 1500, 1500, 1100)
NO_SIGNAL = "its remote control has no signal"


@pytest.mark.parametrize(
    ("pulses", "why"),
    [
        (REST, ""),
        ((), NO_SIGNAL),
        ((0,) * 8, NO_SIGNAL),
        ((1500, 0, 1500, 0, 1500), ""),  # two that are not in use
        ((1500, 1500, 65535, 1500, 1500), NO_SIGNAL),
        ((1500, 1500, 1500, 1500, 0), NO_SIGNAL),
        ((1500,) * 4, "its remote control has 4 channels, remote.mode_switch is 5"),
    ],
)
def test_readings_without_information_are_reported(pulses: tuple[int, ...], why: str) -> None:
    assert Remote().fault(pulses) == why


def test_a_remote_control_without_a_switch_needs_no_channel_for_it() -> None:
    assert Remote(mode_switch=0).fault((1500,) * 3) == ""
    assert not Remote(mode_switch=0).switched((1500,) * 3, (1900,) * 3)


def test_sticks_and_switch_have_the_channels_of_the_file() -> None:
    for channel, driven in ((1, True), (2, False), (3, True), (4, False), (5, False)):
        moved = tuple(1800 if n == channel else pulse for n, pulse in enumerate(REST, start=1))
        assert Remote().drives(moved) is driven
        assert Remote().switched(moved, REST) is (channel == 5)
        assert Remote(steering=4, throttle=2).drives(moved) is (channel in (2, 4))
    assert not Remote().drives(()) and not Remote().drives((0, 0, 0)) and not Remote().drives((1590, 1500, 1410))


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
    stage.drive("svea7", 0.3, 0.25, 1.2)
    truth, wheel = stage.arrivals("svea7", Role.TRUTH)[-1], stage.arrivals("svea7", Role.WHEEL)[-1]
    assert wheel.twist.twist.linear.x == pytest.approx(0.3, abs=1e-3)
    assert truth.twist.twist.angular.z == pytest.approx(0.3 * 0.2553419 / 0.324, abs=1e-2)  # to the left
    topics = {arrival.topic for arrival in stage.hub_arrivals}
    assert topics >= {"robots/svea7/wheel_odometry/velocity", "vicon/svea7"}
    assert not [topic for topic in topics if "mavros" in topic or "qualisys" in topic]
    assert set(Intake(stage.binding, stage.fleet.sensors).topics) <= topics
    assert stage.roles_read(stage.hub_arrivals) == {Role.WHEEL, Role.IMU, Role.DETECTIONS, Role.TRUTH}


def test_a_differential_drive_by_its_profile_alone() -> None:
    """The turn rate on cmd_vel is that of the bicycle, and a fake of it drives the same curve as one of SVEA."""
    robot, turns = load_profile("diffdrive"), {}
    for profile in (robot, SVEA):
        stage = Stage("svea_overtaking", OVERTAKING, EXACT, profile=profile)
        stage.drive("svea7", 0.3, 0.25, 2.0)
        wheel, imu = stage.arrivals("svea7", Role.WHEEL)[-1], stage.arrivals("svea7", Role.IMU)[-1]
        twist = wheel.twist.twist
        turns[profile.topics[Role.MANUAL].type] = twist.linear.x, imu.angular_velocity.z
        if profile is robot:
            sent = stage.arrivals("svea7", Role.MANUAL)[-1].twist
            assert sent.linear.x == pytest.approx(0.3)
            assert sent.angular.z == pytest.approx(0.3 * math.tan(0.25) / 0.324)
            assert stage.roles_read(stage.hub_arrivals) == {Role.WHEEL, Role.IMU, Role.DETECTIONS, Role.TRUTH}
    assert turns["geometry_msgs/msg/TwistStamped"] == pytest.approx(turns["mavros_msgs/msg/ManualControl"], abs=1e-4)


@pytest.mark.parametrize("drive", [MotionCommand(0.3, 0.4), MotionCommand(-0.2, -0.3), MotionCommand(0.0, 0.5)])
def test_turn_rates_go_back_to_steering_angles(drive: MotionCommand) -> None:
    message = load_profile("diffdrive").command
    back = message.drive(message.values(drive))
    assert (back.steering, back.speed) == pytest.approx((drive.steering, drive.speed))
    assert message.drive(message.values(MotionCommand(0.3, 0.0))) == MotionCommand()


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
    assert patterns_of(ROVER.name, rover)[Role.WHEEL] == ("/robots/{car}/wheel_odometry/velocity",)
    text = 'environment = "svea_overtaking"\nnames = "rover.toml"\ncars = [{ name = "svea7" }, { name = "svea8" }]'
    (tmp_path / "map.toml").write_text(text)
    assert load_map(tmp_path / "map.toml").names == "rover.toml"
    (tmp_path / "map.toml").write_text(text.replace("rover.toml", "sveaa"))
    with pytest.raises(CoopenvError, match=r"map\.toml: names: unknown profile 'sveaa' \(did you mean 'svea'\?\)"):
        load_map(tmp_path / "map.toml")


BAD_PROFILES = {
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
    "old commands": ("max_age = 0.15, urgent", "max_age = 0.2, urgent", "topics.command.max_age: needed, above 0 and"),
    "commands of any age": ("max_age = 0.15, urgent", "urgent", "topics.command.max_age: needed, above 0 and at most"),
    "a slash in front": ('"robots/{car}/imu', '"/robots/{car}/imu', "topics.imu.name: "),
    "one field for both": (
        'field = "speed"',
        'field = "steering_angle"',
        "speed.field: 'steering_angle' is steering.field",
    ),
    "a limit that is cut off": (
        "hardest = { speed = 1.0",
        "hardest = { speed = 1.2",
        "hardest: needs 1.2 of command.speed",
    ),
    "a limit below 0": ("steering_rate = 4.0", "steering_rate = -4.0", "steering_rate must be above 0"),
}


HELD = {"uint16": (0, 65535), "int8": (-128, 127), "bool": (0, 1), "float32": (-0.5,)}
NOT_HELD = {"uint16": (65536, -1, 0.5), "int8": (128, -129), "bool": (2,)}


@pytest.mark.parametrize("kind", HELD)
def test_fields_hold_their_values(kind: str) -> None:
    """Also when a gate stops its car: an error there would leave it without a command."""

    def braking(value: float, neutral: float) -> CarProfile:
        fields = {**SVEA.command.neutral, "lamp": (kind, neutral)}
        brake = {"fields": {"lamp": value, "x": 1.0}, "deceleration": 3.0}
        return load_profile({"base": "svea", "command": {"neutral": fields, "brake": brake}})

    for value in HELD[kind]:
        message = braking(value, 0).command
        assert read_drive(write_drive(0, message, MotionCommand(brake=True)), message).brake
    for value in NOT_HELD.get(kind, ()):
        for values in ((value, 0), (0, value)):
            with pytest.raises(CoopenvError, match=rf"\.lamp: a field of type {kind} cannot be {value:g}"):
                braking(*values)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"topics": {"manual": {"name": "{car}/cmd", "type": "geometry_msgs/msg/Twist"}}}, "is no stamped message of"),
        (
            {"command": {"neutral": {"linear_x": ["float64", 0], "angular_z": ["float64", 0]}}},
            "has float64, float64, fl",
        ),
    ],
)
def test_a_command_message_of_another_type_is_refused(change: dict[str, Any], why: str) -> None:
    with pytest.raises(CoopenvError, match=rf"fleet\.toml: profile: command\.neutral: float64.*, but .* {why}"):
        check_types(load_profile({"base": "diffdrive", **change}), "fleet.toml")


def test_every_profile_has_types_that_can_be_read() -> None:
    shipped = sorted(file.stem for file in FOLDER.glob("*.toml"))
    assert shipped == ["diffdrive", "svea"]
    for name in (*shipped, str(ROVER)):
        check_types(load_profile(name), name)


@pytest.mark.parametrize("case", BAD_PROFILES)
def test_a_mistake_in_a_profile_is_one_line(tmp_path: Path, case: str) -> None:
    before, after, said = BAD_PROFILES[case]
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
