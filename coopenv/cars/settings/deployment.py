"""The deployment file: the cars, their network, and their limits."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from coopenv.base.errors import CoopenvError, check_one_of, listed, shown
from coopenv.base.sections import Section, read_toml, validated
from coopenv.cars.fake.settings import USUAL as DEFAULT_FAKE
from coopenv.cars.fake.settings import FakeSettings
from coopenv.cars.gate.gate import TIMEOUT
from coopenv.cars.gate.wheel_command import CommandMessage
from coopenv.cars.link.transport import SECURE, UNIX, Tls, address_of
from coopenv.cars.settings.limits import USUAL, Limits, Number, Point, Positive, is_simple
from coopenv.cars.settings.profile import MOST_CHANNELS, SVEA, CarProfile, RemotePulses, load_profile
from coopenv.cars.settings.sensors import Name, Sensors, read_calibration

Endpoint = Annotated[str, AfterValidator(lambda text: address_of(text) and text)]  # such as tcp/127.0.0.1:7447

WIRES = {
    "zenoh": ("tcp/127.0.0.1:7447", ("tcp", "tls", "quic", "udp", UNIX)),
    "nats": ("nats/127.0.0.1:4222", ("nats", "tcp", "tls")),
    "ros1": ("tcp/127.0.0.1:11311", ("tcp",)),
}
"""Kinds of networks: default endpoints, and protocols."""


def refuse_foreign(kind: str, endpoints: tuple[str, ...], field: str) -> None:
    """Refuse endpoints of a protocol that a kind of network does not have, with a ValueError that names it."""
    for endpoint in endpoints:
        if address_of(endpoint).protocol not in WIRES[kind][1]:
            raise ValueError(f"{field}: {shown(endpoint)}: {kind} has {listed(WIRES[kind][1])}")


class NetworkSettings(Section):
    """Settings of the cars' network."""

    kind: Literal["zenoh", "nats", "ros1"] = "zenoh"
    """`zenoh`: CDR under the keys of zenoh-bridge-ros2dds; `nats`: the authors' format; `ros1`: topics of a ROS
    master."""
    connect: tuple[Endpoint, ...] = Field(
        default_factory=lambda given: (WIRES[given.get("kind", "zenoh")][0],), min_length=1
    )
    """Endpoints of the router, the broker or the ROS master (default: on this computer, at its usual port)."""
    tls: Tls | None = None
    """Certificates, needed for endpoints `tls/...` and only for them."""

    @model_validator(mode="after")
    def _endpoints_fit(self) -> Self:
        if self.kind == "ros1" and len(self.connect) > 1:
            raise ValueError("connect: there is one ROS master, more than one endpoint is given")
        refuse_foreign(self.kind, self.connect, "connect")
        for endpoint in self.connect:
            secure = address_of(endpoint).protocol in SECURE
            if secure and self.tls is None:
                raise ValueError(f"tls: is missing, {endpoint} needs at least its root_ca")
            if not secure and self.tls is not None and address_of(endpoint).protocol != UNIX:
                raise ValueError(f"connect: {endpoint} is not encrypted; with network.tls, expected tls/...")
        return self


class GateLink(Section):
    """Connection of a car's gate, independent of `network`: no radio may be between the gate and the wheels."""

    connect: tuple[Endpoint, ...] | None = Field(default=None, min_length=1)
    """Endpoint, on the car, of its own bridge, router or ROS master for its gate and `coopenv svea health` (default: on
    the loopback, at its usual port). With `docker/car-zenoh.json5`: `unixsock-stream//run/coopenv/zenoh.sock`."""


Channel = Annotated[int, Field(ge=1, le=MOST_CHANNELS)]


