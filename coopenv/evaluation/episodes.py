"""Episodes in every world of a batch: stepping, and the records that drivers are judged by."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.seeds import evaluation_seed, world_keys
from coopenv.episode import Views
from coopenv.estimation import Outcome, Sight
from coopenv.policies import Policy, decide, restart
from coopenv.scenario import Scenario

BLOCK_WORLDS, BLOCKS = 2**16, 2**14
"""Number of worlds of a block of held-out seeds, and of blocks; the seeds after them judge agents while they learn."""
DIVERGED = 1e9  # m or deg: stands for an error that is not a number


@dataclass(frozen=True)
class Episodes:
    """Record of the driven vehicles in many worlds, for the score of a driver, which has no single `Episode`.

    K decisions, W worlds, N driven vehicles. Row k is the end of decision k.
    """

    vehicles: tuple[str, ...]
    """(N,) names."""
    period: float
    """Of a decision, s."""
    under_way: np.ndarray
    """(K, W, N) bool: the vehicle had not ended before this decision."""
    position_error: np.ndarray
    """(K, W, N), m."""
    orientation_error: np.ndarray
    """(K, W, N), deg."""
    targets_in_view: np.ndarray
    """(K, W, N), measured in the last frame of the decision."""
    reward: np.ndarray
    """(K, W, N)."""
    position: np.ndarray
    """(K + 1, W, N, 2), true, m, map; row 0 is the start."""
    heading: np.ndarray
    """(K, W, N), true, rad from the map's x axis."""
    pan: np.ndarray
    """(K, W, N), angle by which the camera is turned to the left, rad."""
    route: np.ndarray
    """(W, N, P, 2), m, map, at the start; its last point is repeated, NaN for vehicles without a goal."""
    arrivals: np.ndarray
    """(K, W, N), how often the vehicle had arrived by the end of the decision."""
    outcome: np.ndarray
    """(W, N), an `Outcome`, or a condition of the scenario's own; negative: the vehicle was not there."""
    sees: np.ndarray
    """(K, W, N, N) bool: the vehicle measured another driven one in the last frame of the decision."""
    goal: np.ndarray
    """(W, N) bool: the vehicle has a goal at which its episode ends."""
    horizon: int
    """Number of decisions of an episode that nothing ends sooner."""

    @property
    def worlds(self) -> int:
        """Number of worlds."""
        return int(self.outcome.shape[0])

    @property
    def time(self) -> np.ndarray:
        """(K,) s since the start, at the end of every decision."""
        return np.asarray(self.period * np.arange(1, len(self.under_way) + 1))

    @property
    def travel_time(self) -> np.ndarray:
        """(W, N) s from the start to the end of the decision in which a vehicle first arrived; NaN: never."""
        first = np.argmax(self.arrivals > 0, axis=0) + 1
        return np.where(self.arrivals[-1] > 0, first * self.period, np.nan)

    @property
    def present(self) -> np.ndarray:
        """(W, N) bool: the vehicle was there."""
        return np.asarray(self.outcome >= 0)

    @property
    def seen_share(self) -> np.ndarray:
        """(N, N) share of a vehicle's time under way for which it measured another driven one."""
        counted = (self.sees & self.under_way[..., None]).sum(axis=(0, 1))
        return np.asarray(counted / np.maximum(self.under_way.sum(axis=(0, 1)), 1)[:, None])

    @property
    def looking(self) -> np.ndarray:
        """(K, W, N) rad in [-pi, pi): where the camera looks, from the nearest piece of the route; NaN without one."""
        way = np.full(self.heading.shape, np.nan)
        nearest = np.full(self.heading.shape, np.inf)
        for begin, end in zip(np.moveaxis(self.route, 2, 0)[:-1], np.moveaxis(self.route, 2, 0)[1:], strict=True):
            leg = end - begin
            square = np.maximum((leg**2).sum(axis=-1), 1e-12)
            offset = self.position[1:] - begin
            share = np.clip((offset * leg).sum(axis=-1) / square, 0.0, 1.0)
            distance = np.linalg.norm(offset - share[..., None] * leg, axis=-1)
            nearer = (distance < nearest) & (square > 1e-9)
            way = np.where(nearer, np.arctan2(leg[..., 1], leg[..., 0]), way)
            nearest = np.where(nearer, distance, nearest)
        return np.asarray((self.heading + self.pan - way + np.pi) % (2 * np.pi) - np.pi)

    @property
    def lost_for(self) -> np.ndarray:
        """(W, N) number of decisions for which a vehicle counts as lost after its last one; 0: it is not lost.

        A vehicle is lost after a collision, off its route, and at any other end but an arrival at its goal. It counts
        for the rest of its way at the mean pace that it had, at most for another episode; without a goal, or after an
        arrival, for the rest of the episode. What is left of the way is the straight line to the goal, as a share of
        the route's length.
        """
        to_goal = self.goal & (self.arrivals[-1] == 0)
        failed = np.isin(self.outcome, (Outcome.COLLIDED, Outcome.OFF_ROUTE)) | to_goal
        steps = self.under_way.sum(axis=0)
        last = np.take_along_axis(self.position, steps[None, ..., None], axis=0)[0]
        length = np.linalg.norm(np.diff(self.route, axis=2), axis=-1).sum(axis=-1)
        left = np.clip(np.linalg.norm(last - self.route[:, :, -1], axis=-1) / np.maximum(length, 1e-6), 0.0, 1.0)
        rest = np.minimum(steps * left / np.maximum(1.0 - left, 1e-6), self.horizon)
        rest = np.where(to_goal, rest, self.horizon - steps)
        return np.where(failed & self.present, np.maximum(np.rint(rest), 1), 0).astype(int)

    @property
    def distance(self) -> np.ndarray:
        """(K, W, N) m that were driven until the end of every decision."""
        return np.asarray(np.cumsum(np.linalg.norm(np.diff(self.position, axis=0), axis=-1), axis=0))


