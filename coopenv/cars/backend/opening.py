"""From a deployment file to a backend: environment, network, keys and recorder."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError, DataWarning, ScenarioError, listed
from coopenv.base.installation import scenario_path
from coopenv.cars.backend.backend import Svea
from coopenv.cars.backend.binding import Binding, bind
from coopenv.cars.backend.drive import PRESENCE, DriveRecorder, RecordedTransport, head_of
from coopenv.cars.backend.status import ROLES
from coopenv.cars.deployment import Deployment, load_deployment
from coopenv.cars.keys import Signer, Verifier, check_known, load_signer, load_verifier
from coopenv.cars.profile import RESET_TOPIC, Role, presence_of
from coopenv.cars.transport.base import Transport
from coopenv.cars.transport.open import open_transport
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.files import OVERRIDES


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

    A `DataWarning` tells of landmarks and vehicles that no camera can tell.

    Raises:
        CoopenvError: one line that names the file and the field, or what cannot be reached.
    """
    deployment = load_deployment(path, connect)
    scenario = scenario_of(deployment, environment, overrides or {})
    binding = bind(scenario, deployment.cars, deployment.markers, Path(path).name, car, deployment.profile)
    if binding.unmarked:
        remark = f"{Path(path).name}: no markers, so that no camera can tell them: {listed(binding.unmarked)}"
        warnings.warn(DataWarning(remark), stacklevel=2)
    signer, verifier = _keys(deployment, binding, car)
    link = open_transport(deployment) if transport is None else transport
    try:
        types = _types(binding, deployment.security.identity)
        recorder = None if record is None else DriveRecorder(Path(record), head_of(deployment, binding, car), types)
    except CoopenvError:
        link.close()
        raise
    if recorder is not None:
        names = [binding.names[i] for i in binding.local]
        aside = {binding.profile.topic_of(name, role) for name in names for role in (Role.GATE, *ROLES)}
        link = RecordedTransport(link, recorder, aside, {binding.profile.topic_of(name, Role.STOP) for name in names})
    return Svea(deployment, binding, link, signer, verifier, recorder)


def scenario_of(deployment: Deployment, environment: str | None, overrides: Mapping[str, Any]) -> Scenario:
    """Return the environment of a deployment.

    Args:
        deployment: names it, and has overrides of it.
        environment: name or path in place of its own.
        overrides: after the deployment's.

    Raises:
        CoopenvError: there is no such environment, or an override is not valid.
    """
    own, file = deployment.environment, deployment.file.name
    if own.endswith(".toml"):
        own = str(deployment.folder / own)
    try:
        scenario_path(own if environment is None else environment)
    except CoopenvError as error:
        raise error if environment is not None else CoopenvError(f"{file}: environment: {error}") from None
    try:
        return load_scenario(environment or own, {**deployment.overrides, **overrides})
    except ScenarioError as error:
        raise _of_the_file(deployment, environment or own) or error from None


def _of_the_file(deployment: Deployment, environment: str) -> CoopenvError | None:
    """Return what is wrong with a deployment's own overrides; None: nothing."""
    try:
        load_scenario(environment, deployment.overrides)
    except ScenarioError as error:
        if str(error).startswith("override"):
            return CoopenvError(f"{deployment.file.name}: {str(error).replace(OVERRIDES, 'overrides', 1)}")
    return None


def _keys(deployment: Deployment, binding: Binding, car: str | None) -> tuple[Signer | None, Verifier | None]:
    folder = deployment.keys
    if folder is None:
        return None, None
    verifier = load_verifier(folder)
    for name in binding.cars:
        check_known(verifier, name, folder)
    return load_signer(folder, car or deployment.security.identity), verifier


def _types(binding: Binding, identity: str) -> dict[str, str]:
    """Return the type of every topic of the cars, presence included."""
    names = (*binding.cars, *binding.leaders)
    profile = binding.profile
    types = {profile.topic_of(name, role): topic.type for name in names for role, topic in profile.topics.items()}
    present = {presence_of(name): PRESENCE for name in (*names, identity)}
    return {**types, **present, RESET_TOPIC: "std_msgs/msg/Int64"}
