"""A fake car as a process, or a thread: opened by its deployment, and run in real time."""

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from coopenv.backends.svea.binding import bind
from coopenv.backends.svea.opening import scenario_of
from coopenv.errors import CoopenvError
from coopenv.fake.car import REAL, Fake
from coopenv.fake.faults import Fault
from coopenv.svea.deployment import load_deployment
from coopenv.svea.keys import check_known, load_signer, load_verifier
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
    complain: Callable[[str], None] = lambda _: None,
) -> Fake:
    """Return a fake of a car of a deployment file; arguments as for `Fake`.

    Raises:
        CoopenvError: the file or its environment is not valid, the car is unknown, or a key is missing.
    """
    fleet = load_deployment(path)
    fleet.car(car)
    scenario = scenario_of(fleet, None, {})
    if scenario.backend != "simulated":
        raise CoopenvError(f"{path}: environment: backend '{scenario.backend}' has no fakes; known: simulated")
    binding = bind(scenario, fleet.cars, fleet.markers, Path(path).name, None)
    signer = verifier = None
    if gate and (folder := fleet.keys) is not None:
        verifier = load_verifier(folder)
        check_known(verifier, fleet.security.identity, folder)
        signer = load_signer(folder, car)
    more: dict[str, Any] = {"seed": seed, "faults": faults, "gate": gate, "complain": complain}
    return Fake(fleet, binding, car, transport, signer=signer, verifier=verifier, **more)


def run(fake: Fake, stop: threading.Event) -> None:
    """Let a car live in real time until it is told to stop, or an exception such as a signal's ends it."""
    try:
        while not stop.is_set():
            fake.advance()
            stop.wait(max((fake.next - REAL.steady()) * 1e-9, REST))
    finally:
        fake.close()
