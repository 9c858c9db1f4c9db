"""A fake car as a process, or a thread: opened by its deployment, and run in real time."""

import threading
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from coopenv.backends.svea.binding import bind
from coopenv.backends.svea.opening import scenario_of
from coopenv.errors import CoopenvError
from coopenv.fake.car import REAL, Fake
from coopenv.fake.faults import Fault
from coopenv.svea.deployment import load_deployment
from coopenv.svea.gate.settings import Settings
from coopenv.svea.transport.base import Transport

REST = 0.004
"""s between two looks at the clock, at least: what falls due meanwhile is done together."""


def open_fake(
    path: str | Path,
    car: str,
    transport: Transport,
    *,
    seed: int = 0,
    faults: Iterable[Fault] = (),
    gate: bool = True,
    station: str | None = None,
    complain: Callable[[str], None] = lambda _: None,
) -> Fake:
    """Return a fake of a car of a deployment file; arguments as for `prepare_fake` and `Fake`."""
    return prepare_fake(path, car, gate, station)(transport, seed=seed, faults=faults, complain=complain)


def prepare_fake(path: str | Path, car: str, gate: bool = True, station: str | None = None) -> Callable[..., Fake]:
    """Return what makes a fake of a network and further arguments of `Fake`: all that can be wrong without a network.

    Args:
        path: deployment file.
        car: its name.
        gate: as for `Fake`.
        station: whose commands count at its gate (None: those of the file's `security.identity`).

    Raises:
        CoopenvError: the file or its environment is not valid, the car is unknown, or a key is missing or another's.
    """
    fleet = load_deployment(path)
    fleet.car(car)
    scenario = scenario_of(fleet, None, {})
    if scenario.backend != "simulated":
        raise CoopenvError(f"{path}: environment: backend '{scenario.backend}' has no fakes; known: simulated")
    binding = bind(scenario, fleet.cars, fleet.markers, Path(path).name, None)
    given = Settings.of(car, Path(path)).changed({}, station=station)
    signer, verifier = given.identities() if gate else (None, None)
    trusting = fleet.security.model_copy(update={"identity": given.station})
    fleet = fleet.model_copy(update={"security": trusting})
    return partial(Fake, fleet, binding, car, gate=gate, signer=signer, verifier=verifier)


def run(fake: Fake, stop: threading.Event) -> None:
    """Let a car live in real time until it is told to stop, or an exception such as a signal's ends it."""
    try:
        while not stop.is_set():
            fake.advance()
            stop.wait(max((fake.next - REAL.steady()) * 1e-9, REST))
    finally:
        fake.close()
