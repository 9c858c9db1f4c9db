"""Broken drives of simulated rooms, and how the gate names their faults: python -m benchmarks.doctor --rooms 3.

Fake cars drive to random points of a random room, and their messages are written as ROS 2 bags. Each fault changes the
messages or the map. It counts as named if a finding has the words of its true cause. Numbers of rooms above 100 were
not looked at while thresholds were chosen.
"""

from __future__ import annotations

import argparse
import copy
import math
import re
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.binding import bind
from coopenv.cars.bags import log
from coopenv.cars.bags.bag import Bag
from coopenv.cars.doctor.finding import Treatment
from coopenv.cars.fake.car import Fake
from coopenv.cars.gate.gate import GateClock
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.transport import Arrival, matcher
from coopenv.cars.messages import codec
from coopenv.cars.settings.profile import Role
from coopenv.estimation.metrics import wilson_interval
from coopenv.observers import run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.bags import write_raw

BEGIN, STEP = 1_760_000_000 * 10**9, 0.002  # ns, s
ROLES = (Role.DETECTIONS, Role.CAMERA_INFO, Role.WHEEL, Role.IMU, Role.TRUTH)
CAR = "svea7"


class RoomNetwork:
    """A network within this process, on a simulated clock, that keeps what is sent."""

    def __init__(self, seed: int) -> None:
        """Begin at the time of all drives; delays follow from the seed."""
        self.now, self._rng = BEGIN, np.random.default_rng(seed)
        self.kept = list[tuple[int, str, bytes]]()
        self._subscribers = list[tuple[Callable[[str], bool], Callable[[Arrival], None]]]()
        self.clock = GateClock(lambda: self.now, lambda: self.now)

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **_: Any) -> None:
        """Keep and deliver a message."""
        received = self.now + round(1e9 * self._rng.exponential(0.002))
        self.kept.append((received, topic, payload))
        for matches, callback in self._subscribers:
            if matches(topic):
                callback(Arrival(topic, payload, received, attachment))

    def subscribe(self, pattern: str, callback: Callable[[Arrival], None]) -> None:
        """Deliver the messages of a pattern."""
        self._subscribers.append((matcher(pattern), callback))

    def announce(self, name: str) -> None:
        """Nothing listens."""

    watch = subscribe


Fault = Callable[["Drive"], "Drive"]


@cache
def room_text(number: int) -> str:
    """Return a random room: 5 to 8 landmarks along the walls of 4 to 8 m by 4 to 8 m."""
    rng = np.random.default_rng([7, number])
    half = rng.uniform(2.0, 4.0, 2)
    marks = []
    count = int(rng.integers(5, 8))
    for k in range(count):
        angle = 2.0 * math.pi * (k + rng.uniform(-0.25, 0.25)) / count
        way = min(half[0] / max(abs(math.cos(angle)), 1e-6), half[1] / max(abs(math.sin(angle)), 1e-6))
        x, y, z = way * math.cos(angle), way * math.sin(angle), rng.uniform(0.05, 0.6)
        marks.append(f'[[landmarks]]\nname = "M{k + 1}"\nposition = [{x:.3f}, {y:.3f}, {z:.3f}]\n')
    text = Path(__file__).parents[1].joinpath("envs", "svea_overtaking.toml").read_text(encoding="utf-8")
    head, tail = text.split("[[roads]]")[0], text[text.index("[vehicle_defaults]") :].split("[[vehicles]]")[0]
    route = '[[routes]]\nname = "a"\nwaypoints = [[0.0, -1.0], [0.0, 1.0]]\n\n'
    head = head.replace("#:schema ../docs/scenario.schema.json\n", "").replace(
        "Overtaking, SVEA cars", f"Room {number}"
    )
    return f'{head}{route}{"".join(marks)}\n{tail}[[vehicles]]\nroutes = ["a"]\n'


def map_text(number: int) -> str:
    """Return the map of a room's drive."""
    count = room_text(number).count("[[landmarks]]")
    markers = ", ".join(f"M{k + 1} = {k + 1}" for k in range(count))
    return f'environment = "room.toml"\nmarkers = {{ {markers} }}\n\n[[cars]]\nname = "{CAR}"\nmarker = 9\n'


