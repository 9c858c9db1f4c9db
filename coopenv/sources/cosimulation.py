"""Worlds whose vehicles a program on the host moves (co-simulation): the contract of the program, and the world."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from pkgutil import resolve_name
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.installation import blamed, load_reference
from coopenv.estimation.poses import Array, about_z
from coopenv.motions.command import LATERAL, SPEED, TURN
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Road
from coopenv.sources.feed import COSIMULATED, cosimulation_struct
from coopenv.sources.worlds import Simulated, SimulatedWorld
from coopenv.world.launch import PerWorld
from coopenv.world.route import UNDER_WAY
from coopenv.world.state import allocate, fields


@dataclass(frozen=True)
class Poses:
    """Planar poses of N vehicles and Z other bodies, up to `most_vehicles`, map frame; all finite."""

    xy: Array  # (N, 2) m
    heading: Array  # (N,) rad, from x towards y
    speed: Array  # (N,) m/s
    steering: Array  # (N,) rad, or the turn rate of another drive, rad/s; positive to the left
    crashed: Array  # (N,) bool, has touched something
    left: Array  # (N,) bool, has left the road for good
    traffic_position: Array  # (Z, 3) centres of boxes, m
    traffic_heading: Array  # (Z,) rad
    traffic_half: Array  # (Z, 3) half of their edges, m
    driven: Array | bool = False  # (N,) moved by commands and `[dynamics]`: poses count at the start only


AXES: Mapping[str, tuple[int, ...]] = {field.name: () for field in dataclass_fields(Poses)} | {
    "xy": (2,),
    "traffic_position": (3,),
    "traffic_half": (3,),
}
"""Axes after N or Z."""


@dataclass(frozen=True)
class Moment:
    """The vehicles of one world before the next tick, map frame."""

    command: Array  # (N, 5) see `coopenv.motions.command`; zero speeds and steering where the episode has ended
    present: Array  # (N,) bool
    xy: Array  # (N, 2) m
    heading: Array  # (N,) rad
    speed: Array  # (N,) m/s
    yaw_rate: Array  # (N,) rad/s


class TrafficProgram(ABC):
    """A program that moves the vehicles of one world, in simulated time; made from a scenario.

    It is saved and restored as a deep copy, unless it does so otherwise.
    """

    @property
    def roads(self) -> tuple[Road, ...]:
        """Roads to draw if the scenario has none."""
        return ()

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Begin an episode; the same seed gives the same one."""

    @abstractmethod
    def command(self, now: Moment) -> None:
        """Drive to the next camera tick. Worlds of a batch are all commanded before poses are asked for."""

    @abstractmethod
    def poses(self) -> Poses:
        """Return all poses after the last reset or command."""

    def save(self) -> Any:
        """Return a copy of everything that the next tick depends on."""
        return deepcopy(self)

    def accepts(self, saved: Any) -> bool:
        """Return whether `restore` can take this."""
        return type(saved) is type(self)

    def restore(self, saved: Any) -> None:
        """Continue from a state of `save`."""
        vars(self).update(vars(deepcopy(saved)))

    def close(self) -> None:  # noqa: B027 (most programs hold nothing)
        """Let go of everything; may be called again."""


def own_program(scenario: Scenario) -> TrafficProgram:
    """Return the program that the section `[program]` names. Raises CoopenvError: there is none, or its code fails."""
    assert scenario.program is not None  # the schema asks for it
    code, options = scenario.program.code, scenario.program.options
    with blamed(f"program.code: {code}"):
        made = load_reference(code)(scenario, **options)
    if not isinstance(made, TrafficProgram):
        raise CoopenvError(f"program.code: {code} makes no coopenv.sources.cosimulation.TrafficProgram")
    return made


