"""A batch of worlds on a device: allocate, reset by mask, advance, save and restore."""

import os
import warnings
from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError, ScenarioWarning, check_memory
from coopenv.estimation import UNKNOWN, Sight
from coopenv.estimation.validity import Rule
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import PARAMETERS
from coopenv.world.build import build_model
from coopenv.world.embedded import HOST, SIMULATED, Embedded, Nothing, Source
from coopenv.world.launch import (
    VEHICLES_PER_LEVEL,
    Call,
    Launcher,
    PerLane,
    PerWorld,
    threads_and_lanes,
    width_of_lanes,
)
from coopenv.world.model import check_device, device_memory, mat66d, precision
from coopenv.world.quality import COORDINATES
from coopenv.world.random import NOT_SET
from coopenv.world.sensor_stage import SensorStage
from coopenv.world.state import (
    ANYTHING,
    SCRATCH,
    allocate,
    allocate_state,
    checked_state,
    interleaves_worlds,
    overwrite,
    parts,
    repeated,
    size_of,
    state_fields,
    state_sizes,
    state_struct,
    with_own_scratch,
)
from coopenv.world.step import (
    ARRANGE,
    LOOK,
    MOVE,
    SENSE,
    Kernels,
    Turns,
    follow_kernels,
    fused_kernels,
    host_kernels,
    observer_kernels,
    source_kernels,
)
from coopenv.world.warp_internals import field_types

BY_AGENT = {
    "bearing": 0.0,
    "bearing_tick": -1,
    "sight": Sight.NOT_A_NEIGHBOUR,
    **dict.fromkeys(("arriving", "inbox_tick", "inbox_stamp"), -1),
    **dict.fromkeys(("inbox_rotation", "inbox_position", "inbox_std"), 0.0),
}
"""Fields of measurements and messages, and their values for an agent that is not kept."""
Keys = Sequence[int | None] | np.ndarray | None
Options = Mapping[str, Any] | None