@dataclass(frozen=True)
class Message:
    """One message."""

    received: int
    topic: str
    kind: str
    value: Any


@dataclass
class Drive:
    """The messages of a drive, and the texts of its files."""

    messages: list[Message]
    room: str
    map: str


@cache
def driven(number: int, seconds: float) -> Drive:
    """Return a drive in a room."""
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder, "room.toml")
        room.write_text(room_text(number), encoding="utf-8")
        scenario = load_scenario(room)
    network = RoomNetwork(number)
    cars = (SimpleNamespace(name=CAR, marker=9, landmark=None, vehicle=None),)
    numbers = {mark.name: k + 1 for k, mark in enumerate(scenario.landmarks)}
    binding = bind(scenario, cars, numbers, "room", None)  # type: ignore[arg-type]
    car, profile = Fake(binding, CAR, network, seed=number), binding.profile  # type: ignore[arg-type]
    rng, goal = np.random.default_rng([3, number]), np.zeros(2)
    places = np.array([mark.position[:2] for mark in scenario.landmarks])
    for k in range(round(seconds / STEP)):
        if k % 25 == 0:
            R, p = car.world.pose(car.world.agent)
            if k % 1500 == 0 or np.linalg.norm(goal - p[:2]) < 0.4:
                goal = rng.uniform(0.6 * places.min(axis=0), 0.6 * places.max(axis=0))
            ahead = R.T[:2, :2] @ (goal - p[:2])
            turn = float(np.clip(math.atan2(ahead[1], ahead[0]), -0.5, 0.5))
            speed = 0.42 if math.sin(0.4 * k * STEP + number) > -0.6 else 0.25
            command = write_drive(network.now, profile.command, MotionCommand(turn, speed))
            network.publish(profile.topic_of(CAR, Role.MANUAL), command)
        network.now += round(STEP * 1e9)
        car.advance()
    types = {profile.topic_of(CAR, role): profile.topics[role].type for role in ROLES}
    kept = sorted((r, t, payload) for r, t, payload in network.kept if t in types)
    messages = [Message(r, f"/{t}", types[t], codec.decode(payload, types[t])) for r, t, payload in kept]
    return Drive(messages, room_text(number), map_text(number))


def edited(drive: Drive, topic: str, edit: Callable[[Any, float], None], after: float = 0.0) -> Drive:
    """Return a drive in which the messages of topics that contain a text are changed from a time on, s."""
    found = []
    for m in drive.messages:
        t = 1e-9 * (m.received - BEGIN)
        if topic in m.topic and t >= after:
            m = replace(m, value=copy.deepcopy(m.value))
            edit(m.value, t)
        found.append(m)
    return replace(drive, messages=found)


def without(drive: Drive, topic: str) -> Drive:
    """Return a drive without topics that contain a text."""
    return replace(drive, messages=[m for m in drive.messages if topic not in m.topic])


IMU, WHEEL, TRUTH, CAMERA, INFO = "imu/data_raw", "wheel_odometry", "qualisys", "objects_info", "camera_info"


def gyro(factor: Sequence[float], bias: float = 0.0, order: str = "xyz", after: float = 0.0) -> Fault:
    """Return turn rates about axes in another order, times factors, and with a bias about z."""

    def edit(m: Any, _: float) -> None:
        w = [getattr(m.angular_velocity, axis) for axis in order]
        for axis, value, k in zip("xyz", w, factor, strict=True):
            setattr(m.angular_velocity, axis, k * value + bias * (axis == "z"))

    return lambda drive: edited(drive, IMU, edit, after)


def wheels(x: float, y: float = 0.0) -> Fault:
    """Return speeds times a factor, along both axes."""

    def edit(m: Any, _: float) -> None:
        v = m.twist.twist.linear
        v.x, v.y = x * v.x, y * v.x

    return lambda drive: edited(drive, WHEEL, edit)


