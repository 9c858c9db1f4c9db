"""Sensors of fake cars: the truth with the scenario's noise and lasting errors, as messages of real cars.

Cameras cast rays: blocks of a Pixy and the authors' bearings, or frames with tags.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.binding import Binding
from coopenv.cars.fake.frames import FrameRenderer, PlacedTag, facing, pattern
from coopenv.cars.fake.settings import AHEAD, CarFaults, FakeSettings
from coopenv.cars.fake.world import CarWorld, Neighbours
from coopenv.cars.link.transport import Transport
from coopenv.cars.messages.codec import encode, header, make, ros2
from coopenv.cars.messages.see import object_bearings
from coopenv.cars.messages.vision import Calibration, opencv, rays
from coopenv.cars.settings.profile import IMAGES, CarProfile, Role
from coopenv.estimation.poses import Array
from coopenv.scenario.sensing import Noise
from coopenv.world.random import ODOMETRY_NOISE

TRUTH_RATE, FILTER_RATE = 100.0, 20.0
LEADER_RATE, CONDITION_RATE = 60.0, 5.0
"""Hz: motion capture, own filter; poses of a moving landmark, conditions of a car."""

GRAVITY = 9.81  # m/s^2
FULL = 0.9  # share of the battery that is left
STANDING = {"connected": True, "armed": True, "manual_input": True, "mode": "MANUAL", "system_status": 4}
BATTERY = {
    **{"voltage": 10.5 + 2.1 * FULL, "temperature": 25.0, "current": -1.0, "percentage": FULL},
    **{"charge": 5.0 * FULL, "capacity": 5.0, "design_capacity": 5.0},
    **{"power_supply_status": 2, "power_supply_health": 1, "power_supply_technology": 3, "present": True},
}

Act = Callable[[int, int], None]
"""Called with when it was due, steady clock, and the stamp by the car's clock; ns."""


@dataclass(frozen=True)
class SensorPublisher:
    """Publishes messages of a car on a network."""

    name: str
    profile: CarProfile
    network: Transport

    def send(self, role: Role, stamp: int, frame: str, /, **fields: Any) -> None:
        """Publish a message by its fields, the fields of SVEA's type; a stamp in ns.

        Types without covariances, or without a twist, get what they have room for.
        """
        topic = self.profile.topics[role]
        known = {name: node[1] for name, node in ros2().fielddefs[topic.type][1]}
        for name in fields.keys() & {"pose", "twist"}:
            if name in known and "WithCovariance" not in str(known[name]):
                fields[name] = fields[name][name]
        held = {name: value for name, value in fields.items() if name in known}
        payload = encode(make(topic.type, header=header(stamp, frame), **held))
        self.network.publish(self.profile.topic_of(self.name, role), payload, **topic.way)


