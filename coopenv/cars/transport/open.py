"""From a deployment file to its network."""

from collections.abc import Callable

from coopenv.base.errors import CoopenvError
from coopenv.cars.deployment import Deployment, DeploymentError, Tls
from coopenv.cars.transport.base import Transport
from coopenv.cars.transport.zenoh import Certificates


def open_transport(deployment: Deployment, timeout: float = 2.0) -> Transport:
    """Connect to the network of a fleet; topics are those of the profile on every kind of network.

    Args:
        deployment: says where, how and with which certificates.
        timeout: s to wait for the router, broker or master.

    Raises:
        DeploymentError: certificates that cannot be used, or what the kind of network cannot do.
        LinkError: nobody answers there.
        CoopenvError: an extra is not installed.
    """
    network, certificates = deployment.network, certificates_of(deployment)
    if network.kind == "ros1":
        from coopenv.cars.transport.ros1 import open_ros1

        return _translated(lambda types: open_ros1(network.connect[0], types, timeout), deployment)
    if network.kind == "nats":
        from coopenv.cars.transport.nats import open_nats

        return _translated(lambda _: open_nats(network.connect, certificates, timeout), deployment)
    from coopenv.cars.transport.zenoh import open_zenoh

    return open_zenoh("client", network.connect, tls=certificates, timeout=timeout)


def _translated(connect: Callable[[dict[str, str]], Transport], deployment: Deployment) -> Transport:
    """Return a connection to the authors' cars under our names."""
    from coopenv.cars.transport.authors import Authors, routes_of

    routes = [
        route for car in deployment.cars for route in routes_of(car, deployment.profile)
    ]  # before anything is opened
    return Authors(connect({route.name: route.theirs.type for route in routes}), routes)


def certificates_of(deployment: Deployment) -> Certificates | None:
    """Return the files of `network.tls`, checked (None: there is no such section); errors as for `open_transport`."""
    tls = deployment.network.tls
    if tls is None:
        return None
    try:
        return _found(tls, deployment)
    except CoopenvError as error:
        raise DeploymentError(f"network.{error}") from None


def _found(tls: Tls, deployment: Deployment) -> Certificates:
    own = None if tls.certificate is None else deployment.folder / tls.certificate
    key = None if tls.key is None else deployment.folder / tls.key
    return Certificates(deployment.folder / tls.root_ca, own, key)