def stuck(topic: str, begin: float, part: Callable[[Any], tuple[Any, str]]) -> Fault:
    """Return a stream that repeats its value for 12 s from a time on."""

    def change(drive: Drive) -> Drive:
        held: list[Any] = []

        def edit(m: Any, t: float) -> None:
            owner, name = part(m)
            held.append(copy.deepcopy(getattr(owner, name)))
            if t < begin + 12.0:
                setattr(owner, name, held[0])

        return edited(drive, topic, edit, begin)

    return change


def truth(place: Callable[[complex], complex], heading: Callable[[float], float] = float) -> Fault:
    """Return other places and headings by motion capture."""

    def edit(m: Any, _: float) -> None:
        p, q = m.pose.pose.position, m.pose.pose.orientation
        at, yaw = place(complex(p.x, p.y)), heading(2.0 * math.atan2(q.z, q.w))
        p.x, p.y, q.z, q.w = at.real, at.imag, math.sin(0.5 * yaw), math.cos(0.5 * yaw)

    return lambda drive: edited(drive, TRUTH, edit)


def late(topic: str, seconds: float) -> Fault:
    """Return stamps that are late."""

    def edit(m: Any, _: float) -> None:
        at = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec + round(1e9 * seconds)
        m.header.stamp.sec, m.header.stamp.nanosec = divmod(at, 10**9)

    return lambda drive: edited(drive, topic, edit)


def info(edit: Callable[[Any], None]) -> Fault:
    """Return other messages of calibration."""
    return lambda drive: edited(drive, INFO, lambda m, _: edit(m))


def _twice_the_size(m: Any, binning: int) -> None:
    m.k = np.array(m.k) * [2, 2, 2, 2, 2, 2, 1, 1, 1]
    m.width, m.height, m.binning_x, m.binning_y = 2 * m.width, 2 * m.height, binning, binning


def _binned(m: Any) -> None:
    m.binning_x = m.binning_y = 2


def _longer(m: Any) -> None:
    m.k = np.array(m.k) * [1.03, 1, 1, 1, 1.03, 1, 1, 1, 1]


def pixels(place: Callable[[int, int], tuple[int, int]]) -> Fault:
    """Return blocks at other pixels."""

    def edit(m: Any, _: float) -> None:
        for block in m.objects:
            block.center_x, block.center_y = place(block.center_x, block.center_y)

    return lambda drive: edited(drive, CAMERA, edit)


def numbered(order: dict[int, int]) -> Fault:
    """Return blocks with other numbers."""

    def edit(m: Any, _: float) -> None:
        for block in m.objects:
            block.signature = order.get(block.signature, block.signature)

    return lambda drive: edited(drive, CAMERA, edit)


def landmarks(move: Callable[[int, Any], Any]) -> Fault:
    """Return a map with other positions."""

    def change(drive: Drive) -> Drive:
        count = iter(range(100))

        def moved(match: re.Match[str]) -> str:
            values = move(next(count), np.array([float(v) for v in match[1].split(",")]))
            return f"position = [{', '.join(f'{v:.4f}' for v in values)}]"

        head, *marks = drive.room.split("[[landmarks]]")
        tail = "".join("[[landmarks]]" + re.sub(r"position = \[([^]]*)\]", moved, mark, count=1) for mark in marks)
        return replace(drive, room=head + tail)

    return change


def camera(**keys: Any) -> Fault:
    """Return other keys of the environment's camera."""

    def change(drive: Drive) -> Drive:
        text = drive.room
        for key, value in keys.items():
            text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text, count=1)
        return replace(drive, room=text)

    return change


def quaternion(yaw: float, pitch: float = 0.0) -> list[float]:
    """Return the orientation of a camera that looks ahead, turned by deg, scalar first."""
    ahead = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    x, y, z, w = (Rotation.from_euler("zy", [yaw, pitch], degrees=True) * ahead).as_quat().tolist()
    return [round(v, 6) for v in (w, x, y, z)]


