"""Messages between the plug-in observers of one world: contents on the host, delivery as the radio decided.

The receiver checks each message. An invalid message is refused and counted; otherwise it has the effect of a loss.
"""

from collections.abc import Mapping
from operator import index
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Message, ObserverInit, Received, check_message, check_received, sealed

MOST_CONTENTS = 100_000  # bytes of a message


class LastReceived(NamedTuple):
    """The last message of a sender that reached a receiver."""

    sent: int
    """Tick of sending."""
    message: Message | None
    """The last valid one; None: there was none."""
    stamp: int
    """Tick at which that one was sent, by the clock of the receiver."""


class Mailbox:
    """Carries the observers' messages; the radio decides when each of them arrives."""

    def __init__(self, observer_init: ObserverInit) -> None:
        self.observer_init = observer_init
        self.sent: list[dict[int, Message | None]] = [{} for _ in observer_init.setups]
        """Per sender: tick of sending to message, of messages that may still be under way; None: invalid."""
        self.replayable: list[dict[int, Message]] = [{} for _ in observer_init.setups]
        """Per sender that may replay: tick to its message before the fault."""
        self.received: list[dict[int, LastReceived]] = [{} for _ in observer_init.setups]
        """Per receiver: sender to its last message."""
        self.bytes = np.zeros(len(observer_init.setups))
        self.refused = np.zeros(len(observer_init.setups), dtype=np.int64)
        """Per receiver: invalid messages."""
        self.forms: dict[int, tuple[int, ...]] = {}
        """Per vehicle: shape of its covariances in messages, which it expects of its neighbours, too."""
        self._senders = [[int(t) for t in setup.targets if t >= setup.landmarks] for setup in observer_init.setups]
        """Per receiver: the targets that are vehicles."""

    def post(self, vehicle: int, k: int, message: Message, replay: int = 0, kept: int = 0) -> bool:
        """Send one message and return whether it is valid; that of the start is received but not counted.

        A replay sends the message of `replay` ticks before; for that, messages are kept for `kept` ticks.
        """
        sent, before = self.sent[vehicle], self.replayable[vehicle]
        if kept > 0:
            before[k] = message
            message = before.get(max(k - replay, 0), message)
            while (oldest := next(iter(before))) < k - kept:
                del before[oldest]
        sent[k] = _valid_copy(message)
        while (oldest := next(iter(sent))) < k - self.observer_init.flight - 1:
            del sent[oldest]
        if k > 0:
            self.bytes[vehicle] += _size(message)
        return sent[k] is not None

    def inbox(
        self,
        k: int,
        vehicle: int,
        inbox_tick: ArrayLike,
        arrived: Mapping[tuple[int, int], Received] = MappingProxyType({}),
        clock: ArrayLike | None = None,
    ) -> dict[int, Received]:
        """Return the messages that a vehicle has received by tick k, by target, without stale ones.

        `inbox_tick` (N,) holds the tick of sending of the last message that the radio delivered of each sender, -1:
        none; `arrived` the messages of this tick from vehicles that are estimated elsewhere, see `Sensed.messages`;
        `clock` (N,) the ticks by which the vehicles' clocks are ahead.
        """
        b, landmarks, lasts = self.observer_init, self.observer_init.setups[vehicle].landmarks, self.received[vehicle]
        ticks, received = np.asarray(inbox_tick).tolist(), {}
        ahead = None if clock is None else np.asarray(clock).tolist()
        for target in self._senders[vehicle]:
            sender = target - landmarks
            sent, last = ticks[sender], lasts.get(sender)
            if (vehicle, sender) in arrived:
                self._receive(vehicle, sender, sent, _valid_copy(arrived[vehicle, sender].message), sent)
            elif sent in self.sent[sender] and (last is None or last.sent != sent):
                stamp = sent if ahead is None else min(max(sent + ahead[sender] - ahead[vehicle], 0), k)
                self._receive(vehicle, sender, sent, self.sent[sender][sent], stamp)
            last = lasts.get(sender)
            if last is not None and last.message is not None and last.sent == sent >= 0:
                age = (k - last.stamp) * b.dt
                if age <= b.staleness:
                    received[target] = Received(last.message, age)
        return received

    def _receive(self, vehicle: int, sender: int, sent: int, message: Message | None, stamp: int) -> None:
        """Store a message that has reached a vehicle, or refuse it: then the last one stays."""
        lasts = self.received[vehicle]
        if message is not None:
            form = () if message.covariance is None else message.covariance.shape
            if form in ((), self.forms.get(vehicle, form)):
                lasts[sender] = LastReceived(sent, message, stamp)
                return
        self.refused[vehicle] += 1
        lasts[sender] = lasts.get(sender, LastReceived(sent, None, stamp))._replace(sent=sent)

    def get_state(self) -> dict[str, Any]:
        """Return the sent and received messages, the expected forms and the counts."""
        received = [{sender: tuple(last) for sender, last in of_one.items()} for of_one in self.received]
        counts = {"bytes": self.bytes, "refused": self.refused}
        return {"sent": self.sent, "said": self.replayable, "heard": received, "forms": self.forms, **counts}

    def set_state(self, state: Any) -> None:
        """Set the state that `get_state` returned, as read-only arrays; other values raise any exception."""
        senders = range(len(self.observer_init.setups))
        sent, received, count = state["sent"], state["heard"], np.asarray(state["bytes"], np.float64)
        refused = np.asarray(state["refused"], np.int64)
        replayable = [{index(k): _checked(message) or Message() for k, message in own.items()} for own in state["said"]]
        lengths = {len(sent), len(replayable), len(received), len(count), len(refused)}
        if lengths != {len(senders)} or not np.isfinite(count).all():
            raise CoopenvError("not one mailbox per vehicle")
        self.replayable = replayable
        self.sent = [{index(k): _checked(message) for k, message in of_sender.items()} for of_sender in sent]
        self.received = [
            {
                senders[j]: LastReceived(index(k), _checked(message), index(stamp))
                for j, (k, message, stamp) in of_one.items()
            }
            for of_one in received
        ]
        self.forms = {senders[j]: tuple(map(index, form)) for j, form in state["forms"].items()}
        self.bytes, self.refused = count, refused


def _size(message: Any) -> int:
    """Return the bytes of a message, 0 if they cannot be counted."""
    try:
        return int(message.size_bytes)
    except (ValueError, TypeError, AttributeError):
        return 0


def _valid_copy(message: Any) -> Message | None:
    """Return a read-only copy of a message; None if it is invalid."""
    try:
        if _size(message) > MOST_CONTENTS:
            return None
        p, R, P = map(_floats, (message.position, message.rotation, message.covariance))
        copied = Message(p, R, P, {name: sealed(np.array(value)) for name, value in message.extra.items()})
        check_received(copied)
    except (CoopenvError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError):
        return None
    return copied


def _checked(message: Message | None) -> Message | None:
    if message is None:
        return None
    check_message(message)
    for array in (message.position, message.rotation, message.covariance, *message.extra.values()):
        if array is not None:
            sealed(array)
    return message


def _floats(value: Array | None) -> Array | None:
    """Return a read-only copy in double precision, or in single precision if it came so."""
    if value is None:
        return None
    return sealed(np.array(value, np.float32 if getattr(value, "dtype", None) == np.float32 else np.float64))