def held_out_seeds(block: int, worlds: int) -> list[int]:
    """Return the seeds of the first so many worlds of a block; blocks share none, whatever the number of worlds.

    Raises:
        CoopenvError: there is no such block, or it has fewer worlds.
    """
    if not (0 <= block < BLOCKS and 0 <= worlds <= BLOCK_WORLDS):
        limits = f"seed_block must be below {BLOCKS} and worlds at most {BLOCK_WORLDS}"
        raise CoopenvError(f"{limits}, got {block} and {worlds}")
    return [evaluation_seed(block * BLOCK_WORLDS + world) for world in range(worlds)]


def driven_vehicles(scenario: Scenario) -> list[int]:
    """Return the indices of the vehicles that actions drive."""
    return [i for i, vehicle in enumerate(scenario.vehicles) if vehicle.motion.kind == "driven"]


def play(
    engine: Engine,
    seeds: int | Sequence[int],
    ticks: int,
    policy: Policy | None = None,
    to_the_end: bool = True,
    options: Mapping[str, Any] | None = None,
    stride: int = 1,
) -> Iterator[int]:
    """Start an episode in every world and yield the number of camera ticks since then, from 0, once they are there.

    Args:
        engine: the engine to run, on any backend; it is stopped at an error.
        seeds: of the batch, or one per world.
        ticks: after the start; fewer where the backend has no more.
        policy: drives every vehicle, its rows are (world, vehicle); None: action zero.
        to_the_end: go on when all vehicles that are estimated here have ended.
        options: for a backend that takes some at a reset.
        stride: ticks from one number to the next, at most those of a decision.

    Raises:
        CoopenvError: the policy returns something else than actions.
    """
    with engine.stopping():
        if isinstance(seeds, int):
            keys = world_keys(seeds, engine.world.worlds)
        else:
            keys = [world_keys(seed)[0] for seed in seeds]
        engine.reset(keys, options=options)
        engine.set_actions(np.zeros_like(engine.view("actions")))
        shape, here = engine.view("actions").shape, [*estimated_here(engine)]
        rows = shape[0] * shape[1]
        if policy is not None:
            restart(policy, np.ones(rows, dtype=bool))
        yield 0
        for tick in range(0, ticks, stride):
            if tick % engine.world.model.ticks_per_decision == 0:
                if not to_the_end and engine.view("ended")[:, here].all():
                    return
                if policy is not None:
                    observations = engine.view("observation").reshape(rows, -1).copy()
                    engine.set_actions(decide(policy, observations, shape[-1]).reshape(shape))
            engine.step(ticks=min(stride, ticks - tick))
            if engine.view("exhausted")[0]:
                return
            yield min(tick + stride, ticks)


def estimated_here(engine: Engine) -> tuple[int, ...]:
    """Return flags of the vehicles that are estimated here, not elsewhere and received by radio."""
    here = engine.backend.capabilities.estimated
    return tuple(range(engine.world.model.vehicles)) if here is None else here


def drive(
    engine: Engine,
    policy: Policy,
    seeds: Sequence[int],
    on_progress: Callable[[float], None] = lambda share: None,
) -> Episodes:
    """Drive an episode in every world of an engine, until all are over.

    Args:
        engine: the worlds.
        policy: drives every vehicle; its rows are (world, vehicle).
        seeds: a seed per world.
        on_progress: called with the share of the horizon that is done.

    Raises:
        CoopenvError: the policy returns something else than actions.
    """
    scenario, view = engine.backend.scenario, engine.view
    chosen, ticks = driven_vehicles(scenario), scenario.horizon_ticks
    agents = [len(scenario.landmarks) + i for i in chosen]
    kept, place, headings, sees = Views(engine, KEPT), [], [], []
    for tick in play(engine, seeds, ticks, policy, False, stride=scenario.ticks_per_decision):
        if tick == 0:
            count = view("route_count")[:, chosen].copy()
            route = _routes(view("route")[:, chosen, :, :2], count)
        kept.take()
        place.append(view("position")[:, agents, :2].astype(np.float32))
        forward = view("rotation")[:, agents][..., :2, 0]
        headings.append(np.arctan2(forward[..., 1], forward[..., 0]).astype(np.float32))
        sees.append(view("sight")[:, chosen][..., agents] == Sight.VISIBLE)
        on_progress(tick / ticks)
    record = {name: kept[name][1:, :, chosen] for name in KEPT}
    errors = {name: np.nan_to_num(record.pop(name), nan=DIVERGED, posinf=DIVERGED) for name in ERRORS}
    return Episodes(
        vehicles=tuple(scenario.vehicle_names[i] for i in chosen),
        period=scenario.ticks_per_decision / scenario.rates.camera,
        **errors,
        **record,
        position=np.stack(place),
        heading=np.stack(headings[1:]),
        route=route,
        outcome=view("ended")[:, chosen].copy(),
        sees=np.stack(sees[1:]),
        goal=(count > 0) & scenario.termination.arrival,
        horizon=scenario.decisions,
    )


ERRORS = ("position_error", "orientation_error")
KEPT = ("under_way", *ERRORS, "targets_in_view", "reward", "arrivals", "pan")


def _routes(points: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return routes (W, N, P, 2) with their last point, number `count` (W, N), repeated; NaN without any."""
    place = np.minimum(np.arange(points.shape[2]), np.maximum(count - 1, 0)[..., None])
    found = np.take_along_axis(points, place[..., None], axis=2)
    return np.where(count[..., None, None] > 0, found, np.nan)
