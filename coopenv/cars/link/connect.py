"""The transport of a deployment, over its kind of network."""

from coopenv.base.errors import CoopenvError
from coopenv.cars.link.transport import Tls, Transport
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.settings.deployment import Deployment, DeploymentError


def open_transport(deployment: Deployment, timeout: float = 2.0) -> Transport:
    """Connect to the network of a fleet; topics are the profile's on every kind of network.

    Args:
        deployment: the network and its certificates.
        timeout: s to wait for the router, broker or master.

    Raises:
        DeploymentError: certificates that cannot be used, or what the kind of network cannot do.
        LinkError: no answer there.
        CoopenvError: an extra is not installed.
    """
    network, certificates = deployment.network, certificates_of(deployment)
    if network.kind == "zenoh":
        return open_zenoh("client", network.connect, tls=certificates, timeout=timeout)
    from coopenv.cars.link.ros1 import Authors, routes_of

    routes = [route for car in deployment.cars for route in routes_of(car, deployment.profile)]  # before any is opened
    if network.kind == "nats":
        from coopenv.cars.link.nats import open_nats

        return Authors(open_nats(network.connect, certificates, timeout), routes)
    from coopenv.cars.link.ros1 import open_ros1

    types = {route.name: route.theirs for route in routes}
    return Authors(open_ros1(network.connect[0], types, timeout), routes)


def certificates_of(deployment: Deployment) -> Tls | None:
    """Return the files of `network.tls`, checked (None: there is no such section); errors as for `open_transport`."""
    try:
        return deployment.network.tls and deployment.network.tls.checked(deployment.folder)
    except CoopenvError as error:
        raise DeploymentError(f"network.{error}") from None
