"""Record the sample bags of this folder from fake cars on a simulated clock: python examples/bags/make.py.

Two cars drive past four landmarks for 12 s. The commands to their wheels are in the bag. As in a laboratory, messages
of svea7 get lost, 1 % of its camera's stamps are 3 s ahead, and the clock of svea1 is 0.12 s ahead and drifts. The same
bag is written as ROS 2 MCAP, ROS 2 sqlite3 and ROS 1.
"""

import math
import shutil
import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from coopenv.cars.backend.backend import scenario_of
from coopenv.cars.backend.binding import bind
from coopenv.cars.fake.car import Fake
from coopenv.cars.fake.settings import fake_fault
from coopenv.cars.gate.gate import GateClock
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.transport import Arrival, matcher
from coopenv.cars.messages import codec
from coopenv.cars.settings.deployment import load_deployment
from coopenv.cars.settings.profile import Role

FLEET = Path(__file__).parents[1] / "fleet" / "overtaking.toml"
KEPT = (Role.DETECTIONS, Role.CAMERA_INFO, Role.WHEEL, Role.IMU, Role.TRUTH, Role.MANUAL)
AHEAD, DRIFT = 0.12, 0.0002  # s, and s per s, of the clock of svea1
FAULTS = {"svea7": ("loss=0.03", "wrong_stamps=0.01"), "svea1": (f"clock_offset={AHEAD}", f"clock_drift={DRIFT}")}
SPEEDS = {"svea7": 0.27, "svea1": 0.25}  # m/s
SLOW = 0.4  # share of the speed from 5 to 7 s and from 10 s on
SECONDS, STEP = 12.0, 0.001
BEGIN = 1_760_000_000 * 10**9  # ns
DELAY = 0.002  # s, mean of the time on the network


class Network:
    """A network within this process, on a simulated clock, that keeps what is sent."""

    def __init__(self):
        self.now, self.kept, self._subscribers, self._rng = BEGIN, [], [], np.random.default_rng(0)

    def publish(self, topic, payload, attachment=b"", **_):
        received = self.now + round(1e9 * self._rng.exponential(DELAY))
        self.kept.append((received, topic, payload))
        for matches, callback in self._subscribers:
            if matches(topic):
                callback(Arrival(topic, payload, received, attachment))

    def subscribe(self, pattern, callback):
        self._subscribers.append((matcher(pattern), callback))

    def announce(self, name):
        pass

    watch = subscribe


def drive():
    """Return (received in ns, topic, type, payload in CDR) of all messages that are kept."""
    fleet, network = load_deployment(FLEET), Network()
    binding = bind(scenario_of(fleet, None, {}), fleet.cars, fleet.markers, FLEET.name, None)
    clock = GateClock(lambda: network.now, lambda: network.now)
    cars = {car.name: Fake(binding, car.name, network, clock=clock, seed=1) for car in fleet.cars}
    for name, faults in FAULTS.items():
        for text in faults:
            cars[name].add_fault(fake_fault(text))
    profile = fleet.profile
    for k in range(round(SECONDS / STEP)):
        if k % 50 == 0:
            t = k * STEP
            turn, share = 0.35 * math.cos(2.0 * math.pi * t / 4.0), SLOW if 5.0 < t < 7.0 or t > 10.0 else 1.0
            for name, speed in SPEEDS.items():
                stamp = network.now + round(1e9 * (AHEAD + DRIFT * t) * (name == "svea1"))  # by the clock of its car
                command = write_drive(stamp, profile.command, MotionCommand(turn, share * speed))
                network.publish(profile.topic_of(name, Role.MANUAL), command)
        network.now += round(STEP * 1e9)
        for car in cars.values():
            car.advance()
    types = {profile.topic_of(name, role): profile.topics[role].type for name in cars for role in KEPT}
    return sorted((r, topic, types[topic], payload) for r, topic, payload in network.kept if topic in types)


def write(writer, messages, store, convert):
    with writer as bag:
        connections = {}
        for received, topic, kind, payload in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(f"/{topic}", kind, typestore=store)
            bag.write(connections[topic], received, convert(payload, kind))


def main(folder):
    messages = drive()
    for name, storage, mode in (("mcap", "MCAP", "STORAGE"), ("sqlite3", "SQLITE3", "FILE")):
        shutil.rmtree(folder / name, ignore_errors=True)
        writer = Writer(folder / name, version=9, storage_plugin=StoragePlugin[storage])
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        write(writer, messages, codec.ros2(), lambda payload, _: payload)
    (folder / "ros1.bag").unlink(missing_ok=True)
    writer = Writer1(folder / "ros1.bag")
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    write(writer, messages, codec.ros1(), codec.ros1_of)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent)
