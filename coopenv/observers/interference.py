"""Faults of a world for observers on the host: changed messages, clock offsets, restarts.

The world draws them (`coopenv.world.v2x`), so that observers in its kernels and on the host have the same faults.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.outcomes import REPLAY
from coopenv.estimation.poses import Array, exp_so3
from coopenv.observers.contract import Message
from coopenv.scenario import Scenario

FIELDS = ("broadcast_shift", "broadcast_turn")
"""Of the state, at every tick."""


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

    def at(self, k: int) -> "Interference":
        """Return the faults at tick k."""
        return replace(
            self, **{name: getattr(self, name)[k] for name in ("shift", "turn", "std", "replay", "restarts")}
        )

    def broadcast(self, observer: Any, vehicle: int, message: Message) -> Message:
        """Return the message that a vehicle broadcasts in place of one."""
        return altered(observer, message, self.shift[vehicle], self.turn[vehicle], float(self.std[vehicle]))


def altered(observer: Any, message: Message, shift: Array, turn: Array | None = None, std: float = 0.0) -> Message:
    """Return a message that states another pose, and a covariance std^2 I of whatever size (std 0: its own).

    Other entries are changed by the observer: its method `tampered(message)`, if it has one, makes them agree.
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
    return made if tampered is None else tampered(made)


def interference_of(
    scenario: Scenario, model: Any, view: Callable[[str], NDArray[Any]], world: int, k: int
) -> Interference | None:
    """Return the faults of one world at tick k, from its state by name; None without any."""
    if not any(faults.any for faults in scenario.all_faults):
        return None
    fault = model.fault.numpy()
    begun = view("lie_tick")[world]
    lies = (begun >= 0) & (k >= begun)
    shift, turn = (np.array(view(name)[world], dtype=float) for name in FIELDS)
    old = np.where(fault["lie"] == REPLAY, fault["lie_replay"], 0).astype(np.int64)
    return Interference(
        shift=shift,
        turn=turn,
        std=np.where(lies, fault["lie_std"], 0.0),
        replay=np.where(lies, old, 0),
        clock=view("clock")[world].astype(np.int64),
        restarts=view("restart_tick")[world] == k,
        kept=old,
    )


def stacked(ticks: list[Interference | None]) -> Interference | None:
    """Return the faults at several ticks as one."""
    there = [tick for tick in ticks if tick is not None]
    if not there:
        return None
    names = ("shift", "turn", "std", "replay", "restarts")
    return replace(there[0], **{name: np.stack([getattr(tick, name) for tick in there]) for name in names})
