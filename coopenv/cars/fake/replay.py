"""A fake car that obeys recorded commands as fast as it can, on a clock of its own; its messages are kept."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.binding import Binding
from coopenv.cars.codec import decode, stamp_of
from coopenv.cars.fake.car import Fake
from coopenv.cars.fake.faults import FakeSettings
from coopenv.cars.gate.core import GateClock, write_drive
from coopenv.cars.profile import MotionCommand, Role
from coopenv.cars.readings import READERS, CarPose, Sample, read
from coopenv.cars.vision import Calibration

Sent = Mapping[Role, Sequence[Sample]]
"""Samples by role in the order of their stamps, by the sender's clock, with times of reception."""


def replay(
    binding: Binding,
    car: str,
    commands: Sequence[tuple[int, MotionCommand]],
    settings: FakeSettings,
    seed: int,
    start: CarPose | None = None,
) -> Sent:
    """Return what a fake sends under commands at times in ns, up to the last one; `start` is its pose (None: any)."""
    now = commands[0][0]
    clock = GateClock(lambda: now, lambda: now)
    arrived: list[tuple[str, bytes, int]] = []
    network: Any = SimpleNamespace(**dict.fromkeys(("subscribe", "announce", "watch", "close"), lambda *_: None))
    network.publish = lambda topic, payload, *_, **__: arrived.append((topic, payload, now))  # without other ends
    fake = Fake(binding, car, network, seed=seed, clock=clock, settings=settings)
    if start is not None and start.rotation is not None:
        fake.world.put(fake.world.agent, start.rotation, start.position - np.array(binding.scenario.map.origin))
    waiting = list(reversed(commands))
    while waiting:
        now = max(now + 1, min(fake.next, waiting[-1][0]))
        fake.advance()
        while waiting and waiting[-1][0] <= now:
            at, drive = waiting.pop()
            fake.obey(write_drive(at, binding.profile.command, drive), at)
    roles = {binding.profile.topic_of(car, role): role for role in READERS}
    found: dict[Role, list[Sample]] = {}
    lens = Calibration.of(binding.scenario.cameras[binding.cars[car]])
    for topic, payload, received in arrived:
        with suppress(CoopenvError):  # of no use to readers either
            role = roles[topic]
            message = decode(payload, binding.profile.topics[role].type)
            value = read(role, message, lens, known=binding.targets, vision=binding.profile.vision)
            found.setdefault(role, []).append(Sample(car, role, stamp_of(message), received, value))
    return {role: sorted(samples, key=lambda sample: sample.stamp) for role, samples in found.items()}
