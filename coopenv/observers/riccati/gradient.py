"""A differentiable rollout: from actions to the uncertainty of every vehicle, through Warp's tape.

It covers what has a derivative: noise off, no losses and no delay, k = 1, and ticks in which one linearisation
suffices. Whether a target is in view is taken as it falls out on the way forward. Contact and arrival end nothing here:
vehicles drive on through one another.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import ActionError, ScenarioError, ScenarioWarning
from coopenv.base.seeds import world_keys
from coopenv.observers.riccati import gradient_kernels as kernels
from coopenv.scenario import Scenario
from coopenv.scenario.topology import neighbour_sets, processing_order
from coopenv.world import kernel_cache
from coopenv.world.dynamics import LONGEST_SUBSTEP
from coopenv.world.launch import kernel
from coopenv.world.world import World


@dataclass(frozen=True)
class Rollout:
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

    def rollout(self, actions: np.ndarray, seed: int = 0) -> Rollout:
        """Drive by actions (T, W, N, 2) in (-1, 1), one per decision, and differentiate the final uncertainty.

        Raises:
            ActionError: the actions have another shape.
        """
        world = self._world
        expected = (world.worlds, world.model.vehicles, 2)
        actions = np.asarray(actions)
        numeric = actions.dtype.kind in "fiu"
        if not numeric or actions.ndim != 4 or len(actions) == 0 or actions.shape[1:] != expected:
            raise ActionError(f"actions have shape {actions.shape}, expected (decisions, W, N, 2) = (T, *{expected})")
        if not np.isfinite(actions).all():
            raise ActionError("actions are not finite")
        if len(actions) * self.scenario.ticks_per_decision > self.scenario.horizon_ticks:
            raise ActionError(f"{len(actions)} decisions reach beyond the horizon of {self.scenario.horizon:g} s")
        world.reset(world_keys(seed, world.worlds))
        decisions = [self._array(action, kernels.vec2) for action in actions]
        total, turn = self._array(np.zeros(1), kernels.scalar), wp.zeros(1, dtype=kernels.scalar, device=world.device)
        truth, held, belief = self._start()
        tape = wp.Tape()
        with tape:
            commands = [self._array(np.zeros((*action.shape, 4)), kernels.vec4) for action in decisions]
            for action, command in zip(decisions, commands, strict=True):
                self._launch(kernels.command_kernel, [world.model, action, command])
            for tick in range(1, len(actions) * self.scenario.ticks_per_decision + 1):
                command = self._command(commands, tick)
                truth, held = self._move(truth, held, command, tick)
                belief = self._estimate(truth, held, belief, tick, turn)
            self._launch(kernels.trace_kernel, [belief, total])
        tape.backward(total)
        if float(turn.numpy()[0]) > self.scenario.observer.max_turn:
            warnings.warn(
                "an attitude turned by more than observer.max_turn within a tick: this rollout does not re-linearise",
                ScenarioWarning,
                stacklevel=2,
            )
        believed = belief.numpy()
        return Rollout(
            float(total.numpy()[0]),
            np.stack([action.grad.numpy() for action in decisions]),
            believed["covariance"],
            truth.numpy()["position"],
            np.einsum("wnij,wnj->wni", believed["rotation"], believed["position"]),
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

    def _record(self, struct: Any) -> Any:
        record = struct()
        for name, var in struct.vars.items():
            setattr(record, name, self._make(var.type.dtype))
        return record

    def _start(self) -> tuple[Any, Any, Any]:
        state, L = self._world.state, self._world.model.landmarks
        speed = state.speed.numpy()
        R, p = state.rotation.numpy()[:, L:], state.position.numpy()[:, L:]
        truth = self._make(kernels.Truth, rotation=R, position=p, speed=speed, steering=state.steering.numpy())
        held = self._make(kernels.Held, velocity=speed[..., None] * np.eye(3)[0])
        R, p = state.estimate_rotation.numpy(), state.estimate_position.numpy()
        return truth, held, self._make(kernels.Belief, rotation=R, position=p, covariance=state.covariance.numpy())

    def _command(self, commands: list[Any], tick: int) -> Any:
        """Return the command in force during a tick, see `coopenv.world.command.command_in_force`."""
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
                truth, held, first = self._make(kernels.Truth), self._make(kernels.Held), False
                self._launch(kernels.drive_kernel, [*before, due, wp.float64(duration / steps), truth, held])
        return truth, held

    def _estimate(self, truth: Any, held: Any, belief: Any, tick: int, turn: Any) -> Any:
        world, rate = self._world, self.scenario.rates.camera
        kernel_cache.launch(
            kernel(kernels.show_kernel, "float64"),
            dim=(world.worlds, world.model.agents),
            inputs=[world.model, truth, world.state, wp.float64(tick / rate)],
            device=world.device,
            record_tape=False,
        )
        dt = wp.float64(1.0 / rate)
        predicted, after = self._make(kernels.Belief), self._make(kernels.Belief)
        sums = self._record(kernels.Information)
        self._launch(kernels.predict_kernel, [world.model, held, belief, predicted, dt])
        counts = world.model.target_count.numpy()
        for vehicle in self._order:
            seen = [world.model, world.state, truth, predicted, after, vehicle, sums]
            self._launch(kernels.inform_kernel, seen, dim=(world.worlds, int(counts[vehicle])))
            self._launch(kernels.correct_kernel, [predicted, sums, after, vehicle, dt, turn], dim=world.worlds)
        return after

    def _launch(self, function: Any, arguments: list[Any], dim: Any = None) -> None:
        grid = (self._world.worlds, self._world.model.vehicles) if dim is None else dim
        compiled = kernel(function, "float64", differentiable=True)
        kernel_cache.launch(compiled, dim=grid, inputs=arguments, device=self._world.device)


def tick_intervals(tick: int, camera: float, odometry: float) -> list[tuple[float, bool]]:
    """Return the intervals between the events of a camera tick: (duration s, an odometry sample ends it)."""
    now, end = (tick - 1) / camera, tick / camera
    first = math.floor(now * odometry + 1e-9) + 1  # the sample at t = 0 is the start speed
    intervals = []
    sample = first
    while sample / odometry <= end + 1e-9:
        intervals.append((sample / odometry - now, True))
        now = sample / odometry
        sample += 1
    if end - now > 1e-12:
        intervals.append((end - now, False))
    return intervals


def check_differentiable(scenario: Scenario) -> None:
    """Refuse what has no derivative or what this rollout leaves out.

    Raises:
        ScenarioError: the first such setting.
    """
    v2x, cameras, observer = scenario.v2x, scenario.cameras, scenario.observer
    reasons = {
        "every vehicle must have the motion 'driven'": all(v.motion.kind == "driven" for v in scenario.vehicles),
        "noise.enabled must be false": not any(noise.enabled for noise in scenario.noises),
        "v2x must have delay 0, period 1, no loss, range or staleness": (
            (v2x.delay, v2x.period, v2x.loss, v2x.range, v2x.staleness) == (0, 1, 0.0, None, None)
        ),
        "camera.miss_probability must be 0": all(c.miss_probability == 0.0 for c in cameras),
        "camera.quantise must be false and camera.undistort true": all(c.undistort and not c.quantise for c in cameras),
        "dynamics.latency must be the same for every vehicle": len({limits.latency for limits in scenario.limits}) == 1,
        "observer.name must be 'riccati' with k = 1": observer.name == "riccati" and observer.k == 1.0,
        "dynamics.gated must be false": not any(limits.gated for limits in scenario.limits),
        "action.pan must not be there": scenario.action.pan is None,
        "rates.observer must not be below rates.camera": (scenario.rates.observer or math.inf) >= scenario.rates.camera,
    }
    for reason, holds in reasons.items():
        if not holds:
            raise ScenarioError(f"a differentiable rollout needs another scenario: {reason}")
