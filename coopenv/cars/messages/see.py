"""`coopenv svea see`: a node that finds the tags in a car's frames and publishes their bearings."""

import sys
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, Full, Queue
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.cars.link.transport import Arrival, Transport
from coopenv.cars.messages.codec import decode, encode, header, make, stamp_of
from coopenv.cars.messages.readings import Detections, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import CarProfile, Role

SILENT = 2.0  # s without a frame that are worth a line


def object_bearings(markers: Iterable[int], rays: Iterable[Iterable[float]]) -> list[Any]:
    """Return ObjectBearings of markers by rays (3,), camera to marker, optical frame; the message has the opposite."""
    rows = ((marker, *ray) for marker, ray in zip(markers, rays, strict=True))
    kind = "pixy_camera/msg/ObjectBearing"
    return [make(kind, id=n, bearing_x=-x, bearing_y=-y, bearing_z=-z) for n, x, y, z in rows]


def next_message(transport: Transport, topic: str, kind: str, patience: float) -> Any | None:
    """Return the next message of a topic that is of a type (None: none within s); whatever else comes is dropped."""
    received = Queue[Any](1)

    def keep(arrival: Arrival) -> None:
        with suppress(CoopenvError, Full):
            received.put_nowait(decode(arrival.payload, kind))

    transport.subscribe(topic, keep)
    with suppress(Empty):
        return received.get(timeout=patience)
    return None


def published_calibration(car: str, profile: CarProfile, transport: Transport, patience: float) -> Calibration:
    """Return the calibration that a car's camera publishes. Raises CoopenvError: none comes in s, or none of use."""
    topic = profile.topic_of(car, Role.CAMERA_INFO)
    info = next_message(transport, topic, profile.topics[Role.CAMERA_INFO].type, patience)
    if info is None:
        raise CoopenvError(f"{car}: no calibration of its camera for {patience:g} s on {topic}")
    calibration = read(Role.CAMERA_INFO, info, vision=profile.vision)
    assert isinstance(calibration, Calibration)
    return calibration


MOST_REASONS = 100  # that are counted; errors quote what a message holds


@dataclass(eq=False, repr=False)
class FrameReader:
    """Publishes the bearings of tags in frames, the newest first; frames that come in the meantime are left out."""

    car: str
    profile: CarProfile  # whose detections are frames
    calibration: Calibration
    transport: Transport  # stays the caller's

    def __post_init__(self) -> None:
        """Subscribe to the frames of the car."""
        self._topics = {role: self.profile.topic_of(self.car, role) for role in (Role.DETECTIONS, Role.BEARINGS)}
        self._newest = Queue[Arrival](1)
        self.counts = Counter[str]()
        """Frames that were `read` or `left out`, and the others by the reason for which they are not used."""
        self.transport.subscribe(self._topics[Role.DETECTIONS], self._keep)

    def _keep(self, arrival: Arrival) -> None:
        with suppress(Empty):
            self._newest.get_nowait()
            self.counts["left out"] += 1
        self._newest.put_nowait(arrival)  # the only thread that puts

    def run(self) -> None:
        """Read frames until an exception, such as that of a signal; each trouble is one line of standard error."""
        while True:
            try:
                self.publish(self._newest.get(timeout=SILENT))
                self.counts["silent"] = 0
            except Empty:
                self._note("silent", f"no frame for {SILENT:g} s on {self._topics[Role.DETECTIONS]}")
            except CoopenvError as error:
                self._note(str(error), str(error))

    def _note(self, reason: str, line: str) -> None:
        if reason not in self.counts and len(self.counts) >= MOST_REASONS:
            return
        self.counts[reason] += 1
        if self.counts[reason] == 1:
            print(f"{self.car}: {line}", file=sys.stderr, flush=True)

    def publish(self, arrival: Arrival) -> None:
        """Publish the bearings of a frame, stamped with the middle of its exposure. Raises CoopenvError: it is none."""
        message = decode(arrival.payload, self.profile.topics[Role.DETECTIONS].type)
        found = read(Role.DETECTIONS, message, self.calibration, vision=self.profile.vision)
        assert isinstance(found, Detections)
        topic, entries = self.profile.topics[Role.BEARINGS], object_bearings(found.markers, found.bearings.tolist())
        about = header(stamp_of(message) + found.late, message.header.frame_id)
        payload = encode(make(topic.type, header=about, bearing=entries))
        self.transport.publish(self._topics[Role.BEARINGS], payload, **topic.way)
        self.counts["read"] += 1