@dataclass(eq=False, repr=False)
class CarSensors:
    """Odometry and condition of one car. Lasting errors are drawn by the world."""

    world: CarWorld
    publisher: SensorPublisher
    settings: FakeSettings
    differential: bool  # the wheels measure a turn rate, else 0

    def __post_init__(self) -> None:
        """Put them on the car of the world."""
        world, settings = self.world, self.settings
        noise = world.scenario.noises[world.vehicle]
        self._wheel_std = deviation(noise.velocity, noise, settings.wheel_rate)  # m/s, of a sample
        self._wheel_turn_std = deviation(noise.angular_velocity, noise, settings.wheel_rate)
        self._gyro_std = deviation(noise.angular_velocity, noise, settings.imu_rate)  # rad/s, a sample of each axis
        self.acts: list[tuple[float, Act]] = [
            (settings.wheel_rate, self._wheel),
            (settings.imu_rate, self._imu),
            (FILTER_RATE, self._odometry),
            (CONDITION_RATE, self._condition),
        ]
        """Rates in Hz, and what is published."""

    def begin(self, rng: np.random.Generator) -> None:
        """Begin an episode: the filter starts at its own origin, noise comes from `rng`."""
        self._rng = rng
        self._pose = np.zeros(3)  # of the filter, x and y in m and the heading in rad, from where the car began
        self._speed, self._turn_rate = 0.0, 0.0  # last samples
        self._since = 0
        self._factor = float(self.world.view("parameter")[0, int(ODOMETRY_NOISE)])

    def _wheel(self, due: int, stamp: int) -> None:
        velocity, turn = self.world.twist
        slip = self.world.view("slip")[0, self.world.vehicle]
        drawn, fixed = self.world.view("odometry_scale")[0, self.world.vehicle], self.settings.wheel_scale
        scale = (1.0 + (drawn if fixed is None else fixed)) * (1.0 + slip[0])
        self._dead_reckon(due)
        noise = self._rng.normal(size=2) * self._factor * (self._wheel_std, self._wheel_turn_std)
        self._speed = float(velocity[0] * scale * math.cos(slip[1]) + noise[0])
        turned = float(turn[2] * scale + noise[1]) if self.differential else 0.0
        covariance = np.diag([self._wheel_std**2, 0.0, 0.0, 0.0, 0.0, self._wheel_turn_std**2])
        twist = {"twist": ((self._speed, 0.0, 0.0), (0.0, 0.0, turned)), "covariance": covariance}
        self.publisher.send(Role.WHEEL, stamp, f"{self.publisher.name}/base_link", twist=twist)

    def _imu(self, due: int, stamp: int) -> None:
        """Publish turn rates, and the weight of a car on a plane; the IMU knows no orientation."""
        bias = self.world.view("gyro_bias")[0, self.world.vehicle].copy()
        if self.settings.gyro_bias is not None:
            bias[2] = self.settings.gyro_bias
        turn = self.world.twist[1] + bias + self._rng.normal(size=3) * self._factor * self._gyro_std
        self._dead_reckon(due)
        self._turn_rate = float(turn[2])
        fields = {"angular_velocity": turn, "linear_acceleration": (0.0, 0.0, GRAVITY)}
        fields["angular_velocity_covariance"] = self._gyro_std**2 * np.eye(3)
        unknown = {"orientation": (0.0, 0.0, 0.0, 1.0), "orientation_covariance": [-1.0, *np.zeros(8)]}
        self.publisher.send(Role.IMU, stamp, f"{self.publisher.name}/imu", **fields, **unknown)

    def _odometry(self, due: int, stamp: int) -> None:
        self._dead_reckon(due)
        x, y, heading = self._pose.tolist()
        turned = (0.0, 0.0, math.sin(heading / 2.0), math.cos(heading / 2.0))
        fields = {
            "pose": {"pose": ((x, y, 0.0), turned)},
            "twist": {"twist": ((self._speed, 0.0, 0.0), (0.0, 0.0, self._turn_rate))},
        }
        name = self.publisher.name
        self.publisher.send(Role.ODOMETRY, stamp, f"{name}/odom", child_frame_id=f"{name}/base_link", **fields)

    def _dead_reckon(self, now: int) -> None:
        """Move the filter's pose to a time by the last samples, held and summed."""
        dt = (now - self._since) * 1e-9 if self._since else 0.0
        self._since = now
        middle = self._pose[2] + 0.5 * dt * self._turn_rate
        way = dt * self._speed
        self._pose += (way * math.cos(middle), way * math.sin(middle), dt * self._turn_rate)

    def _condition(self, _due: int, stamp: int) -> None:
        self.publisher.send(Role.STATE, stamp, "", **STANDING)
        self.publisher.send(Role.REMOTE, stamp, "", rssi=200, channels=[1500] * 8)
        self.publisher.send(Role.BATTERY, stamp, "", **BATTERY)


def deviation(stated: float, noise: Noise, rate: float) -> float:
    """Return the standard deviation of a sample at a rate, Hz, whose density is that of what a scenario states."""
    if not noise.enabled:
        return 0.0
    return stated if isinstance(noise.odometry_rate, str) else stated * math.sqrt(rate / noise.odometry_rate)


CAMERA_INFO_RATE = 1.0  # Hz
OLDEST = 255  # frames that the camera counts
BLUR, NOISE = 0.5, 2.0
"""Standard deviations of blur and noise of frames: pixels and shades."""


class Spot(NamedTuple):
    """A marker in a frame."""

    number: int
    pixel: Array  # (2,) of its centre
    size: float  # side over distance
    age: int = 1  # frames in a row


