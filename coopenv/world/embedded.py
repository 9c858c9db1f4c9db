"""Interface of the world to an observer and a source of ticks, each a few Warp functions.

The world imports neither; `coopenv.world.step` builds kernels from them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Coordinates
from coopenv.estimation.validity import Rule
from coopenv.world.camera import draw_map, observe
from coopenv.world.dynamics import move, move_landmarks, remember
from coopenv.world.model import Precision
from coopenv.world.nearby import sort_into_cells
from coopenv.world.odometry import draw_errors, measure_odometry
from coopenv.world.referee import depart, referee, touches_anything
from coopenv.world.reset import place_bodies, set_initial_estimate
from coopenv.world.route import appear, direct_traffic
from coopenv.world.v2x import draw_faults, transmit
from coopenv.world.warp_internals import device_function, outlined


@wp.struct
class Nothing:
    """Empty struct: memory of an observer without any, and record of a source without any."""

    unused: wp.int32


@wp.struct
class Now:
    """The current tick."""

    tick: wp.int32  # time since the start in units of `model.camera_period`: its number, where ticks come regularly
    period: wp.float64  # s since the last tick
    due: wp.bool  # whether the scenario's observer rate asks for a correction


@device_function
def correction_due(model: Any, tick: int) -> bool:
    """Return whether the scenario's observer rate (`rates.observer`) asks for a correction at a camera tick."""
    ratio = model.observer.rate * model.camera_period
    before = wp.floor(wp.float64(tick - 1) * ratio + wp.float64(1.0e-9))
    return wp.floor(wp.float64(tick) * ratio + wp.float64(1.0e-9)) > before


@device_function
def regular_tick(model: Any, tick: int):
    """Return a tick of a world whose ticks come at the camera's rate."""
    now = Now()
    now.tick = tick
    now.period = model.camera_period
    now.due = correction_due(model, tick)
    return now


@dataclass(frozen=True)
class Messages:
    """Host format of an embedded observer's messages (`coopenv.observers.kernel_observer`)."""

    write: Callable[[Any], Any]
    """(KernelObserver): return the `Message` that `send` has broadcast."""
    read: Callable[[Any, int, Any, int], None]
    """(KernelObserver, sender, Message, sent): put a message into the observer's inbox; `sent` is
    when, in the kernels' time. Raises ValueError or a CoopenvError where the message is malformed."""
    tampered: Callable[[Any, Any], Any] = lambda made, honest: made
    """(false Message, honest Message): return the false one with all entries in agreement with its pose."""


@dataclass(frozen=True)
class Embedded:
    """An observer that runs in the world's kernels.

    Its functions read what a vehicle senses and receives from `state`, write its estimate there (`estimate_rotation`,
    `estimate_position`, `covariance`, `corrected_tick`), and keep their own variables in `memory`. `model` and
    `state` are the ones of `coopenv.world`; the only truth that they may read is the landmarks' positions. A vehicle
    writes its own rows alone, and reads only received data of other vehicles: vehicles may run at once.
    """

    name: str
    """Name in scenarios and tables."""
    estimate: Any
    """(model, state, memory, world, vehicle, now): take one camera tick `Now`; messages have been delivered. Or several
    functions, in turn (`parts`): on a GPU each is a kernel of its own, which keeps nothing else than its records."""
    start: Any
    """(model, state, memory, world, vehicle): begin an episode at the initial estimate, which stands in the state, its
    covariance is `coopenv.world.v2x.start_covariance` (LEFT coordinates); vehicles come leaders first. Called again
    for a vehicle that restarts, see `[faults.restart]`."""
    send: Any
    """(model, state, memory, world, vehicle, tick): broadcast data beyond the V2X pose estimate; called
    at every tick, after `start` as well."""
    memory: Any = Nothing
    """A Warp struct whose arrays are declared with `coopenv.world.state.array`, the axes W (worlds) and N (vehicles)
    first; or W and L: scratch."""
    sizes: Mapping[str, int] = field(default_factory=dict, hash=False)
    """Lengths of axes by letter, besides those of the state (`coopenv.world.state.state_sizes`)."""
    fit: Callable[[Any], "Embedded"] | None = None
    """(model): return the variant to compile for a model; None: this one."""
    valid: Mapping[str, Rule] = field(default_factory=dict, hash=False)
    """Rules for a saved memory, by field. Without a rule, floats must be finite and integers are unrestricted: give
    every index and count a rule."""
    messages: Messages | None = None
    """Messages on the host; None: it sends the V2X pose estimate alone."""
    coordinates: Coordinates = Coordinates.RICCATI
    """Coordinates of its covariance on the host; in the state they are (2 lambda, p)."""
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Options of the Warp module that it is compiled in."""
    fused: bool = False
    """Run it in one kernel with the simulation in simulated worlds. A single world is then a tenth faster, batches are
    not, and the observer is compiled once more."""

    def __post_init__(self) -> None:
        """Check that all parts are Warp functions. Raises CoopenvError."""
        given = (*(("estimate", part, 6) for part in self.parts), ("start", self.start, 5), ("send", self.send, 6))
        for name, part, count in given:
            if not isinstance(part, wp.Function) or len(signature(part.func).parameters) != count:
                expected = f"expected a Warp function (@wp.func) of {count} arguments"
                raise CoopenvError(f"observer '{self.name}': {name}: {expected}")

    @property
    def parts(self) -> tuple[Any, ...]:
        """The functions of `estimate`."""
        return self.estimate if isinstance(self.estimate, tuple) else (self.estimate,)

    @property
    def starts(self) -> bool:
        """True if the observer acts at the start of an episode."""
        return self.start is not start_nothing or self.send is not send_nothing


@dataclass(frozen=True)
class Source:
    """Source of the ticks of a world."""

    name: str
    begin: Any  # (model, state, record, world): go to the start of an episode
    move: Any
    """(model, state, record, world, vehicle, tick): move the truth of a vehicle to a tick and measure its odometry. The
    three stages write everything that is sensed, the truth, and which messages arrive at whom (`state.arriving`, see
    `coopenv.world.v2x`); `begin` does so for the first frame. In `move` and `look` a vehicle writes its own rows alone,
    so that vehicles may come in any order, or at once."""
    arrange: Any
    """(model, state, record, world, tick): carry everything else to the tick, after all vehicles have moved."""
    look: Any
    """(model, state, record, world, vehicle, tick): judge where a vehicle is, measure, and receive."""
    record: Callable[[Precision], Any]  # returns the Warp struct of the record that both read
    knows_truth: bool = True  # the truth is always there; otherwise it may be NaN
    keeps_nearby: bool = False  # whether `topology.most_nearby` may limit what a vehicle keeps
    fused: bool = False  # whether small observers run in one kernel with it, see `Embedded.fused`
    in_lanes: tuple[Any, ...] = ()  # stages that take several worlds at once in that kernel


@device_function
def start_nothing(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    """Begin an episode of an observer without a memory."""


@device_function
def estimate_nothing(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Leave the estimate unchanged: the host writes it."""


