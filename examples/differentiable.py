"""A differentiable rollout: from actions to the uncertainty of every vehicle, through Warp's tape.

It needs a scenario with derivatives: noise off, no losses and no delay, k = 1, and ticks in which one linearisation
suffices. Visibility is that of the forward pass. Contact and arrival do not end an episode here: vehicles drive on
through one another.

They call the stages' own functions. Sums over targets are atomic additions from one thread per target, because Warp
does not differentiate through variables that a dynamic loop changes.
"""

import math
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import ActionError, ScenarioError, ScenarioWarning
from coopenv.base.seeds import world_keys
from coopenv.estimation.linalg import block3, cholesky6, exp_so3, increment, join6, orthonormalise
from coopenv.motions.command import command_of
from coopenv.motions.dispatch import displacement, drive_step
from coopenv.motions.table import DRIVES
from coopenv.observers.riccati import accumulate_information, correct_kalman, predict_covariance, predict_pose
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets, processing_order
from coopenv.world import launch
from coopenv.world.camera import VISIBLE, marker_position, sight_of
from coopenv.world.dynamics import LONGEST_SUBSTEP, prescribe
from coopenv.world.launch import kernel
from coopenv.world.model import PRESCRIBED, precision
from coopenv.world.nearby import sort_into_cells
from coopenv.world.world import World

scalar, vec3, vec5, mat33, mat66 = (
    getattr(precision("float64"), name) for name in ("scalar", "vec3", "vec5", "mat33", "mat66")
)
mat23 = wp.types.matrix((2, 3), scalar)


@wp.struct
class TrueMotion:
    """True motion at one instant."""

    rotation: mat33
    position: vec3
    speed: scalar
    turn: scalar
    lateral: scalar


@wp.struct
class Held:
    """The odometry sample in force, and the increment since the last tick."""

    velocity: vec3
    angular_velocity: vec3
    rotation: mat33
    translation: vec3


@wp.struct
class PoseBelief:
    """Estimated pose and covariance."""

    rotation: mat33
    position: vec3
    covariance: mat66


def command_kernel(model: Any, action: wp.array3d(dtype=Any), command: wp.array2d(dtype=Any)):
    """Make every vehicle's command of its action."""
    world, vehicle = wp.tid()
    lateral = scalar(0.0)
    if model.columns > 2:
        lateral = action[world, vehicle, 2]
    first = action[world, vehicle, 0]
    command[world, vehicle] = command_of(
        model.dynamics[vehicle], first, action[world, vehicle, 1], lateral, scalar(0.0)
    )


def drive_kernel(
    model: Any,
    truth: Any,
    command: wp.array2d(dtype=Any),
    held: Any,
    first: int,
    sample: int,
    dt: wp.float64,
    truth_after: Any,
    held_after: Any,
):
    """Move every vehicle for dt under its command and append the held odometry sample; then take a new one if due.

    The `first` step of a tick begins a new increment.
    """
    world, vehicle = wp.tid()
    now = truth[world, vehicle]
    limits = model.dynamics[vehicle]
    R, position, speed, turn, lateral = drive_step(
        limits, now.rotation, now.position, now.speed, now.turn, now.lateral, command[world, vehicle], dt, 0
    )
    truth_after[world, vehicle] = TrueMotion(R, position, speed, turn, lateral)
    odometry = held[world, vehicle]
    v = odometry.velocity
    w = odometry.angular_velocity
    if first != 0:
        rotation, translation = increment(wp.identity(3, scalar), vec3(), v, w, dt)
    else:
        rotation, translation = increment(odometry.rotation, odometry.translation, v, w, dt)
    if sample != 0:
        v, w = displacement(limits, speed, turn, lateral, scalar(1.0), vec3())
    held_after[world, vehicle] = Held(v, w, rotation, translation)


def predict_kernel(model: Any, held: Any, before: Any, after: Any, dt: wp.float64):
    """Propagate the estimate of every vehicle by one tick of odometry."""
    world, vehicle = wp.tid()
    belief = before[world, vehicle]
    step = held[world, vehicle]
    R, p = predict_pose(belief.rotation, belief.position, step.rotation, step.translation)
    P = belief.covariance
    E = wp.transpose(step.rotation)
    v1, v2 = model.observer.v1 * dt, model.observer.v2 * dt
    A, B, D = predict_covariance(E, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3), v1, v2)
    after[world, vehicle] = PoseBelief(R, p, join6(A, B, wp.transpose(B), D))