class Remote(Section):
    """Channels of the remote control, as `mavros/rc/in` numbers them from 1 on; PX4's usual order."""

    steering: Channel = 1
    """Channel of the stick that steers, from 1 on."""
    throttle: Channel = 3
    """Channel of the stick that drives."""
    mode_switch: int = Field(default=5, ge=0, le=MOST_CHANNELS)
    """Channel of the switch that chooses the autopilot's mode (0: there is none)."""

    @model_validator(mode="after")
    def _each_has_its_own(self) -> Self:
        if len({self.steering, self.throttle, self.mode_switch}) < 3:
            raise ValueError("steering, throttle and mode_switch: two of them are on the same channel")
        return self

    def fault(self, pulses: tuple[int, ...], usual: RemotePulses = SVEA.pulses) -> str:
        """Return why pulses, us, one per channel, are no signal; empty where they are."""
        for name in ("steering", "throttle", "mode_switch"):
            channel = getattr(self, name)
            if pulses and channel > len(pulses):
                return f"its remote control has {len(pulses)} channels, remote.{name} is {channel}"
            if not pulses or (channel and not usual.shortest <= pulses[channel - 1] <= usual.longest):
                return "its remote control has no signal"
        return ""

    def drives(self, pulses: tuple[int, ...], usual: RemotePulses = SVEA.pulses) -> bool:
        """Return whether a stick is moved; one without a signal is not."""
        used = [pulses[channel - 1] for channel in (self.steering, self.throttle) if channel <= len(pulses)]
        return any(
            usual.shortest <= pulse <= usual.longest and abs(pulse - usual.neutral) > usual.moved for pulse in used
        )

    def switched(self, pulses: tuple[int, ...], before: tuple[int, ...], usual: RemotePulses = SVEA.pulses) -> bool:
        """Return whether the switch is no longer where it was."""
        if not 0 < self.mode_switch <= min(len(pulses), len(before)):
            return False
        return abs(pulses[self.mode_switch - 1] - before[self.mode_switch - 1]) > usual.moved


Marker = Annotated[int, Field(ge=0)]
Agent = Annotated[int, Field(ge=0, le=9999)]
Age = Annotated[float, Field(gt=0.0, le=2.0)]
Corner = tuple[Number, Number]


class DeploymentError(CoopenvError):
    """A deployment file does not describe a fleet that can drive."""


class Car(Section):
    """One car."""

    name: Name
    """Name of the car in its topics, `fleet/NAME/...`."""
    vehicle: str | None = None
    """Vehicle of the environment (default: the first one, in the environment's order, that no other car names and no
    earlier car has taken)."""
    landmark: str | None = None
    """Moving landmark of the environment, instead of a vehicle: its position is known, and it is not driven."""
    marker: Marker | None = None
    """Number of the marker on the car, 1 to 7 (none: cameras cannot identify the car)."""
    agent: Agent | None = None
    """Number of the car in the authors' names, `agentN/...`, on `nats` and `ros1` (default: that of its marker)."""

    @property
    def agent_number(self) -> int | None:
        """Its number in the authors' names; None: it has none."""
        return self.marker if self.agent is None else self.agent


def with_tables(
    raw: Mapping[str, Any], more: Mapping[str, Any], keys: Sequence[str], where: str, error: type[CoopenvError]
) -> dict[str, Any]:
    """Return plain data with the entries of tables of another file added, `where` both are named.

    Raises:
        CoopenvError: of class `error`; one of them is no table.
    """
    joined = dict(raw)
    for key in keys:
        own, other = raw.get(key, {}), more.get(key, {})
        if not (isinstance(own, Mapping) and isinstance(other, Mapping)):
            raise error(f"{where}: {key}: expected a table")
        joined[key] = {**own, **other}
    return joined


