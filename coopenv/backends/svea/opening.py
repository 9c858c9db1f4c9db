"""From a deployment file to a backend: environment, network, keys and tape."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopenv.backends.svea.backend import Svea
from coopenv.backends.svea.binding import Binding, bind
from coopenv.backends.svea.drive import head_of
from coopenv.backends.svea.status import ROLES
from coopenv.backends.svea.tape import Tape
from coopenv.backends.svea.taped import PRESENCE, Taped
from coopenv.errors import CoopenvError
from coopenv.scenario import Scenario, load_scenario
from coopenv.svea.deployment import Deployment, load_deployment
from coopenv.svea.keys import check_known, load_signer, load_verifier
from coopenv.svea.signing import Signer, Verifier
from coopenv.svea.topics import RESET_TOPIC, TOPICS, Role, presence_of, topic_of
from coopenv.svea.transport.base import Transport
from coopenv.svea.transport.open import open_transport


def open_svea(
    path: str | Path,
    environment: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    car: str | None = None,
    record: str | Path | None = None,
    transport: Transport | None = None,
    connect: str | None = None,
) -> Svea:
    """Return the cars of a deployment file as a backend.

    Args:
        path: the file.
        environment: name or path in place of the file's own.
        overrides: dotted keys of the environment, after the file's.
        car: estimate and drive this one alone, the others are heard (None: all of them, as an edge server does).
        record: MCAP file to write what comes and goes to.
        transport: a network that is open already (None: as the file says).
        connect: endpoint in place of the file's.

    Raises:
        CoopenvError: one line that names the file and the field, or what cannot be reached.
    """
    deployment = load_deployment(path, connect)
    scenario = scenario_of(deployment, environment, overrides or {})
    binding = bind(scenario, deployment.cars, deployment.markers, Path(path).name, car)
    signer, verifier = _keys(deployment, binding, car)
    link = open_transport(deployment) if transport is None else transport
    try:
        types = _types(binding, deployment.security.identity)
        tape = None if record is None else Tape(Path(record), head_of(deployment, binding, car), types)
    except CoopenvError:
        link.close()
        raise
    if tape is not None:
        names = [binding.names[i] for i in binding.local]
        aside = {topic_of(name, role) for name in names for role in (Role.GATE, *ROLES)}
        link = Taped(link, tape, aside, {topic_of(name, Role.STOP) for name in names})
    return Svea(deployment, binding, link, signer, verifier, tape)


def scenario_of(deployment: Deployment, environment: str | None, overrides: Mapping[str, Any]) -> Scenario:
    """Return the environment of a deployment."""
    own = deployment.environment
    if own.endswith(".toml") and not Path(own).is_absolute():
        own = str(deployment.folder / own)
    return load_scenario(environment or own, {**deployment.overrides, **overrides})


def _keys(deployment: Deployment, binding: Binding, car: str | None) -> tuple[Signer | None, Verifier | None]:
    given = deployment.security.keys
    if given is None:
        return None, None
    folder = given if given.is_absolute() else deployment.folder / given
    verifier = load_verifier(folder)
    for name in binding.cars:
        check_known(verifier, name, folder)
    return load_signer(folder, car or deployment.security.identity), verifier


def _types(binding: Binding, identity: str) -> dict[str, str]:
    """Return the type of every topic of the cars, presence included."""
    names = (*binding.cars, *binding.leaders)
    types = {topic_of(name, role): topic.type for name in names for role, topic in TOPICS.items()}
    present = {presence_of(name): PRESENCE for name in (*names, identity)}
    return {**types, **present, RESET_TOPIC: "std_msgs/msg/Int64"}