class World:
    """`worlds` copies of one scenario, stepped together.

    The draws of a world depend on its key alone (`coopenv.base.seeds`): it is bit for bit the single world with that
    key (on the same device). In lanes (`in_lanes`) this holds for the truth; measurements and estimates are equal
    within rounding, and bit for bit in any other batch in lanes.
    """

    source: Source = SIMULATED  # where its ticks come from

    def __init__(
        self,
        scenario: Scenario,
        worlds: int = 1,
        dtype: str = "float32",
        device: str = "cpu",
        threads: int | None = None,
        observer: Embedded = HOST,
        start_covariance: np.ndarray | None = None,
    ) -> None:
        """Build the arrays; call `reset` before `advance`.

        Args:
            scenario: scenario of all worlds.
            worlds: number of worlds.
            dtype: "float32" or "float64".
            device: "cpu", "cuda", "cuda:0", ...
            threads: shares into which the batch, or each of its worlds, is split on the CPU; None: by size and cores
                (`threads_and_lanes`). Results do not depend on it.
            observer: observer in the kernels (none by default: the estimates are written from outside).
            start_covariance: (N, 6, 6) of the initial estimates, for the observer; LEFT coordinates, rad and m.

        Raises:
            DeviceError: unknown precision or device.
            CoopenvError: no worlds or no threads, or they would not fit into memory.
        """
        for name, count in (("num_worlds", worlds), ("threads", 1 if threads is None else threads)):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 1 <= count < 2**31:
                raise CoopenvError(f"{name} must be at least 1, whole and below 2^31, got {count!r}")
        self.scenario = scenario
        self.worlds = worlds = int(worlds)
        if scenario.topology.most_nearby is not None and not self.source.keeps_nearby:
            raise CoopenvError("topology.most_nearby: only where vehicles are simulated; leave it out")
        self.precision = precision(dtype)
        self.device = check_device(device)
        self.model = self._build_model()
        N = self.model.vehicles
        shares, lanes = threads_and_lanes(worlds, N, self.device, threads)
        self.threads = max(shares, lanes) if self.device == "cpu" else 1
        width = width_of_lanes(self.device, dtype) if os.environ.get("COOPENV_LANES") == "1" else 0
        fits = 0 < width <= worlds and self.model.kept == 0
        shares = min(shares, worlds // width) if fits else shares
        self.observer = observer if observer.fit is None else observer.fit(self.model)
        """Observer in the kernels; `HOST` if estimates are written from outside, see `PlugIns`."""
        self.model.coordinates = COORDINATES.index(self.observer.coordinates)
        self.in_parts = self.device != "cpu" and len(self.observer.parts) > 1
        """True if the observer's parts are separate kernels; on the CPU they would only reload a world's state."""
        sizes = {**state_sizes(self.model, worlds), **self.observer.sizes}
        needed = size_of(state_struct(self.precision), sizes) + size_of(self.observer.memory, {**sizes, SCRATCH: lanes})
        check_memory(needed, f"num_worlds: {worlds}", device_memory(self.device))
        self.state = allocate_state(self.model, worlds, self.precision, self.device)
        self.state.parameter_set.fill_(NOT_SET)
        self.state.difficulty.fill_(self.scenario.difficulty.number)
        covariance = np.zeros((N, 6, 6)) if start_covariance is None else np.ascontiguousarray(start_covariance)
        anew = np.concatenate([covariance, np.broadcast_to(UNKNOWN, (N, 6, 6))])
        self.model.start.covariance = wp.array(anew, dtype=mat66d, device=self.device)
        shared = "" if lanes == N else SCRATCH
        self.memory = allocate(self.observer.memory, sizes, self.device, shared, interleaves_worlds(self.device))
        """Memory of the embedded observer besides the state."""
        others = [with_own_scratch(self.memory, sizes) for _ in range(1, self.threads)] if lanes > 1 else []
        self._memories = PerLane([PerWorld(memory) for memory in (self.memory, *others)])
        self._turns = allocate(Turns, {**sizes, "D": N + 1, "F": 2}, self.device)
        self._turns.vehicle.assign(np.tile(self.model.order.numpy(), (worlds, 1)))
        self._turns.first.assign(np.tile(np.minimum(np.arange(N + 1), 1) * N, (worlds, 1)))
        self._set_due(0, 1)
        by_level = self.device != "cpu" and lanes == 1 and self.in_parts
        self._levels = [self._turns_of_level(level) for level in range(N if by_level else 0)]
        """Turns of all possible levels; none where levels are found on the device."""
        self._record = self._build_record()
        self.actions = wp.zeros((worlds, N, self.model.action_size), dtype=self.precision.scalar, device=self.device)
        self.mask = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        """(W,) worlds that `restart` resets and that `advance` leaves alone; zero between calls."""
        self.launch = Launcher(worlds, self.device, dtype, shares, lanes, needed // worlds)
        sensors = scenario.sensors if self.source.knows_truth else ()  # other sources give their readings
        self.sensors = SensorStage(sensors, self.model, self.state, self.mask, self.precision, scenario.target_names)
        """Stage of the sensors beside the camera."""
        self.in_lanes = fits and self._fused
        """True if kernels take several worlds at once (`coopenv.lanes`)."""
        self._views: dict[str, np.ndarray] = {}

    def _build_model(self) -> Any:
        return build_model(self.scenario, self.precision, self.device)

    def _build_record(self) -> Any:
        """Return the record that the source of ticks reads."""
        return Nothing()

    def set_parameters(self, values: Mapping[str, np.ndarray], worlds: np.ndarray) -> None:
        """Set the parameters of the next resets of the worlds of a mask (W,), until the next call.

        Args:
            values: (W,) by name: factors of the scenario's parameters (NaN: drawn again), and `difficulty`.
            worlds: (W,) bool.
        """
        factors = self.state.parameter_set.numpy().copy()
        for name, given in values.items():
            if name == "difficulty":
                self.state.difficulty.assign(np.where(worlds, given, self.state.difficulty.numpy()))
            else:
                column = factors[:, list(PARAMETERS).index(name)]
                column[worlds] = np.where(np.isnan(given), NOT_SET, given)[worlds]
        self.state.parameter_set.assign(factors)

    def steer_lies(self, velocity: np.ndarray) -> None:
        """Continue the lies that have begun, from their present offset on, at another velocity.

        Args:
            velocity: (W, N, 3) at which the offset of broadcast positions grows, m/s, map axes; rows of vehicles that
                do not lie now are not read. See the fault `lie` for the offset's start.
        """
        s = self.state
        now, begun = s.tick.numpy()[:, None], s.lie_tick.numpy()
        lies, before = ((begun >= 0) & (begun <= now))[..., None], s.lie_velocity.numpy()
        grown = before * (now - begun)[..., None] * self.model.camera_period
        s.lie_offset.assign(s.lie_offset.numpy() + np.where(lies, grown, 0.0))
        s.lie_velocity.assign(np.where(lies, velocity, before))
        s.lie_tick.assign(np.where(lies[..., 0], now, begun))

    def reset(self, keys: Keys = None, mask: np.ndarray | None = None, options: Options = None) -> None:
        """Start a new episode in the worlds of `mask` (all by default).

        Args:
            keys: of the random streams, one per world, reduced modulo 2^64; None (for all or for one) keeps a world's
                key and draws a new episode from it.
            mask: (W,) bool.
            options: for a source of ticks on the host; None otherwise.
        """
        if self.device != "cpu":
            self.check_room()
        self.state.crowded.zero_()  # restarts on the device keep it
        chosen = np.ones(self.worlds, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if keys is not None:
            wanted = np.array([int(key or 0) % 2**64 for key in keys], dtype=np.uint64)
            new = chosen & np.array([key is not None for key in keys])
            self.state.seed.assign(np.where(new, wanted, self.state.seed.numpy()))
            # restart() raises the episode's number by one: the first one of a key is 0
            self.state.episode.assign(np.where(new, np.uint32(2**32 - 1), self.state.episode.numpy()))
        self.mask.assign(chosen.astype(np.int32))
        self.restart()
        self.mask.zero_()

    @property
    def _fused(self) -> bool:
        """Whether one kernel runs whole decisions."""
        return self.observer.fused and self.source.fused and self.launch.lanes == 1 and not self.sensors.there

    @property
    def _world_kernels(self) -> Kernels:
        """Kernels of the source with the observer, or without it."""
        if self._fused:
            lanes = ("cell" if self.model.cells.across == 1 else "grid") if self.in_lanes else None
            return fused_kernels(self.source, self.observer, self.precision, lanes)
        return source_kernels(self.source, self.precision)

    def restart(self) -> None:
        """Start the next episode in the worlds of `self.mask`, on the device."""
        self._run("begin", self._world_kernels["begin"], self._record, PerWorld(self.mask))
        if self.sensors.there:
            self.launch.by_lane("begin sensors", *self.sensors.calls(begins=True))
            self.sensors.compute(begins=True)
        if self.observer.starts:
            start = observer_kernels(self.observer, self.precision)["start"]
            self._run("start", start, PerWorld(self.memory), PerWorld(self.mask))
        if self.device == "cpu":  # reading from a GPU would wait for it
            self.check_room()

    def advance(self, ticks: int) -> None:
        """Run camera ticks under `self.actions`, stopping each world at its horizon; of one decision at most."""
        memory, hold = PerWorld(self.memory), PerWorld(self.mask)
        self._revive(ticks)
        sensing = self._world_kernels
        if self.launch.lanes > 1 or self.sensors.own or (self.in_parts and self.model.radio.delay == 0):
            self._advance_in_lanes(ticks)
        elif "advance" in sensing:
            arguments = [memory, self._record, PerWorld(self.actions), hold, ticks]
            self._run(("advance", ticks), sensing["advance"], *arguments)
        else:
            decide = sensing["decide"], [self.model, PerWorld(self.state), PerWorld(self.actions), hold]
            self.launch.decision(("advance", ticks), ticks, decide, *self._look(SENSE), *self._follow(1))
        if self.device == "cpu":  # reading from a GPU would wait for it
            self.check_room()

    def _revive(self, ticks: int) -> None:
        """Restart the observers whose restart falls into the next ticks."""
        if self.model.restarts == 1:
            revive = observer_kernels(self.observer, self.precision)["revive"]
            self._run(("revive", ticks), revive, PerWorld(self.memory), PerWorld(self.mask), ticks)

    def _advance_in_lanes(self, ticks: int) -> None:
        """Run ticks of one decision; vehicles do not wait for each other but for messages of the same tick."""
        self.decide()
        for _ in range(ticks):
            self._move()
            if self.model.radio.delay > 0 and not self.sensors.own:
                self.launch.by_lane("look and follow", *self._look(LOOK), *self._follow())
            else:
                self._look_around()
                self._follow_by_level()
            self.finish()

    def _follow_by_level(self) -> None:
        """Let vehicles follow, the vehicles of a large level in parallel; small levels are not worth the overhead."""
        self._run("levels", host_kernels(self.precision)["find_levels"], PerWorld(self.mask), PerWorld(self._turns))
        for level, turns in enumerate(self._levels):  # idle launches cost less than to wait for the GPU
            self.launch.by_lane(("follow", level), *self._follow(turns=turns))
        if self._levels:
            return
        sizes = np.trim_zeros(np.diff(self._turns.first.numpy()).sum(axis=0), "b")
        large = (sizes >= VEHICLES_PER_LEVEL * self.launch.lanes) | (self.device != "cpu") | self.in_parts
        changes = np.flatnonzero(large[1:] | large[:-1]) + 1
        for first, last in pairwise([0, *changes.tolist(), len(sizes)]):
            self._set_due(first, last)
            if large[first]:
                self.launch.by_lane("follow", *self._follow())
            else:
                for n, (follow, arguments) in enumerate(self._follow()):
                    self.launch(("follow in turn", n), follow, [*arguments, 0, 1], (1,))

    def _set_due(self, first: int, last: int) -> None:
        """Set the levels that follow next."""
        if self.device == "cpu":
            self._turns.due.numpy()[...] = first, last
        else:
            self._turns.due.assign(np.full((self.worlds, 2), (first, last), dtype=np.int32))

    def _turns_of_level(self, level: int) -> Any:
        """Return turns that share everything with the world's but the level that is due."""
        result = Turns()
        for name in field_types(self._turns):
            setattr(result, name, getattr(self._turns, name))
        row: Any = wp.array([[level, level + 1]], dtype=wp.int32, device=self.device)
        result.due = repeated(row, 0, self.worlds)
        return result

    def _sense(self, stages: int) -> Call:
        """Return the launch of stages of a tick before observers."""
        sense = source_kernels(self.source, self.precision)["sense"]
        return sense, [self.model, PerWorld(self.state), self._record, PerWorld(self.mask), stages]

    def _look(self, stages: int) -> list[Call]:
        """Return the launches of stages of a tick before observers, and of the sensors beside the camera."""
        return [self._sense(stages), *self.sensors.calls()]

    def _look_around(self) -> None:
        """Measure after everything has moved, in lanes."""
        self.launch.by_lane("look", *self._look(LOOK))
        self.sensors.compute()

    def _follow(self, ends: int = 0, turns: Any = None) -> list[Call]:
        """Return the launches of the observers, in turn; with `ends` the last one ends the tick."""
        *others, last = follow_kernels(self.observer, self.precision, self.in_parts)
        due = PerWorld(self._turns if turns is None else turns)
        given = [self.model, PerWorld(self.state), self._memories, PerWorld(self.mask), due]
        return [*((follow, [*given, 0]) for follow in others), (last, [*given, ends])]

    def _move(self) -> None:
        """Move the truth to the next tick, in lanes."""
        self.launch.by_lane("move", self._sense(MOVE))
        arrange, arguments = self._sense(ARRANGE)
        self.launch("arrange", arrange, [*arguments, 0, 1], (1,))

    def check_room(self) -> None:
        """Check that all vehicles have kept all agents in range since the last reset; on a GPU the next reset warns.

        Raises:
            CoopenvError: the scenario's limit is too low.
        """
        if self.model.kept and self.view("crowded").any():
            world, vehicle = np.argwhere(self.view("crowded"))[0].tolist()
            found = f"more than {self.model.kept} targets and senders are in range of vehicle_{vehicle + 1}"
            line = f"topology.most_nearby: {found} in world {world}"
            if self.device == "cpu":
                raise CoopenvError(line)
            warnings.warn(line, ScenarioWarning, stacklevel=3)

    def load(self) -> None:
        """Load the kernels, compiling the missing ones; nothing moves."""
        self.restart()
        self.mask.fill_(1)
        World.advance(self, 1)
        self.mask.zero_()

    def _run(self, key: Hashable, kernel: wp.Kernel, *arguments: Any) -> None:
        self.launch(key, kernel, [self.model, PerWorld(self.state), *arguments])

    # A decision in stages, for estimators on the host: decide; then per tick sense, per vehicle receive and broadcast,
    # and finish; each in the worlds that `advance` would move.

    def decide(self) -> None:
        """Make commands of `self.actions`."""
        decide = source_kernels(self.source, self.precision)["decide"]
        self._run("decide", decide, PerWorld(self.actions), PerWorld(self.mask))

    def sense(self) -> None:
        """Move the truth to the next tick and measure it."""
        if self.launch.lanes == 1:
            self.launch.by_lane("sense", *self._look(SENSE))
            self.sensors.compute()
        else:
            self._move()
            self._look_around()

    def receive(self, vehicle: int) -> None:
        """Let a vehicle receive the messages arriving at this tick."""
        self._run(("receive", vehicle), host_kernels(self.precision)["receive"], PerWorld(self.mask), vehicle)

    def broadcast(self, vehicle: int) -> None:
        """Broadcast the estimate that has been written for a vehicle."""
        self._run(("broadcast", vehicle), host_kernels(self.precision)["broadcast"], PerWorld(self.mask), vehicle)

    def finish(self) -> None:
        """End the tick."""
        self._run("finish", host_kernels(self.precision)["finish"], PerWorld(self.mask))

    def view(self, name: str) -> np.ndarray:
        """Return a field of the state on the host, without a copy on the CPU.

        Where vehicles keep nearby agents, measurements and messages are copied: (W, N, A) or (W, N, N), as otherwise.
        """
        if name in BY_AGENT and self.model.kept:
            return self._by_agent(name)
        if self.device != "cpu" or name not in self._views:
            self._views[name] = getattr(self.state, name).numpy()
        return self._views[name]

    def _by_agent(self, name: str) -> np.ndarray:
        """Return a field with entries or boxes as one with agents or senders."""
        entries, agents = getattr(self.state, name).numpy(), self.view("kept_agent")
        first = self.model.landmarks * (state_fields(self.precision)[name].axes[2] == "Y")
        shape = (*agents.shape[:2], self.model.agents - first, *entries.shape[3:])
        values = np.full(shape, BY_AGENT[name], entries.dtype)
        w, i, entry = np.nonzero(agents >= first)
        values[w, i, agents[w, i, entry] - first] = entries[w, i, entry]
        return values

    def get_state(self) -> dict[str, np.ndarray]:
        """Return a copy of all variables, random streams included (they are seeds and counters)."""
        return {name: array.numpy().copy() for name, array in self.state_arrays().items()}

    def set_state(self, values: Mapping[str, np.ndarray]) -> None:
        """Restore a state of `get_state`; a CoopenvError names an invalid field, and nothing has changed."""
        overwrite(self.state_arrays(), self.checked_state(values, {}, {}))

    def checked_state(
        self, values: Mapping[str, Any], more: Mapping[str, Any], rules: Mapping[str, Rule]
    ) -> dict[str, np.ndarray]:
        """Return copies of a state's fields that fit into `state_arrays`, and into more arrays with their own rules."""
        arrays = {**self.state_arrays(), **more}
        return checked_state(values, arrays, {**self.state_rules(), **rules}, self.model, self.source.knows_truth)

    def state_rules(self) -> dict[str, Rule]:
        """Return the rules of the fields of a saved state, by name."""
        own = {name: field.rule for name, field in state_fields(self.precision).items() if field.rule is not None}
        of_observer = {f"observer_{name}": rule for name, rule in self.observer.valid.items()}
        return {**own, **of_observer, "actions": ANYTHING}

    def state_arrays(self) -> dict[str, Any]:
        """Return every array that `set_state` writes, by name."""
        known = {name: getattr(self.state, name) for name in state_fields(self.precision)}
        own = {f"observer_{name}": array for name, array in parts(self.memory, self.observer.memory).items()}
        return {**known, **own, "actions": self.actions}
