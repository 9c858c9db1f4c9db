"""The static side of a world: a scenario as arrays and numbers on a device, in one floating point precision.

Agents are landmarks first, then vehicles, as in the paper; A = landmarks + vehicles. N = vehicles, O = obstacles.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from coopenv.base.errors import DeviceError, suggest
from coopenv.world.launch import start_warp
from coopenv.world.warp_internals import field_types


@dataclass(frozen=True)
class Precision:
    """Scalar, vector and matrix types that belong together."""

    name: str
    scalar: Any
    numpy: Any
    vec2: Any
    vec3: Any
    vec5: Any
    vec6: Any
    mat33: Any
    mat66: Any


def _precision(scalar: Any) -> Precision:
    vector, matrix, number = wp.types.vector, wp.types.matrix, wp.dtype_to_numpy(scalar)
    small = vector(2, scalar), vector(3, scalar), vector(5, scalar), vector(6, scalar), matrix((3, 3), scalar)
    return Precision(scalar.__name__, scalar, number, *small, matrix((6, 6), scalar))


PRECISIONS = {"float32": _precision(wp.float32), "float64": _precision(wp.float64)}


def precision(dtype: object) -> Precision:
    """Return the types for a name or type of NumPy or torch. Raises DeviceError: neither `float32` nor `float64`."""
    dtype = str(getattr(dtype, "__name__", dtype)).removeprefix("torch.")
    if dtype not in PRECISIONS:
        raise DeviceError(f"unknown dtype '{dtype}'{suggest(dtype, PRECISIONS)}; known: float32, float64")
    return PRECISIONS[dtype]


def check_device(device: object) -> str:
    """Return the canonical name of a device, by name or of torch. Raises DeviceError: Warp has no such device here."""
    start_warp()
    device = str(device)
    if device.split(":")[0] not in ("cpu", "cuda"):
        raise DeviceError(f"unknown device '{device}'; known: cpu, cuda, cuda:0, ...")
    if device.startswith("cuda") and not wp.is_cuda_available():
        raise DeviceError(f"device '{device}' asked for, but no CUDA device is available here; use device='cpu'")
    try:
        return str(wp.get_device(device))
    except (ValueError, RuntimeError):
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"unknown device '{device}'; known: {known}") from None


def device_memory(device: str) -> int | None:
    """Return the bytes of a device's own memory; None: it shares this machine's."""
    found = wp.get_device(device)
    return int(found.total_memory) if found.is_cuda else None


STATIC = wp.constant(0)
PRESCRIBED = wp.constant(1)
DRIVEN = wp.constant(2)
"""Values of `Model.motion.kind`."""


SENSED = wp.constant(0)
IDEAL = wp.constant(1)
BLIND = wp.constant(2)
"""Values of `Model.sensing`, see the scenario's key."""

mat66d: Any = wp.types.matrix((6, 6), wp.float64)