def refuse_repeated(cars: Sequence[Car], markers: Mapping[str, int], numbers: tuple[int, int] | None = None) -> None:
    """Refuse a name, vehicle, landmark or marker of two, with a ValueError that names it.

    Args:
        cars: a fleet.
        markers: numbers of the markers of landmarks, by name.
        numbers: smallest and largest one that the camera identifies (None: any).
    """
    given: dict[str, list[Any]] = {
        "cars: the name": [car.name for car in cars],
        "cars: the vehicle": [car.vehicle for car in cars if car.vehicle is not None],
        "cars: the landmark": [car.landmark for car in cars if car.landmark is not None],
        "markers: the number": [*markers.values(), *(c.marker for c in cars if c.marker is not None)],
        "cars: the agent (or marker)": [c.agent_number for c in cars if c.agent_number is not None],
    }
    for what, values in given.items():
        for value, times in Counter(values).items():
            if times > 1:
                raise ValueError(f"{what} {value!r} is used twice")
    for what, number in [*markers.items(), *((c.name, c.marker) for c in cars if c.marker is not None)]:
        if numbers is not None and not numbers[0] <= number <= numbers[1]:
            raise ValueError(f"marker {number} of {what}: the camera knows {numbers[0]} to {numbers[1]} only")
    for i, car in enumerate(cars):
        if car.vehicle is not None and car.landmark is not None:
            raise ValueError(f"cars.{i}: is a vehicle or a landmark, not both")


LIMITED = ("speed", "steering", "acceleration", "steering_rate")

LAG = 0.1
"""Allowance (s) for the period of the gate and the lags of a car."""
ROLLING = 1.0
"""Deceleration of a car that is not braked, unless it is measured, m/s^2."""


