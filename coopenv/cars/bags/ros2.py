"""Recordings as plain ROS 2 bags: standard messages in CDR alone, with the map by which coopenv reads the episode back.

Topics of a vehicle: `detections` (each marker at a distance of 1 m along its bearing), `odometry` (dead reckoning, with
twists that lead to the next tick, and the measured one between), `imu` (the measured turn rate), `truth`, `estimate`,
`camera_info`. Moving landmarks have `pose`, `/landmarks` shows all of them, and `/tf` has the truth or the estimate.
"""

import re
import warnings
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, DataWarning, listed
from coopenv.base.files import replacing_folder, writing
from coopenv.cars.backend.binding import marker_places
from coopenv.cars.bags.files import METADATA  # which names a missing extra
from coopenv.cars.messages.codec import encode, header, make, pose, ros2
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import TRANSFORMS
from coopenv.cars.settings.toml import toml_text
from coopenv.estimation.poses import Array, covariance_in_map, exp_so3, exp_translation, log_so3
from coopenv.observers.recording import Recording
from coopenv.observers.registry import named
from coopenv.observers.runner import Run, run
from coopenv.observers.sensed import Truth
from coopenv.scenario import Scenario
from coopenv.scenario.own_terms import without_own_terms
from coopenv.scenario.sensing import Camera

START = 1_577_836_800
"""s since 1970 of tick 0: 2020-01-01. A time of reception of 0 means that a clock was not set."""
DISTANCE = 1.0  # m of markers, whose distance a camera does not measure
FIRST_MARKER = 1
BEFORE, AFTER, LATE = 0.45, 0.55, 0.95
"""Shares of the time between ticks at which the measured twist begins, ends, and the twist after it comes again.

Readers make a tick half a period after its frame, with the last twist before. Other twists lead to the next tick, also
if a reader interpolates.
"""
SAME_PLACE = 1e-6  # m, of rounding
MAP_FILE, ENVIRONMENT_FILE = "topics.toml", "environment.toml"
STATIC = "/tf_static"


class Sent(NamedTuple):
    """A message of a bag."""

    time: int  # ns since 1970, of reception; stamps are the same, but those of frames with an age
    topic: str
    message: Any


def export_bag(recording: Recording, folder: Path, observer: str | None) -> None:
    """Write a recording as a bag with the estimates of an observer, by name; None: without.

    Raises:
        CoopenvError: no such observer, or it fails, or the folder cannot be written.
    """
    estimates = None if observer is None else run(named(observer), recording)
    if estimates is not None and estimates.failure:
        raise CoopenvError(f"{estimates.failure}; --no-scene writes the bag without estimates")
    write_bag(recording, folder, estimates)


def write_bag(recording: Recording, folder: str | Path, estimates: Run | None = None) -> None:
    """Write a recording as the folder of a ROS 2 bag, metadata and MCAP, with the map of its topics; it is replaced.

    Args:
        recording: of any vehicles; without a scenario there is no map.
        folder: of the bag.
        estimates: of an observer on the recording, for the topics `estimate`; None: they are absent.

    Raises:
        OutputError: the folder cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    folder, scenario = Path(folder), recording.scenario
    if left_out := sorted({sensor.name for setup in recording.setups for sensor in setup.sensors}):
        text = f"{folder}: left out, since no standard message has their measurements: {listed(left_out)}"
        warnings.warn(text, DataWarning, stacklevel=2)
    if scenario is not None and (others := {limits.model for limits in scenario.limits} - {"bicycle"}):
        text = (
            f"{folder}: written without a map: coopenv reads bags of cars that steer, not of {listed(sorted(others))}"
        )
        warnings.warn(text, DataWarning, stacklevel=2)
        scenario = None
    names = (METADATA, f"{folder.name}.mcap", MAP_FILE, ENVIRONMENT_FILE)
    with replacing_folder(folder, names) as part, writing(folder):
        with Writer(part / folder.name, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            connections: dict[str, Any] = {}
            for time, topic, message in messages_of(recording, estimates):
                if topic not in connections:
                    qos = [_latched()] if topic == STATIC else []
                    about = {"typestore": ros2(), "offered_qos_profiles": qos}
                    connections[topic] = bag.add_connection(topic, message.__msgtype__, **about)
                bag.write(connections[topic], time, encode(message))
        for file in [*(part / folder.name).iterdir()]:
            file.rename(part / file.name)
        (part / folder.name).rmdir()
        if scenario is not None:
            (part / MAP_FILE).write_text(toml_text(map_of(recording, scenario)), encoding="utf-8")
            contents = without_own_terms(scenario.model_dump(mode="json", exclude_unset=True))
            (part / ENVIRONMENT_FILE).write_text(toml_text(contents), encoding="utf-8")


def _latched() -> Any:
    """Return the quality of service of static transforms: nodes that begin later get them, too."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    ever = QosTime(9_223_372_036, 854_775_807)  # the largest number of ns
    kept = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*kept, ever, ever, QosLiveliness.AUTOMATIC, ever, False)


