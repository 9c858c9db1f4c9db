"""Sensing, communication and estimation: camera, rates, noise, topology, V2X, observer.

Off by default. Chances and standard deviations apply per vehicle and episode.
"""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from coopenv.base import units
from coopenv.base.errors import shown
from coopenv.base.sections import (
    Direction,
    NonNegative,
    NonNegativeVector3,
    Number,
    Positive,
    PositiveVector2,
    QuaternionWxyz,
    Rate,
    Sample,
    Section,
    TagFamily,
    Vector2,
    Vector3,
)

PerAxis = NonNegative | NonNegativeVector3
"""One number for all axes, or one for each."""

Pixels = Annotated[int, Field(ge=1, le=65_535)]

Latency = Annotated[Annotated[float, Field(ge=0.0, le=5.0)], units.LAG]
"""s; so long the poses of all agents are kept."""

ROTATION_OF_CAMERA = {"forward": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), "body": np.eye(3)}
"""Camera to body: columns are the optical frame's x (right), y (down), z (forward)."""


def rotation_of(yaw: float | None, quaternion_wxyz: Any) -> np.ndarray:
    """Return the rotation (3, 3) that a file gives as a quaternion or a yaw."""
    if quaternion_wxyz is None:
        w, x, y, z = math.cos((yaw or 0.0) / 2), 0.0, 0.0, math.sin((yaw or 0.0) / 2)
    else:
        w, x, y, z = quaternion_wxyz
        length = math.sqrt(x * x + y * y + z * z + w * w)
        w, x, y, z = w / length, x / length, y / length, z / length
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return np.array(
        [
            [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww],
        ]
    )


def _known_model(given: object) -> object:
    """Refuse another model, in words that help on cars as well, whose pixels mean nothing without a calibration."""
    if given not in ("pinhole", "omnidirectional", "none"):
        raise ValueError(
            f"expected 'omnidirectional', 'pinhole' or 'none', got {shown(given)}; cars need 'pinhole' with the "
            "calibration of their camera: image_size, focal_length, principal_point and distortion in [camera] of the "
            "environment"
        )
    return given