def slower(rate: float) -> Fault:
    """Return times of reception that pass at another rate than stamps."""

    def change(drive: Drive) -> Drive:
        return replace(
            drive, messages=[replace(m, received=BEGIN + round((m.received - BEGIN) / rate)) for m in drive.messages]
        )

    return change


def odometry(room: bool, child: str) -> Fault:
    """Return wheel velocities as odometry of motion capture, in the frame of the room or the body's, and its header."""
    return lambda drive: _odometry(drive, room, child)


def _odometry(drive: Drive, room: bool, child: str) -> Drive:
    poses = [(m.received, m.value.pose) for m in drive.messages if TRUTH in m.topic]
    times = np.array([t for t, _ in poses])
    found = []
    for m in drive.messages:
        if WHEEL in m.topic:
            pose = poses[min(int(np.searchsorted(times, m.received)), len(poses) - 1)][1]
            q, v = pose.pose.orientation, m.value.twist.twist.linear.x
            yaw = 2.0 * math.atan2(q.z, q.w) * room
            twist = {"twist": ((v * math.cos(yaw), v * math.sin(yaw), 0.0), (0.0, 0.0, 0.0))}
            kind = "nav_msgs/msg/Odometry"
            value = codec.make(kind, header=m.value.header, child_frame_id=child, pose=pose, twist=twist)
            value.header.frame_id = "mocap"
            m = replace(m, kind=kind, value=value)
        found.append(m)
    return replace(drive, messages=found)


def silent(topic: str, begin: float, seconds: float) -> Fault:
    """Return a topic without messages for a time."""

    def change(drive: Drive) -> Drive:
        def kept(m: Message) -> bool:
            return topic not in m.topic or not begin <= 1e-9 * (m.received - BEGIN) < begin + seconds

        return replace(drive, messages=[m for m in drive.messages if kept(m)])

    return change


def twice(topic: str, later: float) -> Fault:
    """Return each message of a topic a second time, with a stamp that is later, s."""

    def change(drive: Drive) -> Drive:
        of = [m for m in drive.messages if topic in m.topic]
        again = late(topic, later)(replace(drive, messages=of)).messages
        gap = round(1e9 * (later or 0.002))
        more = [replace(m, received=m.received + gap) for m in again]
        return replace(drive, messages=sorted([*drive.messages, *more], key=lambda m: m.received))

    return change