def messages_of(recording: Recording, estimates: Run | None) -> Iterator[Sent]:
    """Yield the messages of a recording in the order of time; arguments as for `write_bag`.

    A period before tick 0 there is one of each kind: a reader begins with them, so that its tick 0 is that of the
    recording.
    """
    r, scenario = recording, recording.scenario
    origin = np.zeros(3) if scenario is None else np.array(scenario.map.origin)
    vehicles = [_Vehicle(r, i, origin, estimates) for i in range(len(r.setups))]
    moving = moving_landmarks(r)
    yield _sent(r, -1, STATIC, make(TRANSFORMS[0], transforms=[vehicle.mounting for vehicle in vehicles]))
    for k in range(-1, r.ticks):
        places, changed = r.landmarks[max(k, 0)] + origin, k < 0 or (r.landmarks[k] != r.landmarks[max(k - 1, 0)]).any()
        for vehicle in vehicles:
            yield from (_sent(r, k, f"/{vehicle.name}/{name}", message) for name, message in vehicle.messages(k))
        for name, (landmark, marker) in moving.items():
            at = pose(np.eye(3), places[landmark] - marker)
            about = header(_time(r, k), "map")
            yield _sent(r, k, f"/{name}/pose", make("geometry_msgs/msg/PoseStamped", header=about, pose=at))
        if changed:
            yield _sent(r, k, "/landmarks", _markers(_time(r, k), places))
        if moved := [found for vehicle in vehicles if (found := vehicle.transform(k)) is not None]:
            yield _sent(r, k, "/tf", make(TRANSFORMS[0], transforms=moved))
        between = (vehicle.between(k) for vehicle in vehicles if 0 <= k < r.ticks - 1)
        yield from sorted((sent for some in between for sent in some), key=lambda sent: sent.time)


def _time(recording: Recording, k: int) -> int:
    return START * 10**9 + round(k * recording.dt * 1e9)


def _sent(recording: Recording, k: int, topic: str, message: Any) -> Sent:
    return Sent(_time(recording, k), topic, message)