class Camera(Section):
    """The camera that every vehicle carries, unless it has its own; optical frame: x right, y down, z forward."""

    model: Annotated[Literal["pinhole", "omnidirectional", "none"], BeforeValidator(_known_model)] = "omnidirectional"
    """`omnidirectional` sees in every direction; `pinhole` is bounded by its image. The model, range, distortion
    and quantisation matter only where `topology.mode` is `sensed`; with `fixed` every neighbour is always measured."""
    position: Annotated[Vector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """Optical centre in the body frame, m."""
    orientation: Literal["forward", "body"] | QuaternionWxyz = "forward"
    """Camera to body: `forward` looks along the body's x axis, `body` has the body's own axes."""
    image_size: tuple[Pixels, Pixels] = (316, 208)
    """Width and height, pixels."""
    focal_length: Annotated[PositiveVector2, units.PIXELS] = (213.161906, 213.521038)
    """fx and fy, pixels."""
    principal_point: Annotated[Vector2, units.PIXELS] = (154.841998, 114.98398)
    """cx and cy, pixels."""
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of the plumb-bob model."""
    undistort: bool = True
    """Compute bearings from undistorted pixels."""
    quantise: bool = False
    """Round detections to whole pixels."""
    range: Annotated[Positive | None, units.DISTANCE] = None
    """Farthest distance at which a target is detected, m (none: unlimited)."""
    miss_probability: units.Chance = 0.0
    """Chance that a detection in view is lost, drawn per target and frame."""
    extrinsics_error: Annotated[NonNegative, units.SMALL_ANGLE] = 0.0
    """Standard deviation per axis of a rotation by which the true camera is turned against `orientation`, rad; drawn
    per vehicle and episode. Observers know `orientation` alone."""
    extrinsics_position_error: Annotated[NonNegative, units.DETAIL] = 0.0
    """Likewise of where the optical centre is, per axis, m."""
    focal_length_error: Annotated[NonNegative, units.SHARE] = 0.0
    """Standard deviation of e: the true focal length is (1 + e) times the known one, so that the coordinates of a
    bearing on the image plane (at distance 1) are (1 + e) times what they should be; drawn per vehicle and episode."""
    extrinsics_walk: Annotated[NonNegative, units.SMALL_ANGLE] = 0.0
    """Random walk of that rotation, standard deviation per axis, rad per square root of a second."""
    latency: Latency = 0.0
    """Age of a frame when its bearings are used, s; observers know it."""
    latency_error: Latency = 0.0
    """Standard deviation of an error of the latency, s; drawn per vehicle and episode. Frames may thereby be ahead of
    the odometry."""
    latency_jitter: Latency = 0.0
    """Standard deviation of a further error, drawn for every frame, s."""

    def to_body(self, pan: float = 0.0) -> np.ndarray:
        """Return the rotation (3, 3) from the nominal optical frame to the body, for a pan angle to the left, rad."""
        given = self.orientation
        mounted = ROTATION_OF_CAMERA[given] if isinstance(given, str) else rotation_of(None, given)
        return mounted if pan == 0.0 else rotation_of(pan, None) @ mounted

    @property
    def is_misplaced(self) -> bool:
        """True if the true camera differs from the nominal one."""
        turned = self.extrinsics_error, self.extrinsics_walk
        return any((*turned, self.extrinsics_position_error, self.focal_length_error))

    @property
    def is_late(self) -> bool:
        """True if its frames have an age."""
        return any((self.latency, self.latency_error, self.latency_jitter))


class Images(Section):
    """Rendered frames of `sensing = "images"`. Landmarks and vehicles carry tags, upright and turned to the camera."""

    family: TagFamily = "tag36h11"
    """Family of the tags: `tag16h5` to `tag36h11` of AprilTag, `DICT_4X4_50` to `DICT_7X7_1000` of ArUco. Numbers are
    those of the targets, landmarks first, from 0 on."""
    side: Annotated[Positive, units.DETAIL] = 0.16
    """Of the black squares, m."""
    blur: Annotated[float, Field(ge=0.0, le=50.0)] = 0.5
    """Standard deviation of the blur, pixels."""
    noise: Annotated[float, Field(ge=0.0, le=255.0)] = 2.0
    """Standard deviation of a pixel, shades: black and white are 190 apart."""
    wrong_identity: units.Chance = 0.0
    """Chance that a tag that is found is taken for that of another target of the vehicle, drawn per tag and frame. Lost
    ones: `camera.miss_probability`."""


class Rates(Section):
    """Rates in Hz; the sensors are asynchronous."""

    camera: Annotated[Rate, units.FREQUENCY] = 60.0
    """Frames per second; one frame is one tick."""
    odometry: Annotated[Rate, units.FREQUENCY] = 100.0
    """Samples of the body twist per second, each held until the next."""
    observer: Annotated[Rate | None, units.FREQUENCY] = None
    """Rate of the observer's corrections (none: at every camera frame)."""
    decision: Annotated[Rate, units.FREQUENCY] = 10.0
    """Rate of the policy's actions; the camera rate must be a multiple."""

    @model_validator(mode="after")
    def _whole_ticks(self) -> Self:
        ratio = self.camera / self.decision
        if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-9:
            raise ValueError(
                f"decision: the camera rate ({self.camera:g} Hz) must be a whole multiple of the decision rate "
                f"({self.decision:g} Hz)"
            )
        return self


class CorrelatedBearing(Section):
    """An error of a bearing that changes slowly: a Gauss-Markov process of first order, of its own for every target."""

    std: Annotated[NonNegative, units.SMALL_ANGLE] = 0.0
    """Standard deviation of each tangent axis, rad."""
    time: Annotated[Positive, units.TIME] = 10.0
    """Correlation time, s."""


class BearingNoise(Section):
    """Noise of a bearing."""

    model: Literal["paper", "isotropic"] = "isotropic"
    """`paper`: uniform noise on the coordinates of the image plane across `axis`; `isotropic`: Gaussian in
    the tangent plane of the bearing."""
    scale: Annotated[NonNegative, units.SMALL_ANGLE] = 0.0
    """`paper`: largest deviation (image plane at distance 1); `isotropic`: standard deviation per axis, rad."""
    axis: Direction = (0.0, 0.0, 1.0)
    """Optical axis of the paper's formula, in the camera frame."""
    rate: Annotated[Rate | Sample, units.FREQUENCY] = "sample"
    """Camera rate in Hz at which the scale holds (other rates keep its density), or `sample`: at any rate."""
    correlated: CorrelatedBearing = CorrelatedBearing()


class Slip(Section):
    """Occasional slip of the wheels, so that the odometry differs from the body's motion. Off unless `rate` is set."""

    rate: NonNegative = 0.0
    """Slips begin so often, 1/s."""
    duration: Annotated[Positive, units.LAG] = 0.5
    """Mean duration, s; durations are exponentially distributed."""
    size: Annotated[NonNegative, units.CHANCE] = 0.3
    """Largest share by which the measured speed is too high, drawn uniformly per slip."""
    angle: Annotated[NonNegative, units.TURN] = 0.0
    """Largest angle (rad) between the measured and the true direction of travel, uniform per slip, to either side."""


class Noise(Section):
    """Measurement noise, and errors of the odometry that last."""

    enabled: bool = True
    """False switches off all noise and errors of odometry, bearings, cameras and the map."""
    velocity: Annotated[NonNegative, units.SPEED_ERROR] = 0.0
    """Standard deviation of each component of a linear velocity sample, m/s."""
    angular_velocity: Annotated[NonNegative, units.TURN_RATE_ERROR] = 0.0
    """Standard deviation of each component of an angular velocity sample, rad/s."""
    odometry_rate: Annotated[Rate | Sample, units.FREQUENCY] = "sample"
    """Odometry rate in Hz at which these hold (other rates keep their density), or `sample`: at any rate."""
    bearing: BearingNoise = BearingNoise()
    odometry_scale: Annotated[NonNegative, units.SHARE] = 0.0
    """Standard deviation of a scale error s, drawn per vehicle and episode: measured is (1 + s) times the velocity."""
    odometry_scale_walk: Annotated[NonNegative, units.SHARE] = 0.0
    """Random walk of the scale, standard deviation per square root of a second."""
    gyro_bias: Annotated[PerAxis, units.TURN_RATE_ERROR] = 0.0
    """Standard deviation of a bias of the measured angular velocity, drawn per vehicle and episode, rad/s: of each
    component, or of the three body axes ([0, 0, x]: a car whose roll and pitch rates an accelerometer corrects)."""
    gyro_bias_walk: Annotated[PerAxis, units.TURN_RATE_ERROR] = 0.0
    """Random walk of the bias, standard deviation, rad/s per square root of a second."""
    slip: Slip = Slip()

    @property
    def lasts(self) -> bool:
        """True if the odometry has lasting errors."""
        errors = (self.odometry_scale, self.odometry_scale_walk, self.gyro_bias, self.gyro_bias_walk, self.slip.rate)
        return any(np.any(error) for error in errors)


class Topology(Section):
    """Targets that a vehicle measures, and senders that it receives."""

    mode: Literal["fixed", "sensed"] = "fixed"
    """`fixed`: every neighbour at every tick; `sensed`: neighbours in the field of view that are not occluded."""
    acyclic: bool = True
    """Restrict to the directed acyclic leader-follower order of the paper's Assumption 1."""
    most_nearby: int | None = Field(default=None, ge=1, le=4_096)
    """Most landmarks and vehicles within the ranges of a vehicle's camera and radio, or in its list of neighbours, for
    scenes of hundreds of vehicles (none: no limit). Time and memory then grow with the number of vehicles, not with its
    square; with map errors, the group `map` of observations looks at all landmarks."""


class V2x(Section):
    """The radio that carries pose estimates between vehicles."""

    links: Literal["neighbours", "all"] = "neighbours"
    """Senders that a vehicle receives: the vehicles that it may measure, or all in range. Its estimator uses the former
    alone; its driver all, for the right of way."""
    delay: int = Field(default=0, ge=0, le=600)
    """Camera ticks from sending to receiving; 0: a leader's estimate of the same tick."""
    period: int = Field(default=1, ge=1, le=100_000)
    """Camera ticks between messages."""
    loss: units.Loss = 0.0
    """Chance that one receiver loses one message."""
    range: Annotated[Positive | None, units.DISTANCE] = None
    """Farthest distance at which messages are received, m (none: unlimited)."""
    staleness: Annotated[Positive | None, units.TIME] = None
    """Messages older than this are not used, s (none: used for ever)."""


class ObserverSettings(Section):
    """The estimator that every vehicle runs, and its gains."""

    name: str = Field(default="riccati", max_length=64, pattern=r"^[A-Za-z][A-Za-z0-9_.-]*$")
    """`riccati`: the paper's observer; `robust`: this project's own; `dead_reckoning`: odometry alone, the lower
    reference; or any plug-in observer, which runs in Python and is looked up when the world is built."""
    k: Positive | tuple[Positive, ...] = 1.0
    """Gain k_i > 0.5, one for all vehicles or one per vehicle."""
    q: Positive | dict[str, Positive] = 10.0
    """Weight q_ij of a bearing, one for all targets or one per target name (others: 10)."""
    V: PositiveVector2 = (0.1, 1.0)
    """V = diag(V[0] I3, V[1] I3) over (2 lambda, p)."""
    P0: PositiveVector2 = (1.0, 100.0)
    """P(0) = diag(P0[0] I3, P0[1] I3)."""
    max_turn: Annotated[Positive, units.TURN] = 0.05
    """The correction is re-linearised whenever the attitude has turned by this much within a tick, rad."""
    gramian_window: Annotated[float, Field(gt=0.0, le=3600.0), units.TIME] = 1.0
    """Length of the sliding window of the observability Gramian, s."""
    gramian_distance: Annotated[Positive | None, units.DISTANCE] = None
    """Length of the window in m driven forwards by odometry, in place of a time (none)."""

    @model_validator(mode="after")
    def _gain_is_stable(self) -> Self:
        gains = self.k if isinstance(self.k, tuple) else (self.k,)
        if not gains or min(gains) <= 0.5:
            raise ValueError("k: the observer is stable for k > 0.5 only (paper, definition of K_i)")
        return self


LONGEST_REPLAY = 60.0
"""s; so long a sender's messages are kept."""


class Restart(Section):
    """A vehicle whose computer starts anew: its observer loses all, and begins again knowing nothing of its pose."""

    chance: units.Chance = 0.0
    """Probability that the vehicle restarts in an episode."""
    time: Annotated[NonNegative, units.TIME] = 0.0
    """When, s; it takes place at the next decision, never in the first one."""
    time_spread: Annotated[NonNegative, units.TIME] = 0.0
    """Largest delay of the time, drawn uniformly, s."""


class Corruption(Section):
    """Messages whose pose is altered on the way, so that they can still be read. What cannot is lost: `v2x.loss`."""

    probability: units.Chance = 0.0
    """Probability of each message, for all its receivers."""
    start: Annotated[NonNegative, units.TIME] = 0.0
    """Time of the start, s."""
    size: Annotated[NonNegative, units.EXTENT] = 10.0
    """Largest deviation of each coordinate of the position, m."""
    turn: Annotated[NonNegative, units.TURN] = 1.0
    """Largest component of the rotation vector by which the orientation is turned, rad."""


class Lie(Section):
    """A vehicle that broadcasts a pose other than its estimate."""

    kind: Literal["none", "jump", "drift", "replay", "collude"] = "none"
    """`jump`: a position off by `offset`; `drift`: one that walks away at `speed`; `replay`: its own message of `age`
    before, as if it were new; `collude`: as `jump`, and all that collude are off by the same, drawn once for them."""
    chance: units.Chance = 1.0
    """Probability that the vehicle lies in an episode; drawn once for all colluding vehicles."""
    start: Annotated[NonNegative, units.TIME] = 0.0
    """Time of the start, s."""
    start_spread: Annotated[NonNegative, units.TIME] = 0.0
    """Largest delay of the start, drawn uniformly (once for all colluding vehicles), s."""
    offset: Annotated[NonNegative, units.EXTENT] = 5.0
    """Offset of `jump` and `collude`, m."""
    turn: Annotated[NonNegative, units.TURN] = 0.0
    """Turn of all kinds but `replay`: about the vehicle's z axis, added to its attitude, rad."""
    odometry: Literal["consistent", "honest"] = "consistent"
    """Odometry in its messages, if any: `consistent` with the lie, or `honest`, the vehicle's own."""
    speed: Annotated[Positive, units.DRIVEN_SPEED] = 0.05
    """Speed of `drift`, m/s."""
    age: Annotated[Annotated[float, Field(gt=0.0, le=LONGEST_REPLAY)], units.LAG] = 1.0
    """Age of the messages of `replay`, s; rounded to whole periods of the radio."""
    direction: Direction | None = None
    """Direction of the offset of the position, map axes, of any length (default: horizontal, drawn)."""
    std: Positive | None = None
    """Claimed standard deviation of its pose, rad and m (default: its honest covariance)."""


class MapError(Section):
    """Landmarks whose place on a vehicle's map is wrong; a wrong entry is the same on all maps that have it."""

    chance: units.Chance = 0.0
    """Probability that an entry is wrong in an episode, drawn per landmark."""
    landmark: str | None = Field(default=None, max_length=64)
    """Name of the landmark (default: any may be wrong)."""
    offset: Annotated[NonNegative, units.EXTENT] = 1.0
    """Distance of the position on the map from the true one, m."""
    offset_spread: Annotated[NonNegative, units.EXTENT] = 0.0
    """Largest increase of the offset, drawn uniformly, m."""
    direction: Direction | None = None
    """Direction of the offset, map axes, of any length (default: horizontal, drawn per landmark)."""
    start: Annotated[NonNegative, units.TIME] = 0.0
    """Time of the start, s; the position is right before it."""
    start_spread: Annotated[NonNegative, units.TIME] = 0.0
    """Largest delay of the start, drawn uniformly per landmark, s."""


class Jammer(Section):
    """A jammer that the vehicle carries: receivers in its range lose all messages, its own receiver too."""

    chance: units.Chance = 0.0
    """Probability that the vehicle has a jammer in an episode."""
    range: Annotated[Positive | None, units.DISTANCE] = None
    """Range, m (none: unlimited)."""
    position: Annotated[Vector3 | None, units.PLACE] = None
    """Fixed place of the jammer, m (default: it moves with the vehicle)."""
    start: Annotated[NonNegative, units.TIME] = 0.0
    """Time of the start, s."""
    start_spread: Annotated[NonNegative, units.TIME] = 0.0
    """Largest delay of the start, drawn uniformly, s."""
    duration: Annotated[Positive | None, units.TIME] = None
    """Duration, s (none: to the end)."""
    period: Annotated[Positive, units.TIME] = 1.0
    """Period of a periodic jammer, s."""
    duty: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """Share of each period in which it jams, from the period's start on; 1: a constant jammer."""


class Faults(Section):
    """Faults of a vehicle's computer, clock, map and messages."""

    clock_offset: Annotated[NonNegative, units.LAG] = 0.0
    """Standard deviation of the vehicle's clock offset, s. Messages seem older or newer by the difference of
    the sender's clock and the receiver's, to whole camera ticks, but never from the future."""
    restart: Restart = Restart()
    corruption: Corruption = Corruption()
    lie: Lie = Lie()
    map_error: MapError = MapError()
    jammer: Jammer = Jammer()

    @property
    def alters(self) -> bool:
        """True if any message differs from its sender's estimate."""
        return self.lie.kind != "none" or self.corruption.probability > 0.0

    @property
    def any(self) -> bool:
        """True if any fault may occur."""
        chances = self.restart.chance, self.map_error.chance, self.jammer.chance
        return self.alters or self.clock_offset > 0.0 or max(chances) > 0.0
