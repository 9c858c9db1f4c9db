"""What goes wrong on the road, as pure functions from a recording to a recording.

The record stays what the sensors and the radio delivered; truth and odometry are never touched. Every random draw is a
function of the seed and the fault alone. The one fault that needs the observers' own messages is a sender that lies:
`Lie` changes them on their way out (see `runner.run`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.observers.contract import Message
from coopenv.observers.interference import altered
from coopenv.observers.recording import Recording

NOMINAL = "nominal"

LOSS = 0.3
DELAY = 0.2  # s
WRONG_SHARE = 0.05
LIE_OFFSET = (3.0, 4.0, 0.0)  # m, 5 m in a horizontal direction that no road has
LIE_STD = 0.01  # m and rad
LIE_FROM = 0.4  # of the horizon
LOST_FROM, LOST_FOR = 0.6, 10.0  # of the horizon, s


def with_loss(recording: Recording, probability: float = LOSS, seed: int = 0) -> Recording:
    """Lose each message, per receiver, with a probability in [0, 1]; what was heard last stays known."""
    inbox = recording.inbox_tick
    news = np.diff(inbox, axis=0, prepend=-1) > 0
    kept = news & (_generator(seed, 1).random(inbox.shape) >= probability)
    return changed(recording, inbox_tick=np.maximum.accumulate(np.where(kept, inbox, -1), axis=0))


def with_delay(recording: Recording, seconds: float = DELAY) -> Recording:
    """Deliver every message later, by a time that is rounded to whole ticks."""
    ticks = min(round(seconds / recording.dt), recording.ticks)
    inbox = np.full_like(recording.inbox_tick, -1)
    inbox[ticks:] = recording.inbox_tick[: recording.ticks - ticks]
    return changed(recording, inbox_tick=inbox)


def with_wrong_association(recording: Recording, share: float = WRONG_SHARE, seed: int = 0) -> Recording:
    """Swap bearings within frames so that a share of all bearings carry the identity of another visible target.

    Every bearing starts a swap with another one of its frame, drawn at random, with half that probability, so that
    it is part of one with (nearly) the whole. A frame with a single bearing stays as it is.
    """
    bearings = recording.bearings.copy()
    generator = _generator(seed, 2)
    starts = recording.visible & (generator.random(recording.visible.shape) < share / 2)
    partners = generator.random(recording.visible.shape)
    for k, i, target in np.argwhere(starts):
        others = np.flatnonzero(recording.visible[k, i])
        others = others[others != target]
        if len(others):
            pair = [target, others[int(partners[k, i, target] * len(others))]]
            bearings[k, i, pair] = bearings[k, i, pair[::-1]]
    return changed(recording, bearings=bearings)


def without_landmarks(recording: Recording, start: float | None = None, duration: float = LOST_FOR) -> Recording:
    """Show no landmark to anybody for a while (s), from a time on (s; None: after `LOST_FROM` of the record)."""
    begin = LOST_FROM * recording.t[-1] if start is None else start
    lost = (recording.t >= begin) & (recording.t < begin + duration)
    landmarks = np.arange(recording.visible.shape[2]) < recording.landmarks.shape[1]
    hidden = lost[:, None, None] & landmarks
    bearings = np.where(hidden[..., None], np.nan, recording.bearings)
    return changed(recording, visible=recording.visible & ~hidden, bearings=bearings)


@dataclass(frozen=True)
class Lie:
    """One vehicle broadcasts a pose that is off, and states a small covariance."""

    sender: int
    start: float
    """s; from then on it lies."""
    offset: tuple[float, float, float] = LIE_OFFSET
    """Added to the position, map axes, m."""
    std: float = LIE_STD
    """What it claims to know its position and orientation by, m and rad."""

    def applies(self, vehicle: int, time: float) -> bool:
        """Return whether a message of a vehicle at a time (s) is a lie."""
        return vehicle == self.sender and time >= self.start

    def broadcast(self, observer: Any, message: Message) -> Message:
        """Return the message as it is broadcast, see `interference.altered`."""
        return altered(observer, message, np.array(self.offset), std=self.std)


def liar(recording: Recording) -> int:
    """Return who lies by default: the second of those, in the order of estimation, that have followers.

    The first one is mostly seen by those that see the landmarks, too. Where only one has followers it is that one.

    Raises:
        CoopenvError: nobody follows anybody.
    """
    leaders = [i for i in recording.order if followers(recording, i)]
    if not leaders:
        raise CoopenvError("no vehicle has another one as its neighbour, so none can lie to another")
    return leaders[min(1, len(leaders) - 1)]


def followers(recording: Recording, vehicle: int) -> list[int]:
    """Return the vehicles that have this one as a neighbour."""
    return [i for i, setup in enumerate(recording.setups) if setup.landmarks + vehicle in setup.targets]


@dataclass(frozen=True)
class Fault:
    """What a variant does to a recording: a change of the record, or a sender that lies, or neither."""

    summary: str
    change: Callable[[Recording, int], Recording] | None = None
    """(recording, seed) -> recording"""
    lies: bool = False

    def applied(self, recording: Recording, seed: int) -> tuple[Recording, Lie | None]:
        """Return the changed record, and the lie for `runner.run`."""
        made = recording if self.change is None else self.change(recording, seed)
        return made, Lie(liar(recording), LIE_FROM * float(recording.t[-1])) if self.lies else None


FAULTS = {
    NOMINAL: Fault("as simulated"),
    "v2x_loss": Fault(f"{LOSS:.0%} of the messages are lost", lambda recording, seed: with_loss(recording, LOSS, seed)),
    "v2x_delay": Fault(f"messages arrive {1e3 * DELAY:.0f} ms late", lambda recording, seed: with_delay(recording)),
    "wrong_association": Fault(
        f"{WRONG_SHARE:.0%} of the bearings carry the identity of another target in view",
        lambda recording, seed: with_wrong_association(recording, WRONG_SHARE, seed),
    ),
    "lying_neighbour": Fault(
        f"one vehicle broadcasts a position off by {np.linalg.norm(LIE_OFFSET):g} m, sure of it to "
        f"{100 * LIE_STD:g} cm, after {LIE_FROM:.0%} of the run",
        lies=True,
    ),
    "landmarks_lost": Fault(
        f"no landmark is seen for {LOST_FOR:g} s, from {LOST_FROM:.0%} of the run on",
        lambda recording, seed: without_landmarks(recording),
    ),
}
"""By the name of the variant."""


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream])


def changed(recording: Recording, **arrays: Any) -> Recording:
    """Return the record with other arrays, which nobody can write to."""
    for array in arrays.values():
        array.setflags(write=False)
    return replace(recording, **arrays)