@device_function
def send_nothing(model: Any, state: Any, memory: Any, world: int, vehicle: int, tick: int):
    """Add nothing to the V2X pose estimate."""


HOST = Embedded("host", estimate_nothing, start_nothing, send_nothing)
"""Placeholder for an observer that runs on the host (`coopenv.api.host_observers.PlugIns`)."""


@outlined
def sense_vehicle(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Run the sensing stages of a vehicle, at the start of an episode (tick 0) as at every tick."""
    observe(model, state, world, vehicle, tick)
    transmit(model, state, world, vehicle, tick)
    direct_traffic(model, state, world, vehicle, tick)


@device_function
def begin_sensing(model: Any, state: Any, world: int):
    """Draw errors of maps, initial estimates and lasting errors, look for contact, take the first frame."""
    sort_into_cells(model, state, world)
    draw_map(model, state, world)
    remember(model, state, world, 0)
    for vehicle in range(model.vehicles):
        set_initial_estimate(model, state, world, vehicle)
        draw_errors(model, state, world, vehicle)
        draw_faults(model, state, world, vehicle)
        state.collided[world, vehicle] = touches_anything(model, state, world, vehicle)
    for vehicle in range(model.vehicles):
        sense_vehicle(model, state, world, vehicle, 0)


@outlined
def begin_simulation(model: Any, state: Any, record: Any, world: int):
    """Draw the start of an episode, and take the first frame."""
    place_bodies(model, state, world)
    begin_sensing(model, state, world)


@device_function
def move_vehicle(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int):
    """Move the truth of one vehicle to a tick and measure its motion."""
    depart(model, state, world, vehicle)
    move(model, state, world, vehicle, tick)
    measure_odometry(model, state, world, vehicle, tick)


@device_function
def arrange_world(model: Any, state: Any, record: Any, world: int, tick: int):
    """Carry the landmarks to a tick, let vehicles appear, and sort everything into the grid."""
    move_landmarks(model, state, world, tick)
    appear(model, state, world, tick)
    remember(model, state, world, tick)
    sort_into_cells(model, state, world)


@device_function
def look_around(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int):
    """Judge where a vehicle is, and take its camera frame and its messages."""
    referee(model, state, world, vehicle)
    sense_vehicle(model, state, world, vehicle, tick)


SIMULATED = Source(
    "simulated",
    begin_simulation,
    move_vehicle,
    arrange_world,
    look_around,
    lambda p: Nothing,
    keeps_nearby=True,
    fused=True,
    in_lanes=(measure_odometry, referee, observe, transmit),
)
"""Ticks that are computed."""


@device_function
def sense_nothing(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int):
    """Leave a stage out."""
