"""A fake car as a process, or a thread: opened by its deployment, and run in real time."""

import threading
from pathlib import Path

from coopenv.backends.svea.binding import Binding, bind
from coopenv.errors import CoopenvError
from coopenv.fake.car import REAL, Fake
from coopenv.scenario import load_scenario
from coopenv.svea.deployment import Deployment

REST = 0.002
"""s between two looks at the clock, at least: what falls due meanwhile is done together."""


def binding_of(deployment: Deployment, car: str) -> Binding:
    """Return who is who in the fleet of a car that is to be faked.

    Raises:
        CoopenvError: the car is unknown, or the environment does not fit the fleet.
    """
    deployment.car(car)
    name = deployment.environment
    beside = deployment.folder / name
    scenario = load_scenario(beside if Path(name).suffix == ".toml" else name, deployment.overrides)
    if scenario.backend != "simulated":
        raise CoopenvError(f"environment {name}: fakes are of simulated ones, this says backend = '{scenario.backend}'")
    return bind(scenario, deployment.cars, deployment.markers, "deployment", None)


def run(fake: Fake, stop: threading.Event) -> None:
    """Let a car live in real time until it is told to stop, or an exception such as a signal's ends it."""
    try:
        while not stop.is_set():
            fake.advance()
            stop.wait(max((fake.next - REAL.steady()) * 1e-9, REST))
    finally:
        fake.close()