def buffered(topic: str, seconds: float) -> Fault:
    """Return receptions of a buffer that is emptied every so many s."""

    def change(drive: Drive) -> Drive:
        def received(m: Message) -> int:
            period = round(1e9 * seconds)
            return m.received if topic not in m.topic else BEGIN + -(-(m.received - BEGIN) // period) * period

        messages = [replace(m, received=received(m)) for m in drive.messages]
        return replace(drive, messages=sorted(messages, key=lambda m: m.received))

    return change


def drifting(topic: str, rate: float) -> Fault:
    """Return stamps that run faster by a rate, s per s."""

    def edit(m: Any, t: float) -> None:
        at = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec + round(1e9 * rate * t)
        m.header.stamp.sec, m.header.stamp.nanosec = divmod(at, 10**9)

    return lambda drive: edited(drive, topic, edit)


def covariance(topic: str, part: str) -> Fault:
    """Return a first variance of -1: not known, or not measured."""

    def edit(m: Any, _: float) -> None:
        getattr(m, part).covariance = np.array([-1.0, *[0.0] * 35])

    return lambda drive: edited(drive, topic, edit)


def no_truth(change: Fault) -> Fault:
    """Return a fault of a drive without motion capture."""
    return lambda drive: without(change(drive), TRUTH)


FAULTS: dict[str, tuple[Fault, str]] = {
    "gyro upside down": (gyro([1, -1, -1]), "turn rate .* other sign"),
    "gyro in degrees": (gyro([57.29578] * 3), "turn rate .*deg/s"),
    "gyro is zero": (gyro([0, 0, 0]), "turn rate .* is 0 rad/s"),
    "gyro with other axes": (gyro([1, 1, 1], order="zyx"), "about the x axis"),
    "gyro scale 1.3": (gyro([1, 1, 1.3]), "turn rate of .* 1[.][23]"),
    "gyro bias": (gyro([1, 1, 1], bias=0.06), "gyro bias"),
    "gyro stuck": (stuck(IMU, 8.0, lambda m: (m, "angular_velocity")), "turn rate .* in a row"),
    "wheels reversed": (wheels(-1.0), "velocity .* other sign"),
    "wheels in km/h": (wheels(3.6), "velocity .*km/h"),
    "wheels scale 1.15": (wheels(1.15), "wheel.scale|velocity of .* 1[.][12]"),
    "wheels are zero": (wheels(0.0), "velocity .* is 0 m/s"),
    "wheels with other axes": (wheels(0.0, 1.0), "velocity .* other axes"),
    "wheels stuck": (stuck(WHEEL, 8.0, lambda m: (m.twist.twist, "linear")), "velocity .* in a row"),
    "twist in the room": (odometry(True, "mocap"), "velocity .* in the frame of"),
    "twist in the room, not stated": (odometry(True, "svea7"), "pose's frame, while child_frame_id"),
    "twist of the body, not stated": (odometry(False, "mocap"), "body's frame, while child_frame_id"),
    "truth in mm": (truth(lambda p: 1000.0 * p), "motion capture .* mm"),
    "truth mirrored": (truth(lambda p: p.conjugate(), lambda a: -a), "motion capture .* mirrored"),
    "truth in another frame": (
        truth(lambda p: 1j * p + 1.0, lambda a: a + 0.5 * math.pi),
        "its frame is 9|its frame is -9",
    ),
    "heading of truth negative": (truth(complex, lambda a: -a), "heading .*other sign"),
    "body of truth turned": (truth(complex, lambda a: a + 0.5 * math.pi), "body is turned|the heading of .* deg from"),
    "truth late": (late(TRUTH, 0.14), "truth.*moved"),
    "truth stuck": (stuck(TRUTH, 8.0, lambda m: (m.pose, "pose")), "repeats one pose"),
    "calibrated at twice the size": (info(lambda m: _twice_the_size(m, 0)), "focal length"),
    "binned without need": (info(_binned), "focal length|beyond the image"),
    "focal length 3 % off": (
        info(_longer),
        "focal length",
    ),
    "no distortion": (info(lambda m: setattr(m, "d", np.zeros(5))), "distortion|focal length"),
    "camera late": (late(CAMERA, 0.12), "objects_info.*moved|detections .* stamps were moved"),
    "camera yaw": (camera(orientation=quaternion(3.0)), "orientation|mounting"),
    "camera pitch": (camera(orientation=quaternion(0.0, 4.0)), "orientation|mounting"),
    "camera to the left": (camera(orientation=quaternion(90.0)), "mounting"),
    "camera height": (camera(position=[0.3218, 0.0, 0.30]), "camera position"),
    "image upside down": (pixels(lambda u, v: (315 - u, 207 - v)), "upside down|mounting"),
    "image mirrored": (pixels(lambda u, v: (315 - u, v)), "mirrored"),
    "markers exchanged": (numbered({1: 3, 3: 1}), "M1 and M3 are exchanged"),
    "marker far off": (
        landmarks(lambda k, p: p + np.array([-0.9, 0.95, 0.0]) * (k == 2)),
        "landmark M3 |marker M3: position",
    ),
    "marker moved": (landmarks(lambda k, p: p + np.array([0.25, 0.0, 0.0]) * (k == 1)), "marker M2: position"),
    "map in cm": (landmarks(lambda k, p: 100.0 * p), "landmarks are in cm"),
    "map mirrored": (landmarks(lambda k, p: p * [-1, 1, 1]), "map is mirrored"),
    "gyro outage": (silent(IMU, 8.0, 3.0), "imu/data_raw: an outage of [23]"),
    "camera outage": (silent(CAMERA, 8.0, 4.0), "objects_info: an outage of [34]"),
    "truth outage": (silent(TRUTH, 8.0, 4.0), "qualisys.*: an outage of [34]"),
    "gyro twice": (twice(IMU, 0.0), "duplicates"),
    "truth twice, stamped anew": (twice(TRUTH, 0.005), "duplicates"),
    "gyro through a buffer": (buffered(IMU, 0.8), "imu/data_raw: messages come up to 0"),
    "gyro clock drifts": (drifting(IMU, 0.003), "imu/data_raw: its clock drifts"),
    "camera clock drifts": (drifting(CAMERA, -0.004), "objects_info: its clock drifts"),
    "wheels not measured": (covariance(WHEEL, "twist"), "wheel_odometry"),
    "half speed": (slower(0.5), "all .* topics drift alike"),
    "simulation 2 % slow": (slower(0.98), "all .* topics drift alike"),
    "gyro upside down, no truth": (no_truth(gyro([1, -1, -1])), "turn rate .* other sign"),
    "gyro in degrees, no truth": (no_truth(gyro([57.29578] * 3)), "turn rate .*deg/s"),
    "gyro is zero, no truth": (no_truth(gyro([0, 0, 0])), "turn rate .* is 0 rad/s"),
    "wheels reversed, no truth": (no_truth(wheels(-1.0)), "velocity .* other sign"),
    "wheels in km/h, no truth": (no_truth(wheels(3.6)), "velocity .*km/h"),
    "twice the size, no truth": (no_truth(info(lambda m: _twice_the_size(m, 0))), "focal length"),
    "markers exchanged, no truth": (no_truth(numbered({1: 3, 3: 1})), "M1 and M3 are exchanged"),
    "camera yaw, no truth": (no_truth(camera(orientation=quaternion(3.0))), "orientation|mounting"),
}
"""Changes of a drive, and the words of the true cause."""
SOUND: dict[str, Fault] = {
    "unchanged": lambda drive: drive,
    "short outages": lambda drive: silent(TRUTH, 5.0, 0.6)(silent(IMU, 9.0, 0.3)(silent(CAMERA, 12.0, 0.8)(drive))),
    "camera node begins anew": silent(CAMERA, 10.0, 1.2),
    "no motion capture": lambda drive: without(drive, TRUTH),
    "covariance of truth is -1": covariance(TRUTH, "pose"),
    "twist of the body": odometry(False, CAR),
}
"""Changes that are no faults: nothing is found."""


def findings_of(drive: Drive, folder: Path) -> tuple[list[str], Bag | None]:
    """Return the lines by which a drive is refused or warned of, and its bag; None: it is refused as a whole."""
    (folder / "room.toml").write_text(drive.room, encoding="utf-8")
    (folder / "topics.toml").write_text(drive.map, encoding="utf-8")
    kinds = {m.topic[1:]: m.kind for m in drive.messages}
    rows = [(m.topic[1:], codec.encode(m.value), m.received) for m in sorted(drive.messages, key=lambda m: m.received)]
    write_raw(folder / "bag", rows, kinds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            bag = Bag([folder / "bag"], folder / "topics.toml")
        except CoopenvError as error:
            return [str(error)], None
    return [*map(str, bag.log.findings), *(note for note in bag.log.notes if "moved" in note)], bag


def rmse(bag: Bag, clean: Bag) -> float:
    """Return the position RMSE of `robust` after 3 s by the sound drive's motion capture, m; infinite: it fails."""
    true = [(s.stamp, *s.value.position) for s in clean.log.samples if s.role is Role.TRUTH]  # type: ignore[union-attr,misc]
    try:
        recording = record(bag)
        found = run("robust", recording)
    except CoopenvError:
        return math.inf
    when, *axes = np.array(true, dtype=np.float64).T
    ticks = bag._begin + 1e9 * (recording.t - recording.filled("bearing_age")[:, 0])
    place = np.column_stack([np.interp(ticks, when, axis) for axis in axes[:2]])
    off = np.linalg.norm(found.position[:, 0, :2] - place, axis=-1)[recording.t > 3.0]
    return float(np.sqrt(np.nanmean(off**2))) if np.isfinite(off).any() else math.inf


def main() -> None:
    """Print a table of faults, and totals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--pairs", type=int, default=0, help="drives with two faults in each room")
    parser.add_argument("--sound", type=int, default=0, help="further rooms, with sound drives of 20 to 60 s")
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    total: Counter[str] = Counter()
    spent = []
    for number in range(given.first, given.first + given.rooms + given.sound):
        more = number >= given.first + given.rooms
        sound = driven(number, float(np.random.default_rng(number).uniform(20.0, 60.0)) if more else given.seconds)
        for name, change in SOUND.items():
            found, bag, _ = _opened(change(sound))
            total["sound"] += 1
            total["false alarms"] += bool(found)
            total["refused without a fault"] += bag is None or bool(bag.refused)
            print(f"room {number}: {name}: {found or 'silent'}", flush=True)
        if more:
            continue
        clean = _opened(sound)[1]
        assert clean is not None
        best = rmse(clean, clean)
        for name, entries in _chosen(number, given.only, given.pairs).items():
            drive = sound
            for change, _ in entries:
                drive = change(drive)
            found, bag, cpu = _opened(drive)
            spent.append(cpu)
            hits = [any(re.search(pattern, line) for line in found) for _, pattern in entries]
            verdict = "named" if any(hits) else "silent" if not found else "WRONG"
            total[("two: " if len(entries) > 1 else "") + verdict] += 1
            total["two: each named"] += len(entries) > 1 and all(hits)
            lines: Any = "" if all(hits) and len(found) == len(hits) else found
            off = "refused" if bag is None or bool(bag.refused) else "stated"
            treatments = () if bag is None else (finding.treatment for finding in bag.log.findings)
            if bag is not None and all(t in (Treatment.MENDED, Treatment.LEFT_OUT) for t in treatments):
                worse = rmse(bag, clean) / best
                off = f"{worse:.2f}"
                total["over 1.5 times the error without a word"] += worse > 1.5 and not found
                total["over 1.5 times the error though mended"] += worse > 1.5 and bool(found)
            print(f"  {name:45s} {verdict:7s} {sum(hits)}/{len(hits)} {off:8s} {cpu:4.1f} s {lines}", flush=True)
    few, looks = total["false alarms"], total["sound"]
    low, high = wilson_interval(few, looks)
    print(f"{few} false alarms in {looks} sound drives, {low:.1%} to {high:.1%} with 95 % (Wilson)")
    print(dict(total), f"CPU {np.mean(spent):.2f} s, at most {max(spent):.2f} s" if spent else "")


def _chosen(number: int, only: str, pairs: int) -> dict[str, list[tuple[Fault, str]]]:
    """Return all faults, and pairs of them, by name."""
    chosen = {name: [entry] for name, entry in FAULTS.items() if only in name}
    singles = [name for name in FAULTS if "no truth" not in name]
    rng = np.random.default_rng(number)
    for _ in range(pairs):
        first, second = rng.choice(singles, 2, replace=False).tolist()
        if first.split()[0] != second.split()[0]:  # of one stream: the second may undo the first
            chosen[f"{first} + {second}"] = [FAULTS[first], FAULTS[second]]
    return chosen


def _opened(drive: Drive) -> tuple[list[str], Bag | None, float]:
    """Return findings and bag as `findings_of`, and s of CPU of the doctor."""
    begin = doctor_seconds()
    with tempfile.TemporaryDirectory() as folder:
        return *findings_of(drive, Path(folder)), doctor_seconds() - begin


SPENT = [0.0]


def doctor_seconds() -> float:
    """Return s of CPU that the doctor has taken."""
    return SPENT[0]


def timed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose CPU time is counted."""

    def call(*args: Any) -> Any:
        begin = time.process_time()
        result = function(*args)
        SPENT[0] += time.process_time() - begin
        return result

    return call


for _name in ("examine", "examine_constants", "of_timing"):
    setattr(log, _name, timed(getattr(log, _name)))


if __name__ == "__main__":
    main()