def see_kernel(model: Any, state: Any):
    """Write which targets are in view where the agents are shown. One thread per world."""
    world = wp.tid()
    sort_into_cells(model, state, world)
    for vehicle in range(model.vehicles):
        R = state.rotation[world, model.landmarks + vehicle]
        origin = state.position[world, model.landmarks + vehicle] + R * model.camera[vehicle].position
        to_camera = wp.transpose(R * model.camera[vehicle].rotation)
        for n in range(model.target_count[vehicle]):
            target = model.targets[vehicle, n]
            line = marker_position(model, state, world, target) - origin
            sight = sight_of(model, state, world, vehicle, target, origin, line, to_camera * line)
            state.sight[world, vehicle, target] = sight


def inform_kernel(
    model: Any,
    sight: wp.array3d(dtype=wp.uint8),
    position: wp.array2d(dtype=Any),
    rotation: wp.array2d(dtype=Any),
    truth: Any,
    predicted: Any,
    corrected: Any,
    vehicle: int,
    M: wp.array2d(dtype=Any),
    r: wp.array2d(dtype=Any),
):
    """Add the information of one target in view for one vehicle. Grid: (worlds, its targets).

    That is M = C^T Q C and r = C^T Q (y - C_2 phat) in two blocks. Leaders have their corrected estimate of this tick
    already. Sights, positions and rotations are copies of those of this tick, for the backward pass.
    """
    world, n = wp.tid()
    target = model.targets[vehicle, n]
    own = truth[world, vehicle]
    camera = model.camera[vehicle]
    origin = own.position + own.rotation * camera.position
    marker = model.scene.marker[target]
    place = position[world, target] + rotation[world, target] * marker
    known = place
    if target >= model.landmarks:
        other = target - model.landmarks
        place = truth[world, other].position + truth[world, other].rotation * marker
        known = corrected[world, other].rotation * (corrected[world, other].position + marker)
    if sight[world, vehicle, target] == VISIBLE:
        b = wp.transpose(own.rotation) * wp.normalize(place - origin)
        a = wp.transpose(predicted[world, vehicle].rotation) * known
        e = a - camera.position - predicted[world, vehicle].position
        o = type(own.rotation)()
        M11, M12, M22, r1, r2 = accumulate_information(a, b, e, model.observer.q[target], o, o, o, type(e)(), type(e)())
        wp.atomic_add(M, world, vehicle, join6(M11, M12, wp.transpose(M12), M22))
        wp.atomic_add(r, world, vehicle, wp.matrix_from_rows(r1, r2))


def correct_kernel(
    predicted: Any,
    M: wp.array2d(dtype=Any),
    r: wp.array2d(dtype=Any),
    after: Any,
    vehicle: int,
    dt: wp.float64,
    turn: wp.array(dtype=scalar),
):
    """Correct the estimate of one vehicle over one tick."""
    world = wp.tid()
    belief = predicted[world, vehicle]
    R = belief.rotation
    P = belief.covariance
    L11, L21, L22, _, _ = cholesky6(block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3))
    m = M[world, vehicle]
    sums = r[world, vehicle]
    dx1, dx2, A, B, D = correct_kalman(
        dt, block3(m, 0, 0), block3(m, 0, 3), block3(m, 3, 3), L11, L21, L22, sums[0], sums[1]
    )
    wp.atomic_max(turn, 0, wp.length(dx1))
    P_after = join6(A, B, wp.transpose(B), D)
    after[world, vehicle] = PoseBelief(orthonormalise(R * exp_so3(dx1)), belief.position + dx2, P_after)


def trace_kernel(after: Any, total: wp.array(dtype=Any)):
    """Add up trace P over vehicles and worlds."""
    world, vehicle = wp.tid()
    wp.atomic_add(total, 0, wp.trace(after[world, vehicle].covariance))


def show_kernel(model: Any, truth: Any, state: Any, t: wp.float64):
    """Write the truth of time t into the world's state, where visibility reads it. Grid: (worlds, agents)."""
    world, agent = wp.tid()
    if agent >= model.landmarks:
        state.rotation[world, agent] = truth[world, agent - model.landmarks].rotation
        state.position[world, agent] = truth[world, agent - model.landmarks].position
    elif model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, t)


@dataclass(frozen=True)
class DifferentiableRollout:
    """Result of `DifferentiableWorld.rollout`."""

    uncertainty: float  # sum over worlds and vehicles of trace P at the end (rad^2 + m^2)
    gradient: np.ndarray  # its derivative with respect to the actions, same shape as they
    covariance: np.ndarray  # P at the end, (W, N, 6, 6)
    position: np.ndarray  # true positions at the end, (W, N, 3) m
    position_estimate: np.ndarray  # estimated positions at the end, (W, N, 3) m