class _Vehicle:
    """The messages of one vehicle by tick."""

    def __init__(self, recording: Recording, number: int, origin: Array, estimates: Run | None) -> None:
        self._recording, self._number, self._origin, self._estimates = recording, number, origin, estimates
        scenario, self.name = recording.scenario, recording.setups[number].name
        self._camera = Camera() if scenario is None else scenario.cameras[number]
        self._calibrated = scenario is not None and self._camera.model == "pinhole"
        self._to_body = self._camera.to_body()
        self._ages = recording.filled("bearing_age")[:, number]  # s, of frames
        self._reckoned = np.eye(3), np.zeros(3)

    @property
    def mounting(self) -> Any:
        """The static transform from the body to the optical frame of the camera."""
        place = _transform(self._to_body, self._recording.setups[self._number].lever_arm)
        about = {"header": header(_time(self._recording, -1), self.name), "child_frame_id": f"{self.name}/camera"}
        return make("geometry_msgs/msg/TransformStamped", transform=place, **about)

    def messages(self, k: int) -> Iterator[tuple[str, Any]]:
        """Yield name of the topic and message of a tick; -1 is a period before the first one."""
        r, i, time = self._recording, self._number, _time(self._recording, k)
        seen = np.flatnonzero(r.visible[k, i] & np.isfinite(r.bearings[k, i]).all(axis=-1)) if k >= 0 else ()
        optical = header(time - round(self._ages[max(k, 0)] * 1e9), f"{self.name}/camera")
        if k < 0 and self._calibrated:
            info = Calibration.of(self._camera).info
            yield "camera_info", make("sensor_msgs/msg/CameraInfo", header=optical, **info)
        found = [self._marker(k, int(target), optical) for target in seen]
        yield "detections", make("aruco_msgs/msg/MarkerArray", header=optical, markers=found)
        if k > 0:
            self._reckoned = _moved(self._reckoned, (r.rotation[k, i], r.translation[k, i]))
        at = max(k, 0)
        linear, angular = r.velocity[at, i], r.angular_velocity[at, i]
        yield (
            "odometry",
            self._odometry(time, self._reckoned, *(self._leading(k) if 0 <= k < r.ticks - 1 else (linear, angular))),
        )
        if k < 0:
            return
        body, absent = header(time, self.name), np.array([-1.0, *[0.0] * 8])
        unknown = {"orientation_covariance": absent, "linear_acceleration_covariance": absent}
        yield "imu", make("sensor_msgs/msg/Imu", header=body, angular_velocity=tuple(angular), **unknown)
        rotation, position = r.truth.rotation[k, i], r.truth.position[k, i]
        if np.isfinite(position).all():
            at = pose(rotation, position + self._origin)
            yield "truth", make("geometry_msgs/msg/PoseStamped", header=header(time, "map"), pose=at)
        if self._estimates is not None and np.isfinite(self._estimates.position[k, i]).all():
            yield "estimate", self._estimate(k, self._estimates)

    def _marker(self, k: int, target: int, about: Any) -> Any:
        """Return the message of a bearing, at `DISTANCE`, which a camera does not measure."""
        ray = self._to_body.T @ self._recording.bearings[k, self._number, target]
        place = {"pose": {"position": tuple(DISTANCE * ray), "orientation": (0.0, 0.0, 0.0, 1.0)}}
        return make("aruco_msgs/msg/Marker", header=about, id=FIRST_MARKER + target, pose=place)

    def _odometry(self, time: int, reckoned: tuple[Array, Array], linear: Array, angular: Array) -> Any:
        about = {"header": header(time, f"{self.name}/odom"), "child_frame_id": self.name}
        twist = {"twist": (tuple(linear), tuple(angular))}
        return make("nav_msgs/msg/Odometry", pose={"pose": pose(*reckoned)}, twist=twist, **about)

    def between(self, k: int) -> Iterator[Sent]:
        """Yield the odometry between a tick and the next one: the measured twist, and those that lead to the next."""
        r, i = self._recording, self._number
        begin, end = _time(r, k), _time(r, k + 1)
        times = [begin + round(share * (end - begin)) for share in (BEFORE, AFTER, LATE)]
        before, measured, after = ((b - a) * 1e-9 for a, b in pairwise([begin, *times[:2], end]))
        first, measuring = self._leading(k), (r.velocity[k, i], r.angular_velocity[k, i])
        reached = _increment(*first, before)
        yield self._between(times[0], reached, measuring)
        reached = _moved(reached, _increment(*measuring, measured))
        last = self._leading(k, reached, after)
        yield self._between(times[1], reached, last)
        yield self._between(times[2], _moved(reached, _increment(*last, (times[2] - times[1]) * 1e-9)), last)

    def _between(self, time: int, reached: tuple[Array, Array], twist: tuple[Array, Array]) -> Sent:
        """Return the odometry after an increment since the last tick."""
        return Sent(time, f"/{self.name}/odometry", self._odometry(time, _moved(self._reckoned, reached), *twist))

    def _leading(
        self, k: int, reached: tuple[Array, Array] = (np.eye(3), np.zeros(3)), seconds: float | None = None
    ) -> tuple[Array, Array]:
        """Return velocity and turn rate that lead to the next tick within a time, from an increment after a tick."""
        r, i, (R, p) = self._recording, self._number, reached
        turn = log_so3(R.T @ r.rotation[k + 1, i])
        along = np.column_stack([exp_translation(turn, axis) for axis in np.eye(3)])
        step = np.linalg.solve(along, R.T @ (r.translation[k + 1, i] - p))
        return step / (seconds or r.dt), turn / (seconds or r.dt)

    def _estimate(self, k: int, estimates: Run) -> Any:
        R, p, P = (array[k, self._number] for array in (estimates.rotation, estimates.position, estimates.covariance))
        covariance = covariance_in_map(estimates.coordinates, R, p, P) if np.isfinite(P).all() else np.zeros((6, 6))
        place = {"pose": pose(R, p + self._origin), "covariance": covariance}
        about = header(_time(self._recording, k), "map")
        return make("geometry_msgs/msg/PoseWithCovarianceStamped", header=about, pose=place)

    def transform(self, k: int) -> Any | None:
        """Return the transform from the map to the body, by the truth or the estimate; None: neither is known."""
        r, i, found = self._recording, self._number, self._estimates
        sources: list[Truth | Run | None] = [r.truth, found]
        for source in sources if k >= 0 else ():
            if source is not None and np.isfinite(source.position[k, i]).all():
                place = _transform(source.rotation[k, i], source.position[k, i] + self._origin)
                about = {"header": header(_time(r, k), "map"), "child_frame_id": self.name}
                return make("geometry_msgs/msg/TransformStamped", transform=place, **about)
        return None