class Safety(Section):
    """Limits at which the cars stop. Limits above the profile's are refused."""

    max_speed: float = Field(default=USUAL.speed, gt=0.0)
    """Largest speed, m/s."""
    max_steering: float = Field(default=USUAL.steering, gt=0.0)
    """Largest steering angle, rad."""
    max_acceleration: float = Field(default=USUAL.acceleration, gt=0.0)
    """Largest acceleration, m/s^2."""
    max_steering_rate: float = Field(default=USUAL.steering_rate, gt=0.0)
    """Largest rate of the steering angle, rad/s."""
    reverse: bool = False
    """Allow cars to drive backwards."""
    odometry_age: Age = 0.15
    """Time without odometry after which all cars are stopped, s."""
    truth_age: Age = 0.5
    """Time for which a car's position may be unknown, if a geofence or a separation needs it, s."""
    geofence: tuple[Corner, ...] = Field(default=(), max_length=256)
    """Corners of a polygon that no car may leave, m, in the coordinates of the environment's file (none: no fence)."""
    separation: float = Field(default=0.0, ge=0.0, le=100.0)
    """Least distance between a driven car and any other car of the fleet, m (0: not watched)."""
    deceleration: float | None = Field(default=None, ge=0.1, le=20.0)
    """Deceleration of a stopping car, m/s^2, by a test (default: the profile's brake, or 1). Cars stop early enough to
    stand inside the geofence, apart."""
    judge: Literal["truth", "estimate"] = "truth"
    """Source of the positions for geofence and separation."""
    max_error: Positive | None = 0.15
    """Largest distance between a car's estimated position and that of motion capture, while this is known, m. A car
    stands until its estimate has been within this and the next four limits for 0.2 s, 2 s at most. All cars are
    stopped when one of them has then been exceeded for 0.2 s."""
    max_turn_error: Positive | None = 0.15
    """Largest angle between a car's estimated orientation and that of motion capture, rad."""
    max_std: Positive | None = None
    """Largest standard deviation of the estimated position, m."""
    max_protection_level: Positive | None = None
    """Largest horizontal protection level of `robust`, m: how far off the estimate may be if one landmark, sender or
    sensor is faulty. Unknown, and so too large, are those of other observers, and where the rest determines no pose."""
    max_nis: Positive | None = 10.0
    """Largest normalised innovation squared per degree of freedom, the median over the bearings to static landmarks in
    the last second: below 1 where all is well. Bearings that the observer rejects count."""
    missed_deadlines: int = Field(default=5, ge=1)
    """Late decisions in a row after which all cars are stopped."""
    min_battery: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of the battery below which cars are not armed."""
    conditions: bool | None = None
    """Require messages of remote control, autopilot and battery for arming, and messages of the remote control while
    armed (default: only with `zenoh`, as the authors' cars do not send them)."""
    max_clock_offset: Positive = 0.02
    """Largest offset between the clocks of a car and of this computer for arming, s."""

    def stopping(self, speed: float, command: CommandMessage) -> dict[str, tuple[float, float]]:
        """Return by cause the time, s, and the distance, m, in which a car at a speed, m/s, stops.

        The gate sends neutral, or brakes; without it the autopilot lets the car roll.
        """
        rate = self.deceleration or (command.brake.deceleration if command.brake else ROLLING)
        alone = min(rate, ROLLING) if command.brake else rate
        causes = {
            "station or radio silent": (1e-9 * TIMEOUT + LAG, rate),
            "gate or its router silent": (command.timeout + LAG, alone),
            "autopilot silent": (self.odometry_age + LAG, rate),
        }
        return {cause: (t + speed / a, speed * t + speed**2 / (2.0 * a)) for cause, (t, a) in causes.items()}

    @field_validator("geofence")
    @classmethod
    def _encloses_something(cls, corners: tuple[Point, ...]) -> tuple[Point, ...]:
        if corners and not is_simple(corners):
            raise ValueError("expected at least 3 corners of a polygon whose edges do not cross")
        return corners


class Security(Section):
    """Signatures of commands and of messages between cars."""

    keys: Path | None = None
    """Folder of keys, see `coopenv svea keys` (relative to this file); none: nothing is signed or checked."""
    identity: Name = "station"
    """Name of the key with which this end signs, if it is not a car."""


class Deployment(Section):
    """A fleet and its use."""

    environment: str
    """Name of an environment, or TOML file (relative to this file): vehicles, sensors, radio and observer."""
    overrides: dict[str, Any] = Field(default={})
    """Dotted keys of the environment with other values."""
    profile: CarProfile = SVEA
    """Make of the cars: a shipped profile, `svea`; a TOML file (relative to this file); or a table of differences
    from the profile `base`."""
    cars: tuple[Car, ...] = Field(min_length=1, max_length=64)
    """One table `[[cars]]` per car."""
    markers: dict[str, Marker] = Field(default={})
    """Numbers of the markers of landmarks, by name."""
    network: NetworkSettings = NetworkSettings()
    gate: GateLink = Field(default=GateLink(), exclude=True)  # matters on the car alone, and to no record of a drive
    sensors: Sensors = Sensors()
    safety: Safety = Safety()
    remote: Remote = Remote()
    security: Security = Security()
    fakes: bool = False
    """Treat the cars as fakes, which are moved to the start of each episode."""
    fake: FakeSettings = Field(default=DEFAULT_FAKE, exclude=True)  # matters in the fakes' processes alone
    identified: str | None = Field(default=None, exclude=True)
    """File that `coopenv identify` has written (relative to this file): its overrides and its table `fake` replace
    those of this file."""
    calibration: str | None = Field(default=None, exclude=True)
    """File that `coopenv calibrate` has written (relative to this file): its overrides replace those of this file, its
    corrections and leads of clocks those in `sensors`."""
    file: Path = Field(default=Path(), exclude=True)
    """Path of the deployment; set by `load_deployment`."""

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        """Refuse repeated names, limits beyond those of the make, and a gate's endpoints of another network."""
        refuse_repeated(self.cars, self.markers, self.profile.markers)
        for key in self.safety.model_fields_set & {f"max_{name}" for name in LIMITED}:
            value, most = getattr(self.safety, key), getattr(self.profile.hardest, key.removeprefix("max_"))
            if value > most:
                raise ValueError(f"safety.{key}: {value:g} is over {most:.4g}, the largest of this make")
        if self.safety.reverse and not self.profile.hardest.reverse:
            raise ValueError("safety.reverse: true, but this make does not reverse")
        refuse_foreign(self.network.kind, self.gate_connect, "gate.connect")
        driven = [car.name for car in self.cars if car.landmark is None]
        topics = ["/" + self.profile.topic_of(car, role) for car in driven for role in self.sensors.roles]
        for what, given, known in (
            ("corrections", self.sensors.corrections, driven),
            ("leads", self.sensors.leads, topics),
        ):
            for name in given:
                check_one_of(f"sensors.{what}: unknown", name, known, ValueError)
        if self.profile.sees_frames and (self.sensors.detections, self.sensors.distorted) != ("bearings", False):
            raise ValueError(
                "sensors: frames are not sent to the station: `coopenv svea see` makes bearings of them on the car, "
                'and here detections = "bearings" and distorted = false'
            )
        return self

    @property
    def limits(self) -> Limits:
        """The limits of commands; a default is at most the largest of the make."""
        hardest = self.profile.hardest
        values = {name: min(getattr(self.safety, f"max_{name}"), getattr(hardest, name)) for name in LIMITED}
        return Limits(**values, reverse=self.safety.reverse)

    @property
    def gate_connect(self) -> tuple[str, ...]:
        """Addresses that a car's gate connects to; never beyond the radio unless the file states so."""
        return self.gate.connect or (WIRES[self.network.kind][0],)

    @property
    def folder(self) -> Path:
        """Folder of the file."""
        return self.file.parent

    @property
    def keys(self) -> Path | None:
        """Folder of the keys; None: nothing is signed. Raises DeploymentError: the folder does not exist."""
        if self.security.keys is None:
            return None
        place = self.folder / self.security.keys
        if not place.exists():
            make = f"`coopenv svea keys {self.file}` makes it"
            raise DeploymentError(f"{self.file.name}: security.keys: there is no folder '{place}'; {make}")
        return place

    @property
    def conditions(self) -> bool:
        """True if cars must publish the conditions of remote control, autopilot and battery."""
        return self.network.kind == "zenoh" if self.safety.conditions is None else self.safety.conditions

    def car(self, name: str) -> Car:
        """Return a car by name. Raises DeploymentError: there is none."""
        names = [car.name for car in self.cars]
        check_one_of("unknown car", name, names, DeploymentError)
        return self.cars[names.index(name)]


class IdentifiedFile(Section):
    """File of `coopenv identify`."""

    overrides: dict[str, Any]
    fake: dict[str, Any]
    constants: dict[str, Any] = Field(default={})


def load_deployment(path: str | Path, connect: str | None = None) -> Deployment:
    """Read a deployment file.

    Args:
        path: of the file.
        connect: endpoint in place of the file's `network.connect`.

    Raises:
        DeploymentError: it cannot be read, or one line says which field is not what it must be.
    """
    path = Path(path)
    raw = read_toml(path, DeploymentError)
    network = raw.get("network", {})
    if connect is not None and isinstance(network, dict):
        raw["network"] = {**network, "connect": [connect]}
    if isinstance(name := raw.get("identified"), str):
        found = read_toml(path.parent / name, DeploymentError)
        validated(IdentifiedFile, json.dumps(found, default=str), f"{path.name}: identified: {name}", DeploymentError)
        raw = with_tables(raw, found, ("overrides", "fake"), f"{path.name} and {name}", DeploymentError)
    if isinstance(name := raw.get("calibration"), str):
        both = f"{path.name} and {name}"
        found = read_calibration(path.parent / name, f"{path.name}: calibration: {name}", DeploymentError)
        raw = with_tables(raw, found, ("overrides",), both, DeploymentError)
        more = {"corrections": found.get("corrections", {}), "leads": found["clocks"]["leads"]}
        own = with_tables(raw, {}, ("sensors",), path.name, DeploymentError)["sensors"]
        raw["sensors"] = with_tables(own, more, tuple(more), f"{both}: sensors", DeploymentError)
    return parse_deployment(raw, path)


def parse_deployment(raw: dict[str, Any], path: Path) -> Deployment:
    """Validate plain data that stands, or could stand, in a file; errors as for `load_deployment`."""
    given = raw.get("profile")
    if isinstance(given, str) or (isinstance(given, dict) and "base" in given):
        try:
            raw = {**raw, "profile": load_profile(given, path.parent).model_dump(mode="json")}
        except CoopenvError as error:
            raise DeploymentError(f"{path.name}: profile: {error}") from None
    made = validated(Deployment, json.dumps(raw, default=str), path.name, DeploymentError)
    return made.model_copy(update={"file": path})
