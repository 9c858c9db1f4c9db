"""The other cars of the room, where motion capture says that they are."""

import numpy as np

from coopenv.backends.svea.binding import Binding
from coopenv.errors import CoopenvError
from coopenv.fake.world import Room
from coopenv.svea.codec import decode
from coopenv.svea.quaternions import rotation_of
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.base import Arrival, Transport
from coopenv.world.model import PRESCRIBED


class Neighbours:
    """Hears of the other cars; they are in the room from their first message on."""

    def __init__(self, room: Room, binding: Binding, name: str, transport: Transport) -> None:
        """Listen.

        Args:
            room: where they are put.
            binding: who is who.
            name: of the own car.
            transport: the network.
        """
        L = room.model.landmarks
        agents = {**binding.leaders, **{car: L + vehicle for car, vehicle in binding.cars.items()}}
        self._room, self._origin = room, np.array(room.scenario.map.origin)
        self._agents = {topic_of(car, Role.TRUTH): agent for car, agent in agents.items() if car != name}
        self._heard: dict[str, bytes] = {}
        self._moving = np.flatnonzero(room.model.motion.kind.numpy()[:L] == int(PRESCRIBED))
        transport.subscribe(topic_of("*", Role.TRUTH), self._hear)  # one, as every subscription costs a thread

    def _hear(self, arrival: Arrival) -> None:
        if arrival.topic in self._agents:
            self._heard[arrival.topic] = arrival.payload  # read when the camera looks: many are never looked at

    def begin(self) -> None:
        """Forget where they are; moving landmarks are cars as well, and not there without one."""
        self._heard.clear()
        for landmark in self._moving:
            if landmark != self._room.agent:
                self._room.view("present")[0, landmark] = 0

    def place(self) -> None:
        """Put them where they have been last."""
        while self._heard:
            try:
                topic, payload = self._heard.popitem()
                message = decode(payload, TOPICS[Role.TRUTH].type)
                place = message.pose.pose.position
                R = rotation_of(message.pose.pose.orientation, "orientation")
            except CoopenvError:
                continue  # whatever somebody else has sent
            self._room.put(self._agents[topic], R, np.array([place.x, place.y, place.z]) - self._origin)
