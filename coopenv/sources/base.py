"""The contract of every backend, a source of ticks: simulated, recorded or on real vehicles.

Time goes in ticks, the frames of the scenario's camera rate; between two decisions there are
`scenario.ticks_per_decision` of them. A backend gives every tick, index after index: where nothing came in time from a
vehicle it is marked `missing`, what came after its deadline `late`, and a frame in which nothing was detected simply
has nothing visible (`Sensed`). A backend never waits longer than its deadlines; it ends by giving fewer ticks.
"""

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import are_numbers, are_rotations
from coopenv.motions.command import ACCELERATION, LATERAL, PAN, SPEED, TURN
from coopenv.observers.contract import Message, ObserverInit, check_message
from coopenv.observers.sensed import Sensed
from coopenv.observers.setups import observer_init_of
from coopenv.scenario import Scenario
from coopenv.world.world import World


@dataclass(frozen=True)
class Command:
    """Command of N vehicles until the next decision, see `coopenv.motions.command`; a vehicle that has ended stands.

    Vehicles with prescribed motion are not driven, independent of their rows.
    """

    speed: Array  # (N,) m/s, to reach
    turn: Array  # (N,) by the kind of motion: steering angle, rad, or turn rate, rad/s; positive to the left
    acceleration: Array  # (N,) m/s^2, at most, on the way to the speed
    pan: Array | None = None  # (N,) rad, of cameras that turn, positive to the left; None: 0
    lateral: Array | None = None  # (N,) m/s, to the left, of drives that can; None: 0

    @classmethod
    def of(cls, rows: Array) -> Self:
        """Return the command whose entries stand in the columns of (N, 5), as in a world's state; or of (N, 3 or 4)."""
        values = np.array(rows, dtype=np.float64)
        entries = (SPEED, TURN, ACCELERATION, PAN, LATERAL)[: values.shape[1]]
        return cls(*(values[:, int(entry)] for entry in entries))

    @property
    def steering(self) -> Array:
        """(N,) rad, of vehicles that steer: `turn`."""
        return self.turn

    @property
    def rows(self) -> Array:
        """(N, 5) as in the state of a world."""
        zero = np.zeros_like(self.speed)
        pan, lateral = (zero if entry is None else entry for entry in (self.pan, self.lateral))
        return np.stack([self.speed, self.turn, self.acceleration, pan, lateral], axis=-1)


EPISODE_OVER = "the episode is over"
"""Reason to stop a backend in real time after the last decision."""


@dataclass(frozen=True)
class Capabilities:
    """Capabilities of a backend."""

    truth: bool  # poses are known; where not, errors are NaN and privileged rewards 0
    driven: bool  # commands have an effect
    real_time: bool  # its clock is real time, so that every decision has a deadline
    ticks: int | None  # how many there are, the start included; None: no end of its own
    batched: bool  # it makes worlds on a device itself (`WorldBackend`)
    recorded: bool = False  # its ticks are always the same ones: neither seeds nor commands change anything
    estimated: tuple[int, ...] | None = None  # vehicles that are estimated here and are agents (None: all)
    simulated_clock: bool = False  # that clock waits for the caller: no load makes a decision late


@dataclass(frozen=True)
class VehicleBroadcast:
    """Estimate and message that one vehicle broadcasts after a tick."""

    vehicle: int  # its index
    rotation: Array  # (3, 3) body to map, estimated
    position: Array  # (3,) of the body's origin, map, m
    covariance: Array  # (6, 6) over (2 lambda, p)
    message: Message | None  # of an observer that has messages of its own
    protection_level: float = np.inf  # m, horizontal; inf: unknown, or none stated


@dataclass
class Health:
    """Counts of ticks, rows and messages; `late`, `missing` and `empty` count vehicles' rows."""

    ticks: int = 0  # that were given
    late: int = 0  # rows that came after their deadline
    missing: int = 0  # rows of vehicles from which nothing came
    empty: int = 0  # rows in which nothing was detected
    received: int = 0  # messages from vehicles or sensors, of any kind
    rejected: int = 0  # messages of these that were refused

    def count(self, tick: Sensed, vehicles: Any = slice(None)) -> None:
        """Count one tick, in the rows of some vehicles, or of all."""
        missing = np.asarray(tick.filled("missing"), bool)
        self.ticks += 1
        self.late += int(np.sum(tick.filled("late")[vehicles]))
        self.missing += int(missing[vehicles].sum())
        self.empty += int((~np.any(tick.visible, axis=-1) & ~missing)[vehicles].sum())


@runtime_checkable
class Backend(Protocol):
    """A source of ticks of one world."""

    scenario: Scenario
    """Vehicles, sensors, radio and observers."""
    capabilities: Capabilities
    """Capabilities of the backend, fixed once it is built."""
    health: Health
    """Counts since it was built."""

    @property
    def clock(self) -> float:
        """Time since the reset in s, simulated or real."""
        ...

    def reset(self, seed: int | None, options: Mapping[str, Any]) -> Sensed:
        """Begin an episode and return tick 0.

        Args:
            seed: fixes the episode where anything is drawn; None: the next one.
            options: as given to the environment's `reset`.

        Raises:
            CoopenvError: it cannot begin.
        """
        ...

    def advance(self, command: Command) -> Iterable[Sensed]:
        """Drive until the next decision and return its ticks, each as soon as it is there; fewer at the end."""
        ...

    def stop(self, reason: str) -> None:
        """Bring the vehicles to a stand at once and end the episode; may be called at any time, and again."""
        ...

    def close(self) -> None:
        """Stop, and let go of everything; may be called again."""
        ...