def _increment(linear: Array, angular: Array, seconds: float) -> tuple[Array, Array]:
    """Return rotation and translation by a twist."""
    return exp_so3(angular * seconds), exp_translation(angular * seconds, linear * seconds)


def _moved(pose: tuple[Array, Array], increment: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return rotation and position after an increment in the body."""
    (R, p), (turn, step) = pose, increment
    return R @ turn, p + R @ step


def _transform(rotation: Array, position: Array) -> Any:
    placed = pose(rotation, position)
    return make("geometry_msgs/msg/Transform", translation=tuple(position), rotation=placed.orientation)


def _markers(time: int, places: Array) -> Any:
    """Return the spheres of landmarks for viewers."""
    look = {"ns": "landmarks", "type": 2, "scale": (0.2, 0.2, 0.2), "color": (0.9, 0.6, 0.0, 1.0)}
    spheres = [
        {"header": header(time, "map"), "id": n, "pose": pose(np.eye(3), place), **look}
        for n, place in enumerate(places)
    ]
    return make("visualization_msgs/msg/MarkerArray", markers=spheres)


def moving_landmarks(recording: Recording) -> dict[str, tuple[int, Array]]:
    """Return index and marker (3,) in the body, m, of landmarks that are not in one place, by the name of their topic.

    The place is that of the environment: landmarks that were drawn for an episode count as moving.
    """
    names, scenario = recording.setups[0].target_names, recording.scenario
    usual, bodies = recording.landmarks[0], [np.zeros(3)] * len(recording.landmarks[0])
    if scenario is not None:
        usual = marker_places(scenario.landmarks) - np.array(scenario.map.origin)
        bodies = [np.array(landmark.marker) for landmark in scenario.landmarks]
    moved = (np.abs(recording.landmarks - usual) > SAME_PLACE).any(axis=(0, 2))
    return {re.sub(r"\W", "_", names[n]): (n, bodies[n]) for n in np.flatnonzero(moved).tolist()}


def map_of(recording: Recording, scenario: Scenario) -> dict[str, Any]:
    """Return the map of the topics of a recording's bag, as plain data of its TOML file."""
    names, L = scenario.target_names, len(scenario.landmarks)
    moving = moving_landmarks(recording)
    led = {landmark for landmark, _ in moving.values()}
    cars: list[dict[str, Any]] = []
    for i, name in enumerate(scenario.vehicle_names):
        topics = {role: f"/{name}/{role}" for role in ("detections", "odometry", "truth")}
        if not recording.truth.known[:, i].any():
            del topics["truth"]
        cars.append({"name": name, "vehicle": name, "marker": FIRST_MARKER + L + i, "topics": topics})
    for topic, (landmark, _) in moving.items():
        about = {"name": topic, "landmark": names[landmark], "marker": FIRST_MARKER + landmark}
        cars.append({**about, "topics": {"estimate": f"/{topic}/pose"}})
    return {
        "environment": ENVIRONMENT_FILE,
        "names": "none",
        "odometry": "odometry",
        "camera": "detections",
        "markers": {names[n]: FIRST_MARKER + n for n in range(L) if n not in led},
        "clocks": {"mode": "stamps"},
        "cars": cars,
    }
