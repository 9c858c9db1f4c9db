"""Faults change messages and maps, offset clocks and restart observers.

The world draws them (`coopenv.world.v2x`), so that observers in its kernels and on the host have the same faults.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation import REPLAY
from coopenv.estimation.poses import Array, exp_so3
from coopenv.observers.contract import Message
from coopenv.scenario import Scenario

PER_TICK = ("shift", "turn", "std", "replay", "restarts")
"""Faults that change from tick to tick."""


@dataclass(frozen=True)
class Interference:
    """Faults at one tick, or (K, ...) at several, see `[faults]` of a scenario; no observer reads it."""

    shift: Array  # (..., N, 3) added to positions that a vehicle broadcasts, m, map
    turn: Array  # (..., N, 3) rotation vector by which orientations that it broadcasts are turned, rad
    std: Array  # (..., N) claimed standard deviation of its pose, rad and m; 0: the true one
    replay: NDArray[np.int64]  # (..., N) ticks by which the content of its messages is old; 0: new
    clock: NDArray[np.int64]  # (N,) ticks by which its clock is ahead
    restarts: NDArray[np.bool_]  # (..., N) whether its observer starts anew before this tick
    kept: NDArray[np.int64]  # (N,) ticks for which it keeps its messages to replay them
    consistent: NDArray[np.bool_]  # (N,) whether the other entries of its messages agree with a false pose
    map_error: Array  # (N, L, 3) of the landmarks' places on its map, m
    map_tick: NDArray[np.int64]  # (N, L) tick from which on the map has that error; -1: never

    def at(self, k: int) -> "Interference":
        """Return the faults at tick k."""
        return replace(self, **{name: getattr(self, name)[k] for name in PER_TICK})

    def map_error_of(self, vehicle: int, k: int) -> Array:
        """Return (L, 3) the errors of a vehicle's map at tick k, m."""
        begun = self.map_tick[vehicle]
        return np.where(((begun >= 0) & (begun <= k))[:, None], self.map_error[vehicle], 0.0)


def altered(
    observer: Any,
    message: Message,
    shift: Array,
    turn: Array | None = None,
    std: float = 0.0,
    consistent: bool = True,
) -> Message:
    """Return a message that states another pose, and a covariance std^2 I of whatever size (std 0: its own).

    Other entries of a consistent one are changed by the observer: its method `tampered(false message, honest message)`,
    if it has one, makes them agree.
    """
    position, R, P = message.position, message.rotation, message.covariance
    turned = turn is not None and bool(np.any(turn))
    if not (np.any(shift) or turned or std > 0.0):
        return message
    made = replace(
        message,
        position=None if position is None else position + np.asarray(shift),
        rotation=R if R is None or not turned else R @ exp_so3(np.asarray(turn)),
        covariance=P if P is None or std == 0.0 else std**2 * np.eye(len(P), dtype=P.dtype),
    )
    tampered = getattr(observer, "tampered", None)
    return made if tampered is None or not consistent else tampered(made, message)


def interference_of(
    scenario: Scenario, model: Any, view: Callable[[str], NDArray[Any]], world: int, k: int
) -> Interference | None:
    """Return the faults of one world at tick k, from its state by name; None without any."""
    if not any(faults.any for faults in scenario.all_faults):
        return None
    fault = model.fault.numpy()
    begun = view("lie_tick")[world]
    lies = (begun >= 0) & (k >= begun)
    old = np.where(fault["lie"] == REPLAY, fault["lie_replay"], 0).astype(np.int64)
    landmarks = slice(model.landmarks)
    return Interference(
        shift=np.array(view("broadcast_shift")[world], dtype=float),
        turn=np.array(view("broadcast_turn")[world], dtype=float),
        std=np.where(lies, fault["lie_std"], 0.0),
        replay=np.where(lies, old, 0),
        clock=view("clock")[world].astype(np.int64),
        restarts=view("restart_tick")[world] == k,
        kept=old,
        consistent=fault["lie_consistent"].astype(bool),
        map_error=np.array(view("map_error")[world, :, landmarks], dtype=float),
        map_tick=view("map_tick")[world, :, landmarks].astype(np.int64),
    )


def stacked(ticks: list[Interference | None]) -> Interference | None:
    """Return the faults of one world at several ticks as one."""
    if ticks[0] is None:
        return None
    return replace(ticks[0], **{name: np.stack([getattr(tick, name) for tick in ticks]) for name in PER_TICK})