class CosimulatedWorld(SimulatedWorld):
    """Worlds on the CPU, each with a program that moves its vehicles; all else is as in the simulation."""

    source = COSIMULATED

    def __init__(
        self, program: Callable[[Scenario], TrafficProgram], scenario: Scenario, *arguments: Any, **options: Any
    ) -> None:
        """Build the arrays and start the programs; arguments and errors as for `World`, and the program's errors.

        Raises:
            CoopenvError: not on the CPU.
        """
        super().__init__(scenario, *arguments, **options)
        if self.device != "cpu":
            raise CoopenvError(f"device '{self.device}': these worlds are moved on the host, use device='cpu'")
        self.programs = [program(scenario) for _ in range(self.worlds)]

    def _build_record(self) -> Any:
        struct, model = cosimulation_struct(self.precision), self.model
        record = allocate(struct, {"W": self.worlds, "N": model.vehicles}, self.device)
        self._motion = {name: getattr(record, name).numpy() for name in fields(struct)}
        return PerWorld(record)

    def restart(self) -> None:
        """Start the next episode in the worlds of `self.mask`, see `World.restart`."""
        seeds, episodes, chosen = self.view("seed"), self.view("episode"), np.flatnonzero(self.mask.numpy()).tolist()
        with self._blamed():
            for w in chosen:
                key = [int(seeds[w]), (int(episodes[w]) + 1) % 2**32]
                self.programs[w].reset(int(np.random.SeedSequence(key).generate_state(1)[0]))
            for w in chosen:
                poses = self._poses(w)
                self._put(w, poses, np.zeros_like(poses.xy), np.zeros_like(poses.heading))
        super().restart()

    def fetch(self) -> bool:
        """Drive to the next tick in the worlds that are not over."""
        there = np.flatnonzero((self.mask.numpy() == 0) & (self.view("tick") < self.model.horizon_ticks)).tolist()
        with self._blamed():
            moments = {w: self._moment(w) for w in there}
            for w, now in moments.items():
                self.programs[w].command(now)
            for w, now in moments.items():
                self._carry(w, now, self._poses(w))
        return True

    def _blamed(self) -> Any:
        return blamed(f"backend '{self.scenario.backend}'")

    def _moment(self, world: int) -> Moment:
        """Return a copy of what a program reads.

        A vehicle whose episode has ended brakes with its wheels straight: it may still roll.
        """
        L, command = self.model.landmarks, np.array(self.view("command")[world], dtype=float)
        command[np.ix_(self.view("ended")[world] != UNDER_WAY, [SPEED, TURN, LATERAL])] = 0.0
        R = self._copy("rotation", world)[L:]
        return Moment(
            command=command,
            present=self.view("present")[world, L:] != 0,
            xy=self._copy("position", world)[L:, :2],
            heading=np.arctan2(R[:, 1, 0], R[:, 0, 0]),
            speed=self._copy("speed", world),
            yaw_rate=self._copy("angular_velocity", world)[L:, 2],
        )

    def _poses(self, world: int) -> Poses:
        """Return a program's poses, checked, with absent bodies up to the largest number."""
        poses, most = self.programs[world].poses(), self.model.traffic
        if not isinstance(poses, Poses):
            raise CoopenvError(f"{type(self.programs[world]).__name__}.poses: expected Poses, got {shown(poses)}")
        others, found = len(poses.traffic_half), {}
        if others > most:
            section = self.scenario.backend
            raise CoopenvError(f"{section}.most_vehicles: {most} are too few, there are {others} on the road")
        for name, axes in AXES.items():
            value, own = np.asarray(getattr(poses, name), float), not name.startswith("traffic")
            value = np.full(self.model.vehicles, value) if name == "driven" and not value.ndim else value
            shape = (self.model.vehicles if own else others, *axes)
            if value.shape != shape or not np.isfinite(value).all():
                got = value.shape if value.shape != shape else "others"
                raise CoopenvError(f"poses: {name}: expected finite numbers of shape {shape}, got {got}")
            found[name] = value if own else np.concatenate([value, np.zeros((most - others, *axes))])
        return replace(poses, **found)

    def _carry(self, world: int, before: Moment, poses: Poses) -> None:
        """Put the vehicles of one world where they are at the next tick.

        The odometry measures the twist that leads there from the last pose when it is held over the tick.
        """
        turned = (poses.heading - before.heading + np.pi) % (2.0 * np.pi) - np.pi
        c, s = np.cos(before.heading), np.sin(before.heading)
        dx, dy = (poses.xy - before.xy).T
        forward, left = c * dx + s * dy, c * dy - s * dx
        # rho of Log in SE(2): V(turned)^-1 times the way in the body frame
        half = turned / 2.0
        a = np.where(np.abs(half) < 1e-6, 1.0, half / np.tan(np.where(half == 0.0, 1.0, half)))
        way = np.stack([a * forward + half * left, a * left - half * forward], axis=-1)
        rate = self.scenario.rates.camera
        self._put(world, poses, way * rate, turned * rate)

    def _put(self, world: int, poses: Poses, velocity: Array, yaw_rate: Array) -> None:
        row = {name: values[world] for name, values in self._motion.items()}
        row["true_rotation"][...] = about_z(poses.heading)
        row["true_position"][..., :2] = poses.xy
        row["true_velocity"][..., :2], row["true_angular_velocity"][..., 2] = velocity, yaw_rate
        for name in ("speed", "steering", "crashed", "left", "driven"):
            row[name][...] = getattr(poses, name)
        self.view("traffic_rotation")[world] = about_z(poses.traffic_heading)
        for name in ("traffic_position", "traffic_half"):
            self.view(name)[world] = getattr(poses, name)

    def advance(self, ticks: int) -> None:
        """Run camera ticks, see `World.advance`; `fetch` moves the vehicles to each."""
        self.decide()
        for _ in range(ticks):
            self.fetch()
            super().advance(1)

    def source_state(self) -> dict[str, Any]:
        """Return copies of the programs."""
        return {"programs": [program.save() for program in self.programs]}

    def set_source_state(self, values: Mapping[str, Any]) -> None:
        """Go on with copies of programs. Raises CoopenvError: they are not of these worlds; nothing has changed."""
        given: Any = values.get("programs")
        fits = isinstance(given, list) and len(given) == self.worlds
        if not fits or not all(p.accepts(saved) for p, saved in zip(self.programs, given, strict=True)):
            raise CoopenvError(f"state: programs: expected {self.worlds} of backend '{self.scenario.backend}'")
        for program, saved in zip(self.programs, given, strict=True):
            program.restore(saved)


class Cosimulated(Simulated):
    """Worlds that programs move: many at once on the CPU, or one of them tick by tick."""

    def __init__(self, scenario: Scenario, program: Callable[[Scenario], TrafficProgram] | None = None) -> None:
        """Make one program, whose roads are drawn.

        Args:
            scenario: names the program in its key `backend`.
            program: makes one in place of that; errors are its own.
        """
        assert scenario.cosimulator is not None
        make: Callable[[Scenario], TrafficProgram] = program or resolve_name(scenario.cosimulator.program)
        first = make(scenario)
        super().__init__(scenario.model_copy(update={"roads": scenario.roads or first.roads}))
        first.close()
        self._worlds: list[CosimulatedWorld] = []
        self._make = make

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy it without the worlds that it has made."""
        return Cosimulated, (self.scenario, self._make)

    def kind(self, *arguments: Any, **options: Any) -> CosimulatedWorld:
        """Return worlds; arguments as for `World`."""
        made = CosimulatedWorld(self._make, *arguments, **options)
        self._worlds.append(made)
        return made

    def close(self) -> None:
        """End the episode and the programs."""
        super().close()
        for world in self._worlds:
            for program in world.programs:
                program.close()