class DifferentiableWorld:
    """Worlds in which every vehicle is driven, in float64."""

    def __init__(self, scenario: Scenario, worlds: int = 1, device: str = "cpu") -> None:
        """Build the worlds.

        Raises:
            ScenarioError: the scenario has something without a derivative.
        """
        check_differentiable(scenario)
        self.scenario = scenario
        self._world = World(scenario, worlds, "float64", device)
        self._latency = round(scenario.limits[0].latency * scenario.rates.camera)  # ticks
        self._order = processing_order(scenario, neighbour_sets(scenario))

    def rollout(self, actions: np.ndarray, seed: int = 0) -> DifferentiableRollout:
        """Drive by actions (T, W, N, C) in (-1, 1), one per decision, and differentiate the final uncertainty.

        C is the number of columns of the drive's command.

        Raises:
            ActionError: the actions have another shape.
        """
        world = self._world
        expected = (world.worlds, world.model.vehicles, world.model.columns)
        actions = np.asarray(actions)
        numeric = actions.dtype.kind in "fiu"
        if not numeric or actions.ndim != 4 or len(actions) == 0 or actions.shape[1:] != expected:
            raise ActionError(f"actions have shape {actions.shape}, expected (T, *{expected}), T decisions")
        if not np.isfinite(actions).all():
            raise ActionError("actions are not finite")
        if len(actions) * self.scenario.ticks_per_decision > self.scenario.horizon_ticks:
            raise ActionError(f"{len(actions)} decisions reach beyond the horizon of {self.scenario.horizon:g} s")
        world.reset(world_keys(seed, world.worlds))
        decisions = [self._array(action, scalar) for action in actions]
        total, turn = self._array(np.zeros(1), scalar), wp.zeros(1, dtype=scalar, device=world.device)
        truth, held, belief = self._start()
        tape = wp.Tape()
        with tape:
            commands = [self._array(np.zeros((*action.shape[:2], 5)), vec5) for action in decisions]
            for action, command in zip(decisions, commands, strict=True):
                self._launch(command_kernel, [world.model, action, command])
            for tick in range(1, len(actions) * self.scenario.ticks_per_decision + 1):
                command = self._command(commands, tick)
                truth, held = self._move(truth, held, command, tick)
                belief = self._estimate(truth, held, belief, tick, turn)
            self._launch(trace_kernel, [belief, total])
        tape.backward(total)
        if float(turn.numpy()[0]) > self.scenario.observer.max_turn:
            warnings.warn(
                "an attitude turned by more than observer.max_turn within a tick: this rollout does not re-linearise",
                ScenarioWarning,
                stacklevel=2,
            )
        estimated = belief.numpy()
        return DifferentiableRollout(
            float(total.numpy()[0]),
            np.stack([action.grad.numpy() for action in decisions]),
            estimated["covariance"],
            truth.numpy()["position"],
            np.einsum("wnij,wnj->wni", estimated["rotation"], estimated["position"]),
        )

    def _array(self, values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self._world.device, requires_grad=True)

    def _make(self, struct: Any, **given: np.ndarray) -> Any:
        """Return an array with a record per vehicle, some fields given and zeros for the rest."""
        shape = (self._world.worlds, self._world.model.vehicles)
        array = wp.zeros(shape, dtype=struct, device=self._world.device, requires_grad=True)
        if given:
            records = array.numpy()
            for name, values in given.items():
                records[name] = values
            array.assign(records)
        return array

    def _start(self) -> tuple[Any, Any, Any]:
        state, L = self._world.state, self._world.model.landmarks
        speed = state.speed.numpy()
        R, p = state.rotation.numpy()[:, L:], state.position.numpy()[:, L:]
        truth = self._make(TrueMotion, rotation=R, position=p, speed=speed, turn=state.turn.numpy())
        held = self._make(Held, velocity=speed[..., None] * np.eye(3)[0])
        R, p = state.estimate_rotation.numpy(), state.estimate_position.numpy()
        return truth, held, self._make(PoseBelief, rotation=R, position=p, covariance=state.covariance.numpy())

    def _command(self, commands: list[Any], tick: int) -> Any:
        """Return the command in force during a tick, see `coopenv.world.dynamics.command_in_force`."""
        decision, elapsed = divmod(tick - 1, self.scenario.ticks_per_decision)
        if elapsed >= self._latency:
            return commands[decision]
        return commands[decision - 1] if decision > 0 else self._world.state.last_command

    def _move(self, truth: Any, held: Any, command: Any, tick: int) -> tuple[Any, Any]:
        world, first = self._world, True
        for duration, sample in tick_intervals(tick, self.scenario.rates.camera, self.scenario.rates.odometry):
            steps = max(1, math.ceil(duration / float(LONGEST_SUBSTEP)))
            for step in range(steps):
                before, due = [world.model, truth, command, held, int(first)], int(sample and step == steps - 1)
                truth, held, first = self._make(TrueMotion), self._make(Held), False
                self._launch(drive_kernel, [*before, due, wp.float64(duration / steps), truth, held])
        return truth, held

    def _estimate(self, truth: Any, held: Any, belief: Any, tick: int, turn: Any) -> Any:
        world, rate = self._world, self.scenario.rates.camera
        shown = [world.model, truth, world.state, wp.float64(tick / rate)]
        self._launch(show_kernel, shown, dim=(world.worlds, world.model.agents), differentiable=False)
        self._launch(see_kernel, [world.model, world.state], dim=world.worlds, differentiable=False)
        dt = wp.float64(1.0 / rate)
        predicted, after = self._make(PoseBelief), self._make(PoseBelief)
        sums = [self._make(mat66), self._make(mat23)]
        self._launch(predict_kernel, [world.model, held, belief, predicted, dt])
        counts = world.model.target_count.numpy()
        scene = [wp.clone(part) for part in (world.state.sight, world.state.position, world.state.rotation)]
        for vehicle in self._order:
            seen = [world.model, *scene, truth, predicted, after, vehicle, *sums]
            self._launch(inform_kernel, seen, dim=(world.worlds, int(counts[vehicle])))
            self._launch(correct_kernel, [predicted, *sums, after, vehicle, dt, turn], dim=world.worlds)
        return after

    def _launch(self, function: Any, arguments: list[Any], dim: Any = None, differentiable: bool = True) -> None:
        grid = (self._world.worlds, self._world.model.vehicles) if dim is None else dim
        compiled = kernel(function, "float64", differentiable=differentiable)
        device = self._world.device
        launch.launch(compiled, dim=grid, inputs=arguments, device=device, record_tape=differentiable)