@runtime_checkable
class Broadcasting(Protocol):
    """A backend with vehicles estimated elsewhere: it broadcasts estimates and reports its links."""

    def broadcast(self, sent: Sequence[VehicleBroadcast]) -> None:
        """Send the broadcasts of the vehicles estimated here, after the present tick or at the start."""
        ...

    def notes(self, vehicle: int) -> dict[str, Any]:
        """Return the entries of a vehicle's info about its machine and links, always the same keys."""
        ...


@runtime_checkable
class Repeating(Protocol):
    """A backend of past episodes: a reset repeats their draws."""

    stopped: str
    """Why the vehicles were stopped in the episode that has been replayed; empty: it is not over, or they were not."""

    @property
    def drawn(self) -> tuple[int, int]:
        """Key of the random draws, and number of the episode, of the episode that has begun last."""
        ...


TickStream = Generator[Sensed, Command, None]
"""Yields tick 0, and then one tick for every command that it is sent; it ends by returning, or by being closed."""
Episode = TickStream
"""Former name of `TickStream`."""


IGNORED_OPTIONS = ("options", "arm")
"""Reset options ignored in simulation: `options` of PettingZoo's conformance tests, and `arm`, which arms cars."""


def check_options(options: Iterable[str], known: Sequence[str]) -> None:
    """Refuse options of a reset that a backend does not know. Raises CoopenvError: there is one."""
    for key in options:
        if key not in IGNORED_OPTIONS:
            check_one_of("unknown option", key, known)


class TickGenerator(ABC):
    """A backend whose episodes are generators of ticks, in simulated time; see `Backend` for its methods."""

    options: tuple[str, ...] = ()
    """Names of the options of a reset that `episode` reads; others are refused."""

    def __init__(self, scenario: Scenario, capabilities: Capabilities) -> None:
        self.scenario = scenario
        self.capabilities = capabilities
        self.health = Health()
        self.clock = 0.0
        self._episode: TickStream | None = None

    @abstractmethod
    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        """Return a new episode; arguments as for `Backend.reset`."""

    def reset(self, seed: int | None, options: Mapping[str, Any]) -> Sensed:
        """Begin an episode and return tick 0. Raises CoopenvError: an option is not known, or there is no tick."""
        check_options(options, self.options)
        self.stop("reset")
        self._episode = self.episode(seed, options)
        first = next(self._episode, None)
        if first is None:
            raise CoopenvError(f"{type(self).__name__}: the episode ended before its first tick")
        return self._counted(first)

    def advance(self, command: Command) -> Iterator[Sensed]:
        """Yield the ticks of one decision."""
        for _ in range(self.scenario.ticks_per_decision):
            if self._episode is None:
                return
            try:
                tick = self._episode.send(command)
            except StopIteration:
                return
            yield self._counted(tick)

    def stop(self, reason: str) -> None:
        """End the episode."""
        if self._episode is not None:
            self._episode.close()
        self._episode = None

    def close(self) -> None:
        """End the episode."""
        self.stop("closed")

    def _counted(self, tick: Sensed) -> Sensed:
        self.health.count(tick)
        self.health.received += len(tick.messages)
        self.clock = tick.index * tick.dt if tick.time is None else tick.time
        return tick


class SensingWorld(World, ABC):
    """A world whose measurements can be read on the host."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Build the arrays; arguments and errors as for `World`."""
        super().__init__(*arguments, **options)
        self.late = np.zeros(self.model.vehicles, dtype=np.int64)
        """(N,) ticks of the decision under way whose row came late."""
        self.missing = np.zeros(self.model.vehicles, dtype=np.int64)
        """(N,) ticks of it of which nothing came."""
        self.missing_in_all = np.zeros(self.model.vehicles, dtype=np.int64)
        """(N,) the same since the reset."""

    @cached_property
    def observer_init(self) -> ObserverInit:
        """Initial information for observers."""
        return observer_init_of(self.scenario, self.model)

    @abstractmethod
    def sensed(self, world: int, k: int) -> Sensed:
        """Return the measurements of one world's vehicles at the present tick k, without truth and messages."""

    def fetch(self) -> bool:
        """Make the next tick ready for `sense`; return False where the source has no more."""
        return True

    def source_state(self) -> dict[str, Any]:
        """Return a copy of what the source remembers outside the arrays, by name."""
        return {}

    def set_source_state(self, values: Mapping[str, Any]) -> None:
        """Restore it from the saved state. Raises CoopenvError: it does not fit; nothing has changed then."""


class WorldBackend(Backend, Protocol):
    """A backend whose ticks come about on the device, in any number of worlds."""

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> SensingWorld:
        """Return worlds that step by themselves; arguments as for `World`."""
        ...


def is_valid_message(message: Message) -> bool:
    """Return whether a message from elsewhere holds what an inbox may hold."""
    try:
        check_message(message)
    except CoopenvError:
        return False
    turned = message.rotation is None or bool(are_rotations(np.asarray(message.rotation, dtype=float)))
    return turned and (message.position is None or bool(are_numbers(message.position).all()))