@dataclass(eq=False, repr=False)
class FakeCamera:
    """The camera of one car."""

    world: CarWorld
    binding: Binding
    others: Neighbours  # which are placed for each frame
    faults: CarFaults
    publisher: SensorPublisher
    settings: FakeSettings

    def __post_init__(self) -> None:
        """Put it on the car.

        Raises:
            CoopenvError: it publishes frames, and the extra is not installed, or the family has no such markers.
        """
        world, binding = self.world, self.binding
        self._markers = {target: marker for marker, target in binding.targets.items()}
        self._side = self.settings.marker
        smallest, largest = binding.profile.markers
        self._numbers = range(smallest, largest + 1)
        self._calibration = Calibration.of(world.scenario.cameras[world.vehicle])
        self._vision, self._renderer, self._false_width = binding.profile.vision, None, 2.0
        if binding.profile.sees_frames:
            if self._vision.colours:
                raise CoopenvError("vision.colours: frames of fakes have tags, no colours")
            self._false_width = 40.0  # pixels, so that a tag can be read
            self._renderer = FrameRenderer(self._calibration, self._vision.family)
            self._compressed = binding.profile.topics[Role.DETECTIONS].type != IMAGES[0]
            for number in self._numbers:
                pattern(self._vision.family, number)
        self.acts: list[tuple[float, Act]] = [
            (world.scenario.rates.camera, self._camera),
            (CAMERA_INFO_RATE, self._camera_info),
        ]
        """Rates in Hz, and what is published."""

    def begin(self, rng: np.random.Generator) -> None:
        """Begin an episode: frames count from here, faults draw from `rng`."""
        self._ages: dict[int, int] = {}
        self._frames, self._rng = 0, rng

    def _camera(self, due: int, stamp: int) -> None:
        spots = self._spots(due)
        share = self.faults.value("wrong_stamps", due)
        if share and self._rng.random() < share:
            stamp += round(AHEAD * 1e9)
        begin = stamp - self._vision.late((), self._calibration.image_size[1])
        if self._renderer is None:
            blocks = [self._block(spot) for spot in spots]
            self.publisher.send(Role.DETECTIONS, begin, "camera", objects=blocks)
            self.publisher.send(Role.BEARINGS, stamp, "camera", bearing=self._bearings(blocks))
            return
        frame = self._renderer.render(self._tags(spots), BLUR, NOISE, self._rng)
        self.publisher.send(Role.DETECTIONS, begin, "camera", **self._fields(frame))

    def _camera_info(self, _due: int, stamp: int) -> None:
        self.publisher.send(Role.CAMERA_INFO, stamp, "camera", **self._calibration.info)

    def _spots(self, now: int) -> list[Spot]:
        """Take a frame at a time in ns; return its markers, the nearest first, with faults."""
        self.others.place()
        self._frames += 1
        seen = {agent: ray for agent, ray in self.world.look(self._frames).items() if agent in self._markers}
        self._ages = {agent: min(self._ages.get(agent, 0) + 1, OLDEST) for agent in seen}
        far = np.array([max(self.world.distance(agent), self._side) for agent in seen])
        pixels, sizes = self._rolled(np.array([*seen.values()]).reshape(-1, 3), far), self._side / far
        rows = zip(seen, pixels, sizes, strict=True)
        spots = [Spot(self._markers[agent], pixel, size, self._ages[agent]) for agent, pixel, size in rows]
        return self._with_faults(sorted(spots, key=lambda spot: -spot.size), now)

    def _rolled(self, units: Array, far: Array) -> Array:
        """Return the pixels (m, 2) of rays (m, 3) to markers at distances (m,), each at the time of its row.

        Rays are those of the middle row. Only the own motion counts.
        """
        pixels = self._calibration.pixels(units)
        late = self._vision.row_time * (pixels[:, 1:] - 0.5 * self._calibration.image_size[1])
        (velocity, turn), camera = self.world.twist, self.world.scenario.cameras[self.world.vehicle]
        w, v = turn @ camera.to_body(), (velocity + np.cross(turn, camera.position)) @ camera.to_body()
        return self._calibration.pixels(units - late * (np.cross(w, units) + v / far[:, None]))

    def _with_faults(self, spots: list[Spot], now: int) -> list[Spot]:
        faults, rng, size = self.faults, self._rng, self._calibration.image_size
        if faults.value("swapped_signatures", now):
            numbers = [spot.number for spot in spots]
            spots = [s._replace(number=n) for s, n in zip(spots, reversed(numbers), strict=True)]
        if share := faults.value("duplicate_blocks", now):
            doubled = [spot for spot in spots if rng.random() < share]
            spots = [*spots, *(Spot(s.number, s.pixel + np.array([3.0, 0.0]), 0.5 * s.size) for s in doubled)]
        if rate := faults.value("false_blocks", now):
            for _ in range(rng.poisson(rate / self.world.scenario.rates.camera)):
                number, pixel = int(rng.choice(self._numbers)), rng.integers(size).astype(np.float64)
                spots = [*spots, Spot(number, pixel, self._false_width / self._calibration.focal_length[0])]
        return spots

    def _block(self, spot: Spot) -> Any:
        """Return the ObjectInfo of a Pixy."""
        c = self._calibration
        x, y = np.rint(spot.pixel).clip(0, np.array(c.image_size) - 1).astype(int).tolist()
        width, height = (max(1, round(f * spot.size)) for f in c.focal_length)
        fields = {"center_x": x, "center_y": y, "width": width, "height": height, "age": spot.age}
        return make("pixy_camera/msg/ObjectInfo", signature=spot.number, index=spot.number - 1, **fields)

    def _bearings(self, blocks: list[Any]) -> list[Any]:
        """Return the ObjectBearings of blocks as the authors compute them: distortion is not removed."""
        c, pixels = self._calibration, np.array([(b.center_x, b.center_y) for b in blocks], dtype=np.float64)
        flat = (pixels.reshape(-1, 2) - c.principal_point) / c.focal_length
        units = np.concatenate([flat, np.ones((len(blocks), 1))], axis=-1)
        units /= np.linalg.norm(units, axis=-1, keepdims=True)
        return object_bearings([block.signature for block in blocks], units.tolist())

    def _tags(self, spots: list[Spot]) -> list[PlacedTag]:
        """Return upright tags that face the camera."""
        units, there = rays(np.array([spot.pixel for spot in spots]).reshape(-1, 2), self._calibration)
        rows = zip(spots, units, there, strict=True)
        return [facing(s.number, ray * self._side / s.size, self._side) for s, ray, imaged in rows if imaged]

    def _fields(self, frame: NDArray[np.uint8]) -> dict[str, Any]:
        """Return the fields of the message of a frame."""
        if self._compressed:
            return {"format": "jpeg", "data": opencv().imencode(".jpg", frame)[1]}
        height, width = frame.shape
        return {"height": height, "width": width, "step": width, "encoding": "mono8", "data": frame}