def tick_intervals(tick: int, camera: float, odometry: float) -> list[tuple[float, bool]]:
    """Return the intervals between the events of a camera tick: (duration s, an odometry sample ends it)."""
    now, end = (tick - 1) / camera, tick / camera
    first, last = (math.floor(t * odometry + 1e-9) for t in (now, end))  # the sample at t = 0 is the start speed
    times = [now, *(sample / odometry for sample in range(first + 1, last + 1))]
    intervals = [(after - before, True) for before, after in pairwise(times)]
    return [*intervals, (end - times[-1], False)] if end - times[-1] > 1e-12 else intervals


def check_differentiable(scenario: Scenario) -> None:
    """Refuse scenarios without a derivative or with features that this rollout does not have.

    Raises:
        ScenarioError: the first such setting.
    """
    v2x, cameras, observer = scenario.v2x, scenario.cameras, scenario.observer
    reasons = {
        "every vehicle must have the motion 'driven'": all(v.motion.kind == "driven" for v in scenario.vehicles),
        "dynamics.model must be a kind of coopenv's": all(limits.model in DRIVES for limits in scenario.limits),
        "noise.enabled must be false": not any(noise.enabled for noise in scenario.noises),
        "v2x must have delay 0, period 1, no loss, range or staleness": (
            (v2x.delay, v2x.period, v2x.loss, v2x.range, v2x.staleness) == (0, 1, 0.0, None, None)
        ),
        "camera.miss_probability must be 0": all(c.miss_probability == 0.0 for c in cameras),
        "sensing must not be 'images'": scenario.sensing != "images",
        "camera.quantise must be false and camera.undistort true": all(c.undistort and not c.quantise for c in cameras),
        "dynamics.latency must be the same for every vehicle": len({limits.latency for limits in scenario.limits}) == 1,
        "observer.name must be 'riccati' with k = 1": observer.name == "riccati" and observer.k == 1.0,
        "dynamics.gated must be false": not any(limits.gated for limits in scenario.limits),
        "action.pan must not be there, action.radio be false": not (scenario.action.pan or scenario.action.radio),
        "topology.most_nearby must not be there": scenario.topology.most_nearby is None,
        "rates.observer must not be below rates.camera": (scenario.rates.observer or math.inf) >= scenario.rates.camera,
    }
    for reason, holds in reasons.items():
        if not holds:
            raise ScenarioError(f"a differentiable rollout needs another scenario: {reason}")