@cache
def model_struct(p: Precision) -> Any:
    """Return the Warp struct of the model in one precision."""
    scalar, vec2, vec3, vec6, mat33 = p.scalar, p.vec2, p.vec3, p.vec6, p.mat33

    @wp.struct
    class StartValues:
        """Start of an episode. Angles in rad, lengths in m, map frame."""

        position: wp.array(dtype=vec3)  # (A,)
        rotation: wp.array(dtype=mat33)  # (A,)
        position_spread: wp.array(dtype=vec3)  # (A,)
        yaw_spread: wp.array(dtype=scalar)  # (A,)
        speed: wp.array(dtype=scalar)  # (N,) m/s
        estimate_fixed: wp.array(dtype=wp.int32)  # (N,) 0: estimate_position is relative to the true start
        estimate_position: wp.array(dtype=vec3)  # (N,)
        estimate_radius: wp.array(dtype=scalar)  # (N,)
        orientation_fixed: wp.array(dtype=wp.int32)  # (N,) 0: estimate_rotation multiplies R(0)
        estimate_rotation: wp.array(dtype=mat33)  # (N,)
        orientation_angle: wp.array(dtype=scalar)  # (N,) largest random turn; negative: uniform over SO(3)
        covariance: wp.array(
            dtype=mat66d
        )  # (2N,) of the initial estimates, for observers, and after restarts; left error

    @wp.struct
    class Motion:
        """Prescribed motion: segments of agent a are first[a] .. first[a + 1] - 1 of the table."""

        kind: wp.array(dtype=wp.int32)  # (A,)
        first: wp.array(dtype=wp.int32)  # (A + 1,)
        start: wp.array(dtype=wp.float64)  # (S,) s
        linear: wp.array(dtype=vec3)  # (S,) m/s
        angular: wp.array(dtype=vec3)  # (S,) rad/s
        rotation: wp.array(dtype=mat33)  # (S,) relative to the start
        position: wp.array(dtype=vec3)  # (S,) m

    @wp.struct
    class DynamicsValues:
        """Kind of motion, limits and actuators of one vehicle; m, s, rad."""

        kind: wp.int32  # place in `coopenv.motions.table.DRIVES`
        wheelbase: scalar
        max_speed: scalar
        min_speed: scalar
        max_acceleration: scalar
        steers: wp.int32  # 1: the second column of a command is an angle (rad), not a rate
        max_turn: scalar  # of the second column of a command: rad, or rad/s
        max_turn_change: scalar  # per s
        max_lateral_speed: scalar  # 0: the kind does not move sideways
        speed_time_constant: scalar
        turn_time_constant: scalar
        latency_ticks: wp.int32
        dead_band: scalar  # m/s
        gated: wp.int32  # 1: commands change gradually
        in_traffic: wp.int32  # 1: the model of traffic drives it, see `coopenv.world.route`
        acceleration_mode: wp.int32  # 1: the first entry of an action is an acceleration
        action_turn: scalar  # of an action of 1
        pan_limit: scalar  # of the camera; 0: it does not turn
        pan_rate: scalar

    @wp.struct
    class SceneValues:
        """Boxes that occlude and collide; half sizes of zero mean no body."""

        body_half: wp.array(dtype=vec3)  # (A,) m
        body_center: wp.array(dtype=vec3)  # (A,) body frame, m
        marker: wp.array(dtype=vec3)  # (A,) body frame, m
        anchor: wp.array(dtype=wp.int32)  # (A,) 1: cameras do not see it
        obstacle_rotation: wp.array(dtype=mat33)  # (O,)
        obstacle_center: wp.array(dtype=vec3)  # (O,) m
        obstacle_half: wp.array(dtype=vec3)  # (O,) m
        goal_radius: wp.array(dtype=scalar)  # (N,) m; 0: no goal
        end_on_collision: wp.int32
        end_on_arrival: wp.int32
        off_route: scalar  # m from the route that end an episode; 0: none do

    @wp.struct
    class Cells:
        """The grid in which bodies are found, see `coopenv.world.nearby`."""

        across: wp.int32  # cells along each axis, a power of two; 1: all pairs are tested
        per_metre: scalar  # 1 / edge of a cell
        body_reach: scalar  # m, the farthest point of an agent's box from the agent
        first_building: wp.array(dtype=wp.int32)  # (across^2 + 1,) of the buildings that reach a cell
        building: wp.array(dtype=wp.int32)

    @wp.struct
    class Routes:
        """Routes of vehicles: vehicle i draws one of the routes choice[first[i]] .. choice[first[i + 1] - 1].

        A vehicle without routes goes straight to its goal.
        """

        first: wp.array(dtype=wp.int32)  # (N + 1,)
        choice: wp.array(dtype=wp.int32)  # (C,)
        goal: wp.array(dtype=vec3)  # (N,) m, of vehicles without routes
        points: wp.int32  # of the route that has most
        count: wp.array(dtype=wp.int32)  # (R,) points
        point: wp.array2d(dtype=vec3)  # (R, P) as designed: x, y in m, map; heading in rad
        lateral_spread: wp.array(dtype=scalar)  # (R,) m
        wander: wp.array(dtype=scalar)  # (R,) m
        start_spread: wp.array(dtype=scalar)  # (R,) m
        signal_at: wp.array(dtype=scalar)  # (R,) m, arc length of its stop line
        signal_period: wp.array(dtype=scalar)  # (R,) s
        signal_start: wp.array(dtype=scalar)  # (R,) s in every period, of the green time
        signal_green: wp.array(dtype=scalar)  # (R,) s, its duration
        height: scalar  # m, of the ground that routes lie on, map

    @wp.struct
    class DrawRanges:
        """Ranges of further draws at a reset, G groups of landmarks with Y areas in all."""

        presence: wp.array(dtype=scalar)  # (A,) chance to be there
        any_driven: wp.int32
        pace_spread: wp.array(dtype=scalar)  # (A,) of prescribed motions
        speed_spread: wp.array(dtype=scalar)  # (N,) m/s, at the start
        group: wp.array(dtype=wp.int32)  # (L,) of each landmark; -1: none
        first_area: wp.array(dtype=wp.int32)  # (G + 1,)
        area_share: wp.array(dtype=wp.float64)  # (Y,) of its group up to and with this one
        area_corner: wp.array(dtype=vec3)  # (Y,) m, map, at the least height
        area_first_edge: wp.array(dtype=vec3)  # (Y,) m
        area_second_edge: wp.array(dtype=vec3)  # (Y,) m
        height: wp.array(dtype=scalar)  # (G,) m, from the least to the greatest
        low: wp.array(dtype=scalar)  # (Q,) least factor of each parameter
        high: wp.array(dtype=scalar)  # (Q,)
        easy: wp.array(dtype=scalar)  # (Q,) factor at difficulty 0
        hard: wp.array(dtype=scalar)  # (Q,) and at 1
        level: scalar  # difficulty, unless another one is set
        entry: wp.array(dtype=vec2)  # (N,) s, first and last time of its appearance; negative: present at the reset
        leaves: wp.int32  # 1: vehicles leave where no route follows, 0: they stand there
        next_row: wp.array(dtype=wp.int32)  # (N,) row of a vehicle in the next table
        next_first: wp.array2d(dtype=wp.int32)  # (K, R + 1) routes that may follow route r in row k ...
        next_choice: wp.array(dtype=wp.int32)  # ... are next_choice[next_first[k, r]] .. [next_first[k, r + 1] - 1]

    @wp.struct
    class CameraValues:
        """The camera of one vehicle."""

        rotation: mat33  # camera to body
        position: vec3  # body frame, m
        absent: wp.int32  # 1: there is no camera
        pinhole: wp.int32
        image_size: vec2  # pixels
        focal_length: vec2  # pixels
        principal_point: vec2  # pixels
        k1: scalar
        k2: scalar
        p1: scalar
        p2: scalar
        k3: scalar
        max_radius: scalar  # of undistorted image coordinates, up to which the distortion is monotone
        undistort: wp.int32
        quantise: wp.int32
        range: scalar  # m; infinity: unlimited
        miss_probability: scalar
        orientation_std: scalar  # rad, per axis, of the error of `rotation`
        position_std: scalar  # m, per axis, of the error of `position`
        focal_std: scalar  # of the error of `focal_length`, relative
        orientation_walk: scalar  # rad per root of a second, of the error of `rotation`
        latency: scalar  # s, known age of a frame
        latency_std: scalar  # s, of a constant error of `latency`
        latency_jitter: scalar  # s, of one drawn for every frame
        latency_ticks: wp.int32  # nearest to `latency`
        changes: wp.int32  # 1: frames have an age, or `rotation` walks
        uncertain: wp.int32  # 1: bearings have more noise than white noise, see `coopenv.world.quality.white_share`

    @wp.struct
    class NoiseValues:
        """Noise of a vehicle's sensors: standard deviations per sample at this scenario's rates, and lasting errors."""

        velocity: scalar  # m/s
        angular_velocity: scalar  # rad/s
        bearing_paper: wp.int32
        bearing: scalar
        bearing_correlated: scalar  # rad, standard deviation of a Gauss-Markov process
        bearing_correlation_time: scalar  # s, of that
        bearing_counted: scalar  # rad, standard deviation of white noise by which filters count that
        frames_together: scalar  # frames in the time within which a lasting error of frames counts as one
        axis: mat33  # columns: image-plane axes and optical axis of the paper's formula, camera frame
        lasting: wp.int32  # 1: any of the errors below is on
        odometry_scale: scalar
        odometry_scale_walk: scalar  # per sqrt s
        gyro_bias: vec3  # rad/s, body axes
        gyro_bias_walk: vec3  # rad/s per sqrt s
        slip_rate: scalar  # 1/s
        slip_duration: scalar  # s
        slip_size: scalar
        slip_angle: scalar  # rad

    @wp.struct
    class SensorValues:
        """A sensor beside the camera; rows beyond its kind's are zero."""

        rotation: mat33  # sensor to body
        position: vec3  # body frame, m
        kind: wp.int32  # its place in `coopenv.measurements.kinds.KINDS`; -1: a class of one's own
        rows: wp.int32
        has_target: wp.int32  # 0: it measures the map
        ratio: wp.float64  # measurements per tick, at most 1
        std: vec6  # of white noise
        counted: vec6  # standard deviations by which filters count its noise
        weight: vec6  # squares of the ratios of the error of a camera's bearing, rad, to those of the rows
        bias: vec6  # standard deviations of an error per vehicle and episode
        correlated: vec6  # standard deviations of a Gauss-Markov process
        correlation: scalar  # of that with itself one tick later
        outlier: vec6  # mean size
        outlier_probability: scalar
        miss_probability: scalar
        outage_share: scalar  # of time in outages
        outage_correlation: scalar  # of being in an outage with the same one tick later
        range: scalar  # m; infinity: unlimited
        least_cosine: scalar  # of the angle between its x axis and a target in its field of view
        occluded: wp.int32
        under_sky: wp.int32  # 1: a building above it occludes the map

    @wp.struct
    class Radio:
        """V2X."""

        connected: wp.array(dtype=wp.int32)  # (N,) whether a vehicle has a radio
        entry: wp.int32  # place of an action's first number for the radio; 0: everything is broadcast
        to_all: wp.int32  # 1: messages reach all vehicles, not only vehicles that may measure their sender
        delay: wp.int32  # ticks
        period: wp.int32  # ticks
        slots: wp.int32
        loss: scalar
        range: scalar  # m
        staleness: wp.float64  # s

    @wp.struct
    class FaultValues:
        """Faults of a vehicle's computer, clock and messages."""

        clock: scalar  # standard deviation, s
        restart_chance: scalar
        restart_time: scalar  # s
        restart_time_spread: scalar  # s
        corruption_probability: scalar
        corruption_start: scalar  # s
        corruption_size: scalar  # m
        corruption_turn: scalar  # rad
        lie: wp.int32  # see `coopenv.world.v2x.KINDS`
        lie_chance: scalar
        lie_start: scalar  # s
        lie_start_spread: scalar  # s
        lie_offset: scalar  # m
        lie_speed: scalar  # m/s
        lie_replay: wp.int32  # ticks by which messages are old
        lie_direction: vec3  # of length 1; zero: drawn
        lie_std: scalar  # claimed, rad and m; 0: honest
        lie_turn: scalar  # rad
        lie_consistent: wp.int32  # whether the odometry in messages leads where the lie does
        map_error_chance: scalar
        map_error_landmark: wp.int32  # that is off; -1: any
        map_error_offset: scalar  # m
        map_error_offset_spread: scalar  # m
        map_error_direction: vec3  # of length 1; zero: drawn
        map_error_start: scalar  # s
        map_error_start_spread: scalar  # s
        jammer_chance: scalar
        jammer_start: scalar  # s
        jammer_start_spread: scalar  # s
        jammer_duration: wp.float64  # s
        jammer_period: wp.float64  # s
        jammer_duty: wp.float64
        jammer_range: scalar  # m
        jammer_fixed: wp.int32  # 1: it stands at `jammer_position`, 0: on its vehicle
        jammer_position: vec3  # m

    @wp.struct
    class ObserverValues:
        """Gains of the Riccati observer."""

        k: wp.array(dtype=scalar)  # (N,)
        q: wp.array(dtype=scalar)  # (A,)
        v1: scalar
        v2: scalar
        p1: scalar
        p2: scalar
        max_turn: scalar  # rad
        rate: wp.float64  # Hz
        gramian_stride: wp.int32  # ticks between the samples of the sliding Gramian
        block_ticks: wp.int32  # ticks per block of it, a multiple of the stride
        block_distance: scalar  # m per block of it; 0: blocks last so many ticks
        blocks: wp.int32

    @wp.struct
    class Judgement:
        """References of the terms about an estimate's quality."""

        uncertainty_threshold: scalar  # m
        uncertainty_cap: scalar  # m
        observability_floor: scalar  # of the smallest eigenvalue of the sliding Gramian
        observability_level: scalar  # log10 of that eigenvalue

    @wp.struct
    class Model:
        """Everything about a world that never changes."""

        landmarks: wp.int32
        vehicles: wp.int32
        agents: wp.int32
        obstacles: wp.int32
        traffic: wp.int32  # moving bodies without identity, at most
        sensed: wp.int32  # 1: `topology.mode` measures targets in view, 0: every neighbour
        sensing: wp.int32  # SENSED, IDEAL or BLIND
        camera_rate: wp.float64  # Hz
        odometry_rate: wp.float64  # Hz
        camera_period: wp.float64  # s
        odometry_period: wp.float64  # s
        samples_per_tick: wp.int32  # odometry samples that may fall into one camera tick
        ticks_per_decision: wp.int32
        action_size: wp.int32  # numbers of an action
        columns: wp.int32  # the first of them, which drive
        pans: wp.int32  # whether the next one is the camera's angle
        horizon_ticks: wp.int32
        coordinates: wp.int32  # in which the observer states its covariance at first, see `coopenv.world.quality`
        kept: wp.int32  # agents that a vehicle keeps at a time, see `coopenv.world.nearby`; 0: all
        before_boxes: wp.int32  # entries before that of the first box: all landmarks, or none where some are kept
        listed: wp.int32  # where some are kept: 1: agents in `targets`, which has as many columns, 0: in range
        acyclic: wp.int32  # where some are kept: 1: a vehicle measures the vehicles before it alone
        marker_reach: scalar  # m, the farthest visible point of an agent from the agent
        last_outcome: wp.int32  # largest value of `ended`
        map_size: wp.int32  # landmarks of the map in an observation
        route_step: scalar  # m ahead on the route of the points in an observation: 1, 2, 4 and 8 times
        targets: wp.array2d(dtype=wp.int32)  # (N, A) agents that may be measured and received, ascending, then -1
        target_count: wp.array(dtype=wp.int32)  # (N,)
        order: wp.array(dtype=wp.int32)  # (N,) leaders first
        rank: wp.array(dtype=wp.int32)  # (N,) place in the order
        start: StartValues
        motion: Motion
        dynamics: wp.array(dtype=DynamicsValues)  # (N,)
        scene: SceneValues
        routes: Routes
        drawn: DrawRanges
        camera: wp.array(dtype=CameraValues)  # (N,)
        noise: wp.array(dtype=NoiseValues)  # (N,)
        sensor: wp.array(dtype=SensorValues)  # (R,) beside cameras
        carries: wp.array2d(dtype=wp.int32)  # (N, R) 1: a vehicle has a sensor
        measures: wp.array2d(dtype=wp.int32)  # (R, A) 1: a sensor measures an agent
        landmark_std: wp.array(dtype=scalar)  # (L,) m, accuracy of their places on the map
        fault: wp.array(dtype=FaultValues)  # (N,)
        clocks: wp.int32  # 1: some clock is off
        restarts: wp.int32  # 1: some vehicle may restart
        alters: wp.int32  # 1: some broadcast pose may differ from its sender's estimate
        map_errors: wp.int32  # 1: a landmark may be off on some map
        past: wp.int32  # ticks of which poses are kept: as old as frames may be
        correlated: wp.int32  # 1: some vehicle's bearings have a correlated error
        jammers: wp.int32  # 1: some vehicle may carry a jammer
        radio: Radio
        observer: ObserverValues
        judgement: Judgement
        cells: Cells

    return Model


def entry_struct(p: Precision, name: str) -> Any:
    """Return the struct of the entries of one of the model's arrays of structs."""
    return field_types(model_struct(p))[name].dtype
