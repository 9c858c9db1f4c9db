"""Messages between the plug-in observers of one world: contents on the host, delivery as the radio decided."""

from collections.abc import Mapping
from operator import index
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from coopenv.errors import CoopenvError
from coopenv.estimation.arrays import Array
from coopenv.observers.checks import check_message
from coopenv.observers.contract import Message, Received
from coopenv.observers.recording import Briefing, sealed


class Mailbox:
    """Carries the observers' messages; which of them arrive when is the radio's business."""

    def __init__(self, briefing: Briefing) -> None:
        self.briefing = briefing
        self.sent: list[dict[int, Message]] = [{} for _ in briefing.setups]
        """Per sender: tick of sending to message, of those that may still be under way."""
        self.heard: list[dict[int, tuple[int, Message]]] = [{} for _ in briefing.setups]
        """Per receiver: sender to the last message that arrived, with its tick of sending."""
        self.bytes = np.zeros(len(briefing.setups))
        self._senders = [[int(t) for t in setup.targets if t >= setup.landmarks] for setup in briefing.setups]
        """Per receiver: the targets that are vehicles."""

    def post(self, vehicle: int, k: int, message: Message) -> None:
        """Send one message; that of the start is heard but not counted."""
        sent = self.sent[vehicle]
        sent[k] = _copied(message)
        while (oldest := next(iter(sent))) < k - self.briefing.flight - 1:
            del sent[oldest]
        if k > 0:
            self.bytes[vehicle] += message.size_bytes

    def inbox(
        self,
        k: int,
        vehicle: int,
        inbox_tick: ArrayLike,
        arrived: Mapping[tuple[int, int], Received] = MappingProxyType({}),
    ) -> dict[int, Received]:
        """Return what a vehicle has heard by tick k, by target, without what is stale.

        `inbox_tick` (N,) says when the last message was sent that the radio delivered of each sender, -1: none;
        `arrived` is what came at this tick from vehicles that are estimated elsewhere, see `Sensed.messages`.
        """
        b, landmarks, heard = self.briefing, self.briefing.setups[vehicle].landmarks, self.heard[vehicle]
        ticks, received = np.asarray(inbox_tick).tolist(), {}
        for target in self._senders[vehicle]:
            sender = target - landmarks
            sent = ticks[sender]
            if (vehicle, sender) in arrived:
                heard[sender] = (sent, _copied(arrived[vehicle, sender].message))
            elif sent in self.sent[sender] and (sender not in heard or heard[sender][0] != sent):
                heard[sender] = (sent, self.sent[sender][sent])
            age = (k - sent) * b.dt
            if sent >= 0 and age <= b.staleness and sender in heard and heard[sender][0] == sent:
                received[target] = Received(heard[sender][1], age)
        return received

    def get_state(self) -> dict[str, Any]:
        """Return what has been sent and heard."""
        return {"sent": self.sent, "heard": self.heard, "bytes": self.bytes}

    def set_state(self, state: Any) -> None:
        """Take over what `get_state` returned, so that nobody can change it; anything else raises what it raises."""
        senders = range(len(self.briefing.setups))
        sent, heard, count = state["sent"], state["heard"], np.asarray(state["bytes"], np.float64)
        if not (len(sent) == len(heard) == len(senders) == len(count)) or not np.isfinite(count).all():
            raise CoopenvError("not one mailbox per vehicle")
        self.sent = [{index(k): _checked(message) for k, message in of_sender.items()} for of_sender in sent]
        self.heard = [
            {senders[j]: (index(k), _checked(message)) for j, (k, message) in of_receiver.items()}
            for of_receiver in heard
        ]
        self.bytes = count


def _checked(message: Message) -> Message:
    check_message(message)
    for array in (message.position, message.rotation, message.covariance, *message.extra.values()):
        if array is not None:
            sealed(array)
    return message


def _copied(message: Message) -> Message:
    """Return a copy that nobody can change, the sender included."""
    position, rotation, covariance = map(_floats, (message.position, message.rotation, message.covariance))
    extra = {name: sealed(np.array(value)) for name, value in message.extra.items()}
    return Message(position, rotation, covariance, extra)


def _floats(value: Array | None) -> Array | None:
    """Return a copy in double precision, or in single precision if it came so."""
    if value is None:
        return None
    return sealed(np.array(value, np.float32 if getattr(value, "dtype", None) == np.float32 else np.float64))
