"""Fake cars in this process, on a network within it: all that is real but the sockets, and mostly the time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coopenv.cars.backend.backend import Svea, open_svea
from coopenv.cars.fake.car import Fake, fault_topic
from coopenv.cars.fake.fleet import prepare_fake
from coopenv.cars.fake.lockstep import Hub, LockstepFakes
from coopenv.cars.link.transport import Transport
from coopenv.cars.messages.codec import encode, make

PATIENT = """
[safety] # a machine that runs many tests at once is slow
odometry_age = 2.0
missed_deadlines = 60
max_clock_offset = 0.5
"""

SAFETY = "\n[safety]\n"

LAB = 'environment = "svea_overtaking"\nmarkers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }\n'
LAB_CARS = """
[[cars]]
name = "svea7"
marker = 7

[[cars]]
name = "svea1"
marker = 6
"""
OVERTAKING = f"{LAB}fakes = true\n{LAB_CARS}"


def write_fleet(folder: Path, text: str = OVERTAKING, safety: str = SAFETY) -> Path:
    """Write a deployment file and return its path."""
    path = folder / "fleet.toml"
    path.write_text(text + safety)
    return path


def open_fake(path: Path, car: str, transport: Transport, station: str | None = None, **options: Any) -> Fake:
    """Return a fake of a car of a deployment file."""
    return prepare_fake(path, car, station=station)(transport, **options)


@contextmanager
def fakes(path: Path) -> Iterator[tuple[Hub, Mapping[str, Fake]]]:
    """Return the cars of a deployment file on a simulated clock, which their station moves on."""
    made = LockstepFakes(path)
    yield made.hub, made.cars


def cars(path: Path, hub: Hub, **options: Any) -> Svea:
    """Return the cars as a backend, on the clock of their network."""
    return open_svea(path, transport=hub.connect(), **options)


def send_fault(hub: Hub, car: str, fault: str) -> None:
    """Give a fake car a fault."""
    hub.connect().publish(fault_topic(car), encode(make("std_msgs/msg/String", data=fault)))
